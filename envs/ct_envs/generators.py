"""Generators of the benchmark UnseenMaze: wall grids of four kinds, as pure functions of kind, seed and size.

Grids are bool [height, width], True is wall, row 0 lowest, as everywhere in ``ct_envs``. Each has a closed border and
one 4-connected free region, which has at least ``LEAST_FREE`` of the inner cells.

``VERSION`` is part of every seed. Raise it with any change that alters a maze: then all mazes are new, and nobody can
take results of two versions for results of the same mazes.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ct_envs.errors import UserError
from ct_envs.maze import label_regions
from ct_envs.maze_statistics import count_islands

VERSION = 1
SIDES = (7, 24)  # fewest and most cells of a side, border included
LEAST_FREE = 1 / 3  # of the inner cells

_LARGEST_SEED = 2**63 - 1
_SMALLEST_CAVE = 10  # cells of its shorter side


class Chance:
    """Random choices from a seed of several numbers, all made of ``Generator.random``.

    NumPy may change how its other methods consume random bits; the digests of the mazes would change with them.
    """

    def __init__(self, entropy: list[int]):
        self.rng = np.random.default_rng(entropy)

    def share(self, low: float = 0.0, high: float = 1.0) -> float:
        """A number from [low, high)."""
        return low + (high - low) * self.rng.random()

    def happens(self, probability: float) -> bool:
        """True with this probability."""
        return self.rng.random() < probability

    def below(self, count: int) -> int:
        """An integer from 0 to ``count`` - 1."""
        return int(self.rng.random() * count)

    def between(self, low: int, high: int) -> int:
        """An integer from ``low`` to ``high``."""
        return low + self.below(high - low + 1)

    def grid(self, height: int, width: int, probability: float) -> np.ndarray:
        """bool [height, width], each cell True with this probability."""
        return self.rng.random((height, width)) < probability


def generate_walls(generator: str, seed: int, height: int, width: int) -> np.ndarray:
    """A maze of one kind, bool [height, width], row 0 lowest. The same arguments give the same maze on every machine.

    Args:
        generator: a name of ``GENERATORS``.
        seed: from 0 to 2^63 - 1.
        height, width: cells, border included, from 7 to 24.

    Raises:
        UserError: unknown generator; seed or size out of range.
    """
    if generator not in GENERATORS:
        raise UserError(f"no generator of mazes named '{generator}'; there are {', '.join(GENERATORS)}")
    if not 0 <= seed <= _LARGEST_SEED:
        raise UserError(f"seed {seed} of a maze: give a number from 0 to 2^63 - 1")
    low, high = SIDES
    if not (low <= height <= high and low <= width <= high):
        raise UserError(f"maze of {height} x {width} cells; the generators make {low} to {high} a side")
    chance = Chance([VERSION, list(GENERATORS).index(generator), height, width, seed])
    return GENERATORS[generator](chance, height, width)


# ------------------------------------------------------------------------------------------- perfect mazes, loops


def _perfect(chance: Chance, height: int, width: int) -> np.ndarray:
    """A perfect maze: one way between any two cells."""
    return _stretched(chance, _spanning_tree(chance, height, width), height, width)


def _loops(chance: Chance, height: int, width: int) -> np.ndarray:
    """A perfect maze in which 5 to 50 % of the walls between neighbouring junctions are opened, at least one."""
    lattice = _spanning_tree(chance, height, width)
    row, column = np.nonzero(lattice)
    between = (row + column) % 2 == 1  # the others are pillars, which belong to four junctions
    row, column = row[between], column[between]
    count = max(1, round(chance.share(0.05, 0.5) * len(row)))
    opened = np.argsort(chance.rng.random(len(row)), kind="stable")[:count]
    lattice[row[opened], column[opened]] = False
    return _stretched(chance, lattice, height, width)


def _spanning_tree(chance: Chance, height: int, width: int) -> np.ndarray:
    """A random spanning tree of junctions ("growing tree"), as the walls of a lattice, bool [2 n - 1, 2 m - 1].

    Junctions lie at even rows and columns of the lattice, the walls between neighbours between them. The texture is
    random as well: the next corridor starts at the newest junction (long winding corridors, as a depth-first walk makes
    them) or at any junction (many short dead ends, as Prim's algorithm makes them). Each maze has its own mixture of
    the two, and its own preference for rows or columns.
    """
    n_rows, n_columns = (height - 1) // 2, (width - 1) // 2
    winding, lean = chance.share(), chance.share(0.25, 0.75)
    start = chance.below(n_rows * n_columns)
    seen, active = {start}, [start]
    tree: list[tuple[int, int]] = []
    while active:
        place = len(active) - 1 if chance.happens(winding) else chance.below(len(active))
        here = active[place]
        row, column = divmod(here, n_columns)
        along = [here + step for step, fits in ((-1, column > 0), (1, column < n_columns - 1)) if fits]
        across = [here + step for step, fits in ((-n_columns, row > 0), (n_columns, row < n_rows - 1)) if fits]
        along, across = ([there for there in side if there not in seen] for side in (along, across))
        options = along if along and (not across or chance.happens(lean)) else across
        if not options:
            active[place] = active[-1]
            active.pop()
            continue
        there = options[chance.below(len(options))]
        seen.add(there)
        active.append(there)
        tree.append((here, there))
    lattice = np.ones((2 * n_rows - 1, 2 * n_columns - 1), bool)
    lattice[::2, ::2] = False
    row, column = np.divmod(np.array(tree), n_columns)
    lattice[row.sum(1), column.sum(1)] = False
    return lattice


def _stretched(chance: Chance, lattice: np.ndarray, height: int, width: int) -> np.ndarray:
    """A lattice with a border, in its full size. An even side has a row (column) too many: one random wall is twice as
    thick."""
    lines = []
    for count, side in zip(lattice.shape, (height, width), strict=True):
        thick = [2 * chance.below(count // 2) + 1] if side % 2 == 0 else []
        lines.append(sorted([*range(count), *thick]))
    return np.pad(lattice[np.ix_(*lines)], 1, constant_values=True)


# ---------------------------------------------------------------------------------------------------------- rooms


def _rooms(chance: Chance, height: int, width: int) -> np.ndarray:
    """Rooms with doors: walls divide the free space again and again, each with a door.

    Some walls have a second door, and some end early, which makes a niche. No wall ends at a door, so none closes one.
    """
    walls = np.ones((height, width), bool)
    walls[1:-1, 1:-1] = False
    least = 2 if min(height, width) < 12 else chance.between(2, 3)
    largest = least + chance.between(1, 4)
    todo = [(1, height - 1, 1, width - 1)]
    while todo:
        bottom, top, left, right = room = todo.pop()
        sides = (top - bottom, right - left)
        if max(sides) <= largest and chance.happens(0.7) and room != (1, height - 1, 1, width - 1):
            continue
        first = sides[0] > sides[1] or (sides[0] == sides[1] and chance.happens(0.5))
        for horizontal in (first, not first):
            grid, (low, high, start, end) = (walls, room) if horizontal else (walls.T, (left, right, bottom, top))
            places = [
                line for line in range(low + least, high - least) if grid[line, start - 1] and grid[line, end]
            ]  # fmt: skip
            if places:
                line = places[chance.below(len(places))]
                grid[line, start:end] = True
                _make_doors(chance, grid[line, start:end])
                halves = ((low, line, start, end), (line + 1, high, start, end))
                todo += [half if horizontal else (*half[2:], *half[:2]) for half in halves]
                break
    return walls


def _make_doors(chance: Chance, wall: np.ndarray) -> None:
    """Free a door of one cell, two of them, or up to half of a wall [n] from one of its ends."""
    if chance.happens(0.25):
        width = chance.between(1, max(1, len(wall) // 2))
        wall[slice(0, width) if chance.happens(0.5) else slice(len(wall) - width, None)] = False
        return
    for _ in range(2 if len(wall) >= 8 and chance.happens(0.4) else 1):
        wall[chance.below(len(wall))] = False


# ----------------------------------------------------------------------------------------- open ground: two kinds


def _open_ground(chance: Chance, height: int, width: int) -> np.ndarray:
    """Scattered obstacles or caves. At least one group of walls stands free, so that there is something to walk around.

    Mazes with a side shorter than ``_SMALLEST_CAVE`` cells are never caves, for chambers have no room there.
    """
    large = min(height, width) >= _SMALLEST_CAVE
    draw = _caves if chance.happens(0.5) and large else _obstacles
    while True:
        walls = draw(chance, height, width)
        _join_regions(chance, walls)
        walls = _largest_region(walls)
        enough = (~walls).sum() >= LEAST_FREE * (height - 2) * (width - 2)
        if enough and count_islands(walls):
            return walls


# Obstacles as drawings, '#' is wall. Those with an inside are concave traps.
_CUPS = (
    ("###", "#.#"),
    ("###", "#.#", "#.#"),
    ("####", "#..#", "#..#"),
    ("#####", "#...#", "#...#"),
    ("#####", "#...#", "#...#", "#...#"),
    ("######", "#....#", "#....#", "#....#"),
    ("#######", "#.....#", "#.....#"),
)
_SOLIDS = (
    ("#",),
    ("##",),
    ("###",),
    ("####",),
    ("##", "##"),
    ("##", "#."),
    ("###", "#..", "#.."),
    (".#.", "###", ".#."),
)
_CUP_SHAPES, _SOLID_SHAPES = (
    [np.array([[mark == "#" for mark in line] for line in drawn]) for drawn in drawings]
    for drawings in (_CUPS, _SOLIDS)
)


def _obstacles(chance: Chance, height: int, width: int) -> np.ndarray:
    """Obstacles in an open space, a cell or more apart: blocks, bars, crosses, and cups, which are concave traps.

    The first one is a cup. All may touch the border.
    """
    walls = np.ones((height, width), bool)
    walls[1:-1, 1:-1] = False
    taken = np.zeros_like(walls)  # obstacles and the cells around them
    density, cups = chance.share(0.15, 0.4), chance.share(0.3, 0.9)
    most = density * (height - 2) * (width - 2)
    for _ in range(height * width // 2):
        shapes = _CUP_SHAPES if chance.happens(cups) or not taken.any() else _SOLID_SHAPES
        shape = np.rot90(shapes[chance.below(len(shapes))], chance.below(4))
        rows, columns = shape.shape
        if rows > height - 2 or columns > width - 2:
            continue
        row, column = chance.between(1, height - 1 - rows), chance.between(1, width - 1 - columns)
        if (taken[row : row + rows, column : column + columns] & shape).any():
            continue
        walls[row : row + rows, column : column + columns] |= shape
        taken[row - 1 : row + rows + 1, column - 1 : column + columns + 1] = True
        if walls[1:-1, 1:-1].sum() >= most:
            break
    return walls


def _caves(chance: Chance, height: int, width: int) -> np.ndarray:
    """Caves: a cellular automaton smooths noise. The chambers may lie apart."""
    walls = np.ones((height, width), bool)
    cave = chance.grid(height - 2, width - 2, chance.share(0.46, 0.56))
    for _ in range(chance.between(1, 2)):  # a cell becomes wall if most of the nine cells around it are
        around = np.pad(cave, 1, mode="edge").astype(np.int8)
        rows = around[:-2] + around[1:-1] + around[2:]
        cave = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:] >= 5
    walls[1:-1, 1:-1] = cave
    return walls


def _join_regions(chance: Chance, walls: np.ndarray) -> None:
    """Dig a crooked tunnel from each free region of three or more cells to the next one, in ``walls``."""
    labels, count = label_regions(~walls)
    regions = [cells for cells in (np.argwhere(labels == i + 1) for i in range(count)) if len(cells) >= 3]
    for here, there in pairwise(regions):
        row, column = map(int, here[chance.below(len(here))])
        goal_row, goal_column = map(int, there[chance.below(len(there))])
        while (row, column) != (goal_row, goal_column):
            rows, columns = abs(goal_row - row), abs(goal_column - column)
            if chance.happens(rows / (rows + columns)):
                row += 1 if goal_row > row else -1
            else:
                column += 1 if goal_column > column else -1
            walls[row, column] = False


def _largest_region(walls: np.ndarray) -> np.ndarray:
    """The walls with all free regions filled but the largest."""
    labels, count = label_regions(~walls)
    return labels != 1 + int(np.argmax(np.bincount(labels.ravel(), minlength=count + 2)[1:]))


# Add new generators at the end: the place of a generator is part of its mazes' seeds.
GENERATORS: dict[str, Callable[[Chance, int, int], np.ndarray]] = {
    "perfect": _perfect,
    "loops": _loops,
    "rooms": _rooms,
    "open": _open_ground,
}
