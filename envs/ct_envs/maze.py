"""Mazes as data: a pytree of arrays that a compiled program takes as an argument, never as a constant.

Coordinates are SI and right-handed: x right, y up, the lower-left corner of the lower-left cell at (0, 0). Cell
``(row, column)`` covers ``[column, column + 1) x [row, row + 1)`` times ``cell_m``; row 0 is the *lowest* row, so a
text file is read from its last line up. Arrays are padded with wall to a multiple of ``PAD`` cells, so that mazes of
similar size share one compiled program. Everything outside the array is wall.
"""

import functools
import json
import logging
import os
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from ct_envs.errors import UserError

PAD = 12  # arrays are padded to a multiple of this many cells
CELL_M = 4.0  # side of a cell [m], as in D4RL's ant mazes
MAX_SIDE = 1024  # most cells along a side of a maze file
EXACT_REACH = 16  # cells to each side that are looked at one by one; farther ways through small cells are sampled
WALL, FREE = "#", "."
_LOG = logging.getLogger(__name__)


class Marks(NamedTuple):
    """What stands for walls and free cells where a maze is written down."""

    wall: str
    free: str  # each of these characters

    def __str__(self) -> str:
        return f"'{self.wall}' (wall) or {', '.join(map(repr, self.free))} (free)"


DRAWN = Marks(WALL, FREE)
LISTED = Marks("1", "0rgc")  # Gymnasium-Robotics' maps also mark where resets ("r"), goals ("g") or both ("c") may be


@struct.dataclass
class Boxes:
    """What a maze with cells smaller than a robot's reach needs besides: see ``ct_envs.fine.fit_maze``.

    Its walls are merged into R boxes. The floor is divided into h x w tiles; for each, ``near`` lists the boxes that a
    robot in it could touch in a control step. Box R, the last, is none.
    """

    sides: Float[Array, "*b R+1 4"]  # left, bottom, right, top of each box [m]
    near: Int[Array, "*b h w B"]
    tile_m: Float[Array, "*b"]  # side of a tile [m]
    window_m: Float[Array, "*b"]  # boxes are cut off so far from the robot along each axis [m]
    room_m: Float[Array, "*b H W"]  # distance from the centre of a cell to the nearest wall [m], 0 in walls
    counts: Int[Array, "*b H+1 W+1"]  # number of wall cells below and left of each corner


@struct.dataclass
class Maze:
    """A maze, or a batch of them with leading axes.

    Free cells are listed region by region (4-connected), so that a goal that can be reached from a start is one
    random integer away: the region of ``free_cells[i]`` is ``free_cells[region_lo[i]:region_hi[i]]``. With ``boxes``,
    only those cells are listed at whose centre the robot has room enough that queries find its ways.
    """

    walls: Bool[Array, "*b H W"]
    free_cells: Int[Array, "*b HW"]  # flat indices row * W + column, the first n_free are meant
    region_lo: Int[Array, "*b HW"]
    region_hi: Int[Array, "*b HW"]
    n_free: Int[Array, "*b"]
    cell_m: Float[Array, "*b"]
    boxes: Boxes | None = None  # where cells are small

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), padding included."""
        return self.walls.shape[-2], self.walls.shape[-1]


def make_maze(
    walls: np.ndarray | Sequence[Sequence[int | str]],
    *,
    cell_m: float = CELL_M,
    shape: tuple[int, int] | None = None,
) -> Maze:
    """Build a ``Maze`` from a wall grid.

    Args:
        walls: an array [H, W] is a grid in the maze's coordinates, row 0 lowest: bool, or integers 0 (free) and 1
            (wall). A nested list is a drawing as Gymnasium-Robotics has it, first row on top: 1 is a wall; 0, "r",
            "g" and "c" are free.
        cell_m: side of a cell [m].
        shape: padded (H, W); by default the next multiples of ``PAD``.

    Raises:
        UserError: entries that mean nothing, ragged rows, no free cell, free cells on the border, ``shape`` is too
            small, or ``cell_m`` is no length.
    """
    walls = _listed(walls, "maze") if isinstance(walls, list | tuple) else _grid(np.asarray(walls))
    if not (np.isfinite(cell_m) and cell_m > 0):
        raise UserError(f"maze with cells of {cell_m} m; give a length above 0")
    height, width = shape or tuple(-(-n // PAD) * PAD for n in walls.shape)
    if height < walls.shape[0] or width < walls.shape[1]:
        raise UserError(f"maze of {walls.shape} cells does not fit into shape {(height, width)}")
    padded = np.ones((height, width), bool)
    padded[: walls.shape[0], : walls.shape[1]] = walls

    return Maze(walls=jnp.asarray(padded), **list_cells(~padded), cell_m=jnp.asarray(cell_m, jnp.float32))


def list_cells(free: Bool[np.ndarray, "H W"]) -> dict[str, jax.Array]:
    """The fields of a ``Maze`` that list its free cells, region by region."""
    labels, _ = label_regions(free)
    flat = np.flatnonzero(free)
    flat = flat[np.argsort(labels.ravel()[flat], kind="stable")]
    label = labels.ravel()[flat]

    def pad(values: np.ndarray) -> jax.Array:
        return jnp.asarray(np.pad(values, (0, free.size - len(flat))), jnp.int32)

    return {
        "free_cells": pad(flat),
        "region_lo": pad(np.searchsorted(label, label, "left")),
        "region_hi": pad(np.searchsorted(label, label, "right")),
        "n_free": jnp.asarray(len(flat), jnp.int32),
    }


def label_regions(free: np.ndarray) -> tuple[np.ndarray, int]:
    """Label the 4-connected regions of free cells from 1; 0 is wall. And how many there are."""
    return ndimage.label(free)  # pyright: ignore


def stack_mazes(mazes: list[Maze]) -> Maze:
    """Stack mazes along a new leading axis, padding all to the largest shape. Raises UserError for small cells."""
    if any(maze.boxes is not None for maze in mazes):
        raise UserError("mazes with cells smaller than a robot's reach cannot be stacked; use larger cells")
    shape = (max(m.shape[0] for m in mazes), max(m.shape[1] for m in mazes))
    grown = [make_maze(np.asarray(m.walls), cell_m=float(m.cell_m), shape=shape) for m in mazes]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *grown)


# ---------------------------------------------------------------------------------------------- reading and making


def maze_names() -> list[str]:
    """Names of the layouts that ship with the package."""
    return sorted(p.name[:-4] for p in (resources.files("ct_envs") / "mazes").iterdir() if p.name.endswith(".txt"))


def load_maze(name_or_file: str | Path, *, cell_m: float = CELL_M) -> Maze:
    """Load a named layout, or any map that ``ct_envs.maps.read_map`` reads, as a maze with cells of ``cell_m`` [m].

    A named layout, and a file that does not say how large its cells are, is taken to have cells of that size. A map
    that says so is brought to cells of ``cell_m``: a cell is free only if all of it is free.

    Raises:
        UserError: unknown name, missing file, or a file that is not a maze (names the file, the line, the hint).
    """
    return make_maze(load_walls(name_or_file, cell_m=cell_m), cell_m=cell_m)


def load_walls(name_or_file: str | Path, *, cell_m: float = CELL_M) -> np.ndarray:
    """The wall grid of a named layout or map file, bool [H, W], row 0 lowest, no padding. As ``load_maze``."""
    name = str(name_or_file)
    if name in maze_names():
        text = (resources.files("ct_envs") / "mazes" / f"{name}.txt").read_text("utf-8")
        return parse_walls(text, source=name)
    if not os.path.isfile(name):  # unlike Path.is_file, it takes names that no file can have
        raise UserError(f"no maze or file named '{name}'; named mazes: {', '.join(maze_names())}")
    from ct_envs import maps  # which imports this module

    found = maps.read_map(name)
    for note in found.notes:
        _LOG.warning(note)
    walls = close_walls(found.with_cells(cell_m).walls)
    if walls.all():
        raise UserError(f"{name}: {maps.why_no_cell(found, cell_m)}")
    if max(walls.shape) > MAX_SIDE:
        height, width = walls.shape
        raise UserError(f"{name}: {height} x {width} cells of {cell_m:g} m; at most {MAX_SIDE} x {MAX_SIDE}")
    return walls


def close_walls(walls: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "h w"]:
    """The grid with walls all around: with one more ring of cells, if one at the border is free."""
    inner = np.ones_like(walls)
    inner[1:-1, 1:-1] = walls[1:-1, 1:-1]
    return walls if (walls == inner).all() else np.pad(walls, 1, constant_values=True)


def parse_walls(text: str, *, source: str = "maze", most: int = MAX_SIDE) -> np.ndarray:
    """Parse maze text to bool [H, W], row 0 lowest.

    A line is a row of cells, the first one on top: all of them of ``#`` (wall) and ``.`` (free), or all of ``1``
    (wall) and ``0``, ``r``, ``g`` and ``c`` (free). Line ends may be CRLF. A byte order mark, spaces at the end of a
    line, and blank lines above and below the maze are ignored. So is a comment: ``#``, a space, and text with a letter
    and without another ``#``. No row is taken for one, even if it was drawn with spaces: a row has two walls.
    Text that begins with ``[`` is JSON: a nested list, as ``make_maze`` reads it.

    Args:
        source: what errors call the text.
        most: cells along a side.

    Raises:
        UserError: empty, ragged, unknown character, no JSON, all wall, or free cells on the border.
    """
    text = text.removeprefix("\ufeff")
    if text.lstrip().startswith("["):
        return _listed(_json(text, source), source)
    rows = _rows(text)
    if not rows:
        raise UserError(f"{source}: empty; a maze is lines of '#' (wall) and '.' (free)")
    (first, top), widest = rows[0], max(len(row) for _, row in rows)
    if max(widest, len(rows)) > most:  # before a look at each of its cells
        raise UserError(f"{source}: {len(rows)} x {widest} cells; at most {most} x {most}")
    marks = LISTED if top[:1] and top[0] in (LISTED.wall, *LISTED.free) else DRAWN
    known = {marks.wall, *marks.free}
    for number, row in rows:
        if strange := set(row) - known:
            column = min(map(row.index, strange))
            raise UserError(f"{source}:{number}: column {column + 1} is {row[column]!r}; use {marks}")
        if len(row) != len(top):
            hint = f"line {first} has {len(top)}; make all lines equal"
            raise UserError(f"{source}:{number}: {len(row)} cells, but {hint}")
    drawn = "".join(row for _, row in rows).encode("ascii")
    walls = np.frombuffer(drawn, np.uint8).reshape(len(rows), len(top)) == ord(marks.wall)
    _check_closed(walls, marks, source, lambda row, column: f"{source}:{rows[row][0]}: column {column + 1}")
    return walls[::-1]


def _rows(text: str) -> list[tuple[int, str]]:
    """The rows of maze text, each with the number of its line: no comments, no blank lines above and below."""
    lines = [(number, line.rstrip(" \t")) for number, line in enumerate(text.replace("\r\n", "\n").split("\n"), 1)]
    lines = [(number, line) for number, line in lines if not _is_comment(line)]
    drawn = [i for i, (_, line) in enumerate(lines) if line]
    return lines[drawn[0] : drawn[-1] + 1] if drawn else []


def _is_comment(line: str) -> bool:
    """Whether a line is a comment, as ``parse_walls`` says."""
    return line.startswith(f"{WALL} ") and line.count(WALL) == 1 and any(map(str.isalpha, line))


def _json(text: str, source: str) -> Any:
    """What JSON text holds. Raises UserError."""
    hint = 'write a nested list such as [[1, 1, 1], [1, "r", 1], [1, 1, 1]]'
    try:
        return json.loads(text)
    except json.JSONDecodeError as bad:
        raise UserError(f"{source}:{bad.lineno}: not JSON ({bad.msg}); {hint}") from None
    except (ValueError, RecursionError):  # a number of thousands of digits, thousands of brackets
        raise UserError(f"{source}: not the JSON of a maze; {hint}") from None


def _listed(rows: list | tuple, source: str) -> np.ndarray:
    """The grid bool [H, W], row 0 lowest, of a nested list whose first row is on top. Raises UserError."""
    for number, row in enumerate(rows, 1):
        if not isinstance(row, list | tuple):
            raise UserError(f"{source}: row {number} is {_brief(row)}; give a list of rows, each a list of cells")
        if max(len(row), len(rows)) > MAX_SIDE:
            raise UserError(f"{source}: {len(rows)} x {len(row)} cells; at most {MAX_SIDE} x {MAX_SIDE}")
        for column, cell in enumerate(row, 1):
            if not _is_listed(cell):
                raise UserError(f"{source}: row {number}, column {column} is {_brief(cell)}; use {LISTED}")
        if len(row) != len(rows[0]):
            hint = f"row 1 has {len(rows[0])}; make all rows equal"
            raise UserError(f"{source}: row {number} has {len(row)} cells, but {hint}")
    walls = np.array([[cell == 1 for cell in row] for row in rows], bool)
    _check_closed(walls, LISTED, source, lambda row, column: f"{source}: row {row + 1}, column {column + 1}")
    return walls[::-1]


def _is_listed(cell: Any) -> bool:
    """Whether an entry of a nested list is a cell: 0, 1, "r", "g" or "c". Bools are not: which of their two readings
    is meant, the list's or the array's, nobody can tell."""
    if isinstance(cell, str):
        return cell in ("r", "g", "c")
    return isinstance(cell, int | np.integer) and not isinstance(cell, bool) and cell in (0, 1)


def _grid(walls: np.ndarray) -> np.ndarray:
    """An array of bools, or of integers 0 and 1, as bool [H, W], row 0 lowest. Raises UserError for any other."""
    if walls.ndim != 2:
        raise UserError(f"maze of shape {walls.shape}; give a grid [H, W] of walls, row 0 lowest")
    if walls.dtype.kind not in "biu":
        raise UserError(f"maze of {walls.dtype} entries; give bools, or integers 0 (free) and 1 (wall)")
    strange = walls[(walls != 0) & (walls != 1)]
    if len(strange):
        raise UserError(f"maze with an entry {strange[0]}; give bools, or integers 0 (free) and 1 (wall)")
    grid = walls.astype(bool)
    _check_closed(grid, LISTED, "maze", lambda row, column: f"maze: row {row}, column {column} of the array")
    return grid


def _brief(value: Any) -> str:
    """Anything in a few characters of one line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else f"{text[:37]}..."


def _check_closed(walls: np.ndarray, marks: Marks, source: str, place: Callable[[int, int], str]) -> None:
    """Raise UserError unless a grid has a free cell and walls all around.

    Args:
        place: says where the cell in that row and column is.
    """
    if walls.all():
        raise UserError(f"{source}: no free cell; draw free cells as '{marks.free[0]}'")
    border = walls.copy()
    border[1:-1, 1:-1] = True
    if not border.all():
        row, column = (int(i) for i in np.argwhere(~border)[0])
        raise UserError(f"{place(row, column)} is free at the border; close the maze with '{marks.wall}'")


def random_walls(
    seed: int, *, height: int = 9, width: int = 12, density: float = 1.0, loops: float = 0.3
) -> np.ndarray:
    """A random maze with one connected free region, bool [height, width], row 0 lowest.

    Corridors are carved by a depth-first walk on every second cell; then ``loops`` of the walls that separate two
    corridors are opened, and finally walls are removed at random until only ``density`` of the inner ones remain.

    Args:
        seed: any non-negative integer; the same seed gives the same maze on every machine.
        height, width: cells, border included, at least 5.
        density: 1 keeps all inner walls, 0 gives an empty room.
        loops: fraction of separating walls that are opened; 0 gives a tree (no loops).

    Raises:
        UserError: a size or fraction out of range.
    """
    if min(height, width) < 5 or max(height, width) > MAX_SIDE:
        raise UserError(f"random maze of {height} x {width} cells; use 5 to {MAX_SIDE} a side")
    if not (0 <= density <= 1 and 0 <= loops <= 1):
        raise UserError(f"random maze with density {density} and loops {loops}; both are fractions from 0 to 1")
    rng = np.random.default_rng(seed)
    walls = np.ones((height, width), bool)
    stack = [(1, 1)]
    walls[1, 1] = False
    while stack:
        row, column = stack[-1]
        steps = [(0, 2), (0, -2), (2, 0), (-2, 0)]
        options = [
            (dr, dc)
            for dr, dc in steps
            if 0 < row + dr < height - 1 and 0 < column + dc < width - 1 and walls[row + dr, column + dc]
        ]
        if not options:
            stack.pop()
            continue
        dr, dc = options[rng.integers(len(options))]
        walls[row + dr // 2, column + dc // 2] = walls[row + dr, column + dc] = False
        stack.append((row + dr, column + dc))
    inner = np.zeros_like(walls)
    inner[1:-1, 1:-1] = True
    sides = ~walls[:-2, 1:-1] & ~walls[2:, 1:-1] | ~walls[1:-1, :-2] & ~walls[1:-1, 2:]
    separating = walls & inner
    separating[1:-1, 1:-1] &= sides
    walls[separating & (rng.random(walls.shape) < loops)] = False
    walls[walls & inner & (rng.random(walls.shape) > density)] = False
    labels, count = label_regions(~walls)
    if count > 1:  # thinning may open cells that touch nothing: fill all but the largest region
        sizes = ndimage.sum_labels(~walls, labels, range(1, count + 1))
        walls = labels != 1 + int(np.argmax(sizes))
    return walls


def draw_walls(walls: np.ndarray) -> str:
    """The text of a wall grid (row 0 lowest), as ``parse_walls`` reads it."""
    return "\n".join("".join(WALL if cell else FREE for cell in row) for row in np.asarray(walls)[::-1])


def unpadded(maze: Maze) -> np.ndarray:
    """The wall grid without padding (one ring of wall is kept), bool [H, W]."""
    walls = np.asarray(maze.walls)
    rows, columns = np.nonzero(~walls)
    return walls[: rows.max() + 2, : columns.max() + 2]


# --------------------------------------------------------------------------------------------------------- queries


def cell_of(maze: Maze, point: Float[Array, "2"]) -> Int[Array, "2"]:
    """(row, column) of the cell that holds a point [m]."""
    return jnp.floor(point[::-1] / maze.cell_m).astype(jnp.int32)


def cell_centre(maze: Maze, flat_index: Int[Array, ""]) -> Float[Array, "2"]:
    """Centre [m] of a cell given by its flat index."""
    width = maze.shape[1]
    return (jnp.stack([flat_index % width, flat_index // width]) + 0.5) * maze.cell_m


def is_wall(maze: Maze, cell: Int[Array, "... 2"]) -> Bool[Array, "..."]:
    """Whether cells (row, column) are wall; everything outside the array is."""
    height, width = maze.shape
    row, column = cell[..., 0], cell[..., 1]
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return ~inside | maze.walls[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]


def _neighbourhood(reach: int) -> Int[Array, "n 2"]:
    """Offsets (row, column) of the (2 reach + 1)^2 cells around a cell."""
    side = jnp.arange(-reach, reach + 1, dtype=jnp.int32)
    return jnp.stack(jnp.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)


def clearance(maze: Maze, point: Float[Array, "2"]) -> Float[Array, ""]:
    """Distance [m] from a point to the nearest wall, exact up to one cell, then one cell; 0 inside a wall.

    With ``boxes`` it goes on from one cell: there it is at most 1.5 cells too small, however far the wall is.
    """
    cells = cell_of(maze, point)[None] + _neighbourhood(1)
    low = cells[:, ::-1] * maze.cell_m
    outside = jnp.maximum(jnp.maximum(low - point[None], point[None] - low - maze.cell_m), 0.0)
    distance = jnp.sqrt(jnp.sum(outside**2, -1))
    near = jnp.min(jnp.where(is_wall(maze, cells), distance, maze.cell_m))
    return near if maze.boxes is None else jnp.maximum(near, _room(maze, point))


def _room(maze: Maze, point: Float[Array, "2"]) -> Float[Array, ""]:
    """Distance [m] from a point to the nearest wall of a maze with ``boxes``, or up to 1.5 cells less."""
    assert maze.boxes is not None
    row, column = (cell := cell_of(maze, point))
    height, width = maze.shape
    room = maze.boxes.room_m[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
    beside = jnp.linalg.norm((cell[::-1] + 0.5) * maze.cell_m - point)
    return jnp.where(is_wall(maze, cell), 0.0, jnp.maximum(room - beside, 0.0))


def segment_free(
    maze: Maze, a: Float[Array, "2"], b: Float[Array, "2"], *, radius: float | Float[Array, ""], reach: int = 2
) -> Bool[Array, ""]:
    """Whether a disc of ``radius`` [m] swept from ``a`` to ``b`` touches no wall (exact, not sampled).

    With ``boxes`` and a ``reach`` above ``EXACT_REACH`` it is free for certain where this says so; and a way that is
    two cells wider at each side is always found free.

    Args:
        reach: cells looked at on each side of the segment's midpoint: ``segment_reach(max_length, ...)``.
    """
    if (
        maze.boxes is not None and reach > EXACT_REACH
    ):  # points half a cell apart or less: between two, clearance changes by a quarter at most
        points = a + jnp.linspace(0.0, 1.0, 4 * reach + 1)[:, None] * (b - a)
        room = jax.vmap(_room, (None, 0))(maze, points)
        return jnp.min(room) - jnp.linalg.norm(b - a) / (8 * reach) >= jnp.maximum(radius, 1e-6)
    # Each coordinate by itself: on CPU, XLA then needs a sixth of the time.
    middle, offset = cell_of(maze, (a + b) / 2), _neighbourhood(reach)
    row, column = (middle[i] + offset[:, i] for i in (0, 1))
    distance = _segment_to_box(a, b, column * maze.cell_m, row * maze.cell_m, maze.cell_m)
    nearest = jnp.min(jnp.where(is_wall(maze, jnp.stack([row, column], -1)), distance, jnp.inf))
    return (nearest >= radius) & (nearest > 0)


def in_sight(
    maze: Maze, a: Float[Array, "2"], b: Float[Array, "2"], *, radius: float, reach: int = 2
) -> Bool[Array, ""]:
    """``segment_free`` for a disc of ``radius`` [m], or as large as both ends have room for.

    So a robot that grazes a wall still sees the points it can walk to.
    """
    room = 0.98 * jnp.minimum(clearance(maze, a), clearance(maze, b))
    return segment_free(maze, a, b, radius=jnp.minimum(radius, room), reach=reach)


def segment_reach(max_length: float, radius: float, cell_m: float = CELL_M) -> int:
    """``reach`` that makes ``segment_free`` exact for segments up to ``max_length`` [m]."""
    return int(np.ceil((max_length / 2 + radius) / cell_m))


def _segment_to_box(
    a: Float[Array, "2"], b: Float[Array, "2"], left: Float[Array, "n"], bottom: Float[Array, "n"], side: jax.Array
) -> Float[Array, "n"]:
    """Distance [m] between the segment a-b and square boxes: 0, or to an end or a corner."""
    (x, y), (dx, dy) = a, b - a
    x_low, y_low = left - x, bottom - y  # from here on as seen from a
    x_high, y_high = x_low + side, y_low + side
    squared = jnp.maximum(dx * dx + dy * dy, 1e-12)

    def to_box(x: jax.Array, y: jax.Array) -> jax.Array:
        across = jnp.maximum(jnp.maximum(x_low - x, x - x_high), 0.0)
        up = jnp.maximum(jnp.maximum(y_low - y, y - y_high), 0.0)
        return across * across + up * up

    def to_segment(x: jax.Array, y: jax.Array) -> jax.Array:
        t = jnp.clip((x * dx + y * dy) / squared, 0.0, 1.0)
        return (x - t * dx) ** 2 + (y - t * dy) ** 2

    ends = [to_box(jnp.zeros_like(dx), jnp.zeros_like(dy)), to_box(dx, dy)]
    corners = [to_segment(x, y) for x in (x_low, x_high) for y in (y_low, y_high)]
    nearest = jnp.sqrt(functools.reduce(jnp.minimum, ends + corners))

    def inside(low: jax.Array, high: jax.Array, d: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The parameters of the segment at which it enters and leaves a slab."""
        safe = jnp.where(jnp.abs(d) < 1e-9, 1e-9, d)
        return jnp.minimum(low / safe, high / safe), jnp.maximum(low / safe, high / safe)

    (x_enter, x_leave), (y_enter, y_leave) = inside(x_low, x_high, dx), inside(y_low, y_high, dy)
    enter = jnp.maximum(jnp.maximum(x_enter, y_enter), 0.0)
    leave = jnp.minimum(jnp.minimum(x_leave, y_leave), 1.0)
    return jnp.where(enter <= leave, 0.0, nearest)


def sample_free(
    key: jax.Array, maze: Maze, *, radius: float, index: Int[Array, ""] | None = None
) -> tuple[Float[Array, "2"], Int[Array, ""]]:
    """A random point with clearance ``radius`` [m], and the index of its cell in ``maze.free_cells``.

    The cell is uniform over the free ones, or over the region of ``free_cells[index]`` if that is given; the point is
    uniform over the cell less the robot's radius at each side, which keeps it clear whatever the neighbours are. With
    ``boxes`` it is uniform over a square around the cell's centre, as large as the walls leave.
    """
    return _place(jax.random.uniform(key, (3,), jnp.float32), maze, radius, index)


def sample_pair(key: jax.Array, maze: Maze, *, radius: float) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """A random start and a random goal of the same region, both with clearance ``radius`` [m]."""
    chance = jax.random.uniform(key, (6,), jnp.float32)  # one draw: this runs in every step of every environment
    start, index = _place(chance[:3], maze, radius)
    return start, _place(chance[3:], maze, radius, index)[0]


def _place(
    chance: Float[Array, "3"], maze: Maze, radius: float, index: Int[Array, ""] | None = None
) -> tuple[Float[Array, "2"], Int[Array, ""]]:
    """``sample_free`` from three numbers in [0, 1)."""
    low, high = (0, maze.n_free) if index is None else (maze.region_lo[index], maze.region_hi[index])
    chosen = jnp.minimum(low + (chance[0] * (high - low)).astype(jnp.int32), high - 1)
    if maze.boxes is None:
        slack = maze.cell_m / 2 - radius - 1e-3
    else:  # the corners of the square, too, are clear of walls
        room = maze.boxes.room_m.ravel()[maze.free_cells[chosen]]
        slack = jnp.clip((room - radius) / np.sqrt(2.0) - 1e-3, 0.0, maze.cell_m / 2)
    return cell_centre(maze, maze.free_cells[chosen]) + (2.0 * chance[1:] - 1.0) * slack, chosen
