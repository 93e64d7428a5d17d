"""The 2 x k x k local occupancy map: the only view of the walls that a policy has (paper, sec. IV-A and IV-B).

The window is centred on the robot and aligned with the world. ``map[channel, i, j]`` describes the point
``(j - (k - 1) / 2, i - (k - 1) / 2) * cell_m`` from the robot: ``i`` increases upwards (y), ``j`` to the right (x).
Channel 0 is 1 if that point is in a wall. Channel 1 is 1 in the cell of the goal, if the goal is inside the window.

``local_map`` draws the map of a maze, under jit. ``lidar_map`` draws it from the ranges of a lidar, in NumPy.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from ct_envs.lidar import LIDAR_BEAMS, LIDAR_CELL_M, LIDAR_RANGE_M, MAP_CELLS, lidar_map
from ct_envs.maze import Maze

__all__ = ["LIDAR_BEAMS", "LIDAR_CELL_M", "LIDAR_RANGE_M", "MAP_CELLS", "lidar_map", "local_map"]


def local_map(
    maze: Maze,
    position: Float[Array, "2"],
    goal: Float[Array, "2"],
    *,
    cell_m: float,
    cells: int = MAP_CELLS,
) -> UInt8[Array, "2 k k"]:
    """The local map at ``position`` [m] with a goal at ``goal`` [m]; ``cell_m`` is the side of a map cell [m].

    Its entries are bytes: memory bandwidth limits the speed of thousands of maps a step. In a maze with ``boxes``
    walls may be thinner than a map cell: there, channel 0 is 1 if any part of that cell is wall.
    """
    offset = (jnp.arange(cells, dtype=jnp.float32) - (cells - 1) / 2) * cell_m
    height, width = maze.shape
    if maze.boxes is None:
        column, row = (jnp.floor((position[:, None] + offset[None]) / maze.cell_m)).astype(jnp.int32)
        # Padding and border are wall, so a point outside the array can use the nearest cell inside.
        walls = maze.walls[jnp.clip(row, 0, height - 1)[:, None], jnp.clip(column, 0, width - 1)[None, :]]
    else:
        walls = _any_wall(maze, position, offset, cell_m)
    at = jnp.round((goal - position) / cell_m + (cells - 1) / 2).astype(jnp.int32)
    index = jnp.arange(cells, dtype=jnp.int32)
    here = (index[:, None] == at[1]) & (index[None, :] == at[0])
    return jnp.stack([walls, here]).astype(jnp.uint8)


def _any_wall(maze: Maze, position: Float[Array, "2"], offset: Float[Array, "k"], cell_m: float) -> Bool[Array, "k k"]:
    """Whether there is any wall in the map cells around a position [m]; ``offset`` is that of their centres [m]."""
    assert maze.boxes is not None
    low, high = (
        jnp.floor((position[:, None] + offset[None] + side * cell_m / 2) / maze.cell_m).astype(jnp.int32)
        for side in (-1.0, 1.0)
    )
    limit = jnp.array(maze.shape[::-1], jnp.int32)[:, None]
    low = jnp.clip(low, 0, limit - 1)  # what lies outside is like the border: wall
    high = jnp.clip(high + 1, low + 1, limit)
    (left, bottom), (right, top) = low, high
    counts = maze.boxes.counts
    corner = lambda row, column: counts[row[:, None], column[None, :]]  # noqa: E731
    return corner(top, right) - corner(bottom, right) - corner(top, left) + corner(bottom, left) > 0
