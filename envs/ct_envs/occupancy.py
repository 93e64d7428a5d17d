"""The 2 x k x k local occupancy map, the only thing a policy sees of the walls (paper, sec. IV-A and IV-D).

The window is centred on the robot and aligned with the world. ``map[channel, i, j]`` is the point
``(j - (k - 1) / 2, i - (k - 1) / 2) * cell_m`` from the robot, so ``i`` runs up (y) and ``j`` right (x). Channel 0 is
1 where that point is in a wall; channel 1 is 1 in the one cell that holds the goal, if the window holds it.

From a maze, under jit, ``local_map`` draws it; from the ranges of a lidar, in NumPy, ``lidar_map``.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ct_envs.errors import UserError
from ct_envs.maze import Maze

MAP_CELLS = 25  # k of the paper
LIDAR_BEAMS = 360  # of the Turtlebot3's LDS-01: one a degree, counter-clockwise from the heading
LIDAR_RANGE_M = 1.0  # what we use of its 3.5 m (paper, sec. IV-D)
LIDAR_CELL_M = 0.08  # so that the window just holds the range


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
    offset = (jnp.arange(cells) - (cells - 1) / 2) * cell_m
    column, row = (jnp.floor((position[:, None] + offset[None]) / maze.cell_m)).astype(jnp.int32)
    height, width = maze.shape
    # Padding and border are wall, so a point outside the array may read the nearest cell inside it.
    walls = maze.walls[jnp.clip(row, 0, height - 1)[:, None], jnp.clip(column, 0, width - 1)[None, :]]
    at = jnp.round((goal - position) / cell_m + (cells - 1) / 2).astype(jnp.int32)
    index = jnp.arange(cells)
    here = (index[:, None] == at[1]) & (index[None, :] == at[0])
    return jnp.stack([walls, here]).astype(jnp.uint8)


def lidar_map(
    ranges: Any,
    goal: Any,
    *,
    yaw_rad: Any = 0.0,
    range_m: float = LIDAR_RANGE_M,
    cell_m: float = LIDAR_CELL_M,
    cells: int = MAP_CELLS,
    beams: int = LIDAR_BEAMS,
    missing_ok: bool = False,
) -> UInt8[np.ndarray, "*b 2 k k"]:
    """The local map of a lidar: channel 0 is 1 in the cells in which beams end, channel 1 in the goal's (sec. IV-D).

    Args:
        ranges: [*b, beams] (m); beam i is ``360 i / beams`` degrees to the left of the heading. One of ``range_m`` or
            more met nothing that counts.
        goal: vector from the robot to the goal [*b, 2] (m), in the frame of the map.
        yaw_rad: of the robot in the frame of the map [*b]; 0 for a map in the robot's own frame (x ahead, y left).
        missing_ok: whether NaN, infinity and 0, with which lidars report that nothing came back, are taken as such.

    Raises:
        UserError: too few or too many ranges, negative ones or, without ``missing_ok``, missing ones.
    """
    ranges, goal = np.asarray(ranges, np.float64), np.asarray(goal, np.float64)
    if ranges.shape[-1:] != (beams,):
        found = ranges.shape[-1] if ranges.ndim else "no list of"
        raise UserError(f"the lidar gave {found} ranges, not {beams}; give one for each beam, all around")
    missing = ~np.isfinite(ranges) | (ranges == 0)
    for wrong, mend in ((ranges < 0, "give metres"), (missing & (not missing_ok), "or allow it: missing_ok=True")):
        if wrong.any():
            beam = int(np.argwhere(wrong)[0][-1])
            raise UserError(f"the lidar's range {ranges[wrong][0]} m of beam {beam} is not a distance; {mend}")
    met = ~missing & (ranges < range_m)
    angle = np.asarray(yaw_rad)[..., None] + np.arange(beams) * (2 * np.pi / beams)
    ends = np.where(met, ranges, 0.0)[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    picture = np.zeros((*ranges.shape[:-1], 2, cells, cells), np.uint8)
    _mark(picture[..., 0, :, :], ends, met, cell_m)
    _mark(picture[..., 1, :, :], goal[..., None, :], np.True_, cell_m)
    return picture


def _mark(channel: np.ndarray, points: np.ndarray, meant: Any, cell_m: float) -> None:
    """Set the cells [*b, k, k] that hold the points [*b, n, 2] (m) that are meant and inside the window."""
    cells = channel.shape[-1]
    at = np.floor(points / cell_m + cells / 2)
    *batch, _ = held = np.nonzero(((at >= 0) & (at < cells)).all(-1) & meant)
    column, row = at[held].astype(int).T
    channel[*batch, row, column] = 1
