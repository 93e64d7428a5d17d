"""Collecting planner-guided trajectories (paper, Algorithm 3)."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State

from ct_envs import MazeEnv, Tasks, UserError
from ct_envs.maze import Maze, sample_free
from ct_jax.explorer import ExplorerGuide
from ct_jax.prm import PlanTable, PrmConfig, RoadmapGuide, build_roadmap, stack_tables
from ct_jax.rollout import Controller, Guided, Steps, rollout
from ct_jax.trajectories import Trajectories, concatenate, select

GUIDES = ("roadmap", "shortcut", "explorer")


@dataclass(frozen=True)
class CollectConfig:
    """Planner-guided collection (paper, Algorithm 3 and sec. IV-A). The defaults are the paper's."""

    trajectories: int = 1000  # T: successes to collect
    reset_interval: int = 25  # L: episodes on one roadmap
    guide: str = "roadmap"  # whose plan: "roadmap" point by point, "shortcut" over it, "explorer" (knows no map)
    starts: str = "vertices"  # starts and goals: roadmap "vertices" (paper) or free points of the "maze"
    noise: float = 0.0  # size of a disturbance of the actions that is not imitated
    envs: int = 250  # episodes at a time
    horizon: int = 400  # steps of an episode
    give_up: float = 10.0  # stop after this many times T episodes


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
    """Roll out until all episodes are over, or ``limit`` steps, in compiled chunks; steps as NumPy [T, N, ...].

    Args:
        on_progress: told (steps, episodes that are over) after every ``chunk``.
    """
    parts = []
    for i in range(-(-limit // chunk)):
        state, memory, steps = rollout(env, policy, state, memory, jax.random.fold_in(key, i), chunk)  # pyright: ignore
        parts.append(jax.tree.map(np.asarray, steps))
        over = int((np.asarray(state.done) > 0).sum())
        if on_progress is not None:
            on_progress((i + 1) * chunk, over)
        if over == state.done.shape[0]:
            break
    return state, memory, jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def start_episodes(env: MazeEnv, key: jax.Array, maze: Maze, start: jax.Array, goal: jax.Array) -> State:
    """States of N episodes with the given mazes (leading axis N), starts and goals [N, 2] (m)."""
    n = len(start)
    tasks = Tasks(start[:, None], goal[:, None], jnp.ones(n, jnp.int32))
    return _reset(env)(jax.random.split(key, n), maze, tasks)


_resets: dict[int, tuple[MazeEnv, Callable]] = {}


def _reset(env: MazeEnv) -> Callable:
    if id(env) not in _resets:
        _resets[id(env)] = env, jax.jit(jax.vmap(env.reset))
    return _resets[id(env)][1]


def to_trajectories(steps: Steps, goal: np.ndarray, maze: np.ndarray, learn: np.ndarray | None = None) -> Trajectories:
    """Turn the record of N episodes (time first) into trajectories with final goals.

    The rewards are relabelled to the final goal (paper, sec. III-B): ``MazeEnv``'s are so from the start, whatever
    waypoints the controller followed.
    """
    swap = lambda leaf: np.swapaxes(np.asarray(leaf), 0, 1)  # noqa: E731
    length = np.asarray(steps.alive).sum(0).astype(np.int32)
    return Trajectories(
        position=swap(steps.position),
        proprio=swap(steps.proprio),
        action=swap(steps.action),
        reward=swap(steps.reward),
        learn=swap(steps.alive if learn is None else learn),
        collision=swap(steps.collision * steps.alive),
        goal=np.asarray(goal),
        maze=np.asarray(maze, np.int32),
        length=length,
    )


def make_guide(name: str, env: MazeEnv, prm: PrmConfig) -> RoadmapGuide | ExplorerGuide:
    """The guide of that name. Raises UserError with the valid names."""
    radius, cell_m = env.robot.radius_m, env.engine.cell_m
    if name == "explorer":
        return ExplorerGuide(radius + prm.margin_m, env.map_cell_m, cell_m, prm.connect_m)
    if name not in GUIDES:
        raise UserError(f"no guide named '{name}'; guides: {', '.join(GUIDES)}")
    return RoadmapGuide(radius + prm.margin_m, prm.connect_m, cell_m, shortcut=name == "shortcut")


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
        mazes: stacked; each roadmap takes the next one.
        on_progress: told (successes, episodes) so far.

    Raises:
        UserError: too few successes within ``give_up * T`` episodes.
    """
    n_mazes = mazes.walls.shape[0]
    guide = make_guide(config.guide, env, prm)
    policy = Guided(controller, guide, config.noise)
    kept: list[Trajectories] = []
    successes = episodes = batch = 0
    while successes < config.trajectories:
        if episodes >= config.give_up * config.trajectories:
            raise UserError(
                f"the controller reached only {successes} of {episodes} goals, {config.trajectories} were asked for; "
                "train it longer or look at its success on edges"
            )
        run_key, batch_key = jax.random.split(jax.random.fold_in(key, batch))
        per_maze = max(1, config.envs // config.reset_interval)
        which = np.arange(config.envs) % per_maze  # roadmap of each environment
        maze_of = (batch * per_maze + np.arange(per_maze)) % n_mazes
        starts = [
            _endpoints(jax.random.fold_in(batch_key, i), jax.tree.map(lambda leaf, m=m: leaf[m], mazes), env, config, prm)
            for i, m in enumerate(maze_of)
        ]
        tables = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[table for table, _, _ in starts])
        place = np.arange(config.envs) // per_maze
        start = jnp.stack([starts[w][1][p] for w, p in zip(which, place, strict=True)])
        goal = jnp.stack([starts[w][2][p] for w, p in zip(which, place, strict=True)])
        maze = jax.tree.map(lambda leaf: leaf[maze_of[which]], mazes)
        state = start_episodes(env, run_key, maze, start, goal)
        memory = policy.init(state, plan_memory(guide, tables, jnp.asarray(which), state))
        state, _, steps = run_episodes(env, policy, state, memory, run_key, limit=config.horizon)
        won = np.asarray(state.info["success"]) > 0
        found = select(to_trajectories(steps, np.asarray(goal), maze_of[which]), won)
        kept.append(found)
        successes, episodes, batch = successes + int(won.sum()), episodes + config.envs, batch + 1
        on_progress(successes, episodes)
    everything = concatenate(kept)
    return select(everything, np.arange(config.trajectories))


def plan_memory(guide: RoadmapGuide | ExplorerGuide, tables: PlanTable, which: jax.Array, state: State) -> object:
    """The guide's memory at the start of episodes (or wherever the robots are now)."""
    maze, position, goal = (state.info[name] for name in ("maze", "position", "goal"))
    if isinstance(guide, ExplorerGuide):
        return guide.init(maze)
    return _plan(guide, tables, which, maze, position, goal)


@jax.jit(static_argnums=0)
def _plan(guide: RoadmapGuide, tables: PlanTable, which: jax.Array, maze: Maze, position: jax.Array, goal: jax.Array):
    return guide.init(tables, which, maze, position, goal)


def _endpoints(
    key: jax.Array, maze: Maze, env: MazeEnv, config: CollectConfig, prm: PrmConfig
) -> tuple[PlanTable, jax.Array, jax.Array]:
    """A fresh roadmap, and starts and goals for its share of the environments that it connects."""
    map_key, pair_key, start_key, goal_key = jax.random.split(key, 4)
    roadmap = build_roadmap(map_key, maze, radius_m=env.robot.radius_m, config=prm)
    per_map = -(-config.envs // max(1, config.envs // config.reset_interval))
    if config.starts == "maze":
        sample = jax.vmap(lambda k: sample_free(k, maze, radius=env.robot.radius_m)[0])
        return roadmap.table, sample(jax.random.split(start_key, per_map)), sample(jax.random.split(goal_key, per_map))
    reachable = np.argwhere(np.isfinite(np.asarray(roadmap.table.distance)) & ~np.eye(prm.samples, dtype=bool))
    pairs = reachable[np.asarray(jax.random.randint(pair_key, (per_map,), 0, len(reachable)))]
    return roadmap.table, roadmap.table.points[pairs[:, 0]], roadmap.table.points[pairs[:, 1]]
