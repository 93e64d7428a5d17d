"""Collecting planner-guided episodes of the Turtlebot3 (paper, Algorithm 3 and sec. IV-D), on a pool of simulations.

What a lidar shows cannot be recomputed from a maze, so an episode keeps its local maps, eight cells to the byte.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import networkx as nx
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ct_envs import UserError
from ct_envs.occupancy import MAP_CELLS
from ct_envs.turtlebot3 import RADIUS_M, to_heading
from ct_envs.turtlebot3_pool import Episode, Frame, Turtlebot3Pool
from ct_envs.turtlebot3_world import World, random_world
from ct_jax.collect import CollectConfig
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.interrupts import raise_if_interrupted
from ct_jax.prm import Path, PrmConfig, Roadmap, build_roadmap
from ct_jax.rollout import Action

GUIDES = ("roadmap", "shortcut")
TURTLEBOT3_PRM = PrmConfig(samples=150, connect_m=2.0, margin_m=0.08)  # the paper's, but for the margin: it keeps none
TURTLEBOT3_COLLECT = CollectConfig(trajectories=1000, reset_interval=25, guide="roadmap", envs=50, horizon=400)
_MAP_SHAPE = (2, MAP_CELLS, MAP_CELLS)
_PAIRS = 200  # starts and goals that are tried in one world
_APART_M = 1.0  # least distance of start and goal


@dataclass(frozen=True)
class Drive:
    """An episode of T steps: what was before each action, and what came of it."""

    position: Float[np.ndarray, "T 2"]  # before the action, in the world [m]
    yaw_rad: Float[np.ndarray, "T"]
    proprio: Float[np.ndarray, "T 2"]  # cos dpsi, sin dpsi
    goal: Float[np.ndarray, "T 2"]  # vector to the final goal as it was observed [m]
    map_bits: UInt8[np.ndarray, "T 157"]
    action: Float[np.ndarray, "T 2"]  # as meant, in shares of the top speeds
    target: Float[np.ndarray, "T 2"]  # to be imitated
    learn: Float[np.ndarray, "T"]  # 1 where the target is to be imitated
    reward: Float[np.ndarray, "T"]  # after the action
    frontal: Bool[np.ndarray, "T"]
    grazing: Bool[np.ndarray, "T"]
    goal_world: Float[np.ndarray, "2"]  # final goal in the world [m]
    end_world: Float[np.ndarray, "3"]  # where the robot was in the end: x, y [m], yaw [rad]
    success: bool

    @property
    def length(self) -> int:
        """Steps."""
        return len(self.reward)

    @property
    def collision(self) -> np.ndarray:
        """Whether anything was touched [T]."""
        return self.frontal | self.grazing

    @property
    def maps(self) -> UInt8[np.ndarray, "T 2 k k"]:
        """The local maps."""
        return unpack_maps(self.map_bits)


def pack_maps(maps: UInt8[np.ndarray, "*b 2 k k"]) -> UInt8[np.ndarray, "*b 157"]:
    """Local maps with eight cells to the byte."""
    return np.packbits(maps.reshape(*maps.shape[:-3], -1), axis=-1)


def unpack_maps(bits: UInt8[np.ndarray, "*b 157"]) -> UInt8[np.ndarray, "*b 2 k k"]:
    """The inverse of ``pack_maps``."""
    return np.unpackbits(bits, axis=-1, count=int(np.prod(_MAP_SHAPE))).reshape(*bits.shape[:-1], *_MAP_SHAPE)


class Driver(Protocol):
    """Acts in the N slots of a pool at once, in NumPy, as ``rollout.Policy`` does in compiled programs."""

    def act(self, memory: Any, frame: Frame) -> tuple[Action, Any]:
        """Actions [N, 2] for what is seen now, and the memory after them."""
        ...


class Moment(NamedTuple):
    """One step of all slots."""

    before: Frame
    action: Action
    after: Frame


def drive(
    pool: Turtlebot3Pool,
    episodes: Sequence[Episode],
    driver: Driver,
    memory: Any,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[Drive]:
    """Drive episodes, one in each slot, to their ends.

    Args:
        on_progress: told (steps, episodes that are over) after every step.
    """
    frame = pool.reset(episodes, range(len(episodes)))
    moments: list[Moment] = []
    while not frame.done.all():
        action, memory = driver.act(memory, frame)
        after = pool.step(np.asarray(action.done))
        moments.append(Moment(frame._replace(map=pack_maps(frame.map)), action, after._replace(map=_NOTHING)))
        frame = after
        raise_if_interrupted()
        if on_progress is not None:
            on_progress(len(moments), int(frame.done[: len(episodes)].sum()))
    return [_record(moments, slot, episode) for slot, episode in enumerate(episodes)]


_NOTHING = np.zeros(0, np.uint8)


def _record(moments: list[Moment], slot: int, episode: Episode) -> Drive:
    """What happened in a slot until it was done."""
    mine = [moment for moment in moments if not moment.before.done[slot]]
    end = mine[-1].after

    def take(part: str, name: str, kind: type = np.float32) -> np.ndarray:
        return np.stack([np.asarray(getattr(getattr(moment, part), name)[slot], kind) for moment in mine])

    before, after = functools.partial(take, "before"), functools.partial(take, "after")
    return Drive(
        position=before("position"), yaw_rad=before("yaw_rad"), proprio=before("proprio"), goal=before("goal"),
        map_bits=before("map", np.uint8), action=take("action", "meant"), target=take("action", "target"),
        learn=take("action", "learn"), reward=after("reward"), frontal=after("frontal", bool),
        grazing=after("grazing", bool), goal_world=np.asarray(episode.goal, np.float32),
        end_world=np.append(end.position[slot], end.yaw_rad[slot]).astype(np.float32), success=bool(end.success[slot]),
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------- the planner


class Following(NamedTuple):
    """Where N robots are on their ways."""

    points: Float[np.ndarray, "N L 2"]  # waypoints, the last repeated [m]
    worlds: tuple[World, ...]
    at: np.ndarray  # int [N]: waypoint they head for
    rngs: tuple[np.random.Generator, ...]  # of the disturbances
    disturbance: Float[np.ndarray, "N 2"]


@dataclass(frozen=True)
class PlanDriver:
    """The controller led along planned ways (sec. III-A), as ``rollout.Guided`` is. Its memory is ``Following``."""

    controller: DifferentialDrive = DifferentialDrive()
    guide: str = "roadmap"  # waypoint after waypoint, or a "shortcut" to the last one in sight
    noise: float = 0.0  # size of a disturbance of the actions, which is not imitated
    hold: float = 0.9  # chance that it stays as it is for another step
    waypoint_tolerance_m: float = 0.1
    margin_m: float = 0.08  # kept on shortcuts beyond the robot's radius

    def __post_init__(self):
        if self.guide not in GUIDES:
            raise UserError(f"no guide named '{self.guide}' for the Turtlebot3; guides: {', '.join(GUIDES)}")

    def init(self, n: int, episodes: Sequence[Episode], ways: Sequence[np.ndarray]) -> Following:
        """At the beginning of ``ways`` (each [k, 2], m, start first), in the first of n slots."""
        longest = max(map(len, ways))
        padded = [np.concatenate([way, np.repeat(way[-1:], longest - len(way), 0)]) for way in ways]
        points = np.concatenate([np.stack(padded), np.zeros((n - len(ways), longest, 2))])
        rngs = tuple(np.random.default_rng([episode.seed, 1]) for episode in episodes)
        first = np.full(n, min(1, longest - 1))
        return Following(points, tuple(episode.world for episode in episodes), first, rngs, np.zeros((n, 2)))

    def act(self, memory: Following, frame: Frame) -> tuple[Action, Following]:
        """Towards each robot's waypoint."""
        row, last = np.arange(len(memory.at)), memory.points.shape[1] - 1
        away = np.linalg.norm(memory.points[row, memory.at] - frame.position, axis=-1)
        at = np.where(away < self.waypoint_tolerance_m, np.minimum(memory.at + 1, last), memory.at)
        if self.guide == "shortcut":
            at = self._shortcuts(memory._replace(at=at), frame)
        target = memory.points[row, at] - frame.position
        meant = self.controller(to_heading(target, frame.yaw_rad))
        disturbance = self._disturb(memory, frame.done) if self.noise else memory.disturbance
        action = Action(meant, meant + disturbance, meant, np.ones(len(at), np.float32))  # pyright: ignore
        return action, memory._replace(at=at, disturbance=disturbance)

    def _shortcuts(self, memory: Following, frame: Frame) -> np.ndarray:
        """The last waypoints in sight; where none is, those the robots head for."""
        at = memory.at.copy()
        for slot, world in enumerate(memory.worlds):
            if not frame.done[slot]:
                points = memory.points[slot, at[slot] :]
                here = np.broadcast_to(frame.position[slot], points.shape)
                free = world.segment_free(here, points, RADIUS_M + self.margin_m)
                at[slot] += int(np.flatnonzero(free).max(initial=0))
        return at

    def _disturb(self, memory: Following, done: np.ndarray) -> np.ndarray:
        disturbance = memory.disturbance.copy()
        for slot, rng in enumerate(memory.rngs):
            if not done[slot] and rng.random() >= self.hold:
                disturbance[slot] = self.noise * rng.standard_normal(2)
        return disturbance


# ------------------------------------------------------------------------------------------------------- Algorithm 3


@dataclass(frozen=True)
class Room:
    """A world and a roadmap of it, which serve ``reset_interval`` episodes."""

    world: World
    roadmap: Roadmap

    def draw(self, rng: np.random.Generator, starts: str = "vertices") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A start, a goal [2] and a way between them [k, 2] (m). Raises UserError if the roadmap joins no two."""
        for _ in range(_PAIRS):
            if starts == "maze":
                start, goal = self.world.sample_pair(rng, RADIUS_M, apart_m=_APART_M)
                path = self.roadmap.plan(start, goal)
                if isinstance(path, Path):
                    return start, goal, path.points
                continue
            first, last = rng.integers(len(self.roadmap.points), size=2).tolist()
            points = self.roadmap.points
            if np.linalg.norm(points[first] - points[last]) < _APART_M:
                continue
            if nx.has_path(self.roadmap.graph, first, last):
                way = points[nx.shortest_path(self.roadmap.graph, first, last, weight="weight")]
                return way[0], way[-1], way
        raise UserError("the roadmap joins no start and goal in this world; use fewer obstacles or more samples")


def make_room(key: jax.Array, prm: PrmConfig = TURTLEBOT3_PRM, *, density: float | None = None) -> Room:
    """A random world and its roadmap, by their key; ``density`` as for ``random_world``."""
    world_key, map_key = jax.random.split(key)
    seed = tuple(np.asarray(jax.random.key_data(world_key)).astype(np.uint32).tolist())
    world = random_world(seed, density)
    return Room(world, build_roadmap(map_key, world, radius_m=RADIUS_M, config=prm))


def collect_wave(
    key: jax.Array, pool: Turtlebot3Pool, first: int, config: CollectConfig, prm: PrmConfig, *, n: int,
    density: float | None = None, controller: DifferentialDrive = DifferentialDrive(),
    on_progress: Callable[[int, int], None] | None = None,
) -> list[Drive]:  # fmt: skip
    """Episodes ``first`` to ``first + n - 1`` of Algorithm 3, failures too. Each depends on the key and its number."""
    room_key, episode_key = jax.random.split(key)
    numbers = range(first, first + n)
    which = [number // config.reset_interval for number in numbers]
    rooms = {i: make_room(jax.random.fold_in(room_key, i), prm, density=density) for i in sorted(set(which))}
    episodes, ways = [], []
    for number, room in zip(numbers, which, strict=True):
        seed = int(jax.random.bits(jax.random.fold_in(episode_key, number)))
        start, goal, way = rooms[room].draw(np.random.default_rng([seed, 2]), config.starts)
        episodes.append(Episode(rooms[room].world, start, goal, seed))
        ways.append(way)
    driver = PlanDriver(controller, config.guide, config.noise, margin_m=prm.margin_m)
    return drive(pool, episodes, driver, driver.init(pool.n, episodes, ways), on_progress=on_progress)


def collect_drives(
    key: jax.Array,
    pool: Turtlebot3Pool,
    config: CollectConfig = TURTLEBOT3_COLLECT,
    prm: PrmConfig = TURTLEBOT3_PRM,
    *,
    density: float | None = None,
    controller: DifferentialDrive = DifferentialDrive(),
    on_progress: Callable[[int, int], None] = lambda successes, episodes: None,
) -> list[Drive]:
    """Algorithm 3: drive along plans until T episodes have succeeded, a new world and roadmap every L; only successes.

    ``config.envs`` episodes are driven at a time; ``config.horizon`` is the pool's business.

    Args:
        density: of obstacles; by default that of training.
        on_progress: told (successes, episodes) so far.

    Raises:
        UserError: too few successes within ``give_up * T`` episodes, or a pool that does not fit ``config``.
    """
    if config.envs > pool.n or config.horizon != pool.config.horizon:
        raise UserError(
            f"{config.envs} episodes of {config.horizon} steps do not fit a pool of {pool.n} with horizon "
            f"{pool.config.horizon}; give both the same"
        )
    kept: list[Drive] = []
    episodes = 0
    while len(kept) < config.trajectories:
        if episodes >= config.give_up * config.trajectories:
            raise UserError(
                f"the controller reached only {len(kept)} of {episodes} goals, {config.trajectories} were asked for; "
                "use fewer obstacles, a wider margin or a longer horizon"
            )
        wave = collect_wave(
            key, pool, episodes, config, prm, n=config.envs, density=density, controller=controller
        )  # fmt: skip
        kept += [each for each in wave if each.success]
        episodes += config.envs
        on_progress(len(kept), episodes)
    return kept[: config.trajectories]
