"""Variants that robots in mazes share. Each robot's file gives what differs between the robots."""

from collections.abc import Mapping
from typing import Any

from study import Variant, baseline_config, half_the_updates

BC = {"model.returns": False}
# No fine-tuning. One training with all updates, and randomly shifted timesteps.
CT = {"rounds": 0, "fit.updates": 2500, "fit.warmup": 20, "fit.decay": True, "fit.shift_timestep": 300}
LONG_CT = CT | {"fit.updates": 5000}
LONG = {"last_fit.updates": 5000}  # twice the updates in the last training
MODES_CT = CT | {"model.modes": 4}
MODES = {"model.modes": 4, "model.commitment": 3.0}  # commitment only for models that are trained on recoveries
CALM = {"controller_action_scale": 0.75}  # ant and humanoid fall less often; chosen in the training maze
ROAM = {"recover.random_mazes": 100}  # trajectories from one maze; recoveries also from random mazes
# Trajectories and recoveries also come from 100 random mazes. CT and F-CT have the same total number of updates.
MAZES = {
    "random_mazes": 100, "collect.trajectories": 2500, "collect.reset_interval": 10, "rounds": 6,
    "fit.updates": 600, "fit.shift_timestep": 300, "round_fit.updates": 200, "round_fit.shift_timestep": 300,
    "last_fit.updates": 2400, "last_fit.shift_timestep": 300,
}  # fmt: skip
MAZES_CT = MAZES | {"rounds": 0, "fit.updates": 4000, "fit.decay": True}


def maze_variants(
    robot: str, *, bumps: int, memory: Mapping[str, Any], skill: Mapping[str, Any] | None = None
) -> dict[str, Variant]:
    """The variants of a robot in mazes, by name.

    Args:
        bumps: steps with a collision that count as a failure, as published.
        memory: overrides for a memory of longer duration.
        skill: overrides for the low-level controller as the action head; without them, no variant has it.
    """
    f_ct = {"rounds": 1, "recover.recoveries": 500, "recover.bumps": bumps, "round_fit": half_the_updates}
    found = {
        "published": Variant("published", label="CT"),
        "bc": Variant("published", BC, label="BC-CT"),
        "f-ct": Variant("published", f_ct, label="F-CT", tuned_from="published"),
        "pt-cql": Variant("published", label="PT-CQL", baseline=baseline_config("pt-cql", robot)),
        "sac": Variant("published", label="SAC alone", baseline=baseline_config("sac", robot)),
    }
    lifted = {"cpu": {}, "mazes": MAZES, "modes": MODES, "calm": CALM, "memory": memory}
    lifted |= {} if skill is None else {"skill": skill}
    lifted["calm+memory"] = {**CALM, **memory}
    lifted |= {} if skill is None else {"calm+memory+skill": {**CALM, **memory, **skill}}
    lifted |= {"long": LONG, "calm+long": LONG | CALM}
    without_tuning = {"mazes": MAZES_CT, "modes": MODES_CT, "long": LONG_CT, "calm+long": LONG_CT | CALM}
    for name, tuned in lifted.items():
        found[f"{name}-ct"] = Variant("cpu", without_tuning.get(name, {**CT, **tuned}))
        found[name] = Variant("cpu", tuned, tuned_from=f"{name}-ct")
    return found | {
        "roam": Variant("cpu", ROAM, tuned_from="cpu-ct"),
        "modes+roam": Variant("cpu", MODES | ROAM, tuned_from="modes-ct"),
        "modes+memory-ct": Variant("cpu", {**MODES_CT, **memory}),
        "modes+memory+roam": Variant("cpu", {**MODES, **memory, **ROAM}, tuned_from="modes+memory-ct"),
    }
