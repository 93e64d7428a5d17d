"""Collecting planner-guided trajectories (paper, Algorithm 3)."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State

from ct_envs import MazeEnv, Tasks, UserError
from ct_envs.checked import Above, Checked, Count, Within
from ct_envs.maze import Maze, sample_pair
from ct_jax.devices import data_mesh, fill_up, joined, largest, own, own_rows, place, sharded
from ct_jax.explorer import ExplorerGuide
from ct_jax.interrupts import raise_if_interrupted
from ct_jax.numerics import with_own_numerics
from ct_jax.prm import PlanTable, PrmConfig, RoadmapGuide, build_roadmap, draw_joined, extend, stack_tables
from ct_jax.rollout import Controller, Guided, Steps, broke_off, rollout
from ct_jax.trajectories import Trajectories, concatenate, select

Guide = Literal["roadmap", "shortcut", "explorer"]


@dataclass(frozen=True)
class CollectConfig(Checked):
    """Planner-guided collection (paper, Algorithm 3 and sec. IV-A). The defaults are the paper's."""

    trajectories: Count = 1000  # T: successes to collect
    reset_interval: Count = 25  # L: episodes on one roadmap
    guide: Guide = "roadmap"  # planner: "roadmap" point by point, "shortcut" to visible points, "explorer" without map
    starts: Literal["vertices", "maze"] = "vertices"  # starts and goals: roadmap "vertices" (paper) or free points of
    # the "maze"
    noise: Annotated[float, Within(0, 100)] = 0.0  # standard deviation of a disturbance of actions; it is not imitated
    envs: Annotated[int, Within(1, 100_000)] = 250  # episodes at a time
    horizon: Annotated[int, Within(1, 1_000_000)] = 400  # steps of an episode
    give_up: Annotated[float, Above(0, 1_000_000)] = 10.0  # stop after this many times T episodes


def run_episodes(
    env: MazeEnv,
    policy: object,
    state: State,
    memory: object,
    key: jax.Array,
    *,
    chunk: int = 25,
    limit: int,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[State, object, Steps]:
    """Roll out until all episodes are over, at most ``limit`` steps, in compiled chunks.

    Args:
        state: from ``start_episodes``.
        on_progress: called with (steps, finished episodes) after every ``chunk``.

    Returns:
        The last state and memory, and the steps of this process's own episodes as NumPy [T, n, ...].
    """
    mesh = data_mesh()
    parts, chunk = [], min(chunk, limit)
    for i in range(-(-limit // chunk)):
        state, memory, steps = rollout(env, policy, state, memory, jax.random.fold_in(key, i), chunk, mesh)  # pyright: ignore
        parts.append(own(steps, mesh, axis=1))
        over = int((state.done > 0).sum())
        raise_if_interrupted()
        if on_progress is not None:
            on_progress((i + 1) * chunk, over)
        if over == state.done.shape[0]:
            break
    return state, memory, jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def start_episodes(env: MazeEnv, keys: jax.Array, maze: Maze, start: jax.Array, goal: jax.Array) -> State:
    """States of N episodes with the given keys [N], mazes (leading axis N), starts and goals [N, 2] (m).

    The devices share them evenly, so N must be a length that ``fill_up`` gives.
    """
    n = len(start)
    tasks = Tasks(start[:, None], goal[:, None], jnp.ones(n, jnp.int32))
    return _reset(env)(*place((keys, maze, tasks), sharded(data_mesh())))


_resets: dict[int, tuple[MazeEnv, Callable]] = {}


def _reset(env: MazeEnv) -> Callable:
    if id(env) not in _resets:
        _resets[id(env)] = env, jax.jit(jax.vmap(env.reset))
    return _resets[id(env)][1]


def to_trajectories(steps: Steps, goal: np.ndarray, maze: np.ndarray) -> Trajectories:
    """Turn the record of N episodes (time first) into trajectories with final goals.

    Rewards are those of the final goal (paper, sec. III-C). ``MazeEnv`` already gives them: its reward does not depend
    on the waypoints that the controller followed.
    """
    swap = lambda leaf: np.swapaxes(np.asarray(leaf), 0, 1)  # noqa: E731
    length = np.asarray(steps.alive).sum(0).astype(np.int32)
    return Trajectories(
        position=swap(steps.position),
        proprio=swap(steps.proprio),
        action=swap(steps.action),
        label=swap(steps.label),
        reward=swap(steps.reward),
        label_mask=swap(steps.label_mask * steps.alive),
        collision=swap(steps.collision * steps.alive),
        goal_world=np.asarray(goal),
        maze=np.asarray(maze, np.int32),
        length=length,
    )


def make_guide(name: Guide, env: MazeEnv, prm: PrmConfig) -> RoadmapGuide | ExplorerGuide:
    """The guide with this name."""
    radius, cell_m = env.robot.radius_m, env.engine.cell_m
    if name == "explorer":
        return ExplorerGuide(radius + prm.margin_m, env.map_cell_m, cell_m, prm.connect_m)
    return RoadmapGuide(radius, prm.margin_m, prm.connect_m, cell_m, shortcut=name == "shortcut")


@with_own_numerics
def collect(
    key: jax.Array,
    env: MazeEnv,
    mazes: Maze,
    controller: Controller,
    config: CollectConfig,
    prm: PrmConfig,
    *,
    on_progress: Callable[[int, int], None] = lambda successes, episodes: None,
) -> Trajectories:
    """Algorithm 3: guide pi_c until T episodes have succeeded; only successes are kept.

    Args:
        env: without auto-reset and maps, with ``config.horizon``.
        mazes: stacked; each new roadmap is in the next maze.
        on_progress: called with (successes, episodes) so far.

    Raises:
        UserError: too few successes within ``give_up * T`` episodes.
    """
    policy = Guided(controller, make_guide(config.guide, env, prm), config.noise)

    def wave(first: int) -> tuple[Trajectories, np.ndarray]:
        batch_key, run_key = jax.random.split(jax.random.fold_in(key, first))
        batch = draw_batch(batch_key, env, mazes, config, prm, first_maze=first // config.reset_interval)
        memory = policy.init(batch.state, plan_memory(policy.guide, batch.tables, batch.which, batch.state))
        state, _, steps = run_episodes(env, policy, batch.state, memory, run_key, limit=config.horizon)
        return batch.outcome(state, steps)[:2]

    return gather(config, wave, on_progress)


def gather(
    config: CollectConfig,
    wave: Callable[[int], tuple[Trajectories, np.ndarray]],
    on_progress: Callable[[int, int], None],
) -> Trajectories:
    """The loop of Algorithm 3: episodes, wave after wave, until T have succeeded; only successes are kept.

    Args:
        wave: a function of the index of its first episode. It returns this process's share of ``config.envs`` episodes
            (all shares are equal), and which of them succeeded.

    Returns:
        This process's share of the successes.

    Raises:
        UserError: too few successes within ``give_up * T`` episodes.
    """
    kept: list[Trajectories] = []
    successes = episodes = 0
    while successes < config.trajectories:
        if episodes >= config.give_up * config.trajectories:
            raise UserError(
                f"the controller reached only {successes} of {episodes} goals, but {config.trajectories} are needed; "
                "train it longer or check its success on edges"
            )
        data, won = wave(episodes)
        everyone = joined(won)
        among = everyone & (successes + np.cumsum(everyone) <= config.trajectories)
        kept.append(select(data, own_rows(among)))
        successes, episodes = successes + int(everyone.sum()), episodes + config.envs
        on_progress(successes, episodes)
    return concatenate(kept)


@dataclass(frozen=True)
class Batch:
    """First states of episodes, each with a roadmap that connects its start and goal."""

    state: State
    tables: PlanTable  # leading axis: roadmaps
    which: jax.Array  # int32 [N]: roadmap of each episode
    maze: np.ndarray  # int [N]: maze of each episode
    real: np.ndarray  # bool [N]: false for copies; these make the number even for all devices

    def outcome(self, state: State, steps: Steps) -> tuple[Trajectories, np.ndarray, np.ndarray]:
        """This process's episodes, which of them succeeded, and which broke off: see ``rollout.broke_off``."""
        ends = {name: state.info[name] for name in ("goal", "success")} | {"broken": broke_off(state.info)}
        ends = own(ends, data_mesh())
        real = own_rows(self.real)
        data = to_trajectories(steps, ends["goal"], own_rows(self.maze))
        return data, real & (ends["success"] > 0), real & (ends["broken"] > 0)


def draw_batch(
    key: jax.Array, env: MazeEnv, mazes: Maze, config: CollectConfig, prm: PrmConfig, *, first_maze: int = 0
) -> Batch:
    """New roadmaps, one for every ``reset_interval`` episodes, maze after maze, and the first states of episodes."""
    n_maps = max(1, config.envs // config.reset_interval)
    per_map = -(-config.envs // n_maps)
    maze_of_map = (first_maze + np.arange(n_maps)) % mazes.walls.shape[0]
    keys = jax.random.split(key, n_maps + 1)
    # Each process builds its share of the roadmaps and sends it to the others.
    mine = np.array_split(np.arange(n_maps), jax.process_count())[jax.process_index()]
    drawn = [
        _endpoints(keys[i], jax.tree.map(lambda leaf, m=maze_of_map[i]: leaf[m], mazes), env, config, prm, per_map)
        for i in (mine if len(mine) else [0])  # a process without a share builds one, for the shapes of its arrays
    ]
    tables, start, goal = zip(*drawn, strict=True)
    start, goal = (joined(np.stack(ends)[: len(mine)]) for ends in (start, goal))
    tables = stack_tables(list(tables), largest)
    tables = jax.tree.map(lambda leaf: joined(np.asarray(leaf)[: len(mine)]), tables)
    order = fill_up(config.envs, data_mesh())
    start, goal = (jnp.asarray(ends.reshape(-1, 2)[order]) for ends in (start, goal))
    which = np.repeat(np.arange(n_maps), per_map)[order]
    maze = jax.tree.map(lambda leaf: leaf[maze_of_map[which]], mazes)
    state = start_episodes(env, jax.random.split(keys[-1], len(order)), maze, start, goal)
    return Batch(state, tables, jnp.asarray(which), maze_of_map[which], np.arange(len(order)) < config.envs)


def plan_memory(guide: RoadmapGuide | ExplorerGuide, tables: PlanTable, which: jax.Array, state: State) -> object:
    """The guide's memory for robots at their present positions: at the start of episodes, or later."""
    maze, position, goal = (state.info[name] for name in ("maze", "position", "goal"))
    if isinstance(guide, ExplorerGuide):
        return guide.init(maze)
    return _plan(guide, tables, which, maze, position, goal)


@jax.jit(static_argnums=0)
def _plan(guide: RoadmapGuide, tables: PlanTable, which: jax.Array, maze: Maze, position: jax.Array, goal: jax.Array):
    return guide.init(tables, which, maze, position, goal)


def _endpoints(
    key: jax.Array, maze: Maze, env: MazeEnv, config: CollectConfig, prm: PrmConfig, n: int
) -> tuple[PlanTable, jax.Array, jax.Array]:
    """A new roadmap, and n starts and goals [n, 2] (m) that it connects."""
    map_key, pair_key = jax.random.split(key)
    build = functools.partial(build_roadmap, map_key, maze, radius_m=env.robot.radius_m, config=prm)
    if config.starts == "maze":
        pairs = jax.vmap(lambda k: sample_pair(k, maze, radius=env.robot.radius_m))(jax.random.split(pair_key, n))
        ends = np.stack(pairs, 1)
        if config.guide == "explorer":  # it uses no roadmap, so any table will do
            return build(ends=ends[:0]).table, *pairs
        roadmap = build(ends=ends)
        goals = np.arange(n) + len(roadmap.points)
        grown = extend(roadmap, ends[:, 1]) if roadmap.samples > prm.samples else roadmap
        return grown.table_to(goals), *pairs
    roadmap = build()
    chosen = draw_joined(pair_key, roadmap, n)
    points = jnp.asarray(roadmap.points)
    return roadmap.table_to(chosen[:, 1]), points[chosen[:, 0]], points[chosen[:, 1]]
