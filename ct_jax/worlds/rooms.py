"""The world of cluttered rooms: a pool of PyBullet simulations of the Turtlebot3 (paper, sec. IV-B), in NumPy.

Lidar scans cannot be recomputed, so episodes keep their local maps, with eight cells in a byte.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np

from ct_envs import UserError
from ct_envs.robots import TURTLEBOT3, Robot
from ct_envs.turtlebot3 import RADIUS_M, Turtlebot3Config
from ct_envs.turtlebot3_pool import Episode, PoolFrame, Turtlebot3Pool
from ct_envs.turtlebot3_world import TRAIN_DENSITY, World, random_world
from ct_jax.collect import CollectConfig
from ct_jax.guides.lidar_explorer import LidarExplorer
from ct_jax.guides.room_roadmap import ShortcutGuide, WayGuide
from ct_jax.pairs import Pairs, shortest_ways
from ct_jax.prm import NoPath, PrmConfig, Roadmap, build_roadmap, joins
from ct_jax.runtime.interrupts import raise_if_interrupted
from ct_jax.runtime.numerics import with_own_numerics
from ct_jax.trajectories import pack_maps
from ct_jax.types import End, Frame, Guide, Observation, OnProgress, Policy, Privileged, Rollout, Steps, Tasks

PLANNER = PrmConfig(samples=400, connect_m=2.0, margin_m=0.03, most_samples=1600)
"""The reference planner's: it joins what a robot can reach, and cuts no corner."""

_DENSE = PrmConfig(samples=600, connect_m=2.0, most_samples=2400)  # for the lengths of the shortest ways
_EVALUATION = 1  # seeds of these rooms have three entries, those of training two: none is in both
_PAIRS = 200  # number of starts and goals that are tried in one room
_APART_M = 1.0  # smallest distance between start and goal
_CLEAR_M = 0.05  # distance that the explorer keeps to obstacles; includes half a cell of its grid


@dataclass(frozen=True)
class RoomTasks(Tasks):
    """Episodes in rooms."""

    episodes: list[Episode]
    roadmaps: list[Roadmap | None]  # of each episode's room

    @property
    def worlds(self) -> list[World]:
        """The room of each episode."""
        return [episode.world for episode in self.episodes]

    def part(self, first: int, n: int) -> "RoomTasks":
        """The tasks ``first`` to ``first + n - 1``."""
        some = slice(first, first + n)
        return RoomTasks(
            self.start[some], self.goal[some], self.place[some], jax.random.fold_in(self.key, first),
            self.episodes[some], self.roadmaps[some],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RoomWorld:
    """Rooms of an evaluation, or a new room every few episodes of a collection.

    Episodes run in worker processes, so a script needs ``if __name__ == "__main__":``. ``close`` ends the processes.
    """

    slots: int  # episodes that run at the same time
    rooms: Sequence[World] = ()  # of an evaluation
    densities: tuple[float, float] = (1.0, 1.0)  # of the obstacles in new rooms, relative to training
    noise: float = 0.0  # level of sensor and motion noise; 1 is that of a real robot
    processes: int | None = None
    _pools: dict[int, Turtlebot3Pool] = field(default_factory=dict, init=False, repr=False)  # at most one, by horizon

    robot: Robot = TURTLEBOT3
    horizon: int = TURTLEBOT3.horizon
    places: int = 1

    def close(self) -> None:
        """End the worker processes."""
        while self._pools:
            self._pools.popitem()[1].close()

    def _pool(self, horizon: int) -> Turtlebot3Pool:
        if horizon not in self._pools:
            self.close()
            config = Turtlebot3Config(horizon=horizon, noise=self.noise)
            self._pools[horizon] = Turtlebot3Pool(self.slots, processes=self.processes, config=config)
        return self._pools[horizon]

    def guide(self, name: str, prm: PrmConfig) -> Guide:
        """The planner with this name."""
        if name == "explorer":
            return LidarExplorer(RADIUS_M + _CLEAR_M, prm.margin_m)
        return ShortcutGuide(prm.margin_m, prm.connect_m) if name == "shortcut" else WayGuide()

    # -------------------------------------------------------------------------------------------------- collection

    def sample_tasks(
        self, key: jax.Array, config: CollectConfig, prm: PrmConfig, *, first: int = 0, offset: int = 0
    ) -> RoomTasks:
        """Episodes in new rooms, one for every ``reset_interval`` episodes. ``offset`` means nothing: all are new."""
        del offset
        room_key, episode_key, run_key = jax.random.split(key, 3)
        numbers = range(first, first + config.envs)
        which = np.array([number // config.reset_interval for number in numbers])
        rooms = {i: make_room(jax.random.fold_in(room_key, i), prm, densities=self.densities) for i in np.unique(which)}
        episodes = []
        for number, room in zip(numbers, which, strict=True):
            seed = int(jax.random.bits(jax.random.fold_in(episode_key, number), dtype=jnp.uint32))
            begin, goal = draw_ends(*rooms[room], np.random.default_rng([seed, 2]), config.starts)
            episodes.append(Episode(rooms[room][0], begin, goal, seed))
        run_key = jax.random.fold_in(run_key, first)
        return _tasks(episodes, np.zeros(len(which), int), [rooms[i][1] for i in which], run_key)

    # -------------------------------------------------------------------------------------------------- evaluation

    @with_own_numerics
    def draw_pairs(self, seed: int, n: int) -> Pairs:
        """n starts and goals in each room, at least 1 m apart, and the shortest ways between them."""
        parts = []
        for number, room in enumerate(self.rooms):
            rng = np.random.default_rng((_EVALUATION, seed, number, 1))
            ends = np.array([room.sample_pair(rng, RADIUS_M) for _ in range(n)])
            parts.append((ends, *shortest_ways(jax.random.key(seed), room, ends, radius_m=RADIUS_M, config=_DENSE)))
        ends, shortest = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        place = np.repeat(np.arange(len(self.rooms)), n)
        return Pairs(ends[:, 0], ends[:, 1], shortest, seed, place, straight=sum(part[2] for part in parts))

    def tasks_of(self, pairs: Pairs, prm: PrmConfig | None) -> tuple[RoomTasks, int | None]:
        """The pairs as tasks; with ``prm`` also a roadmap for each room, and how many pairs they do not join."""
        plan_key, run_key = jax.random.split(jax.random.key(pairs.seed))
        roadmaps, not_joined = [None] * len(self.rooms), None
        if prm is not None:
            ends = [pairs.ends[pairs.place == i] for i in range(len(self.rooms))]
            roadmaps = [
                build_roadmap(jax.random.fold_in(plan_key, i), room, radius_m=RADIUS_M, config=prm, ends=ends[i])
                for i, room in enumerate(self.rooms)
            ]
            not_joined = sum(int((~joins(roadmap, each)).sum()) for roadmap, each in zip(roadmaps, ends, strict=True))
        found = zip(pairs.place, pairs.start, pairs.goal, strict=True)
        episodes = [Episode(self.rooms[place], begin, goal, i) for i, (place, begin, goal) in enumerate(found)]
        return _tasks(episodes, pairs.place, [roadmaps[place] for place in pairs.place], run_key), not_joined

    # ----------------------------------------------------------------------------------------------------- rollout

    def rollout(
        self, policy: Policy, tasks: RoomTasks, *, horizon: int, on_progress: OnProgress = lambda over, note: None
    ) -> Rollout:
        """Run all tasks, as many at a time as there are slots."""
        parts = []
        for first in range(0, len(tasks.episodes), self.slots):
            parts.append(_run(self._pool(horizon), policy, tasks.part(first, self.slots)))
            on_progress(min(first + self.slots, len(tasks.episodes)), "")
        steps = _joined([steps for steps, _ in parts])
        end = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(end for _, end in parts))
        counted = np.ones(len(tasks.episodes), bool)
        return Rollout(steps, end, tasks.goal.astype(np.float32), tasks.place, counted, horizon)


def _tasks(episodes: list[Episode], place: np.ndarray, roadmaps: list[Any], key: jax.Array) -> RoomTasks:
    begin, goal = (np.array([getattr(each, name) for each in episodes]) for name in ("start", "goal"))
    return RoomTasks(begin, goal, place, key, episodes, roadmaps)


# ------------------------------------------------------------------------------------------------------------- rooms


def make_room(key: jax.Array, prm: PrmConfig, *, densities: tuple[float, float] = (1.0, 1.0)) -> tuple[World, Roadmap]:
    """A random room and its roadmap. Its density (see ``clutter``) is uniform between the two ``densities``."""
    world_key, map_key = jax.random.split(key)
    seed = tuple(np.asarray(jax.random.key_data(world_key)).astype(np.uint32).tolist())
    low, high = densities
    world = clutter(seed, low + (high - low) * np.random.default_rng((*seed, 3)).random())
    return world, build_roadmap(map_key, world, radius_m=RADIUS_M, config=prm)


def clutter(seed: int | tuple[int, ...], density: float) -> World:
    """A random room with ``density`` times the obstacles of training. Raises UserError like ``random_world``."""
    share = np.random.default_rng(seed).uniform(*TRAIN_DENSITY)  # the same draw as in ``random_world``
    return random_world(seed, density * share)


def evaluation_rooms(seed: int, n: int, *, density: float = 1.0) -> list[World]:
    """The rooms of an evaluation, which no training ever draws. Raises UserError for a density that cannot be."""
    return [clutter((_EVALUATION, seed, number), density) for number in range(n)]


def draw_ends(
    world: World, roadmap: Roadmap, rng: np.random.Generator, starts: str = "vertices"
) -> tuple[np.ndarray, np.ndarray]:
    """A start and a goal [2] (m) that the roadmap joins. Raises UserError if none is found."""
    for _ in range(_PAIRS):
        if starts == "maze":
            begin, goal = world.sample_pair(rng, RADIUS_M, apart_m=_APART_M)
            if not isinstance(roadmap.plan(begin, goal), NoPath):
                return begin, goal
            continue
        first, last = rng.integers(len(roadmap.points), size=2).tolist()
        begin, goal = roadmap.points[[first, last]]
        if np.linalg.norm(begin - goal) >= _APART_M and nx.has_path(roadmap.graph, first, last):
            return begin, goal
    raise UserError("the roadmap joins no start and goal in this room; use fewer obstacles or more samples")


# ----------------------------------------------------------------------------------------------------------- rollout


def as_frame(seen: PoolFrame, goal_world: np.ndarray) -> Frame:
    """What the interfaces say of the pool's frame. The reward is what the robot itself can tell: it feels no touch."""
    return Frame(
        Observation(seen.map, seen.proprio, seen.goal), seen.believed_reward, seen.done,
        Privileged(seen.position, goal_world, seen.collision.astype(np.float32), seen),
    )  # fmt: skip


def _run(pool: Turtlebot3Pool, policy: Policy, tasks: RoomTasks) -> tuple[Steps, End]:
    """Run at most as many tasks as there are slots, in the first ones."""
    n = len(tasks.episodes)
    goal = np.zeros((pool.n, 2))
    goal[:n] = tasks.goal
    seen = pool.reset(tasks.episodes, range(n))
    memory, moments = policy.init(as_frame(seen, goal), tasks), []
    while not seen.done.all():
        key = jax.random.fold_in(tasks.key, len(moments))
        action, memory = policy.act(memory, as_frame(seen, goal), key)
        after = pool.step(np.asarray(action.executed))
        moments.append(_moment(seen, action, after, n))
        seen = after
        raise_if_interrupted()
    steps = jax.tree.map(lambda *leaves: np.stack(leaves), *moments)
    end = End(seen.position[:n].astype(np.float32), seen.reward[:n], seen.success[:n], np.zeros(n, bool), None)
    return steps, end


def _moment(seen: PoolFrame, action: Any, after: PoolFrame, n: int) -> Steps:
    """The record of one step of n episodes."""

    def take(values: Any) -> np.ndarray:
        return np.asarray(values[:n], np.float32)

    given = {name: take(getattr(action, name)) for name in ("label", "label_mask")}
    if action.target_return is not None:
        given["target_return"] = take(action.target_return)
    return Steps(
        position=take(seen.position), proprio=take(seen.proprio), action=take(action.intended),
        reward=take(after.reward), alive=1.0 - take(seen.done), collision=take(after.collision),
        success=take(after.success), frontal=take(after.frontal), grazing=take(after.grazing),
        goal_relative=take(seen.goal), map_bits=pack_maps(seen.map[:n]), **given,
    )  # fmt: skip


def _joined(parts: list[Steps]) -> Steps:
    """The records side by side. In what is added to the shorter ones, nothing moves and nobody is alive."""
    longest = max(len(part.alive) for part in parts)

    def fit(leaf: np.ndarray) -> np.ndarray:
        return np.pad(leaf, [(0, longest - len(leaf)), *[(0, 0)] * (leaf.ndim - 1)], mode="edge")

    parts = [
        jax.tree.map(fit, part)._replace(alive=np.pad(part.alive, [(0, longest - len(part.alive)), (0, 0)]))
        for part in parts
    ]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, 1), *parts)
