"""``MazeEnv``: a robot in a maze as a ``brax.envs.Env``, pure in ``reset`` and ``step``.

The maze and the tasks (starts and goals) are data that travel in ``state.info``, so each environment under ``vmap`` can
have its own and a new maze compiles nothing.
"""

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from flax import struct
from jaxtyping import Array, Float, Int

from ct_envs.errors import UserError
from ct_envs.maze import CELL_M, Maze, clearance, sample_pair
from ct_envs.occupancy import MAP_CELLS, local_map
from ct_envs.physics import PhysicsState, make_engine, nearest_walls
from ct_envs.robots import Robot, get_robot


@struct.dataclass
class Tasks:
    """Starts and goals that resets draw from, in place of free points of the maze."""

    start: Float[Array, "*b M 2"]  # [m]
    goal: Float[Array, "*b M 2"]  # [m]
    n: Int[Array, "*b"]  # how many of the M are meant


class MazeEnv(Env):
    """Reach the goal. Reward is minus the distance to it after the step [m] (paper, sec. III-F).

    Observation: a dict of ``proprio`` [P] (for the point: its velocity, m/s), ``goal`` [2] (from the robot to the
    goal, m) and, with ``maps``, ``map`` [2, 25, 25]. Action: [-1, 1]^nu. An episode ends with success (within the
    goal tolerance), with a failure (a state or action that is not finite) or, as truncation, at the horizon.
    ``state.info`` holds ``success``, ``collision`` (touching a wall now), ``truncation``, ``episode_steps``,
    ``position``, ``goal``, ``maze``, ``tasks`` and ``key``.
    """

    def __init__(
        self,
        robot: str | Robot = "point",
        *,
        engine: str = "auto",
        maze: Maze | None = None,
        map_cell_m: float = 0.8,
        maps: bool = True,
        auto_reset: bool = True,
        horizon: int | None = None,
        reset_velocity_mps: float | None = None,
        cell_m: float = CELL_M,
    ):
        """
        Args:
            robot: a ``Robot`` or its name.
            engine: "mjx", "mujoco", or "auto" (by platform).
            maze: the maze of ``reset`` when it is given none.
            map_cell_m: side of a cell of the local map [m].
            maps: whether observations hold the local map.
            auto_reset: whether a finished environment starts anew, with a fresh start and goal; if not, it stays as
                it is and ``done`` stays 1.
            horizon: control steps of an episode; by default the robot's.
            reset_velocity_mps: spread of the speed after a reset; by default the robot's.
            cell_m: side of the maze's cells [m].

        Raises:
            UserError: unknown robot or engine, cells too small for the robot, or a maze with cells of another size.
        """
        if maze is not None and not np.allclose(maze.cell_m, cell_m):
            raise UserError(f"the maze's cells are not {cell_m} m wide; give MazeEnv the maze's own cell_m")
        self.robot = get_robot(robot) if isinstance(robot, str) else robot
        self.engine = make_engine(engine, self.robot, cell_m=cell_m)
        self.maze, self.map_cell_m, self.maps, self.auto_reset = maze, map_cell_m, maps, auto_reset
        self.horizon = horizon or self.robot.horizon
        self._reset_velocity = self.robot.reset_velocity_mps if reset_velocity_mps is None else reset_velocity_mps

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        sizes: dict[str, tuple[int, ...]] = {"proprio": (self.proprio_size,), "goal": (2,)}
        return sizes | {"map": (2, MAP_CELLS, MAP_CELLS)} if self.maps else sizes

    @property
    def proprio_size(self) -> int:
        """Numbers of proprioception: everything but the position in the plane."""
        model = self.engine.model
        return model.nq - 2 + model.nv

    @property
    def action_size(self) -> int:
        return self.engine.model.nu

    @property
    def backend(self) -> str:
        return self.engine.name

    def reset(self, rng: jax.Array, maze: Maze | None = None, tasks: Tasks | None = None) -> State:
        """A fresh episode in ``maze``, from a random free point to another of the same region, or from ``tasks``."""
        maze = self.maze if maze is None else maze
        if maze is None:
            raise UserError("MazeEnv.reset needs a maze: give one to it or to MazeEnv(maze=...)")
        key, now = jax.random.split(rng)
        zero = jnp.zeros(())
        info = {"key": key, "maze": maze, "tasks": tasks}
        info |= {"truncation": zero, "success": zero, "collision": zero}
        return self._begin(now, State(None, {}, zero, zero, {}, info))

    def _begin(self, key: jax.Array, state: State) -> State:
        """The first state of an episode, in the maze and with the tasks of ``state``."""
        start, goal = self._draw_task(key, state.info["maze"], state.info["tasks"])
        physics = self._initial_physics(jax.random.fold_in(key, 1), start)
        info = state.info | {"goal": goal, "episode_steps": jnp.zeros((), jnp.int32)}
        return self._observe(physics, state.replace(info=info))

    def _draw_task(self, key: jax.Array, maze: Maze, tasks: Tasks | None) -> tuple[jax.Array, jax.Array]:
        if tasks is not None:
            i = jax.random.randint(key, (), 0, tasks.n)
            return tasks.start[i], tasks.goal[i]
        return sample_pair(key, maze, radius=self.robot.radius_m)

    def _initial_physics(self, key: jax.Array, start: jax.Array) -> PhysicsState:
        model = self.engine.model
        qpos = jnp.asarray(model.qpos0, jnp.float32).at[:2].set(start)
        qvel = jnp.zeros(model.nv)
        if self._reset_velocity:
            qvel = self._reset_velocity * jax.random.normal(key, (model.nv,))
        return PhysicsState(qpos, qvel, jnp.zeros(model.nv))

    def _observe(self, physics: PhysicsState, state: State) -> State:
        position, goal = physics.qpos[:2], state.info["goal"]
        obs = {"proprio": jnp.concatenate([physics.qpos[2:], physics.qvel]), "goal": goal - position}
        if self.maps:
            obs["map"] = local_map(state.info["maze"], position, goal, cell_m=self.map_cell_m)
        return state.replace(pipeline_state=physics, obs=obs, info=state.info | {"position": position})

    def step(self, state: State, action: jax.Array) -> State:
        """One control step. With ``auto_reset`` a finished state comes back as the first of the next episode, with the
        reward, ``done`` and outcome of the finished one."""
        before = state.pipeline_state
        walls = nearest_walls(state.info["maze"], before.qpos[:2])
        ctrl = jnp.clip(action, -1.0, 1.0)
        physics = self.engine.step(before, ctrl, walls)
        # The action too: MuJoCo would read one that is not a number as zero, and carry on.
        finite = jnp.all(jnp.isfinite(jnp.concatenate([physics.qpos, physics.qvel, ctrl])))
        physics = jax.tree.map(lambda new, old: jnp.where(finite, new, old), physics, before)

        info = dict(state.info)
        position = physics.qpos[:2]
        distance = jnp.linalg.norm(info["goal"] - position)
        steps = info["episode_steps"] + 1
        success = finite & (distance < self.robot.goal_tolerance_m)
        collision = clearance(info["maze"], position) < self.robot.radius_m
        over = steps >= self.horizon
        done = success | ~finite | over
        info |= {
            "episode_steps": steps,
            "success": success.astype(jnp.float32),
            "collision": collision.astype(jnp.float32),
            "truncation": (over & ~success & finite).astype(jnp.float32),
        }
        stepped = state.replace(reward=-distance, done=done.astype(jnp.float32), info=info)
        if not self.auto_reset:
            stepped = self._observe(physics, stepped)
            return jax.tree.map(lambda new, old: jnp.where(state.done > 0, old, new), stepped, state)
        key, now = jax.random.split(info["key"])
        stepped = stepped.replace(info=info | {"key": key})
        fresh = self._begin(now, stepped)  # only what differs is chosen below; the observation is made once
        goal, steps = (jnp.where(done, fresh.info[name], stepped.info[name]) for name in ("goal", "episode_steps"))
        physics = jax.tree.map(lambda a, b: jnp.where(done, a, b), fresh.pipeline_state, physics)
        return self._observe(physics, stepped.replace(info=stepped.info | {"goal": goal, "episode_steps": steps}))
