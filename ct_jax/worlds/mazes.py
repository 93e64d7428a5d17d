"""The world of mazes: ``MazeEnv`` under jit, sharded over devices."""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Int

from ct_envs import MazeEnv, check_tasks
from ct_envs import Tasks as Episodes
from ct_envs.maze import Maze, sample_pair
from ct_envs.robots import Robot
from ct_jax.collect import CollectConfig
from ct_jax.guides.explorer import ExplorerGuide
from ct_jax.guides.roadmap import RoadmapGuide
from ct_jax.pairs import Pairs, shortest_ways
from ct_jax.prm import PlanTable, PrmConfig, build_roadmap, draw_joined, extend, extend_by_pairs, stack_tables
from ct_jax.rollout import as_frame, run
from ct_jax.runtime.devices import data_mesh, fill_up, joined, largest, own, own_rows, place, sharded
from ct_jax.runtime.interrupts import raise_if_interrupted
from ct_jax.runtime.numerics import with_own_numerics
from ct_jax.types import End, OnProgress, Policy, Rollout, Tasks

_CHUNK = 25  # steps that are compiled into one program
_DENSE = PrmConfig(samples=1000)  # for the lengths of the shortest ways


@dataclass(frozen=True)
class MazeTasks(Tasks):
    """Episodes in mazes."""

    episode_keys: jax.Array  # [N]: of the first states
    maze: Maze  # leading axis N
    tables: PlanTable | None  # roadmaps, stacked
    table_of: Int[jax.Array, "N"]  # roadmap of each episode
    counted: np.ndarray  # bool [N]: false for copies, which make the number even for all devices


@dataclass(frozen=True, eq=False)
class MazeWorld:
    """Mazes, and the environment that steps robots in them.

    Args:
        env: without auto-reset; without maps only if no policy looks at them.
        mazes: one maze, or several along a leading axis.
    """

    env: MazeEnv
    mazes: Maze

    def __post_init__(self) -> None:
        if self.mazes.walls.ndim == 2:
            object.__setattr__(self, "mazes", jax.tree.map(lambda leaf: leaf[None], self.mazes))

    @property
    def robot(self) -> Robot:
        return self.env.robot

    @property
    def horizon(self) -> int:
        return self.env.horizon

    @property
    def places(self) -> int:
        """Number of mazes."""
        return self.mazes.walls.shape[0]

    def close(self) -> None:
        """Nothing is held."""

    def guide(self, name: str, prm: PrmConfig) -> RoadmapGuide | ExplorerGuide:
        """The planner with this name."""
        radius, cell_m = self.robot.radius_m, self.env.engine.cell_m
        if name == "explorer":
            return ExplorerGuide(radius + prm.margin_m, self.env.map_cell_m, cell_m, prm.connect_m)
        return RoadmapGuide(radius, prm.margin_m, prm.connect_m, cell_m, shortcut=name == "shortcut")

    # -------------------------------------------------------------------------------------------------- collection

    def sample_tasks(
        self, key: jax.Array, config: CollectConfig, prm: PrmConfig, *, first: int = 0, offset: int = 0
    ) -> MazeTasks:
        """New roadmaps, one for every ``reset_interval`` episodes, maze after maze, and episodes on them."""
        draw_key, run_key = jax.random.split(jax.random.fold_in(key, first))
        n_maps = max(1, config.envs // config.reset_interval)
        per_map = -(-config.envs // n_maps)
        maze_of_map = (offset + first // config.reset_interval + np.arange(n_maps)) % self.places
        keys = jax.random.split(draw_key, n_maps + 1)
        # Each process builds its share of the roadmaps and sends it to the others.
        mine = np.array_split(np.arange(n_maps), jax.process_count())[jax.process_index()]
        drawn = [
            self._endpoints(keys[i], self._maze(maze_of_map[i]), config, prm, per_map)
            for i in (mine if len(mine) else [0])  # a process without a share builds one, for the shapes of its arrays
        ]
        tables, start, goal = zip(*drawn, strict=True)
        start, goal = (joined(np.stack(ends)[: len(mine)]) for ends in (start, goal))
        tables = stack_tables(list(tables), largest)
        tables = jax.tree.map(lambda leaf: joined(np.asarray(leaf)[: len(mine)]), tables)
        order = fill_up(config.envs, data_mesh())
        start, goal = (ends.reshape(-1, 2)[order] for ends in (start, goal))
        which = np.repeat(np.arange(n_maps), per_map)[order]
        return MazeTasks(
            start, goal, maze_of_map[which], run_key, jax.random.split(keys[-1], len(order)),
            self._maze(maze_of_map[which]), tables, jnp.asarray(which), np.arange(len(order)) < config.envs,
        )  # fmt: skip

    def _maze(self, which: Any) -> Maze:
        return jax.tree.map(lambda leaf: leaf[which], self.mazes)

    def _endpoints(
        self, key: jax.Array, maze: Maze, config: CollectConfig, prm: PrmConfig, n: int
    ) -> tuple[PlanTable, jax.Array, jax.Array]:
        """A new roadmap, and n starts and goals [n, 2] (m) that it joins."""
        radius_m = self.robot.radius_m
        map_key, pair_key = jax.random.split(key)
        build = functools.partial(build_roadmap, map_key, maze, radius_m=radius_m, config=prm)
        if config.starts == "maze":
            pairs = jax.vmap(lambda k: sample_pair(k, maze, radius=radius_m))(jax.random.split(pair_key, n))
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

    # -------------------------------------------------------------------------------------------------- evaluation

    @with_own_numerics
    def draw_pairs(self, seed: int, n: int) -> Pairs:
        """n pairs of free points of one region in each maze, a goal never within twice the tolerance of its start."""
        robot, parts = self.robot, []
        for number in range(self.places):
            maze, keys = self._maze(number), jax.random.split(_key_of(seed, number), 8 * n + 64)
            draw = jax.jit(jax.vmap(lambda key, maze=maze: sample_pair(key, maze, radius=robot.radius_m)))
            start, goal = map(np.asarray, draw(keys))
            apart = np.flatnonzero(np.linalg.norm(start - goal, axis=1) > 2 * robot.goal_tolerance_m)[:n]
            ends = np.stack([start[apart], goal[apart]], 1)
            parts.append(
                (ends, *shortest_ways(_key_of(seed, number), maze, ends, radius_m=robot.radius_m, config=_DENSE))
            )
        ends, shortest = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        number = np.repeat(np.arange(self.places), [len(part[0]) for part in parts])
        return Pairs(ends[:, 0], ends[:, 1], shortest, seed, number, straight=sum(part[2] for part in parts))

    def tasks_of(self, pairs: Pairs, prm: PrmConfig | None) -> tuple[MazeTasks, int | None]:
        """The pairs as tasks; with ``prm`` also a roadmap for each maze, and how many pairs they do not join.

        Raises:
            UserError: pairs that are not in these mazes.
        """
        for number in np.unique(pairs.place):
            here = pairs.place == number
            check_tasks(Episodes(pairs.start[here], pairs.goal[here], int(here.sum())), self._maze(number))  # pyright: ignore[reportArgumentType]
        n, order = len(pairs.start), fill_up(len(pairs.start), data_mesh())
        keys = jax.random.split(jax.random.key(pairs.seed), n + 2)
        start_keys, plan_key, run_key = keys[:-2][order], keys[-2], keys[-1]
        tables = not_joined = None
        if prm is not None:
            tables, not_joined = self._plans(plan_key, pairs, prm)
        tasks = MazeTasks(
            pairs.start[order], pairs.goal[order], pairs.place[order], run_key, start_keys,
            self._maze(pairs.place[order]), tables, jnp.asarray(pairs.place[order], jnp.int32),
            np.arange(len(order)) < n,
        )  # fmt: skip
        return tasks, not_joined

    def _plans(self, key: jax.Array, pairs: Pairs, prm: PrmConfig) -> tuple[PlanTable, int]:
        """The planner's ways to the goals in each maze, and the number of pairs that they do not join."""
        tables, apart = [], 0
        for number in range(self.places):
            ends = pairs.ends[pairs.place == number]
            own_key = key if number == 0 else jax.random.fold_in(key, number)
            roadmap = build_roadmap(own_key, self._maze(number), radius_m=self.robot.radius_m, config=prm, ends=ends)
            grown, nodes = extend_by_pairs(roadmap, ends)
            tables.append(grown.table_to(nodes[:, 1]))
            apart += int((~grown.are_joined(nodes)).sum())
        return stack_tables(tables), apart

    # ----------------------------------------------------------------------------------------------------- rollout

    def rollout(
        self, policy: Policy, tasks: MazeTasks, *, horizon: int, on_progress: OnProgress = lambda over, note: None
    ) -> Rollout:
        """Run all tasks side by side, in compiled chunks, until all episodes are over."""
        env, mesh = self.env.with_horizon(horizon), data_mesh()
        state = start_episodes(env, tasks.episode_keys, tasks.maze, tasks.start, tasks.goal)
        memory, parts = policy.init(as_frame(state), tasks), []
        chunk = min(_CHUNK, horizon)
        for i in range(-(-horizon // chunk)):
            state, memory, steps = run(env, policy, state, memory, jax.random.fold_in(tasks.key, i), chunk, mesh)
            parts.append(own(steps, mesh, axis=1))
            over = int((state.done > 0).sum())
            raise_if_interrupted()
            on_progress(over, f"step {(i + 1) * chunk}")
            if over == state.done.shape[0]:
                break
        steps = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
        names = ("position", "success", "fall", "diverged", "goal")
        last = own({name: state.info[name] for name in names} | {"reward": state.reward}, mesh)
        flags = (last[name] > 0 for name in ("success", "fall", "diverged"))
        end = End(last["position"], last["reward"], *flags)
        return Rollout(steps, end, last["goal"], own_rows(tasks.place), own_rows(tasks.counted), horizon)


def _key_of(seed: int, number: int) -> jax.Array:
    """The key of a maze's pairs. The roadmap for the shortest ways has the same one, as in all published pairs."""
    key = jax.random.key(seed)
    return key if number == 0 else jax.random.fold_in(key, number)


def start_episodes(env: MazeEnv, keys: jax.Array, maze: Maze, start: Any, goal: Any) -> State:
    """First states of N episodes with the given keys [N], mazes (leading axis N), starts and goals [N, 2] (m).

    The devices share them evenly, so N must be a length that ``fill_up`` gives.
    """
    start, goal = jnp.asarray(start)[:, None], jnp.asarray(goal)[:, None]
    episodes = Episodes(start, goal, jnp.ones(len(start), jnp.int32))
    return _reset(env, *place((keys, maze, episodes), sharded(data_mesh())))


@functools.partial(jax.jit, static_argnums=0)
def _reset(env: MazeEnv, keys: jax.Array, maze: Maze, episodes: Episodes) -> State:
    return jax.vmap(env.reset)(keys, maze, episodes)
