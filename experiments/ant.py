"""The paper's experiment for the ant: train in ``antmaze-large``, evaluate there and in ``antmaze-large-eval``.

    python experiments/ant.py [--preset cpu|demo|paper] [--seeds 0 1 2] [--controller own|zoo]

``--preset cpu`` trains small models of all methods in the paper's table II on 1000 guided trajectories: published CT,
BC-CT, F-CT, PT-CQL and SAC alone. It also trains the lifted method without and with fine-tuning. Planner and explorer
are the references. All methods have the same 100 start-goal pairs. Training a low-level controller takes the longest
time on two cores; ``--controller zoo`` uses the shipped controller. ``zoo:ant`` is ``calm-ct``. Writes
``experiments/results/ant-PRESET.json``.
"""

from overrides import maze_variants
from study import main

MEMORY = {"model.stride": 3}  # the memory holds every third step
# The action head is the fixed low-level controller. It has one gait, so data are rotated but not reflected.
SKILL = {"model.skill": True, "fit.turns": True, "round_fit.turns": True, "last_fit.turns": True}

SHIPPED = "calm-ct"  # the variant of zoo:ant

VARIANTS = maze_variants("ant", bumps=40, memory=MEMORY, skill=SKILL)

if __name__ == "__main__":
    main("ant", VARIANTS, __doc__)
