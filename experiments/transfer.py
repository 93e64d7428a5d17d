"""Transfer between the point robot and the ant (paper, sec. IV-A, figure 6): success against updates.

    python experiments/transfer.py [--robots ant point] [--point runs/point/cpu-0] [--ant runs/ant/cpu-0]

Needs a finished run of each robot (``experiments/point.py``, ``experiments/ant.py``, or ``ct-jax train``). A new
transformer is trained on the planning trajectories of a robot's run, either from scratch or from the trunk of the other
robot's model (``ct_jax.transfer``). During training it is evaluated in the unseen maze. Writes
``experiments/results/transfer.json``, and keeps the curves of other runs and seeds.
"""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import tyro
from rows import CT, RESULTS, TransferRow, origin_of, replace_rows
from study import digest_arrays

from ct_envs import Maze, MazeEnv, UserError, stack_mazes
from ct_envs.maze import make_maze, parse_walls
from ct_jax import pipeline
from ct_jax import trajectories as storage
from ct_jax.cli import guarded, leave, prepare_jax
from ct_jax.evaluate import evaluate
from ct_jax.fit import Fit, fit, init_params
from ct_jax.model import TrainedModel, load_model
from ct_jax.runtime.checkpoint import Checkpoints, read_json, write_json
from ct_jax.runtime.files import prepare_outputs
from ct_jax.runtime.progress import Bar
from ct_jax.runtime.run import claim, provenance, random_mazes
from ct_jax.trajectories import Trajectories
from ct_jax.transfer import transfer
from ct_jax.worlds.mazes import MazeWorld

FILE = RESULTS / "transfer.json"


@dataclass(frozen=True)
class Options:
    """What to run."""

    point: Path = Path("runs/point/cpu-0")
    """A finished run of the point robot."""
    ant: Path = Path("runs/ant/cpu-0")
    """A finished run of the ant."""
    robots: tuple[str, ...] = ("ant", "point")
    """Robots to train a transformer for, each with the trunk of the other robot."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    marks: tuple[int, ...] = (50, 100, 200, 400, 800)
    """Numbers of updates after which to evaluate."""
    episodes: int = 100
    """Start-goal pairs."""
    out: Path = Path("runs/transfer")
    """Folder of the curves. Finished curves are not repeated."""


@dataclass(frozen=True, eq=False)
class Target:
    """A robot to train a transformer for, with its data."""

    model: TrainedModel
    data: Trajectories
    env: MazeEnv
    learner: Fit
    mazes: Maze  # mazes of the trajectories, stacked
    unseen: tuple[str, Maze]  # the first unseen maze of the run's evaluation

    @staticmethod
    def of(run: Path, updates: int) -> "Target":
        """The target of a finished run. Training uses the run's last settings, without decay of the learning rate."""
        model = load_model(str(run))
        settings = model.settings
        config = replace(settings.last_fit or settings.fit, updates=updates, decay=False, warmup=20)
        env = MazeEnv(model.robot, map_cell_m=settings.model.map_cell_m, auto_reset=False)
        learner = pipeline.make_learner(model.policy.model, config, settings.model.map_cell_m, env.robot)
        made = read_json(run / "config.json")
        seen, unseen = (
            {name: make_maze(parse_walls(text, source=name)) for name, text in made[key].items()}
            for key in ("mazes", "eval_mazes")
        )
        if not unseen:
            raise UserError(f"{run}: has no unseen maze; train with --eval-maze")
        data = storage.load(run / "collect" / "trajectories.npz")
        mazes = stack_mazes([*seen.values(), *random_mazes(settings.random_mazes)])
        return Target(model, data, env, learner, mazes, next(iter(unseen.items())))


def curve(
    target: Target, source: TrainedModel | None, seed: int, options: Options, folder: Path
) -> list[dict[str, Any]]:
    """Success after each number of updates, from a source's trunk or from scratch. Interrupted curves continue."""
    init_key, fit_key = jax.random.split(jax.random.key(seed))
    policy = target.model.policy
    params = init_params(init_key, policy.model, target.data, policy.params)
    if source is not None:
        params = transfer(source.policy.params, params)
    name, maze = target.unseen
    world = MazeWorld(target.env, maze)
    pairs = world.draw_pairs(0, options.episodes)
    # Save after every chunk, so that each mark continues from the one before.
    checkpoints = Checkpoints(folder / "checkpoints", every_s=0.0)
    rows, made = [], provenance()
    with Bar(str(folder.relative_to(options.out)), max(options.marks)) as bar:
        for mark in sorted(options.marks):
            file = folder / f"{mark}.json"
            if not file.is_file():
                params_now = fit(
                    fit_key, target.learner, params, target.data, target.mazes, updates=mark, checkpoints=checkpoints,
                    on_progress=lambda update, loss: bar.update(update, f"loss {loss:.4f}"),
                )  # fmt: skip
                episodes = evaluate(world, pairs, CT, policy=replace(policy, params=params_now))
                row = {"updates": mark, "maze": name, "episodes": options.episodes} | episodes.summary()
                write_json(file, row | origin_of(made))
            rows.append(read_json(file))
    checkpoints.close()
    return rows


def measure(options: Options) -> list[TransferRow]:
    """The rows of all curves."""
    runs, others = {"point": options.point, "ant": options.ant}, {"point": "ant", "ant": "point"}
    for robot in options.robots:
        if robot not in runs:
            raise UserError(f"--robots {robot}: give {' or '.join(runs)}")
    make = functools.cache(lambda robot: Target.of(runs[robot], max(options.marks)))
    rows = []
    for robot in options.robots:
        other = others[robot]
        for seed in options.seeds:
            for start in ("scratch", "transfer"):
                source = make(other).model if start == "transfer" else None
                head = {"robot": robot, "run": runs[robot].name, "start": other if source else "scratch", "seed": seed}
                head["source"] = runs[other].name if source else None
                folder = options.out / f"{robot}-{runs[robot].name}" / f"{start}-{seed}"
                models = [make(robot).model, *([source] if source else [])]
                # Training continues from the previous mark. A new mark in between would start from later weights.
                of = {
                    "models": [digest_arrays(model.policy.params) for model in models],
                    "episodes": options.episodes, "marks": sorted(options.marks),
                }  # fmt: skip
                claim(folder / "curve.json", of, "runs, pairs or marks")
                rows += [TransferRow.read(head | row) for row in curve(make(robot), source, seed, options, folder)]
    return rows


def main(options: Options) -> None:
    """Run the experiment."""
    prepare_outputs(FILE)
    prepare_jax()
    replace_rows(FILE, measure(options), ("robot", "run", "start", "source", "seed", "updates"), TransferRow)
    print(f"results: {FILE}\npages:   python experiments/pages.py writes them to docs/results")


if __name__ == "__main__":
    leave(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
