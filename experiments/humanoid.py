"""The paper's experiment for the humanoid: train in ``antmaze-large``, evaluate there, in ``antmaze-large-eval`` and in
``hall``.

    python experiments/humanoid.py [--preset cpu|demo|paper] [--seeds 0 1 2] [--controller own|zoo]

``--preset cpu`` trains small models of all methods in the paper's table II on 1000 guided trajectories: published CT,
BC-CT, F-CT, PT-CQL and SAC alone. It also trains the lifted method without and with fine-tuning. Planner and explorer
are the references. All methods have the same 100 start-goal pairs. Training a low-level controller takes hours on one
core, and can be interrupted at any time; ``--controller zoo`` uses the shipped controller. ``zoo:humanoid`` is ``cpu``.
Writes ``experiments/results/humanoid-PRESET.json``.
"""

from overrides import maze_variants
from study import main

MEMORY = {"model.stride": 4}  # the memory holds every fourth step

SHIPPED = "cpu"  # the variant of zoo:humanoid

VARIANTS = maze_variants("humanoid", bumps=60, memory=MEMORY)

if __name__ == "__main__":
    main("humanoid", VARIANTS, __doc__)
