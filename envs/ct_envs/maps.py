"""Maps made by others: one reader for all of them, which gives an occupancy grid with a cell size and an origin.

Read are ROS map_server maps (YAML with PGM, PNG or BMP), pictures of floor plans (PNG, JPEG, PGM, BMP), MovingAI maps,
nested lists (JSON) of Gymnasium-Robotics, D4RL and OGBench, and our own text. The content of a file decides, then its
ending. Row 0 of a grid is the lowest, x points right and y up, as everywhere in this package. Unknown space is wall,
and so is everything outside a map.
"""

import functools
import io
import math
import os
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int8, Shaped
from PIL import Image
from scipy import ndimage

from ct_envs.checked import shown
from ct_envs.errors import UserError
from ct_envs.maze import MAX_SIDE, close_walls, draw_walls, label_regions, parse_walls

UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # values of an occupancy grid, as in ROS' OccupancyGrid
_WALL_FROM = 50  # a cell at least so likely occupied [%] is wall
MAX_MAP_SIDE = 8192  # most cells along a side of a map
LEAST_CELL_M, MOST_CELL_M = 0.001, 100.0
MODES = ("trinary", "scale", "raw")
_HEAD = 4096  # number of bytes that determine the kind of a file
_MOST_MAZE_BYTES = 8 * MAX_SIDE * (MAX_SIDE + 2)  # as JSON with each cell on a line of its own
_MOST_YAML_BYTES = 1 << 16
_SAVED_UNKNOWN = 205  # the grey that map savers write for unknown space
_SAVED_FREE, _SAVED_OCCUPIED = 254, 0
_FAR = 1e7  # no origin is so far away [m]
_FORMATS = ("PNG", "JPEG", "PPM", "BMP")
_MAGIC = re.compile(rb"\x89PNG\r\n\x1a\n|\xff\xd8\xff|P[1-6]\s|BM")
_PICTURES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".pbm", ".bmp")
_HEADER = re.compile(r"(cell_m|origin)\s*:(.*)")
_MOVING_AI = {".": FREE, "G": FREE, "S": FREE, "@": OCCUPIED, "O": OCCUPIED, "T": OCCUPIED, "W": OCCUPIED}


@dataclass(frozen=True, eq=False)
class Map:
    """An occupancy grid on the floor of a world."""

    occupancy: Int8[np.ndarray, "H W"]  # UNKNOWN, or from FREE to OCCUPIED [%]; row 0 lowest
    cell_m: float | None  # side of a cell [m]; None: the file does not say
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # lower left corner x, y [m] and yaw [rad] in the world
    source: str = "map"  # the file, for errors
    kind: str = "map"
    notes: tuple[str, ...] = ()  # what a reader of the map should know; each is one line

    @functools.cached_property
    def walls(self) -> Bool[np.ndarray, "H W"]:
        """Cells that are unknown, or occupied with a likelihood of a half or more."""
        return (self.occupancy < 0) | (self.occupancy >= _WALL_FROM)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.occupancy.shape

    def to_world(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Points of the grid [m], from its lower left corner, as points of the world [m]."""
        x, y, yaw = self.origin
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        return np.asarray(points, np.float64) @ turn.T + (x, y)

    def with_cells(self, cell_m: float) -> "Map":
        """The map in cells of another size [m]. A cell is free only if all of it is free: no wall is lost.

        Raises:
            UserError: a size that is none, or a map with too many such cells.
        """
        cell_m = checked_cell_m(cell_m, self.source)
        if self.cell_m is None or math.isclose(self.cell_m, cell_m, rel_tol=1e-6):
            return replace(self, cell_m=cell_m)
        ratio = cell_m / self.cell_m
        if max(self.shape) / ratio > MAX_MAP_SIDE:
            raise UserError(f"{self.source}: too many cells of {cell_m:g} m; at most {MAX_MAP_SIDE} a side")
        blocked = _any_of(_any_of(self.walls, ratio, 0), ratio, 1)
        return replace(self, occupancy=np.where(blocked, OCCUPIED, FREE).astype(np.int8), cell_m=cell_m)

    def closed(self) -> "Map":
        """The map with walls all around: with one more ring of cells, if one at the border is free."""
        if close_walls(self.walls).shape == self.shape:
            return self
        back = -(self.cell_m or 0.0)
        x, y = (float(each) for each in self.to_world(np.array([back, back])))
        ring = np.pad(self.occupancy, 1, constant_values=UNKNOWN)
        return replace(self, occupancy=ring, origin=(x, y, self.origin[2]))

    def scaled(self, scale: float) -> "Map":
        """The map with all lengths ``scale`` times as long. Raises UserError."""
        if not (math.isfinite(scale) and scale > 0):
            raise UserError(f"{self.source}: scale {scale:g}; give a number above 0")
        if self.cell_m is None:
            raise UserError(f"{self.source}: does not say how large its cells are; give --resolution METRES")
        x, y, yaw = self.origin
        cell_m = checked_cell_m(self.cell_m * scale, self.source)
        return replace(self, cell_m=cell_m, origin=(x * scale, y * scale, yaw))

    def room(self) -> Float[np.ndarray, "H W"]:
        """Radius [m] of the largest disc around the centre of each cell that touches no wall cell's centre; 0 in walls.

        A disc of this radius less 0.71 cells is free for certain.
        """
        inside = np.pad(~self.walls, 1)
        distance: Any = ndimage.distance_transform_edt(inside)
        return distance[1:-1, 1:-1] * (self.cell_m or 1.0)

    def check_room(self, radius_m: float) -> None:
        """Raise UserError unless a robot of that radius [m] has a place in the map."""
        widest = float(self.room().max())
        if not (math.isfinite(radius_m) and radius_m > 0):
            raise UserError(f"a robot of radius {radius_m:g} m; give a length above 0")
        if widest < radius_m:
            mend = f"its widest place has radius {widest:.2f} m: check the resolution, or enlarge it with --scale"
            raise UserError(f"{self.source}: no free space for a robot of radius {radius_m:g} m; {mend}")


def checked_cell_m(cell_m: Any, source: str, name: str = "cells") -> float:
    """A cell size [m] that can be one. Raises UserError."""
    number = _number(cell_m)
    if number is None or not LEAST_CELL_M <= number <= MOST_CELL_M:
        mend = f"give metres from {LEAST_CELL_M:g} to {MOST_CELL_M:g}"
        raise UserError(f"{source}: {name} of {shown(cell_m, quoted=False)} m; {mend}")
    return number


def _any_of(walls: Bool[np.ndarray, "H W"], ratio: float, axis: int) -> Bool[np.ndarray, "h w"]:
    """Walls in cells ``ratio`` times as long along an axis; a cell that reaches beyond the end is wall."""
    length = walls.shape[axis]
    n = max(1, math.ceil(length / ratio - 1e-6))
    low = np.floor(np.arange(n) * ratio + 1e-6).astype(int)
    high = np.ceil(np.arange(1, n + 1) * ratio - 1e-6).astype(int)
    counts = np.cumsum(walls, axis, dtype=np.int32)
    counts = np.concatenate([np.zeros_like(counts.take([0], axis)), counts], axis)
    found = counts.take(np.minimum(high, length), axis) > counts.take(low, axis)
    return found | np.expand_dims(high > length, 1 - axis)


# --------------------------------------------------------------------------------------------------------- reading


def read_map(file: str | Path, *, cell_m: float | None = None) -> Map:
    """Read anyone's map.

    Args:
        cell_m: side of a cell or pixel [m], for a file that does not say.

    Raises:
        UserError: not a map, which names the file, the place and the mend; or ``cell_m`` where the file says another.
    """
    path = Path(file)
    if not os.path.isfile(path):
        raise UserError(f"{path}: no such file; give a map")
    with path.open("rb") as opened:
        head = opened.read(_HEAD)
    found = _reader(path, head)(path, head)
    if cell_m is None:
        if found.cell_m is None and found.kind == _FLOOR_PLAN:
            raise UserError(f"{path}: a picture without a scale; {_scale_of(path)}")
        return found
    cell_m = checked_cell_m(cell_m, str(path))
    if found.cell_m is not None and not math.isclose(found.cell_m, cell_m, rel_tol=1e-6):
        raise UserError(f"{path}: says that its cells are {found.cell_m:g} m, not {cell_m:g} m; leave out one of them")
    return replace(found, cell_m=cell_m)


_FLOOR_PLAN = "floor plan"


def _reader(path: Path, head: bytes) -> Any:
    """The function that reads such a file."""
    ending = path.suffix.lower()
    if _MAGIC.match(head) or ending in _PICTURES:
        return _read_picture
    if ending in (".yaml", ".yml") or re.search(rb"^image[ \t]*:", head, re.MULTILINE):
        return _read_map_server
    if head.startswith(b"type ") or ending == ".map":
        return _read_moving_ai
    return _read_text


def _scale_of(picture: Path) -> str:
    """Where the scale of a picture may be found."""
    for ending in (".yaml", ".yml"):
        beside = picture.with_suffix(ending)
        if beside.is_file():
            return f"give {beside}, which has one"
    return f"give its resolution: ct-jax maps convert {picture} OUT.txt --resolution 0.05"


def _text_of(path: Path, most: int, mend: str) -> str:
    """The text of a file of at most so many bytes. Raises UserError."""
    if path.stat().st_size > most:
        raise UserError(f"{path}: too large; {mend}")
    try:
        return path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as bad:
        line = bad.object[: bad.start].count(b"\n") + 1
        raise UserError(f"{path}:{line}: not UTF-8 text; save the maze as plain text of '#' and '.'") from None


def _read_text(path: Path, head: bytes) -> Map:
    """Our text, with lines ``cell_m: 0.5`` and ``origin: x y yaw`` on top if there are any; or nested lists."""
    has_scale = re.search(rb"^cell_m[ \t]*:", head, re.MULTILINE) is not None
    side = MAX_MAP_SIDE if has_scale else MAX_SIDE
    most = 2 * side * (side + 2) if has_scale else _MOST_MAZE_BYTES
    text = _text_of(path, most, f"at most {side} x {side} cells").removeprefix("\ufeff")
    lines, header = text.split("\n"), {}
    for number, line in enumerate(lines):
        if found := _HEADER.fullmatch(line.strip()):
            header[found[1]] = f"{path}:{number + 1}", found[2].split()
            lines[number] = ""  # so that the numbers of the lines after it stay
        elif line.strip() and not line.startswith("# "):
            break
    walls = parse_walls("\n".join(lines) if header else text, source=str(path), most=side)
    cell_m, origin = None, (0.0, 0.0, 0.0)
    if "cell_m" in header:
        where, given = header["cell_m"]
        cell_m = checked_cell_m(" ".join(given), where, "cell_m")
    if "origin" in header:
        where, given = header["origin"]
        origin = _origin(given, where)
    kind = "nested list" if text.lstrip().startswith("[") else "text"
    return Map(np.where(walls, OCCUPIED, FREE).astype(np.int8), cell_m, origin, str(path), kind)


def _read_moving_ai(path: Path, head: bytes) -> Map:
    """A ``.map`` of the MovingAI path-finding benchmarks: no scale; trees and water are wall, swamp is free."""
    del head
    lines = _text_of(path, 2 * MAX_MAP_SIDE * (MAX_MAP_SIDE + 2), "at most 8192 x 8192 cells").split("\n")
    lines = [line.rstrip("\r") for line in lines]
    begin = next((i for i, line in enumerate(lines[:20]) if line.strip() == "map"), None)
    sizes = dict(line.split(maxsplit=1) for line in lines[:begin] if len(line.split()) == 2)
    try:
        height, width = int(sizes["height"]), int(sizes["width"])
    except (KeyError, ValueError):
        height = width = 0
    if begin is None or not (0 < height <= MAX_MAP_SIDE and 0 < width <= MAX_MAP_SIDE):
        mend = "begin it with 'type octile', 'height N', 'width N' and 'map', each on a line"
        raise UserError(f"{path}: not a MovingAI map of at most {MAX_MAP_SIDE} x {MAX_MAP_SIDE} cells; {mend}")
    rows = lines[begin + 1 :]
    while rows and not rows[-1].strip():
        rows.pop()
    if len(rows) != height:
        raise UserError(f"{path}: {len(rows)} rows, but its height is {height}; correct one of them")
    for number, row in enumerate(rows, begin + 2):
        if len(row) != width:
            raise UserError(f"{path}:{number}: {len(row)} cells, but the width is {width}; correct one of them")
        if strange := set(row) - set(_MOVING_AI):
            column = min(map(row.index, strange))
            known = ", ".join(_MOVING_AI)
            raise UserError(f"{path}:{number}: column {column + 1} is {row[column]!r}; use one of {known}")
    table = np.full(128, OCCUPIED, np.int8)
    table[[ord(mark) for mark in _MOVING_AI]] = list(_MOVING_AI.values())
    drawn = np.frombuffer("".join(rows).encode("ascii"), np.uint8).reshape(height, width)
    return Map(table[drawn[::-1]], None, source=str(path), kind="MovingAI map")


# ------------------------------------------------------------------------------------------------------ map_server


@dataclass(frozen=True)
class Rules:
    """How a picture becomes occupancy: the settings of ROS' map_server (nav2_map_server's map_io)."""

    mode: str = "trinary"
    negate: bool = False
    occupied_thresh: float = 0.65
    free_thresh: float = 0.196


_AS_DRAWN = Rules("scale", False, 0.75, 0.25)  # of floor plans: darker than mid-grey is wall, transparent is unknown


class _NoAliases(yaml.SafeLoader):
    """Reads plain YAML only: aliases can make a few lines explode, and no map needs one."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.constructor.ConstructorError(None, None, "an alias (*)", self.peek_event().start_mark)
        return super().compose_node(parent, index)


def _read_map_server(path: Path, head: bytes) -> Map:
    """A YAML file of ROS' map_server, and the picture that it names."""
    del head
    text = _text_of(path, _MOST_YAML_BYTES, "a map's YAML holds only some lines; give the YAML, not another file")
    try:
        found = yaml.load(text, _NoAliases)
    except yaml.MarkedYAMLError as bad:
        mark = bad.problem_mark
        line = f":{mark.line + 1}" if mark else ""
        raise UserError(f"{path}{line}: not the YAML of a map ({shown(bad.problem)}); {_YAML_MEND}") from None
    except (yaml.YAMLError, ValueError, RecursionError):
        raise UserError(f"{path}: not the YAML of a map; {_YAML_MEND}") from None
    if not isinstance(found, dict):
        raise UserError(f"{path}: holds no settings of a map; {_YAML_MEND}")
    image = found.get("image")
    if not isinstance(image, str) or not image.strip() or "\0" in image:
        raise UserError(f"{path}: names no image; add a line 'image: FILE.pgm'")
    resolution = checked_cell_m(_setting(found, "resolution", path), str(path), "resolution")
    origin = _origin(_setting(found, "origin", path), str(path))
    rules = _rules(found, path)
    picture = path.parent / image
    if not picture.is_file():
        raise UserError(f"{path}: its image {picture} is not there; put it there, or correct the line 'image:'")
    occupancy, grey = _occupancy(_load_picture(picture), rules)
    notes = ()
    if rules.mode != "raw" and grey and occupancy_of_grey(_SAVED_UNKNOWN, rules) == FREE:
        notes = (
            f"{path}: grey {_SAVED_UNKNOWN}, which map savers write for unknown space, is read as free with "
            f"free_thresh {rules.free_thresh:g}; if it is unknown there, write 'free_thresh: 0.196'",
        )
    return Map(occupancy, resolution, origin, str(path), f"map_server map ({rules.mode})", notes)


_YAML_MEND = "write lines such as 'image: floor.pgm' and 'resolution: 0.05', without aliases"


def _setting(found: dict[Any, Any], name: str, path: Path) -> Any:
    """A setting that map_server insists on. Raises UserError."""
    examples = {"resolution": "0.05", "origin": "[0, 0, 0]", "negate": "0"}
    examples |= {"occupied_thresh": "0.65", "free_thresh": "0.196"}
    if found.get(name) is None:
        raise UserError(f"{path}: '{name}' is missing; add a line '{name}: {examples[name]}'")
    return found[name]


def _rules(found: dict[Any, Any], path: Path) -> Rules:
    """The settings of a YAML that say how its picture is read. Raises UserError."""
    mode = found.get("mode", "trinary")
    if mode not in MODES:
        raise UserError(f"{path}: mode is {shown(mode)}; use one of {', '.join(MODES)}")
    negate = _setting(found, "negate", path)
    if negate not in (0, 1):
        raise UserError(f"{path}: negate is {shown(negate)}; use 0 or 1")
    thresholds = {}
    for name in ("occupied_thresh", "free_thresh"):
        given = _setting(found, name, path)
        number = _number(given)
        if number is None or not 0 <= number <= 1:
            raise UserError(f"{path}: {name} is {shown(given)}; give a number from 0 to 1")
        thresholds[name] = number
    rules = Rules(mode, bool(negate), **thresholds)
    if rules.free_thresh >= rules.occupied_thresh:
        low, high = rules.free_thresh, rules.occupied_thresh
        raise UserError(f"{path}: free_thresh {low:g} is not below occupied_thresh {high:g}; correct one of them")
    return rules


def _number(value: Any) -> float | None:
    """A finite number, written as YAML or as text; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | str | np.number):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _origin(given: Any, where: str) -> tuple[float, float, float]:
    """x, y [m] and yaw [rad]. Raises UserError."""
    numbers = [_number(each) for each in given] if isinstance(given, list) else []
    x, y, yaw = numbers if len(numbers) == 3 else (None, None, None)
    if x is None or y is None or yaw is None or max(abs(x), abs(y), abs(yaw)) > _FAR:
        told = f"{len(numbers)} numbers" if numbers and len(numbers) != 3 and None not in numbers else shown(given)
        raise UserError(f"{where}: origin is {told}; give three: x [m], y [m] and yaw [rad] of the lower left corner")
    return x, y, yaw


def occupancy_of_grey(grey: int, rules: Rules) -> int:
    """The occupancy of an opaque grey of 8 bits."""
    return int(_table(rules, channels=1, largest=255)[grey])


def _table(rules: Rules, *, channels: int, largest: int) -> Int8[np.ndarray, "n"]:
    """The occupancy for each sum of a pixel's channels, from 0 to ``channels * largest``."""
    shade = np.arange(channels * largest + 1) / channels / largest
    if rules.mode == "raw":
        byte = np.floor(shade * 255 + 0.5)
        return np.where(byte <= OCCUPIED, byte, UNKNOWN).astype(np.int8)
    low, high = rules.free_thresh, rules.occupied_thresh
    occupied = shade if rules.negate else 1.0 - shade
    between = np.rint((occupied - low) / (high - low) * 100.0) if rules.mode == "scale" else UNKNOWN
    return np.select([occupied > high, occupied < low], [OCCUPIED, FREE], between).astype(np.int8)


# -------------------------------------------------------------------------------------------------------- pictures


@dataclass(frozen=True, eq=False)
class Pixels:
    """The channels of a picture, first row on top."""

    colour: Shaped[np.ndarray, "H W C"]  # one channel for greys, else three
    alpha: Shaped[np.ndarray, "H W"] | None  # ``largest`` where it is opaque
    largest: int  # value of a channel at full brightness


def _read_picture(path: Path, head: bytes) -> Map:
    """A picture of a floor plan; it has no scale."""
    del head
    occupancy, _ = _occupancy(_load_picture(path), _AS_DRAWN)
    return Map(occupancy, None, source=str(path), kind=_FLOOR_PLAN)


def _occupancy(pixels: Pixels, rules: Rules) -> tuple[Int8[np.ndarray, "H W"], bool]:
    """The occupancy of a picture, row 0 lowest; and whether some pixel has the grey that means unknown to map savers.

    As map_io has it: in trinary mode, alpha is one more channel of the brightness; in scale mode, what is not opaque is
    unknown; in raw mode, alpha does not matter.
    """
    total = pixels.colour.sum(-1, dtype=np.int32)
    channels = pixels.colour.shape[-1]
    saved = _SAVED_UNKNOWN * channels * pixels.largest // 255
    grey = pixels.alpha is None and bool((total == saved).any())
    if pixels.alpha is not None and rules.mode == "trinary":
        total, channels = total * (3 // channels) + pixels.alpha, 4
    occupancy = _table(rules, channels=channels, largest=pixels.largest)[total]
    if pixels.alpha is not None and rules.mode == "scale":
        occupancy[pixels.alpha < pixels.largest] = UNKNOWN
    return occupancy[::-1], grey


def _load_picture(path: Path) -> Pixels:
    """The pixels of a picture. Raises UserError, before it is unpacked if it is too large."""
    limit = f"at most {MAX_MAP_SIDE} x {MAX_MAP_SIDE} pixels; make it smaller, with a coarser resolution"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about its size, which is looked at here, and about its metadata
            with Image.open(path, formats=_FORMATS) as image:
                width, height = image.size
                if max(image.size) > MAX_MAP_SIDE:
                    raise UserError(f"{path}: a picture of {width} x {height} pixels; {limit}")
                return _pixels(image, path)
    except (UserError, MemoryError):
        raise
    except Image.DecompressionBombError:
        raise UserError(f"{path}: too large a picture; {limit}") from None
    except Exception as bad:  # decoders raise many kinds of errors for broken files
        why = "" if isinstance(bad, Image.UnidentifiedImageError) else f" ({shown(str(bad))})"
        mend = "save it as PGM, PNG, BMP or JPEG"
        raise UserError(f"{path}: cannot be read as a picture{why}; {mend}") from None


def _pixels(image: Image.Image, path: Path) -> Pixels:
    """The channels of an open picture."""
    if image.format == "PNG":
        with path.open("rb") as opened:
            depth, colours = opened.read(26)[24:26]
        if depth == 16 and colours != 0:
            raise UserError(f"{path}: colours of 16 bits; save it with 8 bits, or as 16-bit grey")
    clear = image.info.get("transparency")
    if image.mode.startswith("I"):  # grey of 16 bits
        grey = np.asarray(image).astype(np.int32)
        alpha = None if clear is None else np.where(grey == clear, 0, 65535)
        return Pixels(grey[..., None], alpha, 65535)
    see_through = clear is not None or image.mode in ("LA", "PA", "RGBA", "La", "RGBa")
    grey = image.mode in ("1", "L", "LA")
    mode = {(True, False): "L", (True, True): "LA", (False, False): "RGB", (False, True): "RGBA"}[grey, see_through]
    channels = np.asarray(image.convert(mode))
    channels = channels if channels.ndim == 3 else channels[..., None]
    return Pixels(channels[..., :-1], channels[..., -1], 255) if see_through else Pixels(channels, None, 255)


def why_no_cell(found: Map, cell_m: float) -> str:
    """Why a map has no free cell of ``cell_m`` [m], and what helps."""
    if found.walls.all():
        return "no free cell; check its thresholds and negate"
    widest = float(found.room().max())
    finer = max(found.cell_m or 0.0, float(f"{widest / 4:.1g}"))
    convert = f"ct-jax maps convert {found.source} OUT.txt --cell-m {finer:g} --scale {cell_m / finer:g}"
    return (
        f"no free cell of {cell_m:g} m, the size that robots in mazes need (its widest place has radius {widest:.2f} "
        f"m); enlarge it: {convert}"
    )


# --------------------------------------------------------------------------------------------------------- writing


def converted(found: Map, file: Path) -> dict[Path, bytes]:
    """The files of a map in another format, which the ending of ``file`` names.

    ``.txt`` is our text, closed, with its cell size and origin on top. ``.yaml`` is a map_server map with a PGM of the
    same name beside it; it keeps what is unknown.

    Raises:
        UserError: another ending, or a map without a cell size or a free cell.
    """
    if file.suffix.lower() not in (".txt", ".yaml", ".yml"):
        raise UserError(
            f"{file}: give a file that ends in .txt (our text) or .yaml (map_server, with a .pgm beside it)"
        )
    if found.cell_m is None:
        raise UserError(f"{found.source}: does not say how large its cells are; give --resolution METRES")
    if found.walls.all():
        raise UserError(f"{found.source}: no free cell; check its thresholds and negate, or use smaller cells")
    if file.suffix.lower() == ".txt":
        found = found.closed()
        origin = " ".join(map(repr, found.origin))
        header = f"cell_m: {found.cell_m!r}\norigin: {origin}\n"
        return {file: (header + draw_walls(found.walls) + "\n").encode()}
    picture = file.with_suffix(".pgm")
    height, width = found.shape
    grey = np.select([found.occupancy < 0, found.walls], [_SAVED_UNKNOWN, _SAVED_OCCUPIED], _SAVED_FREE)
    settings = {"image": picture.name, "mode": "trinary", "resolution": found.cell_m, "origin": list(found.origin)}
    settings |= {"negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196}
    pgm = b"P5\n%d %d\n255\n" % (width, height) + grey[::-1].astype(np.uint8).tobytes()
    text = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return {picture: pgm, file: text.encode()}


def png_of(found: Map) -> bytes:
    """A PNG of the map: white is free, black is wall, grey is unknown. Small maps get larger pixels."""
    grey = np.select([found.occupancy < 0, found.walls], [_SAVED_UNKNOWN, 40], 255).astype(np.uint8)[::-1]
    times = max(1, 600 // max(found.shape))
    written = io.BytesIO()
    Image.fromarray(grey.repeat(times, 0).repeat(times, 1)).save(written, "PNG")
    return written.getvalue()


def in_words(found: Map) -> list[str]:
    """Lines that say what a map holds: its size, its free area, its regions and its widest place."""
    height, width = found.shape
    lines = [f"{found.source}: {found.kind}", f"size: {width} x {height} cells"]
    free, unknown = float((~found.walls).mean()), float((found.occupancy < 0).mean())
    labels, n = label_regions(~found.walls)
    largest = int(np.bincount(labels.ravel())[1:].max(initial=0))
    share = f"{100 * free:.1f} % free, {100 * unknown:.1f} % unknown"
    if found.cell_m is None:
        return [*lines, f"cells: {share}, in {n} regions, the largest of {largest} cells", "cell size: not said"]
    x, y, yaw = found.origin
    area = found.cell_m**2
    lines[1] += f" of {found.cell_m:g} m, {width * found.cell_m:g} x {height * found.cell_m:g} m"
    lines += [f"origin: ({x:g}, {y:g}) m, turned by {yaw:g} rad"]
    lines += [f"free area: {(~found.walls).sum() * area:.1f} m² ({share})"]
    lines += [f"regions: {n}, the largest of {largest * area:.1f} m²"]
    return [*lines, f"widest place: radius {found.room().max():.2f} m"]


def small_picture(found: Map, width: int = 72) -> str:
    """A text picture of where a map is free, ``width`` characters wide or less: '#' mostly wall, '+' some, '.' none."""
    walls = found.walls
    for axis in (0, 1):  # without what is all wall, but for one ring
        inside = np.flatnonzero(~walls.all(1 - axis))
        first, last = (inside[0], inside[-1]) if len(inside) else (0, 0)
        walls = walls.take(range(max(first - 1, 0), min(last + 2, walls.shape[axis])), axis)
    columns = min(width, walls.shape[1])
    rows = max(1, min(round(walls.shape[0] * columns / walls.shape[1] / 2), width))  # a character is twice as high
    counts = np.pad(np.cumsum(np.cumsum(walls, 0, dtype=np.int64), 1), ((1, 0), (1, 0)))
    ends = [
        np.linspace(0, side, n + 1).round().astype(int) for side, n in zip(walls.shape, (rows, columns), strict=True)
    ]
    blocked = np.diff(np.diff(counts[np.ix_(*ends)], axis=0), axis=1)
    cells = np.outer(np.diff(ends[0]), np.diff(ends[1]))
    marks = np.select([2 * blocked >= cells, blocked > 0], ["#", "+"], ".")
    return "\n".join("".join(row) for row in marks[::-1])
