"""Rooms for runs and evaluations: the known controller, training, trials, and the options of an evaluation."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ct_envs import UserError
from ct_envs.robots import TURTLEBOT3, Robot
from ct_envs.turtlebot3 import ACTION_SIZE, MAX_NOISE, PROPRIO_SIZE
from ct_envs.turtlebot3_world import World as Room
from ct_envs.turtlebot3_world import load_world
from ct_jax.controller import ControllerConfig
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.evaluate import Episodes, check_horizon
from ct_jax.model import TrainedModel
from ct_jax.pairs import Pairs, horizon_for
from ct_jax.runtime.checkpoint import write_json
from ct_jax.runtime.progress import Metrics
from ct_jax.runtime.run import Run, cores
from ct_jax.settings import MAX_FACTOR, MAX_WORLDS, RoomConfig, controller_config
from ct_jax.worlds import Trial
from ct_jax.worlds.rooms import PLANNER, RoomWorld, evaluation_rooms

KNOWN_CONTROLLER = DifferentialDrive()
NAME = "rooms"  # of all rooms of an evaluation together, where a maze's name stands
MAX_PAIRS = 1000
SEVEN_SEED = 7  # of the seven pairs
_SLOTS = 50  # episodes of an evaluation at a time


def sizes(robot: Robot) -> tuple[int, int]:
    """Entries of a robot's proprioception and of its action."""
    del robot
    return PROPRIO_SIZE, ACTION_SIZE


def make_env(run: Run, **options: Any) -> NoReturn:
    """Rooms are not stepped by JAX. Raises UserError."""
    del options
    raise UserError(f"the {run.robot} drives in PyBullet: no method can learn in it without trajectories")


@contextmanager
def open_training(run: Run, *, maps: bool) -> Iterator[RoomWorld]:
    """New rooms of the run's density. Local maps come from the lidar, so there always are some."""
    del maps
    rooms = run.settings.rooms or RoomConfig()
    world = RoomWorld(
        run.settings.collect.envs, densities=rooms.densities, noise=rooms.noise, processes=cores()
    )  # fmt: skip
    with closing(world):
        yield world


def controller(run: Run, metrics: Metrics) -> tuple[DifferentialDrive, ControllerConfig]:
    """The known controller (paper, sec. IV-B)."""
    del metrics
    return KNOWN_CONTROLLER, controller_config(run.settings)


def trials(run: Run, folder: Path) -> Iterator[Trial]:
    """The rooms of the evaluation, all together."""
    settings = run.settings
    request = Request(worlds=(settings.rooms or RoomConfig()).worlds, pairs=settings.episodes)
    with request.open(None, settings.pairs_seed) as trial:
        rooms = [describe(room) for room in trial.world.rooms]  # pyright: ignore[reportAttributeAccessIssue]
        write_json(folder / "rooms.json", {"rooms": rooms})
        yield replace(trial, head=trial.head | {"seen": False})


def describe(room: Room) -> dict[str, Any]:
    """A room as JSON holds it, for the report."""
    return {"side_m": room.side_m, "boxes": room.boxes.tolist(), "cylinders": room.cylinders.tolist()}


@dataclass(frozen=True)
class Request:
    """The options of ``ct-jax evaluate`` for the Turtlebot3."""

    worlds: int = 20  # number of rooms
    pairs: int = 25  # in each
    density: float = 1.0  # of obstacles, 1 is that of training
    noise: float = 0.0  # level, 1 is that of a real robot
    horizon: int | None = None  # control steps of an episode; by default in proportion to the longest way

    def check(self, model: TrainedModel) -> None:
        """Raise UserError for a number out of its range."""
        del model
        for name, value, most in (("worlds", self.worlds, MAX_WORLDS), ("pairs", self.pairs, MAX_PAIRS)):
            if not 1 <= value <= most:
                raise UserError(f"--{name} {value}: give a number from 1 to {most}")
        if not 0 <= self.density <= MAX_FACTOR:
            raise UserError(f"--density {self.density}: give a number from 0 to {MAX_FACTOR}; 1 is that of training")
        if not 0 <= self.noise <= MAX_NOISE:
            raise UserError(f"--noise {self.noise}: give a level from 0 to {MAX_NOISE}; 1 is that of a real robot")
        check_horizon(self.horizon)

    @contextmanager
    def open(self, model: TrainedModel | None, seed: int) -> Iterator[Trial]:
        """Random rooms, and pairs in them: the same for every method."""
        del model
        with self._world(evaluation_rooms(seed, self.worlds, density=self.density)) as world:
            yield self._trial(world, world.draw_pairs(seed, self.pairs), seed)

    def show(self, trial: Trial, title: str, episodes: Episodes) -> None:
        """There is no picture of rooms but in the report."""

    @contextmanager
    def _world(self, rooms: Sequence[Room]) -> Iterator[RoomWorld]:
        slots = min(_SLOTS, self.worlds * self.pairs)
        with closing(RoomWorld(slots, rooms, noise=self.noise, processes=cores())) as world:
            yield world

    def _trial(self, world: RoomWorld, pairs: Pairs, seed: int) -> Trial:
        head = {"maze": NAME, "episodes": self.worlds * self.pairs, "seed": seed, "worlds": self.worlds}
        head |= {"pairs": self.pairs, "density": self.density, "noise": self.noise}
        return Trial(NAME, world, pairs, head, PLANNER, self.horizon or horizon_for(TURTLEBOT3, pairs))


@dataclass(frozen=True)
class SevenPairs:
    """The paper's protocol on the real robot, in one fixed room that ships with the package."""

    noise: float = 0.0
    repeats: int = 10  # of each pair

    @contextmanager
    def open(self, model: TrainedModel, seed: int = SEVEN_SEED) -> Iterator[Trial]:
        """Seven pairs, each several times."""
        del model
        room = load_world(str(resources.files("ct_envs") / "worlds" / "seven-pairs.json"))
        request = Request(worlds=1, pairs=7, noise=self.noise)
        with closing(RoomWorld(min(_SLOTS, 7 * self.repeats), [room], noise=self.noise, processes=cores())) as world:
            pairs = world.draw_pairs(seed, 7)
            names = ("start", "goal", "shortest_m", "place")
            again = replace(pairs, **{name: np.repeat(getattr(pairs, name), self.repeats, 0) for name in names})
            trial = request._trial(world, again, seed)
            yield replace(trial, head=trial.head | {"maze": "seven pairs", "episodes": 7 * self.repeats})


def grades(episodes: Episodes) -> dict[str, int]:
    """Trajectories as the paper counts those of the real robot: full successes touch nothing, partial ones graze, and
    failures run into something or do not arrive."""
    assert episodes.frontal is not None and episodes.grazing is not None
    arrived = episodes.success & ~episodes.frontal
    full, partial = int((arrived & ~episodes.grazing).sum()), int((arrived & episodes.grazing).sum())
    return {"full": full, "partial": partial, "failed": len(arrived) - full - partial}
