"""Mazes for runs and evaluations: controller, training, trials, and the options of an evaluation."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ct_envs import MazeEnv, UserError, load_maze
from ct_envs.maze import Maze, unpadded
from ct_envs.robots import Robot, get_robot
from ct_jax.controller import ControllerConfig, SacController, train_controller
from ct_jax.evaluate import Episodes, check_horizon
from ct_jax.model import TrainedModel, copy_controller, load_controller, save_controller
from ct_jax.pairs import Pairs, horizon_for
from ct_jax.prm import Roadmap, build_roadmap
from ct_jax.runtime import devices
from ct_jax.runtime.checkpoint import read_json, write_json
from ct_jax.runtime.files import check_writable, save_arrays
from ct_jax.runtime.progress import Metrics
from ct_jax.runtime.run import Run, join_mazes, slug, training
from ct_jax.settings import MAX_EPISODES, controller_config
from ct_jax.worlds import Trial
from ct_jax.worlds.mazes import MazeWorld

PICTURES = (".png", ".svg", ".pdf")
_FAR_M = 1e6  # no maze is so large
KNOWN_CONTROLLER = None
PAIR_ARRAYS = ("start", "goal", "shortest_m")


def sizes(robot: Robot) -> tuple[int, int]:
    """Entries of a robot's proprioception and of its action."""
    env = MazeEnv(robot, engine="mujoco")
    return env.proprio_size, env.action_size


def make_env(run: Run, **options: Any) -> MazeEnv:
    """The run's environment, with options of ``MazeEnv``."""
    return MazeEnv(run.robot, engine=run.engine, map_cell_m=run.settings.model.map_cell_m, **options)


@contextmanager
def open_training(run: Run, *, maps: bool) -> Iterator[MazeWorld]:
    """The named mazes, and those of the generator."""
    settings = run.settings
    besides = max(settings.random_mazes, settings.recover.random_mazes) if maps else settings.random_mazes
    yield MazeWorld(make_env(run, maps=maps, auto_reset=False), run.stack(besides))


# ------------------------------------------------------------------------------------------------------ controller


def controller(run: Run, metrics: Metrics) -> tuple[SacController, ControllerConfig]:
    """The run's own controller, learned or copied once from where it was given, and its configuration."""
    learned, config = _controller(run, metrics)
    config = config.scaled(run.settings.controller_action_scale)
    return learned.replace(action_scale=config.sac.action_scale), config


def _controller(run: Run, metrics: Metrics) -> tuple[SacController, ControllerConfig]:
    config = controller_config(run.settings)
    if run.done("controller") is not None:
        return load_controller(str(run.folder), run.robot, hint=run.hint("controller"))
    if run.settings.controller != "own":  # a copy: later changes at the source do not affect this run
        with run.stage("controller") as (folder, info):
            devices.first(lambda: copy_controller(run.settings.controller, run.robot, folder))
            info |= {"given": run.settings.controller}
        return load_controller(str(run.folder), run.robot)
    roadmap = _roadmap(run)
    with run.stage("controller") as (folder, info):
        with training(folder, "controller", config.sac.iterations, metrics) as watch:
            make = lambda **options: make_env(run, **options)  # noqa: E731
            learned, tested = train_controller(run.key("controller"), make, roadmap.maze, roadmap, config, **watch)
        devices.first(lambda: save_controller(folder, run.robot, config, learned, run.made | tested))
        info |= tested
    return load_controller(str(run.folder), run.robot)  # the first process's, in all


def _roadmap(run: Run) -> Roadmap:
    """The roadmap of the first maze: it gives the controller its edges. Built again as quickly as it would be read."""
    maze = next(iter(run.mazes.values()))
    roadmap = build_roadmap(run.key("prm"), maze, radius_m=run.spec.radius_m, config=run.settings.prm)
    if run.done("prm") is None:
        with run.stage("prm") as (folder, info):
            file = folder / "roadmap.npz"
            devices.first(lambda: save_arrays(file, points=roadmap.points, edges=roadmap.edges))
            devices.first(lambda: roadmap.write_graph(folder / "roadmap.graphml"))
            info |= {"points": len(roadmap.points), "edges": len(roadmap.edges)}
    return roadmap


# ---------------------------------------------------------------------------------------------------------- trials


def trials(run: Run, folder: Path) -> Iterator[Trial]:
    """Every maze, seen ones first."""
    env, settings = make_env(run, auto_reset=False), run.settings
    for name, maze in join_mazes(run.mazes, run.eval_mazes).items():
        world = MazeWorld(env, maze)
        pairs = _stored_pairs(world, folder / f"pairs-{slug(name)}-{settings.episodes}-{settings.pairs_seed}.json", run)
        head = _head(name, settings.episodes, settings.pairs_seed) | {"seen": name in run.mazes}
        yield Trial(name, world, pairs, head, settings.prm, horizon_for(run.spec, pairs))


def _head(maze: str, episodes: int, seed: int) -> dict[str, Any]:
    return {"maze": maze, "episodes": episodes, "seed": seed}


def _stored_pairs(world: MazeWorld, file: Path, run: Run) -> Pairs:
    """The pairs of the evaluation. They are drawn once and saved; later calls read the file."""
    seed = run.settings.pairs_seed
    found = devices.first(lambda: read_json(file) if file.is_file() else None)
    if found is not None:
        return _read_pairs(file, found, seed)
    pairs = world.draw_pairs(seed, run.settings.episodes)
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


# ------------------------------------------------------------------------------------------ options of an evaluation


@dataclass(frozen=True)
class Request:
    """The options of ``ct-jax evaluate`` for robots in mazes."""

    maze: str = "antmaze-large"  # name or file
    episodes: int = 100
    engine: str = "auto"
    horizon: int | None = None  # control steps of an episode; by default in proportion to the longest way
    picture: Path | None = None  # of all episodes
    video: Path | None = None  # of the first episode

    def check(self, model: TrainedModel) -> None:
        """Raise UserError for a number out of its range, or a picture or video that cannot be made there."""
        del model
        if self.picture is not None:
            if self.picture.suffix not in PICTURES:
                raise UserError(f"--picture {self.picture}: give a {', '.join(PICTURES)} file")
            picture = self.picture
            devices.first(lambda: check_writable(picture, option="--picture"))
        if not 1 <= self.episodes <= MAX_EPISODES:
            raise UserError(f"--episodes {self.episodes}: give a number from 1 to {MAX_EPISODES}")
        check_horizon(self.horizon)

    @contextmanager
    def open(self, model: TrainedModel, seed: int) -> Iterator[Trial]:
        """The maze, and its pairs."""
        maze = load_maze(self.maze)
        if self.video is not None:
            from ct_jax.report.video import check_video  # with matplotlib, which takes its time

            check_video(self.video)
        cell_m = model.settings.model.map_cell_m
        world = MazeWorld(MazeEnv(model.robot, engine=self.engine, map_cell_m=cell_m, auto_reset=False), maze)
        pairs = world.draw_pairs(seed, self.episodes)
        horizon, name = self.horizon or horizon_for(world.robot, pairs), Path(self.maze).stem
        yield Trial(name, world, pairs, _head(self.maze, len(pairs.start), seed), model.settings.prm, horizon)

    def show(self, trial: Trial, title: str, episodes: Episodes) -> None:
        """Write the picture and the video."""
        maze: Maze = jax.tree.map(lambda leaf: leaf[0], trial.world.mazes)  # pyright: ignore[reportAttributeAccessIssue]
        if self.picture is not None and devices.is_first():
            from ct_jax.report import pictures  # imports matplotlib

            reached = f"{int(episodes.success.sum())} of {len(episodes.success)} reached the goal"
            pictures.write_paths(self.picture, unpadded(maze), episodes, f"{title}: {reached}")
        if self.video is not None and devices.is_first():
            from ct_jax.report.video import write_video

            film = as_film(trial.world.robot.name, episodes)
            write_video(self.video, trial.world.robot, maze, film, trial.pairs.goal[0], title)


def as_film(robot: str, episodes: Episodes) -> np.ndarray:
    """``qpos`` [T, nq] before each step of the first episode: position, then what proprioception begins with."""
    assert episodes.proprio is not None
    steps, rest = int(episodes.steps[0]), MazeEnv(get_robot(robot), engine="mujoco").engine.model.nq - 2
    return np.concatenate([episodes.path[:steps, 0], episodes.proprio[:steps, :rest]], -1)
