"""What the pipeline asks of robots in mazes: roadmap and controller, collection, recoveries, evaluation."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ct_envs import Maze, MazeEnv, UserError, load_maze
from ct_envs.maze import unpadded
from ct_jax import devices
from ct_jax.checkpoint import read_json, write_json
from ct_jax.collect import collect
from ct_jax.controllers.sac import SacConfig, SacController, train_controller
from ct_jax.evaluate import METHODS, Episodes, Learned, Pairs, check_horizon, draw_pairs, evaluate, horizon_for
from ct_jax.files import check_writable, save_arrays
from ct_jax.finetune import recover
from ct_jax.model import TrainedModel, copy_controller, load_controller, save_controller
from ct_jax.policy import TransformerPolicy
from ct_jax.prm import PrmConfig, Roadmap, build_roadmap
from ct_jax.progress import Bar, Metrics
from ct_jax.run import Run, join_mazes, kept_row, slug, training
from ct_jax.settings import MAX_EPISODES
from ct_jax.trajectories import Trajectories

PICTURES = (".png", ".svg", ".pdf")
_FAR_M = 1e6  # no maze is so large
PAIR_ARRAYS = ("start", "goal", "shortest_m")  # and how many of the last are straight lines
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class MazeCourse:
    """A run in mazes: ``pipeline.Course``."""

    run: Run

    def controller(self, metrics: Metrics) -> tuple[SacController, SacConfig]:
        """The run's own controller, learned or taken over once from where it was given, and its configuration."""
        controller, config = self._controller(metrics)
        action_scale = self.run.settings.controller_action_scale * config.action_scale
        return controller.replace(action_scale=action_scale), replace(config, action_scale=action_scale)

    def _controller(self, metrics: Metrics) -> tuple[SacController, SacConfig]:
        run, config = self.run, self.run.settings.sac
        if run.done("controller") is not None:
            return load_controller(str(run.folder), run.robot, hint=run.hint("controller"))
        if run.settings.controller != "own":  # a copy: whatever comes to lie there, the run goes on with what it had
            with run.stage("controller") as (folder, info):
                devices.first(lambda: copy_controller(run.settings.controller, run.robot, folder))
                info |= {"given": run.settings.controller}
            return load_controller(str(run.folder), run.robot)
        roadmap = _roadmap(run)
        with run.stage("controller") as (folder, info):
            with training(folder, "controller", config.iterations, metrics) as watch:
                controller, tested = train_controller(
                    run.key("controller"), run.env, roadmap.maze, roadmap, config, **watch
                )
            devices.first(lambda: save_controller(folder, run.robot, config, controller, run.made | tested))
            info |= tested
        return load_controller(str(run.folder), run.robot)  # the first process's, in all

    def collect(self, key: jax.Array, controller: SacController, folder: Path, on_progress: Progress) -> Trajectories:
        """Algorithm 3: in mazes so quick that nothing need be kept on the way."""
        del folder
        config = self.run.settings.collect
        env = self.run.env(maps=False, auto_reset=False, horizon=config.horizon)
        prm, mazes = self.run.settings.prm, self.run.stack(self.run.settings.random_mazes)
        return collect(key, env, mazes, controller, config, prm, on_progress=on_progress)

    def recover(
        self, key: jax.Array, policy: TransformerPolicy, controller: SacController, folder: Path, on_progress: Progress
    ) -> Trajectories:
        """Algorithm 4's failures and recoveries."""
        del folder
        settings = self.run.settings
        return recover(
            key, self._recovering, self.run.stacked, policy, controller, settings.recover, settings.collect,
            settings.prm, on_progress=on_progress,
        )  # fmt: skip

    @functools.cached_property
    def _recovering(self) -> MazeEnv:
        """One environment, and so one compilation, for all rounds."""
        settings = self.run.settings
        return self.run.env(auto_reset=False, horizon=settings.recover.patience + settings.collect.horizon)

    def rows(self, folder: Path, model: TrainedModel) -> Iterator[dict[str, Any]]:
        """Every method in every maze, seen ones first."""
        env = self.run.env(auto_reset=False)
        for name, maze in join_mazes(self.run.mazes, self.run.eval_mazes).items():
            for method in METHODS:
                who = {"policy": model.policy, "controller": model.controller}
                yield evaluated(self.run, env, folder, name, maze, method, **who)


def _roadmap(run: Run) -> Roadmap:
    """The roadmap of the first maze: it gives the controller its edges. Built again as quickly as it would be read."""
    maze = next(iter(run.mazes.values()))
    roadmap = build_roadmap(run.key("prm"), maze, radius_m=run.spec.radius_m, config=run.settings.prm)
    if run.done("prm") is None:
        with run.stage("prm") as (folder, info):
            file = folder / "roadmap.npz"
            devices.first(lambda: save_arrays(file, points=roadmap.points, edges=roadmap.edges))
            info |= {"points": len(roadmap.points), "edges": len(roadmap.edges)}
    return roadmap


# ------------------------------------------------------------------------------------------------------ evaluation


def evaluated(
    run: Run, env: MazeEnv, folder: Path, name: str, maze: Maze, method: str, *, policy: Learned,
    controller: SacController | None = None,
) -> dict[str, Any]:  # fmt: skip
    """A method's row of the table for one maze; see ``kept_row``."""

    def measure() -> Episodes:
        pairs = _stored_pairs(run, name, maze)
        return _watched(env, maze, pairs, method, name, policy, controller, run.settings.prm)

    what = head(run.robot, method, name, run.settings.episodes, run.settings.pairs_seed)
    return kept_row(folder, name, method, what | {"seen": name in run.mazes}, measure)


def head(robot: str, method: str, maze: str, episodes: int, seed: int) -> dict[str, Any]:
    """What a row is of."""
    return {"robot": robot, "method": method, "maze": maze, "episodes": episodes, "seed": seed}


def _watched(
    env: MazeEnv, maze: Maze, pairs: Pairs, method: str, name: str, policy: Learned,
    controller: SacController | None, prm: PrmConfig, horizon: int | None = None,
) -> Episodes:  # fmt: skip
    with Bar(f"{method} in {name}", len(pairs.start)) as bar:
        return evaluate(
            env, maze, pairs, method, policy=policy, controller=controller, prm=prm,
            horizon=horizon or horizon_for(env.robot, pairs),
            on_progress=lambda steps, over: bar.update(over, f"step {steps}"),
        )  # fmt: skip


def _stored_pairs(run: Run, name: str, maze: Maze) -> Pairs:
    """The evaluation's pairs: drawn once, written down, and read back ever after."""
    robot, n, seed = run.spec, run.settings.episodes, run.settings.pairs_seed
    file = run.folder / "evaluate" / f"pairs-{slug(name)}-{n}-{seed}.json"
    found = devices.first(lambda: read_json(file) if file.is_file() else None)
    if found is not None:
        return _read_pairs(file, found, seed)
    pairs = draw_pairs(seed, maze, n, radius_m=robot.radius_m, tolerance_m=robot.goal_tolerance_m)
    arrays = {name: getattr(pairs, name).tolist() for name in PAIR_ARRAYS}
    devices.first(lambda: write_json(file, arrays | {"straight": pairs.straight}))
    return pairs


def _read_pairs(file: Path, found: dict[str, Any], seed: int) -> Pairs:
    """The pairs that a file holds. Raises UserError if they are none."""
    try:
        start, goal, shortest_m = (np.asarray(found[name], np.float64) for name in PAIR_ARRAYS)
        straight = int(found.get("straight", 0))
    except (KeyError, TypeError, ValueError, OverflowError) as bad:
        raise UserError(f"{file}: not an evaluation's pairs ({type(bad).__name__}); delete it and run again") from None
    n = len(shortest_m) if shortest_m.ndim else 0
    shapes = [array.shape for array in (start, goal, shortest_m)]
    near = all((np.abs(array) <= _FAR_M).all() for array in (start, goal, shortest_m))
    if n == 0 or shapes != [(n, 2), (n, 2), (n,)] or not near:
        raise UserError(f"{file}: not an evaluation's pairs (shapes {shapes}); delete it and run again")
    start, goal, shortest_m = (array.astype(np.float32) for array in (start, goal, shortest_m))
    return Pairs(start, goal, shortest_m, seed, straight=straight)


def _check_picture(file: Path) -> None:
    """Raises UserError unless a picture can be written to the file."""
    if file.suffix not in PICTURES:
        raise UserError(f"--picture {file}: give a {', '.join(PICTURES)} file")
    devices.first(lambda: check_writable(file, option="--picture"))


def evaluate_in_maze(
    model: TrainedModel, method: str, seed: int, keep: Callable[[dict[str, Any]], None] = lambda row: None, *,
    maze: str = "antmaze-large", episodes: int = 100, engine: str = "auto", picture: Path | None = None,
    video: Path | None = None, horizon: int | None = None,
) -> dict[str, Any]:  # fmt: skip
    """One method of a model in one maze; returns its row of the table.

    Args:
        keep: told the row before anything is drawn.
        horizon: control steps of an episode; by default in proportion to the longest way.
        picture: file for a picture of all episodes.
        video: file for a video of the first one.

    Raises:
        UserError: unknown maze, no episodes, or a picture or video that cannot be made there.
    """
    if picture is not None:
        _check_picture(picture)
    if not 1 <= episodes <= MAX_EPISODES:
        raise UserError(f"--episodes {episodes}: give a number from 1 to {MAX_EPISODES}")
    check_horizon(horizon)
    world = load_maze(maze)
    if video is not None:
        from ct_jax.report.video import check_video, write_video  # with matplotlib, which takes its time

        check_video(video)
    env = MazeEnv(model.robot, engine=engine, map_cell_m=model.settings.model.map_cell_m, auto_reset=False)
    robot = env.robot
    pairs = draw_pairs(seed, world, episodes, radius_m=robot.radius_m, tolerance_m=robot.goal_tolerance_m)
    name = Path(maze).stem
    outcome = _watched(env, world, pairs, method, name, model.policy, model.controller, model.settings.prm, horizon)
    row = head(model.robot, method, maze, len(pairs.start), seed) | outcome.summary()
    keep(row)
    if picture is not None and devices.is_first():
        from ct_jax.report import pictures  # likewise

        reached = f"{int(outcome.success.sum())} of {len(outcome.success)} reached the goal"
        pictures.write_paths(picture, unpadded(world), outcome, f"{model.robot}, {method} in {name}: {reached}")
    if video is not None and devices.is_first():
        assert outcome.film is not None
        film = outcome.film[: int(outcome.steps[0])]
        write_video(video, robot, world, film, pairs.goal[0], f"{model.robot}, {method} in {name}")
    return row
