"""The benchmark UnseenMaze: its training, validation and test mazes, and the starts and goals in them.

A maze is named by its split and its number: ``test_maze(7)``. Numbers go round the generators, and within a generator
round all sizes from 7 x 7 to 24 x 24 cells.

The splits are disjoint for two reasons. Their seeds come from three separate ranges. And the content of a maze says
which split it belongs to (``split_of``), so that not even a small maze, of which there are few, is in two splits. Each
number draws mazes from its own seeds until one belongs to its split. Mazes that are equal after turning or mirroring
count as one.
"""

import hashlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ct_envs.errors import UserError
from ct_envs.generators import GENERATORS, SIDES, VERSION, Chance, generate_walls
from ct_envs.maze import CELL_M
from ct_envs.maze_statistics import free_cells, shortest_ways

TEST_MAZES = 1000
LARGEST_NUMBER = 2**40 - 1  # of a training or validation maze
CLEARANCE_M = 1.0  # from a start or goal to the nearest wall: as much as the largest robot needs
LEAST_WAY_M = 20.0  # of the shortest way from start to goal; every test maze has longer ones

_ATTEMPTS = 2**20  # seeds of a number; three are used on average
_SEEDS = {"training": 0, "validation": 2**61, "test": 2**62}  # the first seed of each split
_MARGIN_M = 1e-3  # more than float32 rounds


class FarPairs(NamedTuple):
    """Starts and goals in one maze, k of them."""

    start_m: Float[np.ndarray, "k 2"]  # (x, y) in the maze's frame
    goal_m: Float[np.ndarray, "k 2"]
    way_m: Float[np.ndarray, "k"]  # length of the shortest way from cell to cell, along rows and columns
    trap_steps: Int[np.ndarray, "k"]  # depth of the deepest concave trap on that way (``maze_statistics``)


# ---------------------------------------------------------------------------------------------------------- mazes


def training_maze(number: int, generator: str | None = None) -> Bool[np.ndarray, "H W"]:
    """A maze to train in, bool [H, W], row 0 lowest.

    Args:
        number: from 0 to ``LARGEST_NUMBER``.
        generator: the number then counts the mazes of this generator: ``training_maze(n)`` is
            ``training_maze(n // 4, generator_of(n))``.

    Raises:
        UserError: unknown generator, or number out of range.
    """
    return _maze("training", number, generator)


def validation_maze(number: int, generator: str | None = None) -> Bool[np.ndarray, "H W"]:
    """A maze to choose settings by. Otherwise as ``training_maze``."""
    return _maze("validation", number, generator)


def test_maze(number: int) -> Bool[np.ndarray, "H W"]:
    """A maze of the benchmark, from 0 to 999, bool [H, W], row 0 lowest: 250 of each generator. Never train in it, and
    choose nothing by it.

    Raises:
        UserError: number out of range.
    """
    return _maze("test", number, None)


def generator_of(number: int) -> str:
    """The generator of a numbered maze of any split."""
    return list(GENERATORS)[number % len(GENERATORS)]


def split_of(walls: Bool[np.ndarray, "H W"]) -> str:
    """The split that a maze belongs to, by its content: "training", "validation" or "test".

    It holds for mazes of any origin. A program that trains in a maze of its own can check that it is no test maze.
    """
    return list(_SEEDS)[int.from_bytes(fingerprint(walls)[:8], "big") % len(_SEEDS)]


def fingerprint(walls: Bool[np.ndarray, "H W"]) -> bytes:
    """16 bytes that mazes share if they are equal after turning, mirroring and removing surplus walls at the border."""
    rows, columns = np.nonzero(~walls)
    inner = walls[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    turned = [np.rot90(side, quarter) for side in (inner, inner.T) for quarter in range(4)]
    first = min((form.shape, np.packbits(form).tobytes()) for form in turned)
    return hashlib.blake2b(bytes(str(first[0]), "ascii") + first[1], digest_size=16).digest()


def _maze(split: str, number: int, generator: str | None) -> Bool[np.ndarray, "H W"]:
    """The maze of a number: the first from its seeds that belongs to the split."""
    _check_number(split, number)
    generator, index = (generator_of(number), number // len(GENERATORS)) if generator is None else (generator, number)
    height, width = _size(index)
    for seed in seeds_of(split, index):
        walls = generate_walls(generator, seed, height, width)
        if split_of(walls) == split:
            return walls
    raise RuntimeError(f"no {split} maze of {generator} with {height} x {width} cells")  # tests try all small sizes


def seeds_of(split: str, index: int) -> range:
    """The seeds that a generator's maze number ``index`` tries in turn. No other maze of the generator has them."""
    first = _SEEDS[split] + index * _ATTEMPTS
    return range(first, first + _ATTEMPTS)


def _size(index: int) -> tuple[int, int]:
    """(H, W) of a generator's maze: 324 in a row have all sizes, 18 in a row have all heights and all widths."""
    low, high = SIDES
    sides = high - low + 1
    return low + index % sides, low + (5 * index + index // sides) % sides


def _check_number(split: str, number: int) -> None:
    most = TEST_MAZES - 1 if split == "test" else LARGEST_NUMBER
    if not 0 <= number <= most:
        raise UserError(f"{split} maze {number}: give a number from 0 to {most}")


# ---------------------------------------------------------------------------------------------- starts and goals


def test_pairs(
    number: int, count: int, *, least_way_m: float = LEAST_WAY_M, clearance_m: float = CLEARANCE_M
) -> FarPairs:
    """The first ``count`` starts and goals of a test maze: the same for every robot and method.

    Args:
        number: of the maze.
        least_way_m: the shortest way from start to goal is at least so long [m].
        clearance_m: distance [m] that the points keep from walls.

    Raises:
        UserError: number, count or clearance out of range; no way of the maze is so long.
    """
    return _pairs("test", test_maze(number), number, count, least_way_m, clearance_m)


def validation_pairs(
    number: int, count: int, *, least_way_m: float = LEAST_WAY_M, clearance_m: float = CLEARANCE_M
) -> FarPairs:
    """The first ``count`` starts and goals of ``validation_maze(number)``. Otherwise as ``test_pairs``."""
    return _pairs("validation", validation_maze(number), number, count, least_way_m, clearance_m)


def _pairs(
    split: str, walls: Bool[np.ndarray, "H W"], number: int, count: int, least_way_m: float, clearance_m: float
) -> FarPairs:
    """Pairs of cells, uniform over all that are far enough apart, and a uniform point in each cell, less its edges."""
    if count < 1:
        raise UserError(f"{count} pairs of {split} maze {number}: give a number above 0")
    slack = CELL_M / 2 - clearance_m - _MARGIN_M
    if not (clearance_m >= 0 and slack >= 0):
        raise UserError(f"clearance {clearance_m} m in {split} maze {number}: give 0 to less than {CELL_M / 2} m")
    ways = shortest_ways(walls)
    start, goal = np.nonzero(ways.steps * CELL_M >= max(least_way_m, CELL_M))
    if not len(start):
        longest = int(ways.steps.max()) * CELL_M
        raise UserError(f"{split} maze {number} has no way of {least_way_m} m or more; its longest has {longest} m")
    chance = Chance([VERSION, list(_SEEDS).index(split), number]).rng.random((count, 5))
    chosen = (chance[:, 0] * len(start)).astype(np.int64)
    start, goal = start[chosen], goal[chosen]

    def point(cell: Int[np.ndarray, "k"], offset: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 2"]:
        row, column = np.divmod(free_cells(walls)[cell], walls.shape[1])
        centre = (np.stack([column, row], 1) + 0.5) * CELL_M
        return (centre + (2 * offset - 1) * slack).astype(np.float32)

    return FarPairs(
        point(start, chance[:, 1:3]),
        point(goal, chance[:, 3:]),
        ways.steps[start, goal].astype(np.float32) * np.float32(CELL_M),
        ways.trap[start, goal].astype(np.int32),
    )
