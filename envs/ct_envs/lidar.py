"""The local occupancy map of a lidar (paper, sec. IV-B). NumPy only: the simulation processes start without JAX.

The layout of the map is that of ``ct_envs.occupancy``, which draws the maps of mazes.
"""

from typing import Any

import numpy as np
from jaxtyping import UInt8

from ct_envs.errors import UserError

MAP_CELLS = 25  # k of the paper
LIDAR_BEAMS = 360  # of the Turtlebot3's LDS-01: one for each degree, counter-clockwise from the heading
LIDAR_RANGE_M = 1.0  # the range that we use; the lidar has 3.5 m (paper, sec. IV-B)
LIDAR_CELL_M = 0.08  # 25 cells just cover the range on both sides


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
    """The local map of a lidar: channel 0 is 1 in cells where a beam ends, channel 1 in the goal's cell (sec. IV-B).

    Args:
        ranges: [*b, beams] (m); beam i points ``360 i / beams`` degrees to the left of the heading. Ranges of
            ``range_m`` or more are not drawn.
        goal: vector from the robot to the goal [*b, 2] (m), in the frame of the map.
        yaw_rad: yaw of the robot in the frame of the map [*b]; 0 for a map in the robot's own frame (x ahead, y left).
        missing_ok: accept NaN, infinity and 0. Lidars report them for beams that did not come back.

    Raises:
        UserError: the number of ranges is wrong, a range is negative or, without ``missing_ok``, a range is missing.
    """
    ranges, goal = np.asarray(ranges, np.float64), np.asarray(goal, np.float64)
    if ranges.shape[-1:] != (beams,):
        found = ranges.shape[-1] if ranges.ndim else "no list of"
        raise UserError(f"the lidar gave {found} ranges, not {beams}; give one for each beam, all around")
    missing = ~np.isfinite(ranges) | (ranges == 0)
    for wrong, hint in ((ranges < 0, "give metres"), (missing & (not missing_ok), "or allow it: missing_ok=True")):
        if wrong.any():
            beam = int(np.argwhere(wrong)[0][-1])
            raise UserError(f"the lidar's range {ranges[wrong][0]} m of beam {beam} is not a distance; {hint}")
    met = ~missing & (ranges < range_m)
    angle = np.asarray(yaw_rad)[..., None] + np.arange(beams) * (2 * np.pi / beams)
    ends = np.where(met, ranges, 0.0)[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    picture = np.zeros((*ranges.shape[:-1], 2, cells, cells), np.uint8)
    _mark(picture[..., 0, :, :], ends, met, cell_m)
    _mark(picture[..., 1, :, :], goal[..., None, :], np.True_, cell_m)
    return picture


def _mark(channel: np.ndarray, points: np.ndarray, meant: Any, cell_m: float) -> None:
    """Set the cells [*b, k, k] of the points [*b, n, 2] (m) that are flagged in ``meant`` and inside the window."""
    cells = channel.shape[-1]
    at = np.floor(points / cell_m + cells / 2)
    *batch, _ = held = np.nonzero(((at >= 0) & (at < cells)).all(-1) & meant)
    column, row = at[held].astype(int).T
    channel[*batch, row, column] = 1
