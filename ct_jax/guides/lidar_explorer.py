"""The Turtlebot3's explorer: a classical planner that sees the same lidar as the transformer. It is the reference.

It marks the ends of its beams on a grid, assumes that all other cells are free, and follows the shortest path on that
grid. Its positions come from odometry, so it knows the room only by what it saw.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ct_envs.lidar import LIDAR_BEAMS, LIDAR_CELL_M, LIDAR_RANGE_M
from ct_envs.turtlebot3 import to_heading
from ct_envs.turtlebot3_pool import PoolFrame
from ct_jax.types import Frame

_NEAR = 0.15  # first share of a straight path that is not checked: the robot may already be too close to an obstacle
_DEAR = 30.0  # cost factor of cells that are too close to an obstacle: a last resort
_TIGHT = 3.0  # cost factor of cells within the margin


@dataclass(frozen=True)
class Charted:
    """One robot's grid, with its start in the middle."""

    origin: Float[np.ndarray, "2"]  # lower left corner, in the frame of the odometry [m]
    goal: Float[np.ndarray, "2"]  # in the same frame [m]
    occupied: Bool[np.ndarray, "n n"]  # row y, column x
    age: int = 0  # steps since the plan was made
    target: Float[np.ndarray, "2"] | None = None


@dataclass(frozen=True)
class LidarExplorer:
    """Optimistic replanning on the lidar's grid, for the slots of a pool."""

    clear_m: float  # smallest distance between the robot's centre and an obstacle
    margin_m: float = 0.0  # distance kept beyond that, unless the detour is much longer
    cell_m: float = LIDAR_CELL_M
    side_m: float = 14.0  # side of the grid: from a start in one corner of a room it covers the opposite corner
    every: int = 5  # steps between two plans
    look_m: float = 0.8  # largest distance of a waypoint: inside the lidar's range

    def init(self, frame: Frame, tasks: Any = None) -> tuple[Charted, ...]:
        """The memory before anything is seen."""
        del tasks
        seen, n = frame.privileged.scene, round(self.side_m / self.cell_m)
        goal = _in_world(seen, seen.goal)
        return tuple(
            Charted(position - self.side_m / 2, goal[slot], np.zeros((n, n), bool))
            for slot, position in enumerate(seen.believed_position)
        )

    def waypoint(self, memory: tuple[Charted, ...], frame: Frame) -> tuple[np.ndarray, tuple[Charted, ...]]:
        """Vectors to the waypoints [N, 2] in the robots' own frames (m), and the grids so far."""
        return self._waypoint(memory, frame.privileged.scene)

    def _waypoint(self, memory: tuple[Charted, ...], frame: PoolFrame) -> tuple[np.ndarray, tuple[Charted, ...]]:
        here, met = frame.believed_position, frame.ranges < LIDAR_RANGE_M
        ends = _beam_ends(frame)
        charts = [
            chart if frame.done[slot] else self._look(chart, ends[slot][met[slot]], here[slot])
            for slot, chart in enumerate(memory)
        ]
        target = [position if c.target is None else c.target for c, position in zip(charts, here, strict=True)]
        return to_heading(np.stack(target) - here, frame.believed_yaw_rad), tuple(charts)

    def _look(self, chart: Charted, hits: np.ndarray, position: np.ndarray) -> Charted:
        """Mark the obstacles that beams hit, and plan again every ``every`` steps."""
        at = self._cell(chart, hits)
        at = at[((at >= 0) & (at < len(chart.occupied))).all(-1)]
        occupied = chart.occupied.copy()
        occupied[at[:, 1], at[:, 0]] = True
        chart = replace(chart, occupied=occupied, age=chart.age + 1)
        if chart.target is not None and chart.age % self.every:
            return chart
        return replace(chart, target=self._plan(chart, position))

    def _plan(self, chart: Charted, position: np.ndarray) -> np.ndarray:
        """The farthest point of the shortest path that the robot can reach in a straight line."""
        n, reach = len(chart.occupied), round(1.5 / self.cell_m)
        ends = np.clip(np.stack([self._cell(chart, position), self._cell(chart, chart.goal)]), 0, n - 1)
        low, high = np.maximum(ends.min(0) - reach, 0), np.minimum(ends.max(0) + reach + 1, n)
        part = chart.occupied[low[1] : high[1], low[0] : high[0]]
        away = _distance(part, self.cell_m)
        cost = np.where(away < self.clear_m, _DEAR, np.where(away < self.clear_m + self.margin_m, _TIGHT, 1.0))
        way = _way(cost, *(ends - low))
        if len(way) < 2:
            return chart.goal
        points = chart.origin + (way + low + 0.5) * self.cell_m
        points[-1] = chart.goal
        near = np.linalg.norm(points[1:] - position, axis=-1) <= self.look_m
        close = points[1:][: int(np.argmin(np.append(near, False)))]
        share = np.linspace(0.0, 1.0, 25)[:, None, None]
        column, row = np.moveaxis(self._cell(chart, position + share * (close - position)) - low, -1, 0)
        inside = np.clip(row, 0, len(cost) - 1), np.clip(column, 0, cost.shape[1] - 1)
        # The straight line may be as close to obstacles as the path that it replaces, but not closer.
        straight = np.where(share[..., 0] > _NEAR, cost[inside], 1.0).max(0)
        tight = np.maximum.accumulate(cost[way[1:, 1], way[1:, 0]])[: len(close)]
        free = np.flatnonzero(straight <= tight)
        return close[free[-1]] if len(free) else points[1]

    def _cell(self, chart: Charted, points: np.ndarray) -> np.ndarray:
        """Cells [..., 2] (column, row) of points [..., 2] (m)."""
        return np.floor((points - chart.origin) / self.cell_m).astype(int)


def _distance(occupied: np.ndarray, cell_m: float) -> np.ndarray:
    """Distance [m] of each cell to the nearest occupied one."""
    if not occupied.any():
        return np.full(occupied.shape, np.inf)
    return ndimage.distance_transform_edt(~occupied, sampling=cell_m)  # pyright: ignore[reportReturnType]


def _way(cost: np.ndarray, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Cells [k, 2] (column, row) of a shortest path."""
    first, last = (int(row * cost.shape[1] + column) for column, row in (start, goal))
    _, before = dijkstra(_grid(cost), indices=last, return_predecessors=True)
    way = [first]
    while way[-1] != last and before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    return np.stack(np.unravel_index(way, cost.shape)[::-1], -1)


def _grid(cost: np.ndarray) -> csr_array:
    """The 8-connected graph of a grid of costs: the cost of a cell (1 if free) multiplies the path length in it."""
    index = np.arange(cost.size).reshape(cost.shape)
    rows, columns, weights = [], [], []
    for here, there, length in (
        (np.s_[:, :-1], np.s_[:, 1:], 1.0), (np.s_[:-1, :], np.s_[1:, :], 1.0),
        (np.s_[:-1, :-1], np.s_[1:, 1:], 2**0.5), (np.s_[:-1, 1:], np.s_[1:, :-1], 2**0.5),
    ):  # fmt: skip
        weight = length * (cost[here] + cost[there]).ravel() / 2
        for a, b in ((here, there), (there, here)):
            rows.append(index[a].ravel())
            columns.append(index[b].ravel())
            weights.append(weight)
    entries = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(weights), entries), shape=(cost.size,) * 2)


def _beam_ends(frame: PoolFrame) -> Float[np.ndarray, "N 360 2"]:
    """The ends of the beams in the frame of the odometry [m]. The ends of beams that hit nothing are not valid."""
    angle = frame.believed_yaw_rad[:, None] + np.arange(LIDAR_BEAMS) * (2 * np.pi / LIDAR_BEAMS)
    ranges = np.minimum(frame.ranges, LIDAR_RANGE_M)[..., None]
    return frame.believed_position[:, None] + ranges * np.stack([np.cos(angle), np.sin(angle)], -1)


def _in_world(frame: PoolFrame, vector: np.ndarray) -> np.ndarray:
    """Points [N, 2] in the frame of the odometry (m), from vectors in the robots' own frames."""
    return frame.believed_position + to_heading(vector, -frame.believed_yaw_rad)
