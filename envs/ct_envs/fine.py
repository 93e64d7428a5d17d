"""Mazes with cells smaller than a robot, such as maps of buildings with 0.05 m a pixel.

Three boxes of one cell no longer hold all walls that such a robot could touch in a step. So the walls are merged into
rectangles, and each place of the maze gets a list of those within reach. The lists of all places have the same length,
one of a few, so that mazes of one length share one compiled program.
"""

import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from ct_envs.errors import UserError
from ct_envs.maps import read_map
from ct_envs.maze import (
    CELL_M,
    EXACT_REACH,
    MAX_SIDE,
    Boxes,
    Maze,
    list_cells,
    load_walls,
    make_maze,
    maze_names,
    segment_reach,
)
from ct_envs.physics import window_m
from ct_envs.robots import Robot

_LENGTHS = (8, 16, 32, 64, 128, 256)  # of the lists of boxes
_TILES = 4  # a robot's reach, in tiles
_WAY_M = 10.0  # straight ways that planners ask about are about so long [m]: edges of roadmaps


def load_fitted(name_or_file: str | Path, robot: Robot) -> Maze:
    """Load any maze or map at its own scale, for that robot. Raises UserError, as ``load_maze`` and ``fit_maze`` do."""
    if str(name_or_file) in maze_names():
        return make_maze(load_walls(name_or_file))
    cell_m = read_map(name_or_file).cell_m or CELL_M
    return fit_maze(load_walls(name_or_file, cell_m=cell_m), robot, cell_m=cell_m)


def fit_maze(walls: Bool[np.ndarray, "h w"], robot: Robot, *, cell_m: float) -> Maze:
    """A maze for one robot, with cells of any size.

    A robot that reaches less than half a cell in a step gets the maze of ``make_maze``. For any other, the maze has
    ``boxes``, and its free cells are those at whose centre the robot has room, with a margin of up to two cells.

    Args:
        walls: row 0 lowest, closed.
        cell_m: side of a cell [m].

    Raises:
        UserError: no room for the robot, too many cells, or too many boxes near one place.
    """
    maze = make_maze(walls, cell_m=cell_m)
    if robot.reach_m <= cell_m / 2:
        return maze
    padded = np.asarray(maze.walls)
    if max(padded.shape) > MAX_SIDE + 12:
        raise UserError(f"maze of {padded.shape} cells; at most {MAX_SIDE} x {MAX_SIDE}, use larger cells")
    room = wall_distance(padded) * cell_m
    # A robot that has room at the centres of two neighbours can go straight from one to the other. Where ways are too
    # long to be looked at cell by cell, they are found if there is more room.
    margin_m = 2 * cell_m if segment_reach(_WAY_M, robot.radius_m, cell_m) > EXACT_REACH else 0.0
    free = room >= robot.radius_m + margin_m
    if not free.any():
        mend = f"its widest place has radius {room.max():.2f} m"
        raise UserError(f"maze with cells of {cell_m:g} m: no free space for robot '{robot.name}'; {mend}")
    tile_m = max(robot.reach_m / _TILES, cell_m)
    sides = min((merge_walls(padded), merge_walls(padded.T)[:, [1, 0, 3, 2]]), key=len) * cell_m
    boxes = Boxes(
        sides=jnp.asarray(np.concatenate([sides, np.zeros((1, 4))]), jnp.float32),
        near=jnp.asarray(_near(sides, padded, cell_m, tile_m, robot), jnp.int32),
        tile_m=jnp.asarray(tile_m, jnp.float32),
        window_m=jnp.asarray(window_m(robot), jnp.float32),
        room_m=jnp.asarray(room, jnp.float32),
        counts=jnp.asarray(np.pad(np.cumsum(np.cumsum(padded, 0), 1), ((1, 0), (1, 0))), jnp.int32),
    )
    return maze.replace(**list_cells(free), boxes=boxes)


def merge_walls(walls: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, "R 4"]:
    """Rectangles (left, bottom, right, top) in cells that cover all walls, nothing else, and not each other.

    Equal runs of wall in rows that follow each other become one rectangle.
    """
    edges = np.diff(np.pad(walls, ((0, 1), (1, 1))).astype(np.int8), axis=1)  # a last row without walls ends all
    found, begun = [], {}
    for row, edge in enumerate(edges):
        runs = set(zip(np.flatnonzero(edge == 1).tolist(), np.flatnonzero(edge == -1).tolist(), strict=True))
        found += [(left, begun.pop((left, right)), right, row) for left, right in sorted(begun.keys() - runs)]
        begun |= dict.fromkeys(runs - begun.keys(), row)
    return np.array(found, int).reshape(-1, 4)


def wall_distance(walls: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Distance, in cells, from the centre of each cell to the nearest wall, which lies all around, too; 0 in walls.

    The nearest point of a wall cell is a corner of it, or the middle of a side: so the distances between the points of
    a grid of twice the fineness are exact.
    """
    height, width = walls.shape
    lattice = np.ones((2 * height + 1, 2 * width + 1), bool)
    blocked = np.pad(walls, 1, constant_values=True)
    corner = blocked[:-1, :-1] | blocked[:-1, 1:] | blocked[1:, :-1] | blocked[1:, 1:]
    lattice[0::2, 0::2] = ~corner
    lattice[1::2, 0::2] = ~(blocked[1:-1, :-1] | blocked[1:-1, 1:])
    lattice[0::2, 1::2] = ~(blocked[:-1, 1:-1] | blocked[1:, 1:-1])
    lattice[1::2, 1::2] = ~walls
    distance: np.ndarray = ndimage.distance_transform_edt(lattice)  # pyright: ignore[reportAssignmentType]
    return distance[1::2, 1::2] / 2


def _near(
    sides: Float[np.ndarray, "R 4"], walls: Bool[np.ndarray, "H W"], cell_m: float, tile_m: float, robot: Robot
) -> Int[np.ndarray, "h w B"]:
    """The boxes within a robot's reach of each tile in which there is a free cell; R where there are fewer."""
    height, width = (max(1, math.ceil(side * cell_m / tile_m)) for side in walls.shape)
    low_x, low_y = np.arange(width) * tile_m, np.arange(height) * tile_m
    reach = robot.reach_m + 1e-3  # more than the rounding error
    owners, tiles = [], []
    for number, (left, bottom, right, top) in enumerate(sides):
        dx = np.maximum(np.maximum(left - low_x - tile_m, low_x - right), 0.0)
        dy = np.maximum(np.maximum(bottom - low_y - tile_m, low_y - top), 0.0)
        columns, rows = np.flatnonzero(dx <= reach), np.flatnonzero(dy <= reach)
        row, column = np.nonzero(np.hypot(dy[rows][:, None], dx[columns][None]) <= reach)
        tiles.append(rows[row] * width + columns[column])
        owners.append(np.full(len(row), number))
    tile, owner = np.concatenate(tiles), np.concatenate(owners)
    wanted = np.zeros((height, width), bool)
    at = np.argwhere(~walls)
    for row_shift in (-1e-3, 0.5, 1.001):  # a cell may lie in two tiles along an axis, or touch them
        for column_shift in (-1e-3, 0.5, 1.001):
            row, column = ((at + np.array([row_shift, column_shift])) * (cell_m / tile_m)).astype(int).T
            wanted[np.minimum(row, height - 1), np.minimum(column, width - 1)] = True
    tile, owner = tile[wanted.ravel()[tile]], owner[wanted.ravel()[tile]]
    order = np.argsort(tile, kind="stable")
    tile, owner = tile[order], owner[order]
    place = np.arange(len(tile)) - np.searchsorted(tile, tile)
    most = int(place.max(initial=0)) + 1
    length = next((each for each in _LENGTHS if each >= most), 0)
    if not length:
        row, column = divmod(int(tile[np.argmax(place)]), width)
        where = f"({column * tile_m:.1f}, {row * tile_m:.1f}) m"
        mend = f"at most {_LENGTHS[-1]}; use larger cells (ct-jax maps convert --cell-m)"
        raise UserError(f"{most} pieces of wall within reach of robot '{robot.name}' at {where}; {mend}")
    near = np.full((height * width, length), len(sides))
    near[tile, place] = owner
    return near.reshape(height, width, length)
