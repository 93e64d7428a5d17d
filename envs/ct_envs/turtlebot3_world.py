"""Cluttered rooms for the Turtlebot3: a square of walls with boxes and cylinders in it (paper, sec. IV-B). NumPy only.

Coordinates are in metres: x right, y up, and the lower-left corner of the room is (0, 0). The paper gives neither the
size nor the density of its rooms. Ours are 5 m x 5 m, and obstacles cover 5 to 10 % of the floor in training.
"""

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from ct_envs.errors import UserError

SIDE_M = 5.0  # of a random room
TRAIN_DENSITY = (0.05, 0.10)  # share of the floor that obstacles cover, in training
MAX_DENSITY = 0.25  # higher densities do not fit without overlap
HALF_SIZE_M = (0.1, 0.3)  # range of the half sides of boxes and of the radii of cylinders
REGION_CELL_M = 0.05  # cell size of the grid for reachability
MARGIN_M = 0.05  # clearance beyond the robot's radius at random starts and goals

_MAX_BYTES = 1_000_000  # maximum size of a world file
_BOX = ("x_m", "y_m", "half_x_m", "half_y_m", "yaw_rad")
_CYLINDER = ("x_m", "y_m", "radius_m")
_POSITIVE = ("half_x_m", "half_y_m", "radius_m")


@dataclass(frozen=True, eq=False)  # hashed by identity, for the cache of ``_regions``
class World:
    """A square room. Its walls are the sides of ``[0, side_m] x [0, side_m]``. Points outside are not free."""

    side_m: float
    boxes: np.ndarray  # float [B, 5]: centre x, y, half sides along and across, yaw [m, rad]
    cylinders: np.ndarray  # float [C, 3]: centre x, y, radius [m]

    def clearance(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Signed distance [m] from points [m] to the nearest wall or obstacle: exact outside, negative inside."""
        points = np.asarray(points, np.float64)
        nearest = np.minimum(points, self.side_m - points).min(-1)
        local, half = self._in_boxes(points), self.boxes[:, 2:4]
        beyond = np.abs(local) - half
        to_box = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(-1), 0.0)
        to_cylinder = np.linalg.norm(points[..., None, :] - self.cylinders[:, :2], axis=-1) - self.cylinders[:, 2]
        return np.minimum(nearest, np.concatenate([to_box, to_cylinder], -1).min(-1, initial=np.inf))

    def segment_clearance(self, a: Float[np.ndarray, "*n 2"], b: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Exact distance [m] from the segments a-b to the nearest wall or obstacle; 0 or negative if they touch."""
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        nearest = np.minimum(np.minimum(a, b), self.side_m - np.maximum(a, b)).min(-1)
        to_box = _segment_to_box(self._in_boxes(a), self._in_boxes(b), self.boxes[:, 2:4])
        centre, radius = self.cylinders[:, :2], self.cylinders[:, 2]
        to_cylinder = _segment_to_point(a[..., None, :] - centre, b[..., None, :] - centre) - radius
        return np.minimum(nearest, np.concatenate([to_box, to_cylinder], -1).min(-1, initial=np.inf))

    def segment_free(self, ends: Float[np.ndarray, "*n 2 2"], radius: float | np.ndarray) -> Bool[np.ndarray, "*n"]:
        """Whether discs of ``radius`` [m] swept from one end to the other [m] touch nothing."""
        room = self.segment_clearance(ends[..., 0, :], ends[..., 1, :])
        return (room >= radius) & (room > 0)

    def sample_free(self, rng: np.random.Generator, n: int, radius: float) -> Float[np.ndarray, "n 2"]:
        """n points [m], uniform over the area with clearance ``radius`` [m]. Raises UserError if there are too few."""
        kept: list[np.ndarray] = []
        for _ in range(100):
            draw = rng.uniform(radius, max(self.side_m - radius, radius), (4 * n, 2))
            kept.append(draw[self.clearance(draw) >= radius])
            if sum(map(len, kept)) >= n:
                return np.concatenate(kept)[:n]
        raise UserError(f"no room for a robot of radius {radius:.3f} m in this world; use fewer or smaller obstacles")

    def sample_pair(
        self, rng: np.random.Generator, radius: float, *, margin_m: float = MARGIN_M, apart_m: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """A start and a goal [2] (m) in the same region for the robot, at least ``apart_m`` from each other.

        Raises:
            UserError: no such points were found.
        """
        regions = _regions(self, radius + REGION_CELL_M / 2)
        for _ in range(20):
            points = self.sample_free(rng, 64, radius + margin_m)
            label = regions.of(points)
            start = int(np.argmax(label > 0))
            far = np.linalg.norm(points - points[start], axis=-1) >= apart_m
            fit = np.flatnonzero((label == label[start]) & (label > 0) & far)
            if len(fit):
                return points[start], points[fit[0]]
        raise UserError(f"no start and goal {apart_m} m apart in one free region; use fewer or smaller obstacles")

    def regions(self, points: np.ndarray, radius: float) -> np.ndarray:
        """The free regions, int [k], of points [k, 2] (m). A robot can reach all points of its region; 0 is not free.

        It is computed on a grid of 5 cm. Gaps that are up to 5 cm wider than the robot may count as blocked.
        """
        return _regions(self, radius + REGION_CELL_M / 2).of(np.asarray(points, np.float64))

    def reachable(self, start: np.ndarray, goal: np.ndarray, radius: float) -> bool:
        """Whether a robot may be able to go from start to goal [2] (m). If False, it is certainly impossible.

        It is computed on a grid of 5 cm. Gaps that are up to 7 cm too narrow may count as free.
        """
        ends = np.asarray([start, goal], np.float64)
        start_label, goal_label = _regions(self, radius - REGION_CELL_M * 2**-0.5).of(ends)
        return bool(start_label == goal_label and start_label > 0)

    def covered(self) -> float:
        """Share of the floor that the obstacles cover. Overlap counts twice."""
        area = 4.0 * np.prod(self.boxes[:, 2:4], axis=1).sum() + np.pi * (self.cylinders[:, 2] ** 2).sum()
        return float(area / self.side_m**2)

    def _in_boxes(self, points: np.ndarray) -> np.ndarray:
        """Points [*n, 2] in the frame of each box, [*n, B, 2]."""
        away = points[..., None, :] - self.boxes[:, :2]
        cosine, sine = np.cos(self.boxes[:, 4]), np.sin(self.boxes[:, 4])
        along, across = away[..., 0] * cosine + away[..., 1] * sine, away[..., 1] * cosine - away[..., 0] * sine
        return np.stack([along, across], -1)


def make_world(boxes: Any = (), cylinders: Any = (), *, side_m: float = SIDE_M) -> World:
    """A world of boxes [B, 5] (x, y, half sides, yaw) and cylinders [C, 3] (x, y, radius), in m and rad.

    Raises:
        UserError: a number that is not finite, a size that is not positive, or an obstacle outside the room.
    """
    if not (np.isfinite(side_m) and 0.5 <= side_m <= 100.0):
        raise UserError(f"the room has side {side_m} m; use 0.5 to 100 m")
    tables = {}
    for kind, fields, rows in (("boxes", _BOX, boxes), ("cylinders", _CYLINDER, cylinders)):
        table = np.asarray(rows, np.float64).reshape(-1, len(fields))
        for number, row in enumerate(table):
            for name, value in zip(fields, row, strict=True):
                if not np.isfinite(value) or (name in _POSITIVE and value <= 0):
                    wanted = "a positive number" if name in _POSITIVE else "a finite number"
                    raise UserError(f"{kind}[{number}]: {name} is {value}; use {wanted}")
            if not ((row[:2] >= 0) & (row[:2] <= side_m)).all():
                raise UserError(f"{kind}[{number}]: its centre is outside the room of {side_m} m; move it inside")
        tables[kind] = table
    return World(float(side_m), **tables)


def random_world(seed: int | tuple[int, ...], density: float | None = None, *, side_m: float = SIDE_M) -> World:
    """A room with boxes and cylinders of random position, size and yaw, without overlap.

    Args:
        seed: the same seed gives the same world on every machine.
        density: share of the floor that obstacles cover, with an error of up to half an obstacle. If None, it is drawn
            from ``TRAIN_DENSITY``.

    Raises:
        UserError: a density below 0 or above ``MAX_DENSITY``.
    """
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(*TRAIN_DENSITY)
    density = drawn if density is None else density
    if not 0.0 <= density <= MAX_DENSITY:
        raise UserError(f"obstacle density {density}; use 0 to {MAX_DENSITY} (training has {TRAIN_DENSITY})")
    left = density * side_m**2
    obstacles: list[tuple[np.ndarray, float, np.ndarray | None]] = []  # centre, radius around it, half sides and yaw
    while True:
        size = rng.uniform(*HALF_SIZE_M, 2)
        box = np.append(size, rng.uniform(-np.pi, np.pi)) if rng.random() < 0.5 else None
        radius = float(size[0] if box is None else np.hypot(*size))
        area = float(np.pi * radius**2 if box is None else 4.0 * size.prod())
        if area / 2 > left:
            break
        left -= area
        obstacles.append((_place(rng, radius, obstacles, side_m), radius, box))
    boxes = [np.concatenate([centre, box]) for centre, _, box in obstacles if box is not None]
    cylinders = [np.append(centre, radius) for centre, radius, box in obstacles if box is None]
    return make_world(boxes, cylinders, side_m=side_m)


def _place(rng: np.random.Generator, radius: float, others: list, side_m: float) -> np.ndarray:
    """A random centre at which a disc of ``radius`` is inside the room and does not overlap others."""
    for _ in range(10_000):
        centre = rng.uniform(radius, side_m - radius, 2)
        if all(np.hypot(*(centre - other)) > radius + reach for other, reach, _ in others):
            return centre
    raise UserError("the room is too small for this density of obstacles; use less")


# ---------------------------------------------------------------------------------------------------- world files


def save_world(world: World, file: str | Path) -> None:
    """Write a world as JSON, with one obstacle per line."""

    def rows(table: np.ndarray, fields: tuple[str, ...]) -> str:
        lines = [json.dumps(dict(zip(fields, row, strict=True))) for row in table.tolist()]
        return "[\n    " + ",\n    ".join(lines) + "\n  ]" if lines else "[]"

    boxes, cylinders = rows(world.boxes, _BOX), rows(world.cylinders, _CYLINDER)
    text = f'{{\n  "side_m": {world.side_m},\n  "boxes": {boxes},\n  "cylinders": {cylinders}\n}}\n'
    Path(file).write_text(text, "utf-8")


def load_world(file: str | Path) -> World:
    """Read a world file written by ``save_world``. Raises UserError with the file, the place and the remedy."""
    path = Path(file)
    if not path.is_file():
        raise UserError(f"no world file '{path}'; save_world(random_world(0), file) writes one")
    if path.stat().st_size > _MAX_BYTES:
        raise UserError(f"{path}: too large for a world file; at most {_MAX_BYTES // 1_000_000} MB")
    try:
        content = json.loads(path.read_bytes().decode("utf-8"))
    except UnicodeDecodeError:
        raise UserError(f"{path}: not UTF-8 text; save the world as JSON") from None
    except (json.JSONDecodeError, RecursionError) as bad:
        line = getattr(bad, "lineno", 1)
        raise UserError(f"{path}:{line}: not JSON ({getattr(bad, 'msg', 'too deep')}); correct this line") from None
    names = {"side_m", "boxes", "cylinders"}
    if not isinstance(content, dict) or set(content) != names:
        raise UserError(f"{path}: not a world; it needs just {', '.join(sorted(names))}")
    try:
        side_m = _number(content["side_m"], "side_m")
        boxes, cylinders = _rows(content, "boxes", _BOX), _rows(content, "cylinders", _CYLINDER)
        return make_world(boxes, cylinders, side_m=side_m)
    except UserError as bad:
        raise UserError(f"{path}: {bad}") from None


def _rows(content: dict, kind: str, fields: tuple[str, ...]) -> list[list[float]]:
    if not isinstance(content[kind], list):
        raise UserError(f"{kind} is not a list; use [] for none")
    rows = []
    for number, entry in enumerate(content[kind]):
        if not isinstance(entry, dict) or set(entry) != set(fields):
            raise UserError(f"{kind}[{number}]: needs just {', '.join(fields)}")
        rows.append([_number(entry[name], f"{kind}[{number}]: {name}") for name in fields])
    return rows


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{name} is {value!r}; use a number")
    return float(value)


# ------------------------------------------------------------------------------------------- regions and geometry


@dataclass(frozen=True)
class _Regions:
    """Connected regions of grid cells whose centres have a given clearance."""

    labels: np.ndarray  # int [n, n], row y, column x; 0 is not free
    cell_m: float

    def of(self, points: np.ndarray) -> np.ndarray:
        """Region of each point [m, 2]: that of its cell, or of a free cell beside it; 0 if there is none."""
        column, row = np.floor(points / self.cell_m).astype(int).T
        padded = np.pad(self.labels, 2)
        side = (0, -1, 1)
        around = np.stack([
            padded[np.clip(row + 2 + i, 0, len(padded) - 1), np.clip(column + 2 + j, 0, len(padded) - 1)]
            for i in side for j in side
        ])  # fmt: skip
        return np.take_along_axis(around, (around > 0).argmax(0)[None], 0)[0]


@functools.lru_cache(maxsize=64)
def _regions(world: World, radius: float) -> _Regions:
    n = int(np.ceil(world.side_m / REGION_CELL_M))
    ticks = (np.arange(n) + 0.5) * world.side_m / n
    free = world.clearance(np.stack(np.meshgrid(ticks, ticks), -1)) >= radius
    return _Regions(ndimage.label(free)[0], world.side_m / n)  # pyright: ignore


def _segment_to_point(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance from the origin to the segments a-b [..., 2]."""
    along = b - a
    t = np.clip(-(a * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-18), 0.0, 1.0)
    return np.linalg.norm(a + t[..., None] * along, axis=-1)


def _segment_to_box(a: np.ndarray, b: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Distance from the segments a-b [..., B, 2] to the boxes [-half, half] [B, 2]; 0 where they meet."""
    signs = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    to_corner = functools.reduce(np.minimum, (_segment_to_point(a - sign * half, b - sign * half) for sign in signs))
    to_end = np.minimum(*(np.linalg.norm(np.maximum(np.abs(end) - half, 0.0), axis=-1) for end in (a, b)))
    # The slab test: the part of the segment that is inside the box on both axes.
    along = b - a
    safe = np.where(np.abs(along) < 1e-12, 1e-12, along)
    t1, t2 = (-half - a) / safe, (half - a) / safe
    enter = np.maximum(np.minimum(t1, t2).max(-1), 0.0)
    leave = np.minimum(np.maximum(t1, t2).min(-1), 1.0)
    return np.where(enter <= leave, 0.0, np.minimum(to_corner, to_end))
