"""Reading a run folder as arrays and plain values. Missing or damaged files are read as empty."""

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ct_envs.errors import UserError
from ct_envs.maze import CELL_M, parse_walls
from ct_envs.turtlebot3_world import World, make_world

STAGES = ("prm", "controller", "collect", "fit", "finetune", "evaluate")
METHODS = ("planner", "explorer")  # order in the report after the run's own; other methods follow
ROOMS = "rooms"  # the name of all rooms of an evaluation in its files
_ROOM_CELL_M = 0.5  # in rooms, a robot that moves less than this is stuck [m]

Place = np.ndarray | World  # the walls of a maze [H, W], or a room


@dataclass(frozen=True)
class Episodes:
    """The episodes of one method in one maze."""

    maze: str
    method: str
    seen: bool
    path: Float[np.ndarray, "T n 2"]  # [m]
    success: Bool[np.ndarray, "n"]
    collided: Bool[np.ndarray, "n"]
    steps: Int[np.ndarray, "n"]
    start: Float[np.ndarray, "n 2"]
    goal: Float[np.ndarray, "n 2"]
    returns: Float[np.ndarray, "n"] | None
    asked: Float[np.ndarray, "n"] | None  # target return at the start
    room: Int[np.ndarray, "n"] | None = None  # index of the room of each episode


@dataclass(frozen=True)
class Curve:
    """One scalar of one stage."""

    step: np.ndarray
    value: np.ndarray


@dataclass(frozen=True)
class Run:
    """The contents of a report. Fields of missing stages are empty."""

    folder: Path
    config: dict[str, Any]
    method: str  # that was trained
    cell_m: float
    walls: dict[str, Place]  # mazes (training mazes first) or rooms
    seen: dict[str, bool]
    rows: list[dict[str, Any]]  # of evaluate/results.json, seen mazes first, methods in order
    tested: list[Episodes]  # in the same order
    episodes: list[Episodes]  # like ``tested``, but the rooms are separate
    curves: dict[str, dict[str, Curve]]  # by stage and name
    horizon: int  # number of steps of the longest episode
    roadmap: tuple[np.ndarray, np.ndarray] | None  # points [n, 2] (m), edges [m, 2]
    done: dict[str, dict[str, Any]]  # by stage

    @property
    def is_baseline(self) -> bool:
        """Whether a baseline was trained: it has no target returns, and needs no roadmap."""
        return "baseline" in self.config


def read_run(folder: Path) -> Run:
    """Read a run folder.

    Raises:
        UserError: the folder does not exist, or has no readable config.json.
    """
    config = _read_config(folder)
    seen_mazes, unseen_mazes = _texts(config.get("mazes")), _texts(config.get("eval_mazes"))
    walls: dict[str, Place] = dict(_walls(seen_mazes | unseen_mazes))
    rooms = _read_rooms(folder / "evaluate" / "rooms.json")
    walls |= rooms
    seen = dict.fromkeys(unseen_mazes, False) | dict.fromkeys(seen_mazes, True)
    method = str(config.get("method", "ct"))
    rows = _read_rows(folder / "evaluate" / "results.json", method)
    seen = {row["maze"]: bool(row.get("seen")) for row in rows} | seen
    cell_m = number(config.get("cell_m"))
    tested = list(_read_episodes(folder / "evaluate", rows, seen, method))
    episodes = [part for each in tested for part in (_by_room(each, list(rooms)) if each.maze == ROOMS else [each])]
    seen |= dict.fromkeys(rooms, False)
    return Run(
        folder=folder,
        config=config,
        method=method,
        cell_m=_ROOM_CELL_M if rooms else cell_m if cell_m and cell_m > 0 else CELL_M,
        walls=walls,
        seen=seen,
        rows=rows,
        tested=tested,
        episodes=episodes,
        horizon=max((int(e.steps.max()) for e in episodes), default=0),
        curves=_read_curves(folder / "metrics.jsonl"),
        roadmap=_read_roadmap(folder / "prm" / "roadmap.npz"),
        done=dict(_read_done(folder)),
    )


def number(value: Any) -> float | None:
    """The value if it is a finite number, otherwise None."""
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max:
        return float(value)
    return None


def slug(name: str) -> str:
    """The name of a maze or method as part of a file name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)


def read_json(path: Path) -> Any:
    """The contents of a JSON file; None if it is missing or damaged."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None


def _read_config(folder: Path) -> dict[str, Any]:
    path = folder / "config.json"
    if not path.is_file():
        what = "has no config.json, so it is not a run folder" if folder.is_dir() else "is not a folder"
        raise UserError(f"{folder}: {what}; give the folder that `ct-jax train ... --out` wrote")
    config = read_json(path)
    if not isinstance(config, dict):
        raise UserError(f"{path}: not a readable JSON object; run the training again, or restore the file")
    return config


def _texts(mapping: Any) -> dict[str, str]:
    return {str(k): v for k, v in mapping.items() if isinstance(v, str)} if isinstance(mapping, dict) else {}


def _walls(texts: dict[str, str]) -> Iterator[tuple[str, np.ndarray]]:
    """The wall grids of the mazes, without those that cannot be read."""
    for name, text in texts.items():
        try:
            yield name, parse_walls(text, source="maze")
        except UserError:
            continue


def _read_rooms(path: Path) -> dict[str, Place]:
    """The rooms of an evaluation, by name."""
    found = read_json(path)
    rooms: dict[str, Place] = {}
    try:
        for number, room in enumerate(found["rooms"] if isinstance(found, dict) else []):
            rooms[f"room {number + 1}"] = make_world(room["boxes"], room["cylinders"], side_m=room["side_m"])
    except (UserError, KeyError, TypeError, ValueError):
        return {}
    return rooms


def _read_done(folder: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """The finished stages, and before the evaluation those of baselines by their names."""
    *stages, last = (folder / stage for stage in STAGES)
    for stage in (*stages, *sorted(folder.glob("baselines/*")), last):
        if isinstance(done := read_json(stage / "done.json"), dict):
            yield stage.name, done


def _read_rows(path: Path, method: str) -> list[dict[str, Any]]:
    found = read_json(path)
    rows = found.get("rows") if isinstance(found, dict) else None
    rows = rows if isinstance(rows, list) else []
    rows = [row | {"maze": str(row["maze"]), "method": str(row["method"])} for row in rows if _is_row(row)]
    order = [method, *METHODS, *dict.fromkeys(row["method"] for row in rows)]
    mazes = list(dict.fromkeys(row["maze"] for row in rows))
    return sorted(rows, key=lambda r: (not r.get("seen"), mazes.index(r["maze"]), order.index(r["method"])))


def _is_row(row: Any) -> bool:
    return isinstance(row, dict) and "maze" in row and "method" in row


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an archive; empty if it is missing or damaged."""
    try:
        # We open the file ourselves, because NumPy does not close a damaged archive.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
    except Exception:  # a damaged archive raises many kinds of errors
        return {}
    return {name: array for name, array in found.items() if array.dtype.kind in "biuf"}


def _read_roadmap(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    arrays = _read_arrays(path)
    points, edges = arrays.get("points"), arrays.get("edges")
    if points is None or edges is None or points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        return None
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.dtype.kind not in "iu":
        return None
    edges = edges.astype(int)
    inside = len(edges) == 0 or (edges.min() >= 0 and edges.max() < len(points))
    return (points, edges) if inside else None


def _read_episodes(folder: Path, rows: list[dict[str, Any]], seen: dict[str, bool], method: str) -> Iterator[Episodes]:
    methods = dict.fromkeys((method, *METHODS, *(row["method"] for row in rows)))
    for maze, method in product(sorted(seen, key=lambda name: not seen[name]), methods):
        arrays = _read_arrays(folder / f"{slug(maze)}-{slug(method)}.npz")
        path, success = arrays.get("path"), arrays.get("success")
        if path is None or success is None or path.ndim != 3 or path.shape[2] != 2 or not path.size:
            continue
        n = path.shape[1]
        wanted = {"success": (n,), "steps": (n,), "start": (n, 2), "goal": (n, 2)}
        if any(name not in arrays or arrays[name].shape != shape for name, shape in wanted.items()):
            continue
        if not np.isfinite(arrays["steps"]).all():
            continue
        collided = arrays.get("collided")
        yield Episodes(
            maze=maze,
            method=method,
            seen=seen[maze],
            path=path,
            success=success.astype(bool),
            collided=np.zeros(n, bool) if collided is None or collided.shape != (n,) else collided.astype(bool),
            steps=np.clip(arrays["steps"].astype(int), 0, len(path)),
            start=arrays["start"],
            goal=arrays["goal"],
            returns=_optional(arrays, "returns", n),
            asked=_optional(arrays, "asked", n),
            room=None if (room := _optional(arrays, "world", n)) is None else room.astype(int),
        )


def _by_room(episodes: Episodes, names: list[str]) -> Iterator[Episodes]:
    """The episodes of each room separately."""
    if episodes.room is None:
        return
    for number, name in enumerate(names):
        mine = episodes.room == number
        if mine.any():
            parts = {
                field: value[mine]
                for field in ("success", "collided", "steps", "start", "goal", "returns", "asked")
                if (value := getattr(episodes, field)) is not None
            }
            yield replace(episodes, maze=name, path=episodes.path[:, mine], **parts)


def _optional(arrays: dict[str, np.ndarray], name: str, n: int) -> np.ndarray | None:
    values = arrays.get(name)
    if values is None or values.shape != (n,) or not np.isfinite(values).all():
        return None
    return values.astype(float)


def _read_curves(path: Path) -> dict[str, dict[str, Curve]]:
    """Scalars by stage and name. A step that was repeated after a resume counts once. Damaged lines are skipped."""
    points: dict[str, dict[str, dict[float, float]]] = {}
    try:
        lines = path.read_text("utf-8", errors="replace").splitlines()
    except OSError:
        return {}
    for line in lines:
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(record, dict) or (step := number(record.get("step"))) is None:
            continue
        stage = points.setdefault(str(record.get("stage", "training")), {})
        for name, value in record.items():
            if name not in ("stage", "step") and (scalar := number(value)) is not None:
                stage.setdefault(name, {})[step] = scalar
    return {stage: {name: _curve(p) for name, p in named.items()} for stage, named in points.items()}


def _curve(points: dict[float, float]) -> Curve:
    steps = sorted(points)
    return Curve(np.array(steps), np.array([points[step] for step in steps]))
