"""Planning in mazes on a roadmap, as a table that is looked up under jit (paper, sec. III-A)."""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from ct_envs.maze import Maze, in_sight, segment_reach
from ct_jax.prm import NO_HOP, PlanTable
from ct_jax.types import Frame, Privileged

_CANDIDATES = 64  # number of nearest points from which a new waypoint is chosen


@struct.dataclass
class Following:
    """The plans of N environments: their roadmaps with the paths to their goals, and their current waypoints."""

    points: Float[Array, "N n 2"]  # [m]
    next_hop: Int[Array, "N n"]  # towards the goal
    to_go: Float[Array, "N n"]  # path length to the goal's node [m]
    waypoint: Int[Array, "N"]
    goal_node: Int[Array, "N"]


@dataclass(frozen=True)
class RoadmapGuide:
    """Gives each environment the next waypoint of its plan (paper, sec. III-A).

    Plans follow the roadmap's shortest path, point after point. With ``shortcut`` the waypoint is chosen again at every
    step: the visible point with the shortest path to the goal. This is smoother and recovers from any disturbance.
    """

    radius_m: float  # of the robot
    margin_m: float = 0.0  # clearance beyond the radius on the way to a new waypoint, if both ends have that room [m]
    look_m: float = 10.0  # largest distance of a newly chosen waypoint [m]
    cell_m: float = 4.0
    waypoint_tolerance_m: float = 0.5
    shortcut: bool = False

    def init(self, frame: Frame, tasks: Any) -> Following:
        """Connect the robots and their goals to the tasks' roadmaps."""
        return self._connect(tasks.tables, tasks.table_of, frame.privileged)

    @functools.partial(jax.jit, static_argnums=0)
    def _connect(self, tables: PlanTable, which: Int[Array, "N"], at: Privileged) -> Following:
        """Plans on the roadmaps ``which``, stacked in ``tables``."""
        maze, goal = at.scene, at.goal_world
        points, goals = tables.points[which], tables.goal[which]
        column = self._nearest_in_sight(jnp.take_along_axis(points, goals[..., None], 1), maze, goal)
        goal_node = jnp.take_along_axis(goals, column[:, None], 1)[:, 0]
        plan = Following(
            points=points,
            next_hop=tables.next_hop[which, :, column].astype(jnp.int32),
            to_go=tables.distance[which, :, column],
            waypoint=goal_node,
            goal_node=goal_node,
        )
        return plan.replace(waypoint=self._choose(plan, maze, at.position)[0])

    def waypoint(self, plan: Following, frame: Frame) -> tuple[Float[Array, "N 2"], Following]:
        """Vectors to the waypoints [N, 2] (m), and the plans after this step.

        A plan goes on to the next waypoint when one is reached, and chooses another when one is out of sight.
        """
        maze, position, goal = frame.privileged.scene, frame.privileged.position, frame.privileged.goal_world
        row = jnp.arange(len(plan.waypoint))
        away = jnp.linalg.norm(plan.points[row, plan.waypoint] - position, axis=-1)
        hop = plan.next_hop[row, plan.waypoint]
        waypoint = jnp.where((away < self.waypoint_tolerance_m) & (hop != NO_HOP), hop, plan.waypoint)
        kept = plan.points[row, waypoint]
        # The margin is needed to choose a waypoint, not to keep it. Otherwise a robot beside its path would turn back.
        kept_seen = self._sees(maze, position, kept[:, None], self._keep_m)[:, 0]
        way = jnp.where(kept_seen, jnp.linalg.norm(kept - position, axis=-1) + plan.to_go[row, waypoint], jnp.inf)
        better = jnp.inf if not self.shortcut else 1e-3

        def choose() -> jax.Array:
            new, new_way = self._choose(plan, maze, position)
            return jnp.where(~kept_seen | (new_way < way - better), new, waypoint)

        waypoint = choose() if self.shortcut else jax.lax.cond(jnp.all(kept_seen), lambda: waypoint, choose)
        last = (waypoint == plan.goal_node) & self._sees(maze, position, goal[:, None], self._keep_m)[:, 0]
        target = jnp.where(last[:, None], goal, plan.points[row, waypoint])
        return target - position, plan.replace(waypoint=waypoint)

    @property
    def _keep_m(self) -> float:
        return 0.8 * self.radius_m

    def _choose(self, plan: Following, maze: Maze, position: jax.Array) -> tuple[Int[Array, "N"], Float[Array, "N"]]:
        """The visible point with the shortest path to the goal, and the length of that path [m].

        If no point is visible: the nearest point, and infinity.
        """
        away = jnp.linalg.norm(plan.points - position[:, None], axis=-1)
        _, near = jax.lax.top_k(-away, min(_CANDIDATES, away.shape[1]))
        pick = lambda leaf: jnp.take_along_axis(leaf, near, 1)  # noqa: E731
        points = jnp.take_along_axis(plan.points, near[..., None], 1)
        free = self._sees(maze, position, points, self.radius_m + self.margin_m) & (pick(away) <= self.look_m)
        way = jnp.where(free, pick(away) + pick(plan.to_go), jnp.inf)
        best = jnp.argmin(way, -1)[:, None]  # if all are infinite: the first, which is the nearest
        return jnp.take_along_axis(near, best, 1)[:, 0], jnp.take_along_axis(way, best, 1)[:, 0]

    def _nearest_in_sight(self, points: Float[Array, "N n 2"], maze: Maze, goal: jax.Array) -> Int[Array, "N"]:
        away = jnp.linalg.norm(points - goal[:, None], axis=-1)
        hidden = jnp.where(self._sees(maze, goal, points, self.radius_m), 0.0, 1e6)
        return jnp.argmin(away + hidden, -1).astype(jnp.int32)

    def _sees(self, maze: Maze, position: jax.Array, points: Float[Array, "N n 2"], radius: float) -> jax.Array:
        reach = segment_reach(self.look_m, self.radius_m + self.margin_m, self.cell_m)
        reach = max(reach, segment_reach(1.5 * self.look_m, self.radius_m, self.cell_m))
        sight = functools.partial(in_sight, radius=radius, reach=reach)
        free = jax.vmap(jax.vmap(sight, (None, None, 0)))(maze, position, points)
        return free & (jnp.linalg.norm(points - position[:, None], axis=-1) <= 1.5 * self.look_m)
