"""Collecting planner-guided episodes of the Turtlebot3 (paper, Algorithm 3 and sec. IV-B), on a pool of simulations."""

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
from ct_jax.collect import CollectConfig, Guide, gather
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.drive import Drive, GuidedDriver, drive, to_trajectories
from ct_jax.explorer_turtlebot3 import ExplorerGuide
from ct_jax.files import make_folder
from ct_jax.numerics import with_own_numerics
from ct_jax.prm import NoPath, PrmConfig, Roadmap, build_roadmap
from ct_jax.trajectories import Trajectories, load, save

_PAIRS = 200  # number of starts and goals that are tried in one world
_APART_M = 1.0  # smallest distance between start and goal
_LOOK = 24  # number of waypoints checked first: usually one of the best is visible
_NUDGE_M = 1e-3
_CLEAR_M = 0.05  # distance that the explorer keeps to obstacles; includes half a cell of its grid


@dataclass(frozen=True, eq=False)
class Room:
    """A world and its roadmap, used for ``reset_interval`` episodes."""

    world: World
    roadmap: Roadmap

    def draw(self, rng: np.random.Generator, starts: str = "vertices") -> tuple[np.ndarray, np.ndarray]:
        """A start and a goal [2] (m) that the roadmap joins. Raises UserError if none is found."""
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
        raise UserError("the roadmap joins no start and goal in this room; use fewer obstacles or more samples")


def make_room(key: jax.Array, prm: PrmConfig, *, densities: tuple[float, float] = (1.0, 1.0)) -> Room:
    """A random world and its roadmap. Its density (see ``clutter``) is uniform between the two ``densities``."""
    world_key, map_key = jax.random.split(key)
    seed = tuple(np.asarray(jax.random.key_data(world_key)).astype(np.uint32).tolist())
    low, high = densities
    world = clutter(seed, low + (high - low) * np.random.default_rng((*seed, 3)).random())
    return Room(world, build_roadmap(map_key, world, radius_m=RADIUS_M, config=prm))


def clutter(seed: int | tuple[int, ...], density: float) -> World:
    """A random world with ``density`` times the obstacles of training. Raises UserError like ``random_world``."""
    share = np.random.default_rng(seed).uniform(*TRAIN_DENSITY)  # the same draw as in ``random_world``
    return random_world(seed, density * share)


# ------------------------------------------------------------------------------------------------------ planners


class Following(NamedTuple):
    """The plans of N robots and their current waypoints."""

    points: Float[np.ndarray, "N L 2"]  # waypoints, padded by repeating the last one [m]
    at: np.ndarray  # int [N]: index of the current waypoint


@dataclass(frozen=True)
class WayGuide:
    """The roadmap's shortest path from start to goal, point after point (paper, sec. III-A)."""

    waypoint_tolerance_m: float = 0.06  # a robot that turns earlier cuts the corner

    def init(self, frame: Frame, episodes: Sequence[Episode], rooms: Sequence[Room]) -> Following:
        """The plans of the first slots, at their beginnings."""
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
        """Vectors to the robots' waypoints [N, 2] (m), and the plans after this step."""
        row, last = np.arange(len(memory.at)), memory.points.shape[1] - 1
        away = np.linalg.norm(memory.points[row, memory.at] - frame.position, axis=-1)
        at = np.where(away < self.waypoint_tolerance_m, np.minimum(memory.at + 1, last), memory.at)
        return to_heading(memory.points[row, at] - frame.position, frame.yaw_rad), memory._replace(at=at)


class Field(NamedTuple):
    """One robot's roadmap with the path lengths to its goal. The goal is the last point."""

    world: World
    points: Float[np.ndarray, "n 2"]  # [m]
    to_go: Float[np.ndarray, "n"]  # path length to the goal [m]
    target: Float[np.ndarray, "2"]  # [m]


@dataclass(frozen=True)
class ShortcutGuide:
    """At every step the visible point with the shortest path to the goal, like ``prm.RoadmapGuide`` with ``shortcut``.

    It is smoother than the roadmap's path and recovers from any disturbance."""

    margin_m: float  # clearance beyond the robot's radius, if the robot itself has that much room
    look_m: float = 2.0  # largest distance of a waypoint
    waypoint_tolerance_m: float = 0.05  # a nearer waypoint is skipped: the controller would stop there

    def init(self, frame: Frame, episodes: Sequence[Episode], rooms: Sequence[Room]) -> tuple[Field, ...]:
        """The roadmaps, connected to the goals."""
        return tuple(self._field(each, room) for each, room in zip(episodes, rooms, strict=True))

    def _field(self, episode: Episode, room: Room) -> Field:
        goal, points = np.asarray(episode.goal), room.roadmap.points
        seen = self._sees(room.world, goal, points)
        away = np.where(seen, np.linalg.norm(points - goal, axis=-1), np.inf)
        to_go = (np.asarray(room.roadmap.table.distance) + away).min(1)
        return Field(room.world, np.concatenate([points, goal[None]]), np.append(to_go, 0.0), goal)

    def waypoint(self, memory: tuple[Field, ...], frame: Frame) -> tuple[np.ndarray, tuple[Field, ...]]:
        """Vectors to the robots' waypoints [N, 2] (m), and the memory after this step."""
        fields = [
            field if frame.done[slot] else field._replace(target=self._choose(field, frame.position[slot]))
            for slot, field in enumerate(memory)
        ]
        target = np.zeros_like(frame.position)
        target[: len(fields)] = [field.target for field in fields]
        return to_heading(target - frame.position, frame.yaw_rad), tuple(fields)

    def _choose(self, field: Field, position: np.ndarray) -> np.ndarray:
        """The best visible point; if none is visible, the previous target."""
        away = np.linalg.norm(field.points - position, axis=-1)
        passed = (away < self.waypoint_tolerance_m) & (field.to_go > 0)
        way = np.where((away <= self.look_m) & ~passed, away + field.to_go, np.inf)
        best = np.argsort(way)[: int(np.isfinite(way).sum())]
        # The robot is not exactly on a skipped waypoint, so its path may have a little less room than the roadmap's.
        slack = self.waypoint_tolerance_m if passed.any() else 0.0
        for some in (best[:_LOOK], best[_LOOK:]):
            free = np.flatnonzero(self._sees(field.world, position, field.points[some], slack))
            if len(free):
                return field.points[some[free[0]]]
        return field.target

    def _sees(self, world: World, position: np.ndarray, points: np.ndarray, slack_m: float = 0.0) -> np.ndarray:
        """Whether the straight lines from a position [2] to points [k, 2] (m) are free.

        If an end is already close to an obstacle, the line may be as close."""
        ends = np.minimum(world.clearance(points), float(world.clearance(position))) - _NUDGE_M
        room = np.minimum(ends, RADIUS_M + max(self.margin_m - slack_m, 0.0))
        return world.segment_free(np.stack(np.broadcast_arrays(position, points), -2), room)


AnyGuide = WayGuide | ShortcutGuide | ExplorerGuide
_GUIDES: dict[Guide, Callable[[PrmConfig], AnyGuide]] = {
    "roadmap": lambda prm: WayGuide(),
    "shortcut": lambda prm: ShortcutGuide(prm.margin_m, prm.connect_m),
    "explorer": lambda prm: ExplorerGuide(RADIUS_M + _CLEAR_M, prm.margin_m),
}


def make_guide(name: Guide, prm: PrmConfig) -> AnyGuide:
    """The guide with this name."""
    return _GUIDES[name](prm)


# ------------------------------------------------------------------------------------------------------- Algorithm 3


class Wave(NamedTuple):
    """Episodes that are driven at the same time, and their rooms."""

    episodes: list[Episode]
    rooms: list[Room]


def draw_wave(
    key: jax.Array, first: int, config: CollectConfig, prm: PrmConfig, *, n: int,
    densities: tuple[float, float] = (1.0, 1.0),
) -> Wave:  # fmt: skip
    """Episodes ``first`` to ``first + n - 1``, a new room every L. Each depends only on the key and its number."""
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
    """Drive a wave of episodes with a guide."""
    driver = GuidedDriver(guide, controller, noise)

    def begin(frame: Frame) -> Any:
        return driver.init(guide.init(frame, wave.episodes, wave.rooms), frame, wave.episodes)

    return drive(pool, wave.episodes, driver, begin)


@with_own_numerics
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
    """Algorithm 3: drive along plans until T episodes have succeeded; only successes are kept.

    Every L episodes, the world and roadmap are new. ``config.envs`` episodes are driven at a time.

    Args:
        pool: its horizon must be ``config.horizon``.
        densities: of obstacles, see ``make_room``.
        on_progress: called with (successes, episodes) so far.
        keep: see ``keeping``.

    Raises:
        UserError: too few successes within ``give_up * T`` episodes, or a pool that does not fit ``config``.
    """
    if config.envs > pool.n or config.horizon != pool.config.horizon:
        raise UserError(
            f"{config.envs} episodes of {config.horizon} steps do not fit a pool of {pool.n} with horizon "
            f"{pool.config.horizon}; use the same numbers for both"
        )
    guide = make_guide(config.guide, prm)

    def wave(first: int) -> tuple[Trajectories, np.ndarray]:
        drawn = draw_wave(key, first, config, prm, n=config.envs, densities=densities)
        drives = drive_guided(pool, drawn, guide, controller, noise=config.noise)
        return to_trajectories(drives), np.array([each.success for each in drives])

    return gather(config, keep(wave), on_progress)


def _are_flags(found: Any, kinds: int, n: int) -> bool:
    """Whether a value is a list of ``kinds`` lists of n flags."""
    lists = [found, *found] if isinstance(found, list) else [found]
    sizes = [len(each) if isinstance(each, list) else None for each in lists]
    return sizes == [kinds, *[n] * kinds] and all(isinstance(flag, bool) for each in found for flag in each)


def keeping(folder: Path, *, kinds: int, hint: str) -> Callable[[Callable[[int], Any]], Callable[[int], Any]]:
    """Save each wave in a folder. After an interruption, read the saved waves back instead of driving them again.

    Args:
        kinds: number of flag arrays that a wave has besides its trajectories.
        hint: the advice in the error about a damaged file.
    """
    make_folder(folder, parents=True)

    def keep(wave: Callable[[int], Any]) -> Callable[[int], Any]:
        def read_or_drive(first: int) -> Any:
            file, flags_file = folder / f"{first}.npz", folder / f"{first}.json"
            if not file.is_file():
                data, *flags = wave(first)
                write_json(flags_file, {"flags": [flag.tolist() for flag in flags]})
                save(data, file)  # last: this file shows that the wave is complete
            try:
                data = load(file)
            except UserError as bad:
                raise UserError(f"{bad}: {hint}") from None
            found = read_json(flags_file, hint=hint).get("flags")
            if not _are_flags(found, kinds, data.n):
                raise UserError(f"{flags_file}: not {kinds} flags of {data.n} episodes; {hint}")
            return data, *np.array(found, bool)

        return read_or_drive

    return keep
