"""Measures of a maze: free share, loops, dead ends, the longest way, and the depth of its concave traps.

Mazes are wall grids, bool [H, W]. Ways lead from a free cell to one of its four neighbours; a way of n steps is
n ``cell_m`` long. Cells are numbered as ``free_cells`` lists them.

A concave trap is a place that a robot leaves by going away from its goal. Its depth is counted in steps: how much
farther from the goal the shortest way leads before it arrives. Distances to the goal are counted along rows and columns
(Manhattan distance), through walls. In an open room every depth is 0. At the closed end of a corridor of n cells, with
the goal behind that end, the depth is about n.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

_FAR = np.iinfo(np.int16).max


class MazeStatistics(NamedTuple):
    """What ``measure_maze`` measures."""

    free_share: float  # free cells / inner cells
    cycle_rank: int  # independent loops of the graph of free cells; an open square of 2 x 2 cells is one
    islands: int  # of them, those around walls: groups of wall cells that do not touch the border, corners included
    dead_ends: int  # free cells with at most one free neighbour
    longest_way: int  # steps of the longest of all shortest ways
    trap_depth: int  # steps, of the deepest trap for any goal


class Ways(NamedTuple):
    """All shortest ways of a maze with n free cells."""

    steps: Int[np.ndarray, "n n"]  # from each cell (row) to each goal (column); -1 where no way leads
    rise: Int[np.ndarray, "n n"]  # depth of the trap at the cell: the most steps farther from the goal a way gets
    trap: Int[np.ndarray, "n n"]  # depth of the deepest trap on the way from the cell to the goal, both included


def measure_maze(walls: Bool[np.ndarray, "H W"]) -> MazeStatistics:
    """The measures of one maze. Ways between regions that are not connected do not count."""
    height, width = walls.shape
    free = ~walls
    cells, edges, squares = _counts(free)
    ways = shortest_ways(walls)
    cycle_rank = edges - cells + _regions(ways.steps)
    return MazeStatistics(
        free_share=cells / ((height - 2) * (width - 2)),
        cycle_rank=cycle_rank,
        islands=cycle_rank - squares,
        dead_ends=int(((neighbour_table(walls) < cells).sum(1) <= 1).sum()),
        longest_way=int(ways.steps.max()),
        trap_depth=int(ways.trap.max()),
    )


def count_islands(walls: Bool[np.ndarray, "H W"]) -> int:
    """Groups of wall cells that do not touch the border (touching at corners counts), in a maze of one region."""
    cells, edges, squares = _counts(~walls)
    return 1 - cells + edges - squares


def free_cells(walls: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, "n"]:
    """Flat indices (row * W + column) of the free cells, in order."""
    return np.flatnonzero(~walls)


def neighbour_table(walls: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, "n 4"]:
    """The numbers of each free cell's neighbours in ``free_cells``; n where there is a wall."""
    height, width = walls.shape
    cells = free_cells(walls)
    number = np.full((height + 2, width + 2), len(cells))
    number[1:-1, 1:-1][~walls] = np.arange(len(cells))
    row, column = np.divmod(cells, width)
    return np.stack([number[row + 1 + dr, column + 1 + dc] for dr, dc in ((1, 0), (0, 1), (-1, 0), (0, -1))], 1)


def shortest_ways(walls: Bool[np.ndarray, "H W"]) -> Ways:
    """Steps and traps of all shortest ways, by a breadth-first search from all goals at once.

    Of several shortest ways, the one with the least rise counts.
    """
    n, width = int((~walls).sum()), walls.shape[1]
    row, column = np.divmod(free_cells(walls), width)
    straight = (abs(row[:, None] - row) + abs(column[:, None] - column)).astype(np.int16)
    neighbours = neighbour_table(walls) * n  # times n: the flat index of a pair (cell, goal) is cell * n + goal
    # The row after the last cell stands for walls: never reached, and never on a way.
    steps = np.full((n + 1) * n, -1, np.int16)
    steps[n * n :] = _FAR
    peak, trap = (np.full((n + 1) * n, _FAR, np.int16) for _ in range(2))
    flat = straight.ravel()

    layer = np.arange(n) * (n + 1)
    steps[layer] = peak[layer] = trap[layer] = 0
    owner = np.empty((n + 1) * n, np.int64)
    distance = 0
    while len(layer):
        cell, goal = np.divmod(layer, n)
        onward = (neighbours[cell] + goal[:, None]).ravel()
        onward = onward[steps[onward] < 0]
        owner[onward] = np.arange(len(onward))
        layer = onward[owner[onward] == np.arange(len(onward))]  # each pair once
        distance += 1
        steps[layer] = distance
        cell, goal = np.divmod(layer, n)
        before = neighbours[cell] + goal[:, None]
        off = steps[before] != distance - 1
        peak[layer] = np.maximum(flat[layer], np.where(off, _FAR, peak[before]).min(1, initial=_FAR))
        here = peak[layer] - flat[layer]
        trap[layer] = np.maximum(here, np.where(off, _FAR, trap[before]).min(1, initial=_FAR))
    steps, peak, trap = (values[: n * n].reshape(n, n) for values in (steps, peak, trap))
    none = steps < 0
    return Ways(steps, np.where(none, 0, peak - straight), np.where(none, 0, trap))


def _counts(free: Bool[np.ndarray, "H W"]) -> tuple[int, int, int]:
    """Free cells, pairs of free neighbours, and free squares of 2 x 2 cells."""
    across, up = free[:, :-1] & free[:, 1:], free[:-1] & free[1:]
    return int(free.sum()), int(across.sum() + up.sum()), int((across[:-1] & across[1:]).sum())


def _regions(steps: Int[np.ndarray, "n n"]) -> int:
    """Connected regions: each is counted at its first cell."""
    return int((np.argmax(steps >= 0, axis=1) == np.arange(len(steps))).sum())
