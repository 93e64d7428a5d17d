"""A run's folder: what the run is of, what made it, and which of its stages are finished.

``config.json`` says what the run is of, and a run is only continued as what it was begun. Each stage has a folder of
its own, and ``done.json`` in it is written last.
"""

import fcntl
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from ct_envs import Maze, UserError, load_maze, make_maze, maze_names, random_walls, stack_mazes
from ct_envs.maze import draw_walls, unpadded
from ct_envs.robots import Robot, get_robot
from ct_jax import __version__, devices
from ct_jax.checkpoint import Checkpoints, read_json, write_json
from ct_jax.evaluate import Episodes
from ct_jax.files import append_to, check_folders, drop_parts, make_folder, save_arrays
from ct_jax.progress import Bar, Metrics
from ct_jax.settings import Settings, from_dict, to_dict

_ROW = {"method", "maze", "success_rate", "success_ci95", "spl", "return_scaled", "collision_rate", "steps_mean"}
STAGES = ("prm", "controller", "collect", "fit", "finetune", "evaluate", "report")


@dataclass(frozen=True)
class Run:
    """A run: a folder, and what it is of."""

    folder: Path
    robot: str
    preset: str
    settings: Settings
    mazes: dict[str, Maze]  # trained in; none for a robot that drives in rooms
    eval_mazes: dict[str, Maze]  # evaluated in besides them
    seed: int
    engine: str

    def key(self, stage: str) -> jax.Array:
        """The stage's own randomness."""
        return jax.random.fold_in(jax.random.key(self.seed), STAGES.index(stage))

    def round_keys(self, stage: str, number: int) -> jax.Array:
        """The keys of a round: to start and train the value network, likewise the transformer, and to recover."""
        return jax.random.split(jax.random.fold_in(self.key(stage), number), 5)

    @property
    def spec(self) -> Robot:
        """The robot's data."""
        return get_robot(self.robot)

    @property
    def stacked(self) -> Maze | None:
        """The mazes that its data may be in along a leading axis, if any: the named ones, then the generator's."""
        settings = self.settings
        return self.stack(max(settings.random_mazes, settings.recover.random_mazes)) if self.mazes else None

    def stack(self, besides: int) -> Maze:
        """The named training mazes, and so many of the generator's."""
        return stack_mazes([*self.mazes.values(), *random_mazes(besides)])

    def done(self, stage: str) -> dict[str, Any] | None:
        """What the finished stage said of itself; None if it has not finished."""
        file = self.folder / stage / "done.json"
        return devices.first(lambda: read_json(file, hint=self.hint(stage)) if file.is_file() else None)

    @property
    def made(self) -> dict[str, Any]:
        """What made the run, for what is shipped of it."""
        file = self.folder / "config.json"
        config, names = read_json(file), ("command", "commit", "created", "hardware", "versions", "seed")
        missing = [name for name in names if name not in config]
        if missing:
            raise UserError(f"{file}: '{missing[0]}' is missing; restore the file")
        return {name: config[name] for name in names}

    def hint(self, stage: str) -> str:
        """What to do about a damaged file of a stage."""
        return f"delete {self.folder / stage} and continue with --resume"

    @contextmanager
    def stage(self, stage: str) -> Iterator[tuple[Path, dict[str, Any]]]:
        """A stage's folder, and a dict of what it says of itself, written last. ``wall_s`` sums over interruptions."""
        folder = self.folder / stage
        file, begun = folder / "spent.json", time.perf_counter()

        def begin() -> float:
            make_folder(folder)
            spent = read_json(file).get("wall_s") if file.is_file() else 0.0
            if not isinstance(spent, int | float):
                raise UserError(f"{file}: 'wall_s' is no number; delete it and run again")
            return float(spent)

        before = devices.first(begin)
        info: dict[str, Any] = {}
        try:
            yield folder, info
        except BaseException:
            with suppress(UserError):
                if devices.is_first():
                    write_json(file, {"wall_s": round(before + time.perf_counter() - begun, 2)})
            raise

        def finish() -> None:
            write_json(folder / "done.json", info | {"wall_s": round(before + time.perf_counter() - begun, 2)})
            file.unlink(missing_ok=True)
            drop_leftovers(folder)

        devices.first(finish)


# ------------------------------------------------------------------------------------------- trainings and results


@contextmanager
def training(folder: Path, name: str, total: int, metrics: Metrics) -> Iterator[dict[str, Any]]:
    """A training's bar, metrics, and checkpoints in the folder: its ``on_progress`` and ``checkpoints``."""
    with Bar(name, total) as bar, closing(Checkpoints(folder / f"checkpoints-{name}")) as checkpoints:

        def on_progress(done: int, report: float | dict[str, float]) -> None:
            values = report if isinstance(report, dict) else {"loss": report}
            metrics.log(name, done, **values)
            shown = next((word for word in ("success", "loss") if word in values), None)
            bar.update(done, f"{shown} {values[shown]:.4g}" if shown else "")

        yield {"on_progress": on_progress, "checkpoints": checkpoints}


def drop_leftovers(folder: Path) -> None:
    """Delete what only an interrupted stage needs."""
    for left in (*folder.glob("checkpoints-*"), *folder.glob("waves*")):
        shutil.rmtree(left, ignore_errors=True)


def kept_row(
    folder: Path, name: str, method: str, head: dict[str, Any], measure: Callable[[], Episodes]
) -> dict[str, Any]:
    """A method's row of the table, with its episodes beside it in the folder; once there, read back.

    Args:
        head: what the row begins with.
    """
    file = folder / f"{slug(name)}-{method}.json"
    if not devices.first(file.is_file):
        episodes = measure()

        def keep() -> None:
            _save_episodes(episodes_file(folder, name, method), episodes)
            write_json(file, head | episodes.summary())

        devices.first(keep)
    row = devices.first(lambda: read_json(file))
    if not is_row(row):
        raise UserError(f"{file}: not a row of a table; delete it and run again")
    return row


def is_row(row: Any) -> bool:
    """Whether a value can stand in a table: what ``Episodes.summary`` makes, and what it is of."""

    def is_number(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool)

    def is_right(name: str, value: Any) -> bool:
        if name in ("robot", "method", "maze"):
            return isinstance(value, str)
        if name.endswith("_ci95"):
            return isinstance(value, list) and len(value) == 2 and all(map(is_number, value))
        return not name.endswith(("_rate", "_mean", "_scaled", "spl")) or is_number(value)

    return isinstance(row, dict) and row.keys() >= _ROW and all(is_right(name, value) for name, value in row.items())


def episodes_file(folder: Path, name: str, method: str) -> Path:
    """Where a row's episodes are."""
    return folder / f"{slug(name)}-{slug(method)}.npz"


def _save_episodes(file: Path, episodes: Episodes) -> None:
    """Write what happened, for the report's pictures."""
    arrays = {name: getattr(episodes, name) for name in ("path", "success", "collided", "fell", "steps", "returns")}
    arrays |= {"start": episodes.pairs.start, "goal": episodes.pairs.goal}
    more = {name: getattr(episodes, name) for name in ("frontal", "grazing", "diverged")}
    place = episodes.pairs.place
    more |= {"asked": episodes.target_return, "world": place if place.any() else None}
    arrays |= {name: array for name, array in more.items() if array is not None}
    save_arrays(file, **arrays)


# ----------------------------------------------------------------------------------------------------------- mazes


def load_mazes(names: tuple[str, ...]) -> dict[str, Maze]:
    """Mazes by name or file, in order; a file's maze is called like the file, without folder and ending.

    Raises:
        UserError: a maze that cannot be read, or two of one name.
    """
    mazes: dict[str, Maze] = {}
    for given in names:
        name = given if given in maze_names() else Path(given).stem
        _add(mazes, name, load_maze(given), given)
    return mazes


def random_mazes(n: int) -> list[Maze]:
    """The first n training mazes of the generator, the same for all runs; about the size of the paper's."""
    return [make_maze(random_walls(seed, height=9, width=13, density=0.9)) for seed in range(n)]


def join_mazes(seen: dict[str, Maze], unseen: dict[str, Maze]) -> dict[str, Maze]:
    """Seen and unseen mazes together. Raises UserError if two of them have one name."""
    together = dict(seen)
    for name, maze in unseen.items():
        _add(together, name, maze, name)
    return together


def _add(mazes: dict[str, Maze], name: str, maze: Maze, given: str) -> None:
    for other in mazes:
        if slug(other) == slug(name) and (other != name or maze_text(mazes[other]) != maze_text(maze)):
            raise UserError(f"{given}: another maze of this run is called '{other}' already; rename the file")
    mazes.setdefault(name, maze)


def maze_text(maze: Maze) -> str:
    """The maze as its file would show it."""
    return draw_walls(unpadded(maze))


def default_mazes(robot: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The paper's training and evaluation mazes for a robot, if it is one for mazes. Raises UserError for an unknown
    one."""
    if get_robot(robot).course != "maze":
        return (), ()
    return ("antmaze-large",), ("antmaze-large-eval", "hall") if robot == "humanoid" else ("antmaze-large-eval",)


def slug(name: str) -> str:
    """A maze's name as part of a file name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)


# ------------------------------------------------------------------------------------------------------ the folder


@contextmanager
def open_run(run: Run, *, resume: bool) -> Iterator[None]:
    """Make the run's folder, or check that the one there is the same run; no other process may work in it meanwhile.

    Raises:
        UserError: the folder cannot be made, is in use and ``resume`` is not given, or is another run's.
    """
    join_mazes(run.mazes, run.eval_mazes)
    with ExitStack() as held:

        def begin() -> None:
            _make_folder(run, resume)
            held.enter_context(_locked(run.folder))
            check_folders(run.folder)
            drop_parts(run.folder)
            config = run.folder / "config.json"
            if not config.is_file():
                write_json(config, identity(run) | provenance())
            for stage in STAGES:  # a process may have been killed between a stage's end and its tidying up
                if (run.folder / stage / "done.json").is_file():
                    drop_leftovers(run.folder / stage)

        devices.first(begin)
        yield


def _make_folder(run: Run, resume: bool) -> None:
    """The checks and the folder of ``open_run``."""
    if run.folder.exists() and not run.folder.is_dir():
        raise UserError(f"{run.folder}: a file, not a folder; choose another with --out")
    config = run.folder / "config.json"
    if config.is_file():
        _check_same(run, config)
        if not resume:
            raise UserError(f"{run.folder}: holds a run already; continue it with --resume or choose another --out")
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
    except OSError as bad:
        raise UserError(f"{run.folder}: cannot be made ({bad.strerror}); choose another place with --out") from None
    # What a process left that was killed before it wrote config.json does not count.
    if not config.is_file() and any(path.suffix not in (".lock", ".part") for path in run.folder.iterdir()):
        raise UserError(f"{run.folder}: not empty and no run folder; choose another with --out")


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Holds the folder; the system lets go of it when the process ends, however it ends."""
    with append_to(folder / "run.lock") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(f"{folder}: another process is training in it; wait for it or stop it") from None
        yield


def identity(run: Run) -> dict[str, Any]:
    """What a run is of: a run is only continued by one that agrees in all of it."""
    settings = json.loads(json.dumps(to_dict(run.settings)))  # tuples as lists, as they are read back
    texts = [{name: maze_text(maze) for name, maze in mazes.items()} for mazes in (run.mazes, run.eval_mazes)]
    return {
        "robot": run.robot,
        "preset": run.preset,
        "seed": run.seed,
        "engine": run.engine,
        "mazes": texts[0],
        "eval_mazes": texts[1],
        "settings": settings,
    }


def _check_same(run: Run, config: Path) -> None:
    before = read_json(config, hint="restore it, or choose another folder with --out")
    before |= {"settings": _settings_of(config, before.get("settings"))}
    for name, now in identity(run).items():
        found = _difference(name, before.get(name), now)
        if found:
            raise UserError(f"{config}: a run with {found}; choose another folder with --out")


def _settings_of(config: Path, values: Any) -> dict[str, Any]:
    """The settings that an earlier version may have written, as this one writes them."""
    try:
        return json.loads(json.dumps(to_dict(from_dict(values))))
    except UserError as bad:
        raise UserError(f"{config}: {bad}; choose another folder with --out") from None


def _difference(name: str, before: Any, now: Any) -> str:
    """The first thing in which two values differ, in words; empty if they do not."""
    if before == now:
        return ""
    if isinstance(before, dict) and isinstance(now, dict):
        if list(before) != list(now):
            of_version = name.startswith("settings")
            return f"{name} of another version" if of_version else f"{name} {', '.join(before)}, not {', '.join(now)}"
        return next(found for key in now if (found := _difference(f"{name}.{key}", before[key], now[key])))
    if isinstance(now, str) and "\n" in now:
        return f"another {name}"
    return f"{name} {before}, not {now}"


# ------------------------------------------------------------------------------------------------------ provenance


def provenance() -> dict[str, Any]:
    """Command, commit, date, hardware and versions: what is needed to make a result again."""
    packages = ("jax", "flax", "optax", "brax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy", "networkx")
    versions = {"ct-jax": __version__, "python": platform.python_version()}
    return {
        "command": _command(),
        "commit": _commit(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "hardware": hardware(),
        "versions": versions | {name: metadata.version(name) for name in packages},
    }


def _command() -> str:
    program = Path(sys.argv[0]).resolve()
    if program.name in ("ct-jax", "cli.py"):
        return shlex.join(["ct-jax", *sys.argv[1:]])
    # From the repository's root, and without what the machine's folders are called.
    inside = program.is_relative_to(Path.cwd())
    return shlex.join(["python", str(program.relative_to(Path.cwd())) if inside else program.name, *sys.argv[1:]])


def _commit() -> str:
    """The commit of this code, if it is the code of a repository and not only installed inside one.

    "-dirty" if tracked files are changed, but for those in which experiments write down what they found.
    """
    git, here = shutil.which("git"), Path(__file__)

    def ask(*arguments: str) -> str | None:
        asked = subprocess.run([str(git), *arguments], cwd=here.parent, capture_output=True, text=True)
        return asked.stdout.strip() if asked.returncode == 0 else None

    tracked = git is not None and ask("ls-files", "--error-unmatch", here.name) is not None
    if not tracked or not (commit := ask("describe", "--always")):
        return "unknown"
    found = (f":(top,exclude){folder}" for folder in ("experiments/results", "docs"))
    changed = ask("status", "--porcelain", "--untracked-files=no", "--", ":(top)", *found)
    return f"{commit}-dirty" if changed else commit


def hardware() -> str:
    """The devices in words."""
    found = jax.devices()
    accelerators = "" if found[0].platform == "cpu" else f"{len(found)} x {found[0].device_kind}, "
    hosts = f"{jax.process_count()} processes, each " if jax.process_count() > 1 else ""
    return f"{accelerators}{hosts}{platform.machine()} CPU, {cores()} core{'s' * (cores() > 1)}"


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
