"""Evaluation on fixed start-goal pairs: success, return, SPL, collisions and time-outs, with intervals."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from scipy import stats

from ct_envs import MazeEnv, Tasks, UserError, check_tasks
from ct_envs.maze import Maze, sample_pair
from ct_envs.robots import Robot
from ct_jax.collect import make_guide, plan_memory, run_episodes, start_episodes
from ct_jax.devices import data_mesh, fill_up, joined, own
from ct_jax.numerics import with_own_numerics
from ct_jax.policy import Conditioned
from ct_jax.prm import PlanTable, PrmConfig, Space, build_roadmap, extend_by_pairs
from ct_jax.rollout import Controller, Guided, Policy, Steps, broke_off

METHODS = ("ct", "planner", "explorer")
GUIDED = ("planner", "explorer")  # what is led by a plan; everything else is a policy that was learned
MAX_HORIZON = 1_000_000
_DENSE = PrmConfig(samples=1000)  # of the shortest ways
RETURN_UNIT = 100.0  # the paper's scaled return is the raw one over this


@dataclass(frozen=True)
class Pairs:
    """Starts and goals of an evaluation, drawn once from a seed, and the shortest ways between them."""

    start: np.ndarray  # [n, 2], [m]
    goal: np.ndarray
    shortest_m: np.ndarray  # [n], on a dense roadmap; where it has no path, the straight line
    seed: int
    world: np.ndarray | None = None  # int [n]: which of several worlds each is in
    straight: int = 0  # how many have only a straight line for a shortest way: it is a lower bound


@dataclass(frozen=True)
class Episodes:
    """What one method did on the pairs."""

    success: np.ndarray  # bool [n]
    collided: np.ndarray  # bool [n]: touched a wall at any step
    fell: np.ndarray  # bool [n]
    timeout: np.ndarray  # bool [n]: neither arrived nor broke off
    steps: np.ndarray  # [n]
    returns: np.ndarray  # [n], raw; after a fall, or where it diverged, the robot lies where it is until the horizon
    travelled_m: np.ndarray  # [n]
    path: np.ndarray  # float32 [T, n, 2]: positions, for pictures
    pairs: Pairs
    wall_s: float
    horizon: int  # control steps of an episode
    asked: np.ndarray | None = None  # return asked for at the start
    film: np.ndarray | None = None  # float32 [T, nq]: ``qpos`` before each step, of the first episode, for a video
    frontal: np.ndarray | None = None  # bool [n]: ran into something, where that is told from ...
    grazing: np.ndarray | None = None  # ... bool [n]: touched something with its side
    not_joined: int | None = None  # of a planner: pairs that its roadmap does not join
    beyond: int = 0  # pairs too far apart for the robot to make within the horizon
    diverged: np.ndarray | None = None  # bool [n]: a state or action was not finite, where that ends an episode

    def summary(self) -> dict[str, Any]:
        """Rates and means; intervals are 95 %: Wilson for rates, bootstrap over episodes for means."""
        spl = self.success * self.pairs.shortest_m / np.maximum(self.pairs.shortest_m, self.travelled_m)
        rows: dict[str, Any] = {"success_rate": float(self.success.mean()), "success_ci95": wilson(self.success)}
        rows |= {"return_mean": float(self.returns.mean()), "return_ci95": bootstrap(self.returns)}
        rows |= {"return_scaled": float(self.returns.mean() / RETURN_UNIT)}
        rows |= {"return_scaled_ci95": [x / RETURN_UNIT for x in bootstrap(self.returns)]}
        rows |= {"spl": float(spl.mean()), "spl_ci95": bootstrap(spl)}
        rows |= {"collision_rate": float(self.collided.mean()), "collision_ci95": wilson(self.collided)}
        rows |= {"fall_rate": float(self.fell.mean()), "fall_ci95": wilson(self.fell)}
        rows |= {"timeout_rate": float(self.timeout.mean()), "timeout_ci95": wilson(self.timeout)}
        for name in ("frontal", "grazing", "diverged"):
            told = getattr(self, name)
            rows |= {} if told is None else {f"{name}_rate": float(told.mean()), f"{name}_ci95": wilson(told)}
        rows |= {"horizon": self.horizon, "beyond_horizon": self.beyond, "straight_ways": self.pairs.straight}
        rows |= {} if self.not_joined is None else {"not_joined": self.not_joined}
        return rows | {"steps_mean": float(self.steps.mean()), "wall_s": round(self.wall_s, 2)}


def wilson(outcomes: np.ndarray) -> list[float]:
    """95 % interval of a rate."""
    return wilson_of(int(np.sum(outcomes)), len(outcomes))


def wilson_of(successes: int, tries: int) -> list[float]:
    """The same from counts."""
    interval = stats.binomtest(successes, tries).proportion_ci(0.95, method="wilson")
    return [float(interval.low), float(interval.high)]


def bootstrap(values: np.ndarray) -> list[float]:
    """95 % interval of a mean (percentile bootstrap, fixed seed)."""
    if len(values) < 2 or np.ptp(values) == 0:
        return [float(np.mean(values))] * 2
    result = stats.bootstrap((values,), np.mean, n_resamples=2000, rng=np.random.default_rng(0), method="percentile")
    return [float(result.confidence_interval.low), float(result.confidence_interval.high)]


@with_own_numerics
def draw_pairs(seed: int, maze: Maze, n: int, *, radius_m: float, tolerance_m: float) -> Pairs:
    """Draw pairs of free points of one region, a goal never within twice the tolerance of its start."""
    keys = jax.random.split(jax.random.key(seed), 8 * n + 64)
    draw = jax.jit(jax.vmap(lambda key: sample_pair(key, maze, radius=radius_m)))
    start, goal = map(np.asarray, draw(keys))
    apart = np.flatnonzero(np.linalg.norm(start - goal, axis=1) > 2 * tolerance_m)[:n]
    start, goal = start[apart], goal[apart]
    shortest, straight = shortest_ways(jax.random.key(seed), maze, start, goal, radius_m=radius_m, config=_DENSE)
    return Pairs(start, goal, shortest, seed, straight=straight)


def shortest_ways(
    key: jax.Array, space: Maze | Space, start: np.ndarray, goal: np.ndarray, *, radius_m: float, config: PrmConfig
) -> tuple[np.ndarray, int]:
    """Lengths [n] (m) of the shortest ways between starts and goals [n, 2] (m) on a roadmap, which grows until it joins
    them. Where it cannot, the straight line: a lower bound, for a strict SPL. And how many these are."""
    ends = np.stack([start, goal], 1)
    grown, nodes = extend_by_pairs(build_roadmap(key, space, radius_m=radius_m, config=config, ends=ends), ends)
    shortest = grown.distances(nodes)
    unknown = ~np.isfinite(shortest)
    return np.where(unknown, np.linalg.norm(start - goal, axis=1), shortest), int(unknown.sum())


class Learned(Policy, Protocol):
    """A policy that can begin an episode by itself: the transformer's, or a baseline's."""

    def init(self, state: State) -> Any:
        """Its memory at the start of N episodes."""
        ...


def check_horizon(horizon: int | None) -> None:
    """Raises UserError for a horizon that is given and out of its range."""
    if horizon is not None and not 1 <= horizon <= MAX_HORIZON:
        raise UserError(f"--horizon {horizon}: give a number of control steps from 1 to {MAX_HORIZON}")


def horizon_for(robot: Robot, pairs: Pairs) -> int:
    """Control steps of an episode: the robot's own horizon, or more in proportion to the longest way of the pairs."""
    return int(np.ceil(robot.horizon * max(1.0, float(pairs.shortest_m.max()) / robot.way_m)))


def beyond_horizon(robot: Robot, pairs: Pairs, horizon: int) -> int:
    """How many pairs are farther apart than the robot goes in so many control steps."""
    return int((pairs.shortest_m > robot.cruise_mps * robot.control_dt_s * horizon).sum())


@with_own_numerics
def evaluate(
    env: MazeEnv,
    maze: Maze,
    pairs: Pairs,
    method: str,
    *,
    policy: Learned | None = None,
    controller: Controller | None = None,
    prm: PrmConfig | None = None,
    horizon: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Episodes:
    """Run one method on all pairs at once, which all devices share.

    Args:
        env: with maps, without auto-reset.
        method: "planner" (the full map, needs ``controller``), "explorer" (likewise), or any name for ``policy``.
        horizon: control steps of an episode; by default the environment's.

    Raises:
        UserError: pairs that are not of that maze.
    """
    check_tasks(Tasks(pairs.start, pairs.goal, len(pairs.start)), maze)  # pyright: ignore[reportArgumentType]
    env = env.with_horizon(horizon or env.horizon)
    begun = time.perf_counter()
    order = fill_up(len(pairs.start), data_mesh())
    n = len(order)
    keys = jax.random.split(jax.random.key(pairs.seed), len(pairs.start) + 2)
    start_keys, plan_key, run_key = keys[:-2][order], keys[-2], keys[-1]
    mazes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), maze)
    state = start_episodes(env, start_keys, mazes, jnp.asarray(pairs.start[order]), jnp.asarray(pairs.goal[order]))
    asked = not_joined = None
    if method not in GUIDED:
        assert policy is not None
        actor, memory = policy, policy.init(state)
        asked = memory.rtg if isinstance(memory, Conditioned) else None
    else:
        assert controller is not None
        prm = prm or PrmConfig()
        guide = make_guide("shortcut" if method == "planner" else method, env, prm)
        tables, not_joined = _plans(plan_key, env, maze, pairs, prm) if method == "planner" else (None, None)
        actor = Guided(controller, guide)
        memory = actor.init(state, plan_memory(guide, tables, jnp.zeros(n, jnp.int32), state))
    state, _, steps = run_episodes(
        env, actor, state, memory, run_key, chunk=50, limit=env.horizon, on_progress=on_progress
    )
    episodes = _outcome(env, state, steps, pairs, time.perf_counter() - begun, asked)
    return replace(episodes, not_joined=not_joined)


def _plans(key: jax.Array, env: MazeEnv, maze: Maze, pairs: Pairs, prm: PrmConfig) -> tuple[PlanTable, int]:
    """The planner's ways to the goals, with a leading axis of one, and how many starts and goals they do not join."""
    ends = np.stack([pairs.start, pairs.goal], 1)
    roadmap = build_roadmap(key, maze, radius_m=env.robot.radius_m, config=prm, ends=ends)
    grown, nodes = extend_by_pairs(roadmap, ends)
    table = jax.tree.map(lambda leaf: leaf[None], grown.table_to(nodes[:, 1]))
    return table, int((~grown.are_joined(nodes)).sum())


def _outcome(
    env: MazeEnv, state: State, steps: Steps, pairs: Pairs, wall_s: float, asked: jax.Array | None
) -> Episodes:
    """What happened to the pairs, from the steps of each process's own."""
    names = ("success", "fall", "diverged", "position")
    end = {name: state.info[name] for name in names} | {"broken": broke_off(state.info)}
    end = own(end | {"reward": state.reward, "asked": asked}, data_mesh())
    success, broken = end["success"] > 0, end["broken"] > 0
    alive, path = steps.alive, steps.position
    whole = np.concatenate([path, end["position"][None]])
    lying = broken * end["reward"] * (env.horizon - alive.sum(0))
    each = {
        "success": success,
        "collided": (steps.collision * alive).sum(0) > 0,
        "fell": end["fall"] > 0,
        "diverged": end["diverged"] > 0,
        "timeout": ~success & ~broken,
        "steps": alive.sum(0),
        "returns": (steps.reward * alive).sum(0) + lying,
        "travelled_m": np.linalg.norm(np.diff(whole, axis=0), axis=-1).sum(0),
        "asked": end["asked"],
    }
    n = len(pairs.start)
    each = {name: None if rows is None else joined(rows)[:n] for name, rows in each.items()}
    every_path = joined(np.swapaxes(path, 0, 1))[:n]
    rest = env.engine.model.nq - 2  # of qpos, with which proprioception begins
    film = joined(np.concatenate([path[:, 0], steps.proprio[:, 0, :rest]], -1)[None])[0]
    return Episodes(
        **each, path=np.swapaxes(every_path, 0, 1), pairs=pairs, wall_s=wall_s, horizon=env.horizon, film=film,
        beyond=beyond_horizon(env.robot, pairs, env.horizon),
    )  # fmt: skip
