"""PT-CQL's settings, tuned as fairly as the other methods': in the training maze, on pairs that no table is made of.

    python experiments/cql.py --robot ant [--alpha 0.05 0.2 1 5] [--target-rate 0.005 0.05] [--controller zoo]

Each pair of settings is trained on the planning trajectories of the method as published, and tried in the training maze
on 100 pairs of seed 7 (the tables' are of seed 0). Writes ``experiments/results/cql.json``; ``ct_jax/baselines/cql.py``
holds what was chosen.
"""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from _variants import RESULTS, plan_for, pt_cql, replace_rows

from ct_jax.cli import guarded, leave, prepare_jax, print_rows
from ct_jax.run import Run, default_mazes, load_mazes

TUNING_SEED = 7  # of the pairs


@dataclass(frozen=True)
class Options:
    """What to try."""

    robot: str = "point"
    """point, ant or humanoid."""
    alpha: tuple[float, ...] = (0.05, 0.2, 1.0, 5.0)
    """Weights of the conservative penalty."""
    target_rate: tuple[float, ...] = (0.005, 0.05)
    """Shares of the new critics in the target critics at each update."""
    reward_scale: tuple[float, ...] = (0.1,)
    """Of the reward in the critics' units."""
    imitation: tuple[int, ...] = (0,)
    """First updates in which the policy imitates the data."""
    updates: int = 2500
    """Of each training."""
    controller: str = "zoo"
    """own, zoo, or a run folder."""
    seed: int = 0
    """Of the data and the trainings."""
    out: Path = Path("runs/cql")
    """Folder of the trainings; what is finished there is not run again."""


def main(options: Options) -> None:
    """Try everything, writing down each as it is there."""
    prepare_jax()
    plan = plan_for(options.robot, "cpu", controller=options.controller)
    base: Any = plan.baselines["pt-cql"]
    settings = replace(plan.variants["published"], pairs_seed=TUNING_SEED)
    run = Run(
        folder=options.out / options.robot, robot=options.robot, preset="published", settings=settings,
        mazes=load_mazes(default_mazes(options.robot)[0]), eval_mazes={}, seed=options.seed, engine="auto",
    )  # fmt: skip
    grid = itertools.product(options.reward_scale, options.imitation, options.target_rate, options.alpha)
    for scale, imitation, rate, alpha in grid:
        tried = {"alpha": alpha, "target_rate": rate, "reward_scale": scale, "imitation": imitation}
        config = replace(base, updates=options.updates, **tried)
        tried["updates"] = options.updates
        name = "-".join(f"{name}={value:g}" for name, value in tried.items())
        keep([tried | {"model_seed": run.seed} | row for row in pt_cql(run, config, name)])


def keep(rows: list[dict]) -> None:
    """Add rows to the results file in place of those of the same settings, and print them all."""
    varied = {"a": "alpha", "r": "target_rate", "s": "reward_scale", "i": "imitation", "u": "updates"}
    kept = replace_rows(RESULTS / "cql.json", rows, ("robot", *varied.values()))
    short = lambda row: " ".join(f"{letter}{row[name]:g}" for letter, name in varied.items())  # noqa: E731
    print_rows([row | {"method": short(row)} for row in kept if row["robot"] == rows[0]["robot"]])


if __name__ == "__main__":
    leave(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
