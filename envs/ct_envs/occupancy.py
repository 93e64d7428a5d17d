"""The 2 x k x k local occupancy map, the only thing a policy sees of the walls (paper, sec. IV-A and IV-D).

The window is centred on the robot and aligned with the world. ``map[channel, i, j]`` is the point
``(j - (k - 1) / 2, i - (k - 1) / 2) * cell_m`` from the robot, so ``i`` runs up (y) and ``j`` right (x). Channel 0 is
1 where that point is in a wall; channel 1 is 1 in the one cell that holds the goal, if the window holds it.

From a maze, under jit, ``local_map`` draws it; from the ranges of a lidar, in NumPy, ``lidar_map``.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

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

    In bytes: thousands of maps a step are a matter of memory bandwidth.
    """
    offset = (jnp.arange(cells, dtype=jnp.float32) - (cells - 1) / 2) * cell_m
    column, row = (jnp.floor((position[:, None] + offset[None]) / maze.cell_m)).astype(jnp.int32)
    height, width = maze.shape
    # Padding and border are wall, so a point outside the array may read the nearest cell inside it.
    walls = maze.walls[jnp.clip(row, 0, height - 1)[:, None], jnp.clip(column, 0, width - 1)[None, :]]
    at = jnp.round((goal - position) / cell_m + (cells - 1) / 2).astype(jnp.int32)
    index = jnp.arange(cells, dtype=jnp.int32)
    here = (index[:, None] == at[1]) & (index[None, :] == at[0])
    return jnp.stack([walls, here]).astype(jnp.uint8)
