"""``MazeEnv``: a robot in a maze as a ``brax.envs.Env``, pure in ``reset`` and ``step``.

The maze and the tasks (starts and goals) are data in ``state.info``. Therefore each environment under ``vmap`` can have
its own maze, and a new maze does not need a new compilation. Everything that changes during an episode is in
``state.pipeline_state``, including the goal and the number of steps. brax's training wrappers rely on this: they
restart an episode by restoring its first ``pipeline_state`` and ``obs``.
"""

import copy
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper
from flax import struct
from jaxtyping import Array, Float, Int

from ct_envs.errors import UserError
from ct_envs.maze import CELL_M, Maze, sample_pair
from ct_envs.occupancy import MAP_CELLS, local_map
from ct_envs.physics import PhysicsState, make_engine, nearest_walls
from ct_envs.robots import Robot, get_robot


@struct.dataclass
class Tasks:
    """Starts and goals for resets. Without tasks, resets draw free points of the maze."""

    start: Float[Array, "*b M 2"]  # [m]
    goal: Float[Array, "*b M 2"]  # [m]
    n: Int[Array, "*b"]  # number of valid tasks; the others are padding
    # After a success, the goal of one of these D tasks comes next, from the robot's current position.
    follow: Int[Array, "*b M D"] | None = None
    # Maximum angle between the initial heading and the direction of the goal, for a robot with a heading.
    turn_rad: Float[Array, "*b"] | None = None


def check_tasks(tasks: Tasks, maze: Maze) -> None:
    """Raise UserError if the tasks of one environment (without leading axes) are not valid in the maze.

    Shapes are always checked. Values are checked unless they are traced: starts and goals must be finite points in free
    cells, and ``n`` and ``follow`` must refer to existing tasks.
    """
    m = jnp.shape(tasks.start)[0] if jnp.ndim(tasks.start) else 0
    shapes = {"start": (m, 2), "goal": (m, 2), "n": ()}
    shapes |= {} if tasks.follow is None else {"follow": (m, *jnp.shape(tasks.follow)[1:2])}
    shapes |= {} if tasks.turn_rad is None else {"turn_rad": ()}
    for name, shape in shapes.items():
        found = jnp.shape(getattr(tasks, name))
        if found != shape or 0 in shape or (name == "follow" and len(shape) != 2):
            wanted = {"start": "[M, 2]", "goal": "[M, 2]", "follow": "[M, D]"}.get(name, "a scalar")
            raise UserError(f"tasks.{name} has shape {found}; give {wanted} for each environment, the same M for all")
        if name in ("n", "follow") and not jnp.issubdtype(jnp.result_type(getattr(tasks, name)), jnp.integer):
            raise UserError(f"tasks.{name} has entries of {jnp.result_type(getattr(tasks, name))}; give integers")
    if not _is_traced((tasks, maze)):
        _check_values(tasks, maze, m)


def _is_traced(tree: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _check_values(tasks: Tasks, maze: Maze, m: int) -> None:
    """Check the values for ``check_tasks``."""
    n, follow = int(tasks.n), np.asarray([] if tasks.follow is None else tasks.follow, int)
    if not 1 <= n <= m:
        raise UserError(f"tasks.n is {n}; give a number from 1 to {m}, the number of tasks")
    if ((follow < 0) | (follow >= m)).any():
        wrong = follow[(follow < 0) | (follow >= m)][0]
        raise UserError(f"tasks.follow has an entry {wrong}; give indices of tasks, from 0 to {m - 1}")
    if tasks.turn_rad is not None and not np.isfinite(tasks.turn_rad):
        raise UserError(f"tasks.turn_rad is {tasks.turn_rad}; give a finite angle [rad]")
    drawn = np.union1d(np.arange(n), follow).astype(int)
    walls, cell_m = np.asarray(maze.walls), float(maze.cell_m)
    for name in ("start", "goal"):
        points = np.asarray(getattr(tasks, name), np.float64)[drawn]
        column, row = np.moveaxis(np.floor(np.nan_to_num(points) / cell_m), -1, 0)
        inside = np.isfinite(points).all(-1) & (row >= 0) & (column >= 0)
        inside &= (row < walls.shape[0]) & (column < walls.shape[1])
        free = inside.copy()
        free[inside] = ~walls[row[inside].astype(int), column[inside].astype(int)]
        if not free.all():
            which = int(np.argmin(free))
            x, y = points[which]
            where = f"tasks.{name}[{drawn[which]}] is ({x:g}, {y:g}) m"
            raise UserError(f"{where}, in a wall or outside the maze; give points in free cells")


@struct.dataclass
class EpisodeState(PhysicsState):
    """``pipeline_state``: the physics, and the other variables of an episode."""

    goal: Float[Array, "*b 2"]  # [m]
    task: Int[Array, "*b"]  # index of the task
    episode_steps: Int[Array, "*b"]  # control steps so far


class MazeState(State):
    """brax's ``State``, with ``info`` entries that follow its ``pipeline_state``.

    Replacing ``pipeline_state``, as brax's wrappers do to restart an episode, also replaces ``position``, ``goal``,
    ``task`` and ``episode_steps`` in ``info``.
    """

    def replace(self, **updates: Any) -> "MazeState":
        """A state with other fields."""
        if isinstance(episode := updates.get("pipeline_state"), EpisodeState):
            shown = {name: getattr(episode, name) for name in ("goal", "task", "episode_steps")}
            shown["position"] = episode.qpos[..., :2]
            updates["info"] = updates.get("info", self.info) | shown
        return super().replace(**updates)


jax.tree_util.register_dataclass(MazeState, [*State.__dataclass_fields__], [])


class MazeEnv(Env):
    """Reach the goal. The reward is minus the distance to the goal after the step [m] (paper, sec. III-G).

    Observation: a dict of ``proprio`` [P] (``qpos`` without the planar position, then ``qvel``; for the point only its
    velocity, m/s), ``goal`` [2] (from the robot to the goal, m) and, with ``maps``, ``map`` [2, 25, 25] of uint8.
    Action: [-1, 1]^nu, shares of the actuators' range; larger values are clipped. An episode ends with a success
    (within the goal tolerance), with a failure, or at the horizon (truncation). A failure is a fall, or a state or
    action that is not finite; in the latter case the robot keeps its previous state. ``state.info`` holds ``success``,
    ``fall``, ``diverged`` (something was not finite), ``collision`` (a part of the robot touches a wall now),
    ``truncation``, ``episode_steps``, ``position``, ``goal``, ``task``, ``maze``, ``tasks`` and ``key``.

    brax's training wrappers end an episode at their own ``episode_length``, and restart it from its first state. Give
    them an environment with a longer horizon, because they treat the end at the environment's horizon as a failure.
    For networks that take one array as observation, use ``FlatObservation``.
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
            maze: the default maze of ``reset``.
            map_cell_m: side of a cell of the local map [m].
            maps: include the local map in observations.
            auto_reset: restart a finished environment with a new start and goal. Otherwise its state does not change
                any more, and ``done`` stays 1.
            horizon: control steps of an episode; the default is the robot's horizon.
            reset_velocity_mps: standard deviation of the speed after a reset; the default is the robot's.
            cell_m: side of the maze's cells [m]. For cells smaller than the robot's reach, also give a ``maze`` of
                ``ct_envs.fine``; resets then take mazes with the same number of boxes.

        Raises:
            UserError: unknown robot or engine, cells too small for the robot, or a maze with a different cell size.
        """
        if maze is not None:
            _check_maze(maze, cell_m, boxes_of(maze))
        self.robot = get_robot(robot, "mujoco") if isinstance(robot, str) else robot
        self.engine = make_engine(engine, self.robot, cell_m=cell_m, boxes=0 if maze is None else boxes_of(maze))
        self.maze, self.map_cell_m, self.maps, self.auto_reset = maze, map_cell_m, maps, auto_reset
        self.horizon = horizon or self.robot.horizon
        self._with_horizon: dict[int, MazeEnv] = {self.horizon: self}  # shared with those that it holds
        self._ctrl_max = self.engine.model.actuator_ctrlrange[:, 1].astype(np.float32)
        self._reset_velocity = self.robot.reset_velocity_mps if reset_velocity_mps is None else reset_velocity_mps

    def with_horizon(self, horizon: int) -> "MazeEnv":
        """The same environment with episodes of so many control steps: always the same one, so it compiles once."""
        if horizon not in self._with_horizon:
            changed = copy.copy(self)
            changed.horizon = horizon
            self._with_horizon[horizon] = changed
        return self._with_horizon[horizon]

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        sizes: dict[str, tuple[int, ...]] = {"proprio": (self.proprio_size,), "goal": (2,)}
        return sizes | {"map": (2, MAP_CELLS, MAP_CELLS)} if self.maps else sizes

    @property
    def proprio_size(self) -> int:
        """Size of the proprioception: ``qpos`` and ``qvel`` without the position in the plane."""
        model = self.engine.model
        return model.nq - 2 + model.nv

    @property
    def action_size(self) -> int:
        return self.engine.model.nu

    @property
    def backend(self) -> str:
        return self.engine.name

    def reset(self, rng: jax.Array, maze: Maze | None = None, tasks: Tasks | None = None) -> MazeState:
        """A new episode. Start and goal come from ``tasks``, or are random free points of the same region.

        Under ``jit`` or ``vmap``, only the shapes of ``maze`` and ``tasks`` are checked, because their values are
        traced. Call ``check_tasks`` first if the values may be wrong. With wrong values: walls are not where the map
        shows them if the cell size differs; a robot may start in a wall; a goal that is NaN or in a wall is never
        reached; an index of a task beyond the last means the last task; ``n`` below 1 means the first task.

        Raises:
            UserError: no maze, or a maze or tasks with wrong shapes or values, see ``check_tasks``.
        """
        maze = self.maze if maze is None else maze
        if maze is None:
            raise UserError("MazeEnv.reset needs a maze: give one to it or to MazeEnv(maze=...)")
        _check_maze(maze, self.engine.cell_m, self.engine.boxes)
        if tasks is not None:
            check_tasks(tasks, maze)
        key, now = jax.random.split(rng)
        zero = jnp.zeros((), jnp.float32)
        info = {"key": key, "maze": maze, "tasks": tasks}
        info |= dict.fromkeys(("truncation", "success", "fall", "diverged", "collision"), zero)
        return self._observe(self._begin(now, maze, tasks), MazeState(None, {}, zero, zero, {}, info))

    def _begin(self, key: jax.Array, maze: Maze, tasks: Tasks | None) -> EpisodeState:
        """The first state of a new episode."""
        task_key, physics_key = jax.random.split(key)
        task, start, goal = self._draw_task(task_key, maze, tasks)
        physics = self._initial_physics(physics_key, start, goal, tasks)
        steps = jnp.zeros((), jnp.int32)
        return EpisodeState(physics.qpos, physics.qvel, physics.qacc_warmstart, goal, task, steps)

    def _draw_task(self, key: jax.Array, maze: Maze, tasks: Tasks | None) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Index, start and goal of a random task."""
        if tasks is not None:
            i = jax.random.randint(key, (), 0, tasks.n, jnp.int32)
            start, goal = (jnp.asarray(points, jnp.float32) for points in (tasks.start, tasks.goal))
            return i, start[i], goal[i]
        return jnp.zeros((), jnp.int32), *sample_pair(key, maze, radius=self.robot.radius_m)

    def _go_on(
        self, key: jax.Array, tasks: Tasks | None, finished: EpisodeState, won: jax.Array, fresh: EpisodeState
    ) -> EpisodeState:
        """The state after a finished episode.

        After a success with ``tasks.follow``, the robot keeps its state and gets the next goal. Otherwise it is a new
        episode.
        """
        if tasks is None or tasks.follow is None:
            return fresh
        follow = jnp.asarray(tasks.follow, jnp.int32)
        choice = jax.random.randint(key, (), 0, follow.shape[-1], jnp.int32)
        task = jnp.where(won, follow[finished.task, choice], fresh.task)
        goal = jnp.where(won, jnp.asarray(tasks.goal, jnp.float32)[task], fresh.goal)
        robot = {name: getattr(finished, name) for name in PhysicsState.__dataclass_fields__}
        robot = {name: jnp.where(won, old, getattr(fresh, name)) for name, old in robot.items()}
        return fresh.replace(**robot, task=task, goal=goal)

    def _initial_physics(self, key: jax.Array, start: jax.Array, goal: jax.Array, tasks: Tasks | None) -> PhysicsState:
        """The robot in its standing pose at ``start`` [m], with a random heading (see ``Tasks.turn_rad``)."""
        model, robot = self.engine.model, self.robot
        speed_key, yaw_key, joint_key = jax.random.split(key, 3)
        qpos = jnp.asarray(model.key_qpos[0] if model.nkey else model.qpos0, jnp.float32).at[:2].set(start)
        if robot.has_heading:
            yaw = jax.random.uniform(yaw_key, (), jnp.float32, minval=-jnp.pi, maxval=jnp.pi)
            if tasks is not None and tasks.turn_rad is not None:
                x, y = goal - start
                yaw = jnp.arctan2(y, x) + jnp.asarray(tasks.turn_rad, jnp.float32) / jnp.pi * yaw
            half = yaw / 2.0
            qpos = qpos.at[3:7].set(jnp.array([jnp.cos(half), 0.0, 0.0, jnp.sin(half)], jnp.float32))
            noise = jax.random.uniform(joint_key, qpos[7:].shape, jnp.float32, minval=-1.0, maxval=1.0)
            qpos = qpos.at[7:].add(robot.reset_joints_rad * noise)
        qvel = still = jnp.zeros(model.nv, jnp.float32)
        if self._reset_velocity:
            qvel = self._reset_velocity * jax.random.normal(speed_key, (model.nv,), jnp.float32)
        return PhysicsState(qpos, qvel, still)

    def _fell(self, physics: PhysicsState) -> jax.Array:
        """Whether the torso is tilted too much or is too low."""
        fell = jnp.zeros((), bool)
        if self.robot.upright_min is not None:
            _, x, y, _ = physics.qpos[3:7]
            fell |= 1.0 - 2.0 * (x**2 + y**2) < self.robot.upright_min
        if self.robot.height_min_m is not None:
            fell |= physics.qpos[2] < self.robot.height_min_m
        return fell

    def _observe(self, episode: EpisodeState, state: MazeState) -> MazeState:
        position, goal = episode.qpos[:2], episode.goal
        obs = {"proprio": jnp.concatenate([episode.qpos[2:], episode.qvel]), "goal": goal - position}
        if self.maps:
            obs["map"] = local_map(state.info["maze"], position, goal, cell_m=self.map_cell_m)
        return state.replace(pipeline_state=episode, obs=obs)

    def step(self, state: MazeState, action: jax.Array) -> MazeState:
        """One control step. With ``auto_reset``, the last step of an episode returns the first state of the next
        episode, with the reward, ``done`` and outcome of the finished one.

        Raises:
            UserError: the shape of the action is not [nu].
        """
        if jnp.shape(action) != (self.action_size,):
            raise UserError(
                f"the action has shape {jnp.shape(action)}; give [{self.action_size}], for several environments under "
                "jax.vmap(env.step)"
            )
        action = jnp.asarray(action, jnp.float32)
        before: Any = state.pipeline_state
        walls = nearest_walls(state.info["maze"], before.qpos[:2])
        # MuJoCo would treat NaN in an action as zero, and continue.
        usable = jnp.all(jnp.isfinite(action))
        ctrl = jnp.where(usable, jnp.clip(action, -1.0, 1.0), 0.0)
        physics, touching = self.engine.step(before, self._ctrl_max * ctrl, walls)
        finite = usable & jnp.all(jnp.isfinite(jnp.concatenate([physics.qpos, physics.qvel])))
        moved = {name: getattr(physics, name) for name in PhysicsState.__dataclass_fields__}
        moved = {name: jnp.where(finite, new, getattr(before, name)) for name, new in moved.items()}
        episode: EpisodeState = before.replace(**moved, episode_steps=before.episode_steps + 1)

        info = dict(state.info)
        distance = jnp.linalg.norm(episode.goal - episode.qpos[:2])
        fall = finite & self._fell(episode)
        success = finite & ~fall & (distance < self.robot.goal_tolerance_m)
        over = episode.episode_steps >= self.horizon
        done = success | fall | ~finite | over
        info |= {
            "success": success.astype(jnp.float32),
            "fall": fall.astype(jnp.float32),
            "diverged": (~finite).astype(jnp.float32),
            "collision": jnp.where(finite, touching, 0.0),
            "truncation": (over & ~success & ~fall & finite).astype(jnp.float32),
        }
        stepped = state.replace(reward=-distance, done=done.astype(jnp.float32), info=info)
        if not self.auto_reset:
            stepped = self._observe(episode, stepped)
            return jax.tree.map(lambda new, old: jnp.where(state.done > 0, old, new), stepped, state)
        key, now, follow_key = jax.random.split(info["key"], 3)
        fresh = self._begin(now, info["maze"], info["tasks"])
        after = self._go_on(follow_key, info["tasks"], episode, success, fresh)
        episode = jax.tree.map(lambda a, b: jnp.where(done, a, b), after, episode)
        return self._observe(episode, stepped.replace(info=info | {"key": key}))


def boxes_of(maze: Maze) -> int:
    """How many boxes of any size a robot may have near it in a maze; 0 where its cells are large."""
    return 0 if maze.boxes is None else maze.boxes.near.shape[-1]


def _check_maze(maze: Maze, cell_m: float, boxes: int) -> None:
    """Raise UserError unless this is a single maze with cells of this size and so many boxes.

    A traced cell size is not checked.
    """
    if jnp.ndim(maze.walls) != 2:
        raise UserError(
            f"the maze's walls have shape {jnp.shape(maze.walls)}; reset many mazes under jax.vmap(env.reset)"
        )
    if not _is_traced(maze.cell_m) and not np.allclose(maze.cell_m, cell_m):
        raise UserError(f"the maze's cells are not {cell_m} m wide; give MazeEnv the maze's own cell_m")
    if boxes_of(maze) != boxes:
        raise UserError(
            f"the maze has {boxes_of(maze)} boxes near a robot, not {boxes}; give that maze to MazeEnv(maze=)"
        )


class FlatObservation(Wrapper):
    """A ``MazeEnv`` with one array as observation: proprioception, the vector to the goal and, with ``maps``, the map.

    It is for learners such as brax's PPO: ``ppo.train(environment=FlatObservation(MazeEnv(maze=...)), ...)``.
    """

    env: MazeEnv

    def __init__(self, env: MazeEnv):
        super().__init__(env)
        self._shapes = {name: env.observation_size[name] for name in ("proprio", "goal", "map")[: 2 + env.maps]}

    @property
    def observation_size(self) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        return sum(int(np.prod(shape)) for shape in self._shapes.values())

    def reset(self, rng: jax.Array, maze: Maze | None = None, tasks: Tasks | None = None) -> MazeState:
        """As ``MazeEnv.reset``."""
        return self._flat(self.env.reset(rng, maze, tasks))

    def step(self, state: MazeState, action: jax.Array) -> MazeState:
        """As ``MazeEnv.step``."""
        ends = np.cumsum([np.prod(shape) for shape in self._shapes.values()])[:-1].tolist()
        parts = zip(self._shapes.items(), jnp.split(state.obs, ends), strict=True)  # pyright: ignore
        obs = {name: part.reshape(shape) for (name, shape), part in parts}
        if self.env.maps:
            obs["map"] = obs["map"].astype(jnp.uint8)
        return self._flat(self.env.step(state.replace(obs=obs), action))

    def _flat(self, state: MazeState) -> MazeState:
        obs: Any = state.obs
        return state.replace(obs=jnp.concatenate([obs[name].astype(jnp.float32).ravel() for name in self._shapes]))
