"""Collecting planner-guided episodes of the Turtlebot3 (paper, Algorithm 3 and sec. IV-D), on a pool of simulations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
from jaxtyping import Float

from ct_envs import UserError
from ct_envs.turtlebot3 import RADIUS_M, to_heading
from ct_envs.turtlebot3_pool import Episode, Frame, Turtlebot3Pool
from ct_envs.turtlebot3_world import TRAIN_DENSITY, World, random_world
from ct_jax.checkpoint import read_json, write_json
from ct_jax.collect import CollectConfig, gather
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.drive import Drive, GuidedDriver, drive, to_trajectories
from ct_jax.explorer_turtlebot3 import ExplorerGuide
from ct_jax.prm import NoPath, PrmConfig, Roadmap, build_roadmap
from ct_jax.trajectories import Trajectories, load, save

_PAIRS = 200  # starts and goals that are tried in one world
_APART_M = 1.0  # least distance of start and goal
_LOOK = 24  # waypoints that are looked at first: mostly one of the best is in sight
_NUDGE_M = 1e-3
_CLEAR_M = 0.05  # that the explorer keeps to what it saw, half a cell of its grid included


@dataclass(frozen=True)
class RoomConfig:
    """The rooms of training and evaluation."""

    density: float = 1.0  # of obstacles in training: 1 is what the published numbers are measured in
    densest: float | None = None  # with this, each room's density is its own, between the two
    noise: float = 0.0  # level of sensor and motion noise in training; 1 is that of a real robot
    worlds: int = 20  # rooms of the evaluation (paper)

    @property
    def densities(self) -> tuple[float, float]:
        """Between which the densities of the rooms of training are drawn."""
        return self.density, self.density if self.densest is None else self.densest


@dataclass(frozen=True, eq=False)
class Room:
    """A world and a roadmap of it, which serve ``reset_interval`` episodes."""

    world: World
    roadmap: Roadmap

    def draw(self, rng: np.random.Generator, starts: str = "vertices") -> tuple[np.ndarray, np.ndarray]:
        """A start and a goal [2] (m) that the roadmap joins. Raises UserError if it joins no two."""
        for _ in range(_PAIRS):
            if starts == "maze":
                start, goal = self.world.sample_pair(rng, RADIUS_M, apart_m=_APART_M)
                if not isinstance(self.roadmap.plan(start, goal), NoPath):
                    return start, goal
                continue
            first, last = rng.integers(len(self.roadmap.points), size=2).tolist()
            start, goal = self.roadmap.points[[first, last]]
            if np.linalg.norm(start - goal) >= _APART_M and nx.has_path(self.roadmap.graph, first, last):
                return start, goal
        raise UserError("the roadmap joins no start and goal in this world; use fewer obstacles or more samples")


def make_room(key: jax.Array, prm: PrmConfig, *, densities: tuple[float, float] = (1.0, 1.0)) -> Room:
    """A random world and its roadmap, by their key; its density, as for ``clutter``, is uniform between the two."""
    world_key, map_key = jax.random.split(key)
    seed = tuple(np.asarray(jax.random.key_data(world_key)).astype(np.uint32).tolist())
    low, high = densities
    world = clutter(seed, low + (high - low) * np.random.default_rng((*seed, 3)).random())
    return Room(world, build_roadmap(map_key, world, radius_m=RADIUS_M, config=prm))


def clutter(seed: int | tuple[int, ...], density: float) -> World:
    """A random world ``density`` times as full as those of training. Raises UserError as ``random_world``."""
    share = np.random.default_rng(seed).uniform(*TRAIN_DENSITY)  # what ``random_world`` draws by itself
    return random_world(seed, density * share)


# ------------------------------------------------------------------------------------------------------ planners


class Following(NamedTuple):
    """Where N robots are on their ways."""

    points: Float[np.ndarray, "N L 2"]  # waypoints, the last repeated [m]
    at: np.ndarray  # int [N]: waypoint they head for


@dataclass(frozen=True)
class WayGuide:
    """The roadmap's shortest way from start to goal, point after point (paper, sec. III-A)."""

    waypoint_tolerance_m: float = 0.06  # who turns off earlier cuts the corner

    def init(self, frame: Frame, episodes: Sequence[Episode], rooms: Sequence[Room]) -> Following:
        """At the beginning of the ways of the first slots."""
        plans = [room.roadmap.plan(each.start, each.goal) for each, room in zip(episodes, rooms, strict=True)]
        ways = [
            np.stack([each.start, each.goal]) if isinstance(plan, NoPath) else plan.points
            for plan, each in zip(plans, episodes, strict=True)
        ]
        longest = max(map(len, ways))
        padded = [np.concatenate([way, np.repeat(way[-1:], longest - len(way), 0)]) for way in ways]
        n = len(frame.done)
        points = np.concatenate([np.stack(padded), np.zeros((n - len(ways), longest, 2))])
        return Following(points, np.full(n, min(1, longest - 1)))

    def waypoint(self, memory: Following, frame: Frame) -> tuple[np.ndarray, Following]:
        """Vectors to the robots' waypoints [N, 2] (m), each passed once it is reached."""
        row, last = np.arange(len(memory.at)), memory.points.shape[1] - 1
        away = np.linalg.norm(memory.points[row, memory.at] - frame.position, axis=-1)
        at = np.where(away < self.waypoint_tolerance_m, np.minimum(memory.at + 1, last), memory.at)
        return to_heading(memory.points[row, at] - frame.position, frame.yaw_rad), memory._replace(at=at)


class Field(NamedTuple):
    """One robot's roadmap, seen from its goal, which is the last of its points."""

    world: World
    points: Float[np.ndarray, "n 2"]  # [m]
    to_go: Float[np.ndarray, "n"]  # way to the goal [m]
    target: Float[np.ndarray, "2"]  # [m]


@dataclass(frozen=True)
class ShortcutGuide:
    """At every step the point in sight that makes the shortest way to the goal, as ``prm.RoadmapGuide`` does: smoother
    than the roadmap's way, and it recovers from any disturbance."""

    margin_m: float  # kept beyond the robot's radius, where the robot itself has as much room
    look_m: float = 2.0  # farthest waypoint
    waypoint_tolerance_m: float = 0.05  # a nearer one is passed: the controller would come to rest there

    def init(self, frame: Frame, episodes: Sequence[Episode], rooms: Sequence[Room]) -> tuple[Field, ...]:
        """The goals joined to their roadmaps."""
        return tuple(self._field(each, room) for each, room in zip(episodes, rooms, strict=True))

    def _field(self, episode: Episode, room: Room) -> Field:
        goal, points = np.asarray(episode.goal), room.roadmap.points
        seen = self._sees(room.world, goal, points)
        away = np.where(seen, np.linalg.norm(points - goal, axis=-1), np.inf)
        to_go = (np.asarray(room.roadmap.table.distance) + away).min(1)
        return Field(room.world, np.concatenate([points, goal[None]]), np.append(to_go, 0.0), goal)

    def waypoint(self, memory: tuple[Field, ...], frame: Frame) -> tuple[np.ndarray, tuple[Field, ...]]:
        """Vectors to the robots' waypoints [N, 2] (m)."""
        fields = [
            field if frame.done[slot] else field._replace(target=self._choose(field, frame.position[slot]))
            for slot, field in enumerate(memory)
        ]
        target = np.zeros_like(frame.position)
        target[: len(fields)] = [field.target for field in fields]
        return to_heading(target - frame.position, frame.yaw_rad), tuple(fields)

    def _choose(self, field: Field, position: np.ndarray) -> np.ndarray:
        """The best point in sight; where there is none, what the robot headed for."""
        away = np.linalg.norm(field.points - position, axis=-1)
        passed = (away < self.waypoint_tolerance_m) & (field.to_go > 0)
        way = np.where((away <= self.look_m) & ~passed, away + field.to_go, np.inf)
        best = np.argsort(way)[: int(np.isfinite(way).sum())]
        # Beside a waypoint that is passed, the way on may have a little less room than it has from there.
        slack = self.waypoint_tolerance_m if passed.any() else 0.0
        for some in (best[:_LOOK], best[_LOOK:]):
            free = np.flatnonzero(self._sees(field.world, position, field.points[some], slack))
            if len(free):
                return field.points[some[free[0]]]
        return field.target

    def _sees(self, world: World, position: np.ndarray, points: np.ndarray, slack_m: float = 0.0) -> np.ndarray:
        """Whether the ways from a position [2] to points [k, 2] (m) are free; one that is near an obstacle already may
        stay as near."""
        ends = np.minimum(world.clearance(points), float(world.clearance(position))) - _NUDGE_M
        room = np.minimum(ends, RADIUS_M + max(self.margin_m - slack_m, 0.0))
        return world.segment_free(np.stack(np.broadcast_arrays(position, points), -2), room)


AnyGuide = WayGuide | ShortcutGuide | ExplorerGuide
_GUIDES: dict[str, Callable[[PrmConfig], AnyGuide]] = {
    "roadmap": lambda prm: WayGuide(),
    "shortcut": lambda prm: ShortcutGuide(prm.margin_m, prm.connect_m),
    "explorer": lambda prm: ExplorerGuide(RADIUS_M + _CLEAR_M, prm.margin_m),
}


def make_guide(name: str, prm: PrmConfig) -> AnyGuide:
    """The guide of that name. Raises UserError with the valid names."""
    if name not in _GUIDES:
        raise UserError(f"no guide named '{name}' for the Turtlebot3; guides: {', '.join(_GUIDES)}")
    return _GUIDES[name](prm)


# ------------------------------------------------------------------------------------------------------- Algorithm 3


class Wave(NamedTuple):
    """Episodes to be driven at the same time, and the rooms they are in."""

    episodes: list[Episode]
    rooms: list[Room]


def draw_wave(
    key: jax.Array, first: int, config: CollectConfig, prm: PrmConfig, *, n: int,
    densities: tuple[float, float] = (1.0, 1.0),
) -> Wave:  # fmt: skip
    """Episodes ``first`` to ``first + n - 1``, a new room every L. Each depends on the key and its number alone."""
    room_key, episode_key = jax.random.split(key)
    numbers = range(first, first + n)
    which = [number // config.reset_interval for number in numbers]
    rooms = {i: make_room(jax.random.fold_in(room_key, i), prm, densities=densities) for i in sorted(set(which))}
    episodes = []
    for number, room in zip(numbers, which, strict=True):
        seed = int(jax.random.bits(jax.random.fold_in(episode_key, number), dtype=jnp.uint32))
        start, goal = rooms[room].draw(np.random.default_rng([seed, 2]), config.starts)
        episodes.append(Episode(rooms[room].world, start, goal, seed))
    return Wave(episodes, [rooms[i] for i in which])


def drive_guided(
    pool: Turtlebot3Pool, wave: Wave, guide: AnyGuide, controller: DifferentialDrive = DifferentialDrive(), *,
    noise: float = 0.0,
) -> list[Drive]:  # fmt: skip
    """Drive a wave led by a guide."""
    driver = GuidedDriver(guide, controller, noise)

    def begin(frame: Frame) -> Any:
        return driver.init(guide.init(frame, wave.episodes, wave.rooms), frame, wave.episodes)

    return drive(pool, wave.episodes, driver, begin)


def collect(
    key: jax.Array,
    pool: Turtlebot3Pool,
    config: CollectConfig,
    prm: PrmConfig,
    *,
    densities: tuple[float, float] = (1.0, 1.0),
    controller: DifferentialDrive = DifferentialDrive(),
    on_progress: Callable[[int, int], None] = lambda successes, episodes: None,
    keep: Callable[[Callable[[int], Any]], Callable[[int], Any]] = lambda wave: wave,
) -> Trajectories:
    """Algorithm 3: drive along plans until T episodes have succeeded, a new world and roadmap every L; only successes.

    ``config.envs`` episodes are driven at a time; ``config.horizon`` is the pool's business.

    Args:
        densities: of obstacles, as for ``make_room``.
        on_progress: told (successes, episodes) so far.
        keep: see ``keeping``.

    Raises:
        UserError: too few successes within ``give_up * T`` episodes, or a pool that does not fit ``config``.
    """
    if config.envs > pool.n or config.horizon != pool.config.horizon:
        raise UserError(
            f"{config.envs} episodes of {config.horizon} steps do not fit a pool of {pool.n} with horizon "
            f"{pool.config.horizon}; give both the same"
        )
    guide = make_guide(config.guide, prm)

    def wave(first: int) -> tuple[Trajectories, np.ndarray]:
        drawn = draw_wave(key, first, config, prm, n=config.envs, densities=densities)
        drives = drive_guided(pool, drawn, guide, controller, noise=config.noise)
        return to_trajectories(drives), np.array([each.success for each in drives])

    return gather(config, keep(wave), on_progress)


def keeping(folder: Path, *, mend: str) -> Callable[[Callable[[int], Any]], Callable[[int], Any]]:
    """Waves that are written down in a folder and, after an interruption, read back instead of driven again.

    Args:
        mend: what the error tells a person to do about a damaged file.
    """
    folder.mkdir(parents=True, exist_ok=True)

    def keep(wave: Callable[[int], Any]) -> Callable[[int], Any]:
        def read_or_drive(first: int) -> Any:
            file, flags_file = folder / f"{first}.npz", folder / f"{first}.json"
            if not file.is_file():
                data, *flags = wave(first)
                write_json(flags_file, {"flags": [flag.tolist() for flag in flags]})
                part = folder / "part.npz"
                save(data, part)
                part.replace(file)  # last: it says that all is there
            try:
                return load(file), *(np.array(flag, bool) for flag in read_json(flags_file, mend=mend)["flags"])
            except UserError as bad:
                raise UserError(f"{bad}: {mend}") from None

        return read_or_drive

    return keep
