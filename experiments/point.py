"""The paper's experiment for the point robot: train in ``antmaze-large``, evaluate there and in ``antmaze-large-eval``.

    python experiments/point.py [--preset cpu|demo|paper] [--seeds 0 1 2] [--variants published cpu]

``--preset cpu`` trains small models of all methods in the paper's table II on 1000 guided trajectories: published CT,
BC-CT, F-CT, PT-CQL and SAC alone. It also trains the lifted method without (``cpu-ct``) and with fine-tuning (``cpu``).
Planner and explorer are the references. All methods have the same 100 start-goal pairs. ``zoo:point`` is ``mazes-ct``.
Writes ``experiments/results/point-PRESET.json``.
"""

from overrides import maze_variants
from study import main

MEMORY = {"model.stride": 3}  # the memory holds every third step
SKILL = {"model.skill": True}  # the action head is the fixed low-level controller

SHIPPED = "mazes-ct"  # the variant of zoo:point

VARIANTS = maze_variants("point", bumps=20, memory=MEMORY, skill=SKILL)

if __name__ == "__main__":
    main("point", VARIANTS, __doc__)
