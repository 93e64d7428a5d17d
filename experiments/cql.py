"""Choose the settings of PT-CQL in the training maze, on pairs that no table uses.

    python experiments/cql.py --robot ant [--alpha 0.05 0.2 1 5] [--target-rate 0.005 0.05] [--controller zoo]

Each choice is trained on the planning trajectories of the method as published, and evaluated in the training
maze on 100 pairs of seed 7 (the tables use seed 0). Writes ``experiments/results/cql.json``. ``config_for``
in ``ct_jax/baselines/cql.py`` gives the settings that were chosen.
"""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from rows import RESULTS, CqlRow, replace_rows
from study import Study, baseline_rows, load_variants

from ct_envs import UserError
from ct_jax.cli import guarded, leave, prepare_jax, print_rows
from ct_jax.runtime.files import prepare_outputs

TUNING_SEED = 7  # of the pairs
FILE = RESULTS / "cql.json"
VARIED = ("alpha", "target_rate", "reward_scale", "imitation", "updates")


@dataclass(frozen=True)
class Options:
    """What to try."""

    robot: str = "point"
    """point, ant or humanoid."""
    alpha: tuple[float, ...] = (0.05, 0.2, 1.0, 5.0)
    """Weights of the conservative penalty."""
    target_rate: tuple[float, ...] = (0.005, 0.05)
    """Rates at which the target critics follow the critics at each update."""
    reward_scale: tuple[float, ...] = (0.1,)
    """Factors of the reward in the critics' targets."""
    imitation: tuple[int, ...] = (0,)
    """Numbers of initial updates in which the policy imitates the data."""
    updates: int = 2500
    """Updates of each training."""
    controller: str = "zoo"
    """own, zoo, or a run folder."""
    seed: int = 0
    """Seed of the data and of the training."""
    out: Path = Path("runs/cql")
    """Folder for the models. Finished models are not trained again."""


def main(options: Options) -> None:
    """Try all choices of settings. Write each result as soon as it is measured."""
    prepare_outputs(FILE)
    prepare_jax()
    variants = load_variants(options.robot)
    if "pt-cql" not in variants:
        raise UserError(f"--robot {options.robot}: has no PT-CQL; give point, ant or humanoid")
    variant = variants["pt-cql"]
    study = Study(robot=options.robot, preset="published", out=options.out, controller=options.controller)
    made = study.make_run("pt-cql", variant, options.seed)
    settings = replace(made.settings, pairs_seed=TUNING_SEED)
    run = replace(made, folder=options.out / options.robot, settings=settings, eval_mazes={})
    grid = itertools.product(options.reward_scale, options.imitation, options.target_rate, options.alpha)
    for scale, imitation, rate, alpha in grid:
        tried = {"alpha": alpha, "target_rate": rate, "reward_scale": scale, "imitation": imitation}
        config = replace(variant.baseline, updates=options.updates, **tried)
        tried["updates"] = options.updates
        name = "-".join(f"{name}={value:g}" for name, value in tried.items())
        keep([CqlRow.read(tried | {"model_seed": run.seed} | row) for row in baseline_rows(run, config, name)])


def keep(rows: list[CqlRow]) -> None:
    """Write rows to the results file, replacing rows with the same settings, and print all rows of the robot."""
    kept = replace_rows(FILE, rows, ("robot", *VARIED), CqlRow)
    short = lambda row: " ".join(f"{name[0]}{getattr(row, name):g}" for name in VARIED)  # noqa: E731
    print_rows([row.values() | {"method": short(row)} for row in kept if row.robot == rows[0].robot])


if __name__ == "__main__":
    leave(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
