"""Evaluation of the Turtlebot3 in random rooms that no training ever draws (paper, sec. IV-B)."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State

from ct_envs.robots import TURTLEBOT3
from ct_envs.turtlebot3 import RADIUS_M
from ct_envs.turtlebot3_pool import Episode, Frame, Turtlebot3Pool
from ct_envs.turtlebot3_world import World
from ct_jax.agent import act
from ct_jax.collect_turtlebot3 import Room, Wave, clutter, drive_guided, make_guide
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.drive import Drive, drive
from ct_jax.evaluate import GUIDED, Episodes, Learned, Pairs, beyond_horizon, shortest_ways
from ct_jax.numerics import with_own_numerics
from ct_jax.policy import Conditioned
from ct_jax.prm import PrmConfig, build_roadmap, joins
from ct_jax.rollout import Action

_EVALUATION = 1  # seeds of these rooms have three entries, those of training two: none is in both
_DENSE = PrmConfig(samples=600, connect_m=2.0, most_samples=2400)
PLANNER = PrmConfig(
    samples=400, connect_m=2.0, margin_m=0.03, most_samples=1600
)  # joins what a robot can reach, and cuts no corner


# ------------------------------------------------------------------------------------------------------ a policy


def as_state(frame: Frame) -> State:
    """What a pool shows, as the mazes' policies see it.

    The reward is what the robot itself can tell of it. Its place and touches are for whoever watches over a policy.
    """
    obs = {name: jnp.asarray(getattr(frame, name)) for name in ("map", "proprio", "goal")}
    info = {"position": jnp.asarray(frame.position, jnp.float32)}
    info |= {"collision": jnp.asarray(frame.collision, jnp.float32)}
    return State(None, obs, jnp.asarray(frame.believed_reward), jnp.asarray(frame.done, jnp.float32), {}, info)


@dataclass(frozen=True)
class PolicyDriver:
    """A policy of the mazes in the slots of a pool, all of them at the same step of their episodes."""

    policy: Learned
    key: jax.Array

    def init(self, frame: Frame) -> tuple[Any, int]:
        """The policy's memory, and the steps taken."""
        return self.policy.init(as_state(frame)), 0

    def act(self, memory: tuple[Any, int], frame: Frame) -> tuple[Action, tuple[Any, int]]:
        """The policy's actions."""
        own, step = memory
        action, own = act(self.policy, own, as_state(frame), jax.random.fold_in(self.key, step))
        return action, (own, step + 1)


# ---------------------------------------------------------------------------------------------------- evaluation


def draw_rooms(seed: int, worlds: int, *, density: float = 1.0) -> list[World]:
    """The worlds of an evaluation. Raises UserError for a density that cannot be."""
    return [clutter((_EVALUATION, seed, number), density) for number in range(worlds)]


@with_own_numerics
def draw_room_pairs(seed: int, worlds: Sequence[World], n: int) -> Pairs:
    """n starts and goals in each world, at least 1 m apart, and the shortest ways between them on a dense roadmap."""
    parts = []
    for number, world in enumerate(worlds):
        rng = np.random.default_rng((_EVALUATION, seed, number, 1))
        ends = np.array([world.sample_pair(rng, RADIUS_M) for _ in range(n)])
        way, straight = shortest_ways(
            jax.random.key(seed), world, ends[:, 0], ends[:, 1], radius_m=RADIUS_M, config=_DENSE
        )
        parts.append((ends, way, np.array([straight])))
    ends, shortest, straight = (np.concatenate(leaves) for leaves in zip(*parts, strict=True))
    which = np.repeat(np.arange(len(worlds)), n)
    return Pairs(ends[:, 0], ends[:, 1], shortest, seed, which, straight=int(straight.sum()))


@with_own_numerics
def evaluate_rooms(
    pool: Turtlebot3Pool,
    worlds: Sequence[World],
    pairs: Pairs,
    method: str,
    *,
    policy: Learned | None = None,
    controller: DifferentialDrive = DifferentialDrive(),
    on_progress: Callable[[int, int], None] | None = None,
) -> Episodes:
    """Run one method on all pairs, as many at a time as the pool has slots.

    Args:
        method: "planner" (the full map), "explorer", or any name for ``policy``.
        on_progress: told (waves, episodes that are over) after every wave.
    """
    begun = time.perf_counter()
    assert pairs.world is not None
    plan_key, act_key = jax.random.split(jax.random.key(pairs.seed))
    ends = np.stack([pairs.start, pairs.goal], 1)
    rooms = [
        _room(jax.random.fold_in(plan_key, i), world, ends[pairs.world == i])
        for i, world in enumerate(worlds)
        if method in GUIDED
    ]
    not_joined = None
    if method == "planner":
        not_joined = sum(int((~joins(room.roadmap, ends[pairs.world == i])).sum()) for i, room in enumerate(rooms))
    drives: list[Drive] = []
    asked: list[np.ndarray] = []
    for first in range(0, len(pairs.start), pool.n):
        which = range(first, min(first + pool.n, len(pairs.start)))
        episodes = [Episode(worlds[pairs.world[i]], pairs.start[i], pairs.goal[i], i) for i in which]
        if method in GUIDED:
            guide = make_guide("shortcut" if method == "planner" else method, PLANNER)
            wave = Wave(episodes, [rooms[pairs.world[i]] for i in which])
            drives += drive_guided(pool, wave, guide, controller)
        else:
            assert policy is not None
            driver = PolicyDriver(policy, jax.random.fold_in(act_key, first))
            begin = _telling(driver, asked, len(which))
            drives += drive(pool, episodes, driver, begin)
        if on_progress is not None:
            on_progress(first // pool.n + 1, len(drives))
    horizon = pool.config.horizon
    return replace(
        _outcome(drives, pairs, time.perf_counter() - begun, np.concatenate(asked) if asked else None, horizon),
        not_joined=not_joined,
        beyond=beyond_horizon(TURTLEBOT3, pairs, horizon),
    )


def _room(key: jax.Array, world: World, ends: np.ndarray) -> Room:
    """A world with the roadmap of the reference planner, which joins these starts and goals [k, 2, 2] (m)."""
    return Room(world, build_roadmap(key, world, radius_m=RADIUS_M, config=PLANNER, ends=ends))


def grades(episodes: Episodes) -> dict[str, int]:
    """Trajectories as the paper counts those of the real robot: full successes touch nothing, partial ones graze, and
    failures run into something or do not arrive."""
    assert episodes.frontal is not None and episodes.grazing is not None
    arrived = episodes.success & ~episodes.frontal
    full, partial = int((arrived & ~episodes.grazing).sum()), int((arrived & episodes.grazing).sum())
    return {"full": full, "partial": partial, "failed": len(arrived) - full - partial}


def _telling(driver: PolicyDriver, asked: list[np.ndarray], n: int) -> Callable[[Frame], Any]:
    """The driver's beginning, which also notes what return is asked for, if any is."""

    def begin(frame: Frame) -> Any:
        memory = driver.init(frame)
        if isinstance(memory[0], Conditioned):
            asked.append(np.asarray(memory[0].rtg)[:n])
        return memory

    return begin


def _outcome(drives: list[Drive], pairs: Pairs, wall_s: float, asked: np.ndarray | None, horizon: int) -> Episodes:
    longest = max(each.length for each in drives)
    paths = [np.pad(each.path, [(0, longest + 1 - len(each.path)), (0, 0)], mode="edge") for each in drives]
    success = np.array([each.success for each in drives])
    frontal, grazing = (np.array([getattr(each, name).any() for each in drives]) for name in ("frontal", "grazing"))
    return Episodes(
        success=success,
        collided=frontal | grazing,
        fell=np.zeros(len(drives), bool),
        timeout=~success,
        steps=np.array([each.length for each in drives]),
        returns=np.array([each.reward.sum() for each in drives], np.float64),
        travelled_m=np.array([np.linalg.norm(np.diff(each.path, axis=0), axis=-1).sum() for each in drives]),
        path=np.stack(paths, 1)[1:].astype(np.float32),
        pairs=pairs,
        wall_s=wall_s,
        horizon=horizon,
        asked=asked,
        frontal=frontal,
        grazing=grazing,
    )
