"""Planning in rooms on a roadmap (paper, sec. III-A and IV-B), in NumPy."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ct_envs.turtlebot3 import RADIUS_M, to_heading
from ct_envs.turtlebot3_world import World
from ct_jax.prm import NoPath, Roadmap
from ct_jax.types import Frame

_LOOK = 24  # number of waypoints checked first: usually one of the best is visible
_NUDGE_M = 1e-3


class Ways(NamedTuple):
    """The plans of N robots and their current waypoints."""

    points: Float[np.ndarray, "N L 2"]  # waypoints, padded by repeating the last one [m]
    at: np.ndarray  # int [N]: index of the current waypoint


@dataclass(frozen=True)
class WayGuide:
    """The roadmap's shortest path from start to goal, point after point (paper, sec. III-A)."""

    waypoint_tolerance_m: float = 0.06  # a robot that turns earlier cuts the corner

    def init(self, frame: Frame, tasks: Any) -> Ways:
        """The plans of the first slots, at their beginnings."""
        ends = list(zip(tasks.start, tasks.goal, strict=True))
        plans = [roadmap.plan(*each) for roadmap, each in zip(tasks.roadmaps, ends, strict=True)]
        ways = [
            np.stack(each) if isinstance(plan, NoPath) else plan.points for plan, each in zip(plans, ends, strict=True)
        ]
        longest = max(map(len, ways))
        padded = [np.concatenate([way, np.repeat(way[-1:], longest - len(way), 0)]) for way in ways]
        n = len(frame.done)
        points = np.concatenate([np.stack(padded), np.zeros((n - len(ways), longest, 2))])
        return Ways(points, np.full(n, min(1, longest - 1)))

    def waypoint(self, memory: Ways, frame: Frame) -> tuple[np.ndarray, Ways]:
        """Vectors to the robots' waypoints [N, 2] (m), and the plans after this step."""
        here, row, last = frame.privileged.position, np.arange(len(memory.at)), memory.points.shape[1] - 1
        away = np.linalg.norm(memory.points[row, memory.at] - here, axis=-1)
        at = np.where(away < self.waypoint_tolerance_m, np.minimum(memory.at + 1, last), memory.at)
        return to_heading(memory.points[row, at] - here, frame.privileged.scene.yaw_rad), memory._replace(at=at)


class Field(NamedTuple):
    """One robot's roadmap with the path lengths to its goal. The goal is the last point."""

    world: World
    points: Float[np.ndarray, "n 2"]  # [m]
    to_go: Float[np.ndarray, "n"]  # path length to the goal [m]
    target: Float[np.ndarray, "2"]  # [m]


@dataclass(frozen=True)
class ShortcutGuide:
    """At every step the visible point with the shortest path to the goal, as ``RoadmapGuide`` with ``shortcut``.

    It is smoother than the roadmap's path and recovers from any disturbance."""

    margin_m: float  # clearance beyond the robot's radius, if the robot itself has that much room
    look_m: float = 2.0  # largest distance of a waypoint
    waypoint_tolerance_m: float = 0.05  # a nearer waypoint is skipped: the controller would stop there

    def init(self, frame: Frame, tasks: Any) -> tuple[Field, ...]:
        """The roadmaps, connected to the goals."""
        del frame
        return tuple(map(self._field, tasks.goal, tasks.worlds, tasks.roadmaps))

    def _field(self, goal: np.ndarray, world: World, roadmap: Roadmap) -> Field:
        points = roadmap.points
        seen = self._sees(world, goal, points)
        away = np.where(seen, np.linalg.norm(points - goal, axis=-1), np.inf)
        to_go = (np.asarray(roadmap.table.distance) + away).min(1)
        return Field(world, np.concatenate([points, goal[None]]), np.append(to_go, 0.0), goal)

    def waypoint(self, memory: tuple[Field, ...], frame: Frame) -> tuple[np.ndarray, tuple[Field, ...]]:
        """Vectors to the robots' waypoints [N, 2] (m), and the memory after this step."""
        here = frame.privileged.position
        fields = [
            field if frame.done[slot] else field._replace(target=self._choose(field, here[slot]))
            for slot, field in enumerate(memory)
        ]
        target = np.zeros_like(here)
        target[: len(fields)] = [field.target for field in fields]
        return to_heading(target - here, frame.privileged.scene.yaw_rad), tuple(fields)

    def _choose(self, field: Field, position: np.ndarray) -> np.ndarray:
        """The best visible point; if none is visible, the previous target."""
        away = np.linalg.norm(field.points - position, axis=-1)
        passed = (away < self.waypoint_tolerance_m) & (field.to_go > 0)
        way = np.where((away <= self.look_m) & ~passed, away + field.to_go, np.inf)
        best = np.argsort(way)[: int(np.isfinite(way).sum())]
        # The robot is not exactly on a skipped waypoint, so its path may have a little less room than the roadmap's.
        slack = self.waypoint_tolerance_m if passed.any() else 0.0
        for some in (best[:_LOOK], best[_LOOK:]):
            free = np.flatnonzero(self._sees(field.world, position, field.points[some], slack))
            if len(free):
                return field.points[some[free[0]]]
        return field.target

    def _sees(self, world: World, position: np.ndarray, points: np.ndarray, slack_m: float = 0.0) -> np.ndarray:
        """Whether the straight lines from a position [2] to points [k, 2] (m) are free.

        If an end is already close to an obstacle, the line may be as close."""
        ends = np.minimum(world.clearance(points), float(world.clearance(position))) - _NUDGE_M
        room = np.minimum(ends, RADIUS_M + max(self.margin_m - slack_m, 0.0))
        return world.segment_free(np.stack(np.broadcast_arrays(position, points), -2), room)
