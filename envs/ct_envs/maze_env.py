"""``MazeEnv``: a robot in a maze as a ``brax.envs.Env``, pure in ``reset`` and ``step``.

The maze and the tasks (starts and goals) are data that travel in ``state.info``, so each environment under ``vmap`` can
have its own and a new maze compiles nothing.
"""

import copy
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from flax import struct
from jaxtyping import Array, Float, Int

from ct_envs.errors import UserError
from ct_envs.maze import CELL_M, Maze, sample_pair
from ct_envs.occupancy import MAP_CELLS, local_map
from ct_envs.physics import PhysicsState, make_engine, nearest_walls
from ct_envs.robots import Robot, get_robot


@struct.dataclass
class Tasks:
    """Starts and goals that resets draw from, in place of free points of the maze."""

    start: Float[Array, "*b M 2"]  # [m]
    goal: Float[Array, "*b M 2"]  # [m]
    n: Int[Array, "*b"]  # how many of the M are meant
    follow: Int[Array, "*b M D"] | None = None  # tasks one of which follows a success, from where the robot is then
    turn_rad: Float[Array, "*b"] | None = None  # a robot with a heading begins within this of facing its goal


class MazeEnv(Env):
    """Reach the goal. Reward is minus the distance to it after the step [m] (paper, sec. III-G).

    Observation: a dict of ``proprio`` [P] (``qpos`` without the planar position, then ``qvel``; for the point just its
    velocity, m/s), ``goal`` [2] (from the robot to the goal, m) and, with ``maps``, ``map`` [2, 25, 25] of bytes.
    Action: [-1, 1]^nu, shares of the actuators' range. An episode ends with success (within the goal tolerance), with a
    failure (a fall, or a state or action that is not finite) or, as truncation, at the horizon. ``state.info`` holds
    ``success``, ``fall``, ``collision`` (some part touches a wall now), ``truncation``, ``episode_steps``,
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
        self.robot = get_robot(robot, "maze") if isinstance(robot, str) else robot
        self.engine = make_engine(engine, self.robot, cell_m=cell_m)
        self.maze, self.map_cell_m, self.maps, self.auto_reset = maze, map_cell_m, maps, auto_reset
        self.horizon = horizon or self.robot.horizon
        self._ctrl_max = self.engine.model.actuator_ctrlrange[:, 1].astype(np.float32)
        self._reset_velocity = self.robot.reset_velocity_mps if reset_velocity_mps is None else reset_velocity_mps

    def with_horizon(self, horizon: int) -> "MazeEnv":
        """The same environment with episodes of so many control steps."""
        changed = copy.copy(self)
        changed.horizon = horizon
        return changed if horizon != self.horizon else self

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
        info |= {"truncation": zero, "success": zero, "fall": zero, "collision": zero}
        return self._begin(now, State(None, {}, zero, zero, {}, info))

    def _begin(self, key: jax.Array, state: State) -> State:
        """The first state of an episode, in the maze and with the tasks of ``state``."""
        task_key, physics_key = jax.random.split(key)
        task, start, goal = self._draw_task(task_key, state.info["maze"], state.info["tasks"])
        physics = self._initial_physics(physics_key, start, goal, state.info["tasks"])
        info = state.info | {"task": task, "goal": goal, "episode_steps": jnp.zeros((), jnp.int32)}
        return self._observe(physics, state.replace(info=info))

    def _draw_task(self, key: jax.Array, maze: Maze, tasks: Tasks | None) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Number, start and goal of a task."""
        if tasks is not None:
            i = jax.random.randint(key, (), 0, tasks.n)
            return i, tasks.start[i], tasks.goal[i]
        return jnp.zeros((), jnp.int32), *sample_pair(key, maze, radius=self.robot.radius_m)

    def _go_on(self, key: jax.Array, finished: State, fresh: State) -> tuple[PhysicsState, State]:
        """After a success, where tasks follow each other: the robot as it is, with the next goal."""
        tasks: Tasks | None = finished.info["tasks"]
        physics: Any = fresh.pipeline_state
        if tasks is None or tasks.follow is None:
            return physics, fresh
        won = finished.info["success"] > 0
        choice = jax.random.randint(key, (), 0, tasks.follow.shape[-1])
        task = jnp.where(won, tasks.follow[finished.info["task"], choice], fresh.info["task"])
        physics = jax.tree.map(lambda old, new: jnp.where(won, old, new), finished.pipeline_state, physics)
        goal = jnp.where(won, tasks.goal[task], fresh.info["goal"])
        return physics, fresh.replace(info=fresh.info | {"task": task, "goal": goal})

    def _initial_physics(self, key: jax.Array, start: jax.Array, goal: jax.Array, tasks: Tasks | None) -> PhysicsState:
        """Standing at ``start`` [m]; a robot that has a heading looks anywhere, or not too far from its goal."""
        model, robot = self.engine.model, self.robot
        speed_key, yaw_key, joint_key = jax.random.split(key, 3)
        qpos = jnp.asarray(model.key_qpos[0] if model.nkey else model.qpos0, jnp.float32).at[:2].set(start)
        if robot.has_heading:
            yaw = jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)
            if tasks is not None and tasks.turn_rad is not None:
                x, y = goal - start
                yaw = jnp.arctan2(y, x) + tasks.turn_rad / jnp.pi * yaw
            half = yaw / 2.0
            qpos = qpos.at[3:7].set(jnp.array([jnp.cos(half), 0.0, 0.0, jnp.sin(half)]))
            noise = jax.random.uniform(joint_key, qpos[7:].shape, minval=-1.0, maxval=1.0)
            qpos = qpos.at[7:].add(robot.reset_joints_rad * noise)
        qvel = jnp.zeros(model.nv)
        if self._reset_velocity:
            qvel = self._reset_velocity * jax.random.normal(speed_key, (model.nv,))
        return PhysicsState(qpos, qvel, jnp.zeros(model.nv))

    def _fell(self, physics: PhysicsState) -> jax.Array:
        """Whether the torso is tilted too far or too low."""
        fell = jnp.zeros((), bool)
        if self.robot.upright_min is not None:
            _, x, y, _ = physics.qpos[3:7]
            fell |= 1.0 - 2.0 * (x**2 + y**2) < self.robot.upright_min
        if self.robot.height_min_m is not None:
            fell |= physics.qpos[2] < self.robot.height_min_m
        return fell

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
        physics, touching = self.engine.step(before, self._ctrl_max * ctrl, walls)
        # The action too: MuJoCo would read one that is not a number as zero, and carry on.
        finite = jnp.all(jnp.isfinite(jnp.concatenate([physics.qpos, physics.qvel, ctrl])))
        physics = jax.tree.map(lambda new, old: jnp.where(finite, new, old), physics, before)

        info = dict(state.info)
        position = physics.qpos[:2]
        distance = jnp.linalg.norm(info["goal"] - position)
        steps = info["episode_steps"] + 1
        fall = finite & self._fell(physics)
        success = finite & ~fall & (distance < self.robot.goal_tolerance_m)
        over = steps >= self.horizon
        done = success | fall | ~finite | over
        info |= {
            "episode_steps": steps,
            "success": success.astype(jnp.float32),
            "fall": fall.astype(jnp.float32),
            "collision": jnp.where(finite, touching, 0.0),
            "truncation": (over & ~success & ~fall & finite).astype(jnp.float32),
        }
        stepped = state.replace(reward=-distance, done=done.astype(jnp.float32), info=info)
        if not self.auto_reset:
            stepped = self._observe(physics, stepped)
            return jax.tree.map(lambda new, old: jnp.where(state.done > 0, old, new), stepped, state)
        key, now, follow_key = jax.random.split(info["key"], 3)
        stepped = stepped.replace(info=info | {"key": key}, pipeline_state=physics)
        fresh = self._begin(now, stepped)  # only what differs is chosen below; the observation is made once
        after, fresh = self._go_on(follow_key, stepped, fresh)
        names = ("task", "goal", "episode_steps")
        chosen = {name: jnp.where(done, fresh.info[name], stepped.info[name]) for name in names}
        physics = jax.tree.map(lambda a, b: jnp.where(done, a, b), after, physics)
        return self._observe(physics, stepped.replace(info=stepped.info | chosen))
