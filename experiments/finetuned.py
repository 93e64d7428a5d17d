"""What fine-tuning adds, on more pairs than a table has: F-CT less CT in unseen mazes, pair by pair.

    python experiments/finetuned.py --robot ant [--seeds 0 1 2] [--tuned modes] [--runs runs/ant] [--maze validation-2]

In ``antmaze-large-eval``; and, for choosing settings, in ``validation-1`` to ``-3``, of which no table is made.

Needs the finished runs ``cpu-ct-SEED`` and ``cpu-SEED`` (or, as ``--tuned`` says, of another name) of
``experiments/ROBOT.py --preset cpu``, led by one controller. Both models of a seed meet the same pairs of seed 1; the
tables' are of seed 0. Writes ``experiments/results/finetuned.json``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from _variants import LONGER, RESULTS, TUNED, digest_of, origin, replace_rows, untuned

from ct_envs import MazeEnv, UserError, load_maze
from ct_jax.cli import guarded, leave, prepare_jax, print_rows
from ct_jax.evaluate import draw_pairs, evaluate
from ct_jax.model import load_model
from ct_jax.progress import Bar
from ct_jax.run import provenance

FILE = RESULTS / "finetuned.json"
PAIRS_SEED = 1
if TYPE_CHECKING:
    Tuned = str
else:  # so that --help lists them
    Tuned = tyro.extras.literal_type_from_choices(TUNED)


@dataclass(frozen=True)
class Options:
    """What to compare."""

    robot: str = "point"
    """point, ant or humanoid."""
    tuned: Tuned = "cpu"
    """Which F-CT to compare with its CT."""
    longer: bool = False
    """Compare with long-ct instead, which learns for about as many updates as F-CT does."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the models."""
    runs: Path | None = None
    """Folder of the runs (default: runs/ROBOT)."""
    maze: tuple[str, ...] = ("antmaze-large-eval",)
    """Mazes to compare in."""
    pairs: int = 500
    """Start-goal pairs."""


def measure(options: Options, variant: str, seed: int, maze_name: str) -> dict[str, Any]:
    """One model's row."""
    run = (options.runs or Path("runs") / options.robot) / f"{variant}-{seed}"
    model, maze = load_model(str(run)), load_maze(maze_name)
    env = MazeEnv(model.robot, map_cell_m=model.settings.model.map_cell_m, auto_reset=False)
    robot = env.robot
    pairs = draw_pairs(PAIRS_SEED, maze, options.pairs, radius_m=robot.radius_m, tolerance_m=robot.goal_tolerance_m)
    with Bar(f"{run.name} in {maze_name}", options.pairs) as bar:
        episodes = evaluate(
            env, maze, pairs, "ct", policy=model.policy,
            on_progress=lambda steps, over: bar.update(over, f"step {steps}"),
        )  # fmt: skip
    head = {
        "robot": model.robot, "variant": variant, "method": "ct", "maze": maze_name, "seen": False, "model_seed": seed,
        "episodes": options.pairs, "seed": PAIRS_SEED, "controller": digest_of(model.controller),
    }  # fmt: skip
    outcomes = {"success": "".join("01"[int(success)] for success in episodes.success)}
    return head | episodes.summary() | {"outcomes": outcomes} | origin(provenance()) | {"trained": origin(model.made)}


def main(options: Options) -> None:
    """Measure all, seed by seed and maze by maze, and write each down as it is there."""
    prepare_jax()
    for seed in options.seeds:
        for maze in options.maze:
            variants = (LONGER if options.longer else untuned(options.tuned), options.tuned)
            before, after = (measure(options, variant, seed, maze) for variant in variants)
            if before["controller"] != after["controller"]:
                raise UserError(f"the models of seed {seed} were led by different controllers")
            replace_rows(FILE, [before, after], ("robot", "maze", "variant", "model_seed", "controller"))
            print_rows([row | {"method": row["variant"]} for row in (before, after)])


if __name__ == "__main__":
    leave(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
