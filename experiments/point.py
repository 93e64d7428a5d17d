"""The paper's experiment for the point robot: train in ``antmaze-large``, evaluate there and in ``antmaze-large-eval``.

    python experiments/point.py [--preset cpu|demo|paper] [--seeds 0 1 2] [--variants published cpu]

``--preset cpu`` trains small models of all methods in the paper's table II on 1000 guided trajectories: published CT,
BC-CT, F-CT, PT-CQL and SAC alone. It also trains the lifted method without (``cpu-ct``) and with fine-tuning (``cpu``).
Planner and explorer are the references. All methods have the same 100 start-goal pairs. ``zoo:point`` is ``mazes-ct``.
Writes ``experiments/results/point-PRESET.json``.
"""

from overrides import BC, CALM, CT, LONG, LONG_CT, MAZES, MAZES_CT, MODES, MODES_CT, ROAM
from study import Variant, baseline_config, half_the_updates, main

F_CT = {"rounds": 1, "recover.recoveries": 500, "recover.bumps": 20, "round_fit": half_the_updates}
MEMORY = {"model.stride": 3}  # the memory holds every third step
SKILL = {"model.skill": True}  # the action head is the fixed low-level controller

SHIPPED = "mazes-ct"  # the variant of zoo:point

VARIANTS = {
    "published": Variant("published", label="CT"),
    "bc": Variant("published", BC, label="BC-CT"),
    "f-ct": Variant("published", F_CT, label="F-CT", tuned_from="published"),
    "pt-cql": Variant("published", label="PT-CQL", baseline=baseline_config("pt-cql", "point")),
    "sac": Variant("published", label="SAC alone", baseline=baseline_config("sac", "point")),
    "cpu-ct": Variant("cpu", CT),
    "cpu": Variant("cpu", tuned_from="cpu-ct"),
    "mazes-ct": Variant("cpu", MAZES_CT),
    "mazes": Variant("cpu", MAZES, tuned_from="mazes-ct"),
    "modes-ct": Variant("cpu", MODES_CT),
    "modes": Variant("cpu", MODES, tuned_from="modes-ct"),
    "calm-ct": Variant("cpu", CT | CALM),
    "calm": Variant("cpu", CALM, tuned_from="calm-ct"),
    "memory-ct": Variant("cpu", CT | MEMORY),
    "memory": Variant("cpu", MEMORY, tuned_from="memory-ct"),
    "skill-ct": Variant("cpu", CT | SKILL),
    "skill": Variant("cpu", SKILL, tuned_from="skill-ct"),
    "calm+memory-ct": Variant("cpu", CT | CALM | MEMORY),
    "calm+memory": Variant("cpu", CALM | MEMORY, tuned_from="calm+memory-ct"),
    "calm+memory+skill-ct": Variant("cpu", CT | CALM | MEMORY | SKILL),
    "calm+memory+skill": Variant("cpu", CALM | MEMORY | SKILL, tuned_from="calm+memory+skill-ct"),
    "long-ct": Variant("cpu", LONG_CT),
    "long": Variant("cpu", LONG, tuned_from="long-ct"),
    "calm+long-ct": Variant("cpu", LONG_CT | CALM),
    "calm+long": Variant("cpu", LONG | CALM, tuned_from="calm+long-ct"),
    "roam": Variant("cpu", ROAM, tuned_from="cpu-ct"),
    "modes+roam": Variant("cpu", MODES | ROAM, tuned_from="modes-ct"),
    "modes+memory-ct": Variant("cpu", MODES_CT | MEMORY),
    "modes+memory+roam": Variant("cpu", MODES | MEMORY | ROAM, tuned_from="modes+memory-ct"),
}

if __name__ == "__main__":
    main("point", VARIANTS, __doc__)
