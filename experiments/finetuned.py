"""Measure the gain from fine-tuning (F-CT − CT) in unseen mazes, on more start-goal pairs than the tables have.

    python experiments/finetuned.py --robot ant [--seeds 0 1 2] [--tuned modes] [--runs runs/ant] [--maze validation-2]

The default maze is ``antmaze-large-eval``. Use ``validation-1`` to ``-3``, which no table uses, to choose settings.

Needs the finished runs ``cpu-ct-SEED`` and ``cpu-SEED`` (or those of another ``--tuned``) of
``experiments/ROBOT.py --preset cpu``, with the same low-level controller. Both models of a seed are evaluated on the
same pairs, of seed 1; the tables use seed 0. Writes ``experiments/results/finetuned.json``.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from rows import CT, RESULTS, Row, origin_of, replace_rows
from study import as_digits, digest_arrays, load_variants

from ct_envs import MazeEnv, UserError, load_maze
from ct_jax.cli import guarded, leave, prepare_jax, print_rows
from ct_jax.evaluate import evaluate
from ct_jax.model import load_model
from ct_jax.runtime.files import prepare_outputs
from ct_jax.runtime.progress import Bar
from ct_jax.runtime.run import provenance
from ct_jax.worlds.mazes import MazeWorld

FILE = RESULTS / "finetuned.json"
LONGER = "long-ct"  # CT with about the same total number of updates as F-CT
PAIRS_SEED = 1


@dataclass(frozen=True)
class Options:
    """What to compare."""

    robot: str = "point"
    """point, ant or humanoid."""
    tuned: str = "cpu"
    """The fine-tuned variant; it is compared with the variant before fine-tuning."""
    longer: bool = False
    """Compare with long-ct instead. It has about the same total number of updates as F-CT."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the models."""
    runs: Path | None = None
    """Folder of the runs (default: runs/ROBOT)."""
    maze: tuple[str, ...] = ("antmaze-large-eval",)
    """Mazes to compare in."""
    pairs: int = 500
    """Start-goal pairs."""


def measure(options: Options, variant: str, seed: int, maze_name: str) -> Row:
    """The row of one model."""
    run = (options.runs or Path("runs") / options.robot) / f"{variant}-{seed}"
    model, maze = load_model(str(run)), load_maze(maze_name)
    env = MazeEnv(model.robot, map_cell_m=model.settings.model.map_cell_m, auto_reset=False)
    world = MazeWorld(env, maze)
    pairs = world.draw_pairs(PAIRS_SEED, options.pairs)
    with Bar(f"{run.name} in {maze_name}", options.pairs) as bar:
        episodes = evaluate(world, pairs, CT, policy=model.policy, on_progress=bar.update)
    head = {
        "robot": model.robot, "variant": variant, "method": CT, "maze": maze_name, "seen": False, "model_seed": seed,
        "episodes": options.pairs, "seed": PAIRS_SEED, "controller": digest_arrays(model.controller),
        "outcomes": {"success": as_digits(episodes.success)}, "trained": origin_of(model.made),
    }  # fmt: skip
    return Row.read(head | episodes.summary() | origin_of(provenance()))


def before_of(options: Options) -> str:
    """The variant to compare with. Raises UserError if ``--tuned`` does not name a fine-tuned variant."""
    tuned = {name: variant.tuned_from for name, variant in load_variants(options.robot).items() if variant.tuned_from}
    if options.tuned not in tuned:
        raise UserError(f"--tuned {options.tuned}: not a fine-tuned variant; give one of {', '.join(tuned)}")
    return LONGER if options.longer else tuned[options.tuned]


def main(options: Options) -> None:
    """Measure all seeds and mazes. Write each pair of rows as soon as it is measured."""
    prepare_outputs(FILE)
    prepare_jax()
    variants = (before_of(options), options.tuned)
    for seed in options.seeds:
        for maze in options.maze:
            before, after = (measure(options, variant, seed, maze) for variant in variants)
            if before.controller != after.controller:
                raise UserError(f"the models of seed {seed} have different low-level controllers; train both again")
            print_rows([row.values() | {"method": row.variant} for row in (before, after)])
            replace_rows(FILE, [before, after], ("robot", "maze", "variant", "model_seed", "controller"), Row)


if __name__ == "__main__":
    leave(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
