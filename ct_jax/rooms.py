"""What the pipeline asks of robots in rooms: collection, recoveries and evaluation, all in PyBullet.

There is no roadmap stage, for every 25 episodes have a room of their own, and no controller to be learned: it is known.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ct_envs import UserError
from ct_envs.robots import TURTLEBOT3
from ct_envs.turtlebot3 import MAX_NOISE, Turtlebot3Config
from ct_envs.turtlebot3_pool import Turtlebot3Pool
from ct_envs.turtlebot3_world import World, load_world
from ct_jax.checkpoint import write_json
from ct_jax.collect_turtlebot3 import collect, keeping
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.controllers.sac import SacConfig
from ct_jax.evaluate import METHODS, Episodes, Pairs, check_horizon, horizon_for
from ct_jax.evaluate_turtlebot3 import draw_room_pairs, draw_rooms, evaluate_rooms, grades
from ct_jax.finetune_turtlebot3 import recover
from ct_jax.model import TrainedModel
from ct_jax.policy import TransformerPolicy
from ct_jax.progress import Bar, Metrics
from ct_jax.run import Run, cores, kept_row
from ct_jax.settings import MAX_FACTOR, MAX_WORLDS, RoomConfig
from ct_jax.trajectories import Trajectories

NAME = "rooms"  # of all rooms of an evaluation together, where a maze's name stands
MAX_PAIRS = 1000
SEVEN_SEED = 7  # of the seven pairs
_SLOTS = 50  # episodes of an evaluation at a time
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class RoomCourse:
    """A run in rooms: ``pipeline.Course``."""

    run: Run

    @property
    def config(self) -> RoomConfig:
        """The rooms of training and evaluation."""
        return self.run.settings.rooms or RoomConfig()

    def controller(self, metrics: Metrics) -> tuple[DifferentialDrive, SacConfig]:
        """The known controller (paper, sec. IV-B)."""
        del metrics
        return DifferentialDrive(), self.run.settings.sac

    def _pool(self, horizon: int) -> Turtlebot3Pool:
        config = Turtlebot3Config(horizon=horizon, noise=self.config.noise)
        return Turtlebot3Pool(self.run.settings.collect.envs, processes=cores(), config=config)

    def collect(
        self, key: jax.Array, controller: DifferentialDrive, folder: Path, on_progress: Progress
    ) -> Trajectories:
        """Algorithm 3."""
        settings = self.run.settings
        with self._pool(settings.collect.horizon) as pool:
            return collect(
                key, pool, settings.collect, settings.prm, densities=self.config.densities, controller=controller,
                on_progress=on_progress, keep=keeping(folder, kinds=1, hint=self.run.hint("collect")),
            )  # fmt: skip

    def recover(
        self, key: jax.Array, policy: TransformerPolicy, controller: DifferentialDrive, folder: Path,
        on_progress: Progress,
    ) -> Trajectories:  # fmt: skip
        """Algorithm 4's failures and recoveries."""
        settings = self.run.settings
        with self._pool(settings.recover.patience + settings.collect.horizon) as pool:
            return recover(
                key, pool, policy, settings.recover, settings.collect, settings.prm, densities=self.config.densities,
                controller=controller, on_progress=on_progress,
                keep=keeping(folder, kinds=2, hint=self.run.hint("finetune")),
            )  # fmt: skip

    def rows(self, folder: Path, model: TrainedModel) -> Iterator[dict[str, Any]]:
        """Every method in the rooms of the evaluation."""
        test = RoomTest(self.config.worlds, self.run.settings.episodes, self.run.settings.pairs_seed)
        worlds, pairs = test.draw()
        write_json(folder / "rooms.json", {"rooms": [describe(world) for world in worlds]})
        for method in METHODS:
            measure = lambda method=method: test.measure(model, method, worlds, pairs)  # noqa: E731
            yield kept_row(folder, NAME, method, test.head(model.robot, method) | {"seen": False}, measure)


def describe(world: World) -> dict[str, Any]:
    """A room as JSON holds it, for the report."""
    return {"side_m": world.side_m, "boxes": world.boxes.tolist(), "cylinders": world.cylinders.tolist()}


# ------------------------------------------------------------------------------------------------------ evaluation


@dataclass(frozen=True)
class RoomTest:
    """An evaluation in random rooms."""

    worlds: int = 20
    pairs: int = 25  # in each
    seed: int = 0
    density: float = 1.0  # of obstacles, 1 is that of training
    noise: float = 0.0  # level, 1 is that of a real robot
    horizon: int | None = None  # control steps of an episode; by default in proportion to the longest way

    def draw(self) -> tuple[list[World], Pairs]:
        """The rooms, and starts and goals in them: the same for every method. Raises UserError."""
        worlds = draw_rooms(self.seed, self.worlds, density=self.density)
        return worlds, draw_room_pairs(self.seed, worlds, self.pairs)

    def head(self, robot: str, method: str) -> dict[str, Any]:
        """What a row is of."""
        row = {"robot": robot, "method": method, "maze": NAME, "episodes": self.worlds * self.pairs, "seed": self.seed}
        return row | {"worlds": self.worlds, "pairs": self.pairs, "density": self.density, "noise": self.noise}

    def measure(self, model: TrainedModel, method: str, worlds: Sequence[World], pairs: Pairs) -> Episodes:
        """Run a method, with a bar."""
        n = len(pairs.start)
        config = Turtlebot3Config(noise=self.noise, horizon=self.horizon or horizon_for(TURTLEBOT3, pairs))
        with (
            Turtlebot3Pool(min(_SLOTS, n), processes=cores(), config=config) as pool,
            Bar(f"{method} in {NAME}", n) as bar,
        ):
            return evaluate_rooms(
                pool, worlds, pairs, method, policy=model.policy, controller=model.controller,
                on_progress=lambda waves, over: bar.update(over),
            )  # fmt: skip


def evaluate_seven_pairs(model: TrainedModel, method: str, *, noise: float = 0.0, repeats: int = 10) -> dict[str, Any]:
    """The paper's protocol on the real robot, in one fixed room that ships with the package: seven pairs, each driven
    ``repeats`` times, counted as ``grades`` does."""
    world = load_world(str(resources.files("ct_envs") / "worlds" / "seven-pairs.json"))
    pairs = draw_room_pairs(SEVEN_SEED, [world], 7)
    names = ("start", "goal", "shortest_m", "world")
    again = replace(pairs, **{name: np.repeat(getattr(pairs, name), repeats, 0) for name in names})
    test = RoomTest(worlds=1, pairs=7, seed=SEVEN_SEED, noise=noise)
    episodes = test.measure(model, method, [world], again)
    row = test.head(model.robot, method) | {"maze": "seven pairs", "episodes": 7 * repeats}
    return row | grades(episodes) | episodes.summary()


def evaluate_in_rooms(
    model: TrainedModel, method: str, seed: int, keep: Callable[[dict[str, Any]], None] = lambda row: None, *,
    worlds: int = 20, pairs: int = 25, density: float = 1.0, noise: float = 0.0, horizon: int | None = None,
) -> dict[str, Any]:  # fmt: skip
    """One method of a model in random rooms; returns its row of the table.

    Args:
        keep: told the row as soon as it is there.

    Raises:
        UserError: numbers out of their range.
    """
    for name, value, most in (("worlds", worlds, MAX_WORLDS), ("pairs", pairs, MAX_PAIRS)):
        if not 1 <= value <= most:
            raise UserError(f"--{name} {value}: give a number from 1 to {most}")
    if not 0 <= density <= MAX_FACTOR:
        raise UserError(f"--density {density}: give a number from 0 to {MAX_FACTOR}; 1 is that of training")
    if not 0 <= noise <= MAX_NOISE:
        raise UserError(f"--noise {noise}: give a level from 0 to {MAX_NOISE}; 1 is that of a real robot")
    check_horizon(horizon)
    test = RoomTest(worlds, pairs, seed, density, noise, horizon)
    row = test.head(model.robot, method) | test.measure(model, method, *test.draw()).summary()
    keep(row)
    return row
