"""The folder of a run: its configuration, its provenance, and its finished stages.

``config.json`` holds the configuration. A run can only be continued with the same configuration. Each stage has its own
folder. A stage writes ``done.json`` last.
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
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from ct_envs import Maze, UserError, load_maze, make_maze, maze_names, random_walls, stack_mazes
from ct_envs.checked import Checked, from_json
from ct_envs.maze import draw_walls, parse_walls, unpadded
from ct_envs.robots import Robot, get_robot
from ct_jax import __version__
from ct_jax.baselines import TRANSFORMERS, get_baseline
from ct_jax.configs import find_robot
from ct_jax.evaluate import Episodes
from ct_jax.runtime import devices
from ct_jax.runtime.checkpoint import Checkpoints, read_json, write_json
from ct_jax.runtime.files import append_to, check_folders, drop_parts, make_folder, save_arrays
from ct_jax.runtime.progress import Bar, Metrics
from ct_jax.settings import Settings, from_dict, to_dict

_ROW = {"method", "maze", "success_rate", "success_ci95", "spl", "return_scaled", "collision_rate", "steps_mean"}
BASELINES = "baselines"  # the folder in which each baseline has its stage
STAGES = ("prm", "controller", "collect", "fit", "finetune", "evaluate", "report")

_EARLIER = {"method": "ct"}  # what the config.json of an earlier version does not say


@dataclass(frozen=True)
class Run:
    """A run: its folder and its configuration."""

    folder: Path
    robot: str
    preset: str
    settings: Settings
    mazes: dict[str, Maze]  # training mazes; empty for a robot in rooms
    eval_mazes: dict[str, Maze]  # further mazes for the evaluation
    seed: int
    engine: str
    method: str = "ct"  # what is trained: a transformer, or a baseline
    baseline: Checked | None = None  # the settings of a baseline

    def key(self, stage: str) -> jax.Array:
        """The random key of a stage."""
        return jax.random.fold_in(jax.random.key(self.seed), STAGES.index(stage))

    def round_keys(self, stage: str, number: int) -> jax.Array:
        """Five random keys of a round: initialise and train V, initialise and train the transformer, recover."""
        return jax.random.split(jax.random.fold_in(self.key(stage), number), 5)

    @property
    def spec(self) -> Robot:
        """The robot."""
        return get_robot(self.robot)

    @property
    def trained(self) -> Path:
        """The folder of what the run has trained: a model, or a baseline."""
        return self.folder / ("model" if self.baseline is None else f"{BASELINES}/{self.method}")

    @property
    def stacked(self) -> Maze | None:
        """All mazes of the run's data, stacked: the named training mazes, then the random ones; None for rooms."""
        settings = self.settings
        return self.stack(max(settings.random_mazes, settings.recover.random_mazes)) if self.mazes else None

    def stack(self, besides: int) -> Maze:
        """The named training mazes and ``besides`` random mazes, stacked."""
        return stack_mazes([*self.mazes.values(), *random_mazes(besides)])

    def done(self, stage: str) -> dict[str, Any] | None:
        """The contents of ``done.json`` of a stage; None if the stage is not finished."""
        file = self.folder / stage / "done.json"
        return devices.first(lambda: read_json(file, hint=self.hint(stage)) if file.is_file() else None)

    @property
    def made(self) -> dict[str, Any]:
        """The provenance of the run, for the files of a model."""
        file = self.folder / "config.json"
        config, names = read_json(file), ("command", "commit", "created", "hardware", "versions", "seed")
        missing = [name for name in names if name not in config]
        if missing:
            raise UserError(f"{file}: '{missing[0]}' is missing; restore the file")
        return {name: config[name] for name in names}

    def hint(self, stage: str) -> str:
        """The remedy for a damaged file of a stage."""
        return f"delete {self.folder / stage} and continue with --resume"

    @contextmanager
    def stage(self, stage: str) -> Iterator[tuple[Path, dict[str, Any]]]:
        """A context for a stage: its folder, and a dict for ``done.json``. ``wall_s`` includes interrupted attempts."""
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
    """A context with the arguments ``on_progress`` and ``checkpoints`` for a training in a folder."""
    with Bar(name, total) as bar, closing(Checkpoints(folder / f"checkpoints-{name}")) as checkpoints:

        def on_progress(done: int, report: float | dict[str, float]) -> None:
            values = report if isinstance(report, dict) else {"loss": report}
            metrics.log(name, done, **values)
            shown = next((word for word in ("success", "loss") if word in values), None)
            bar.update(done, f"{shown} {values[shown]:.4g}" if shown else "")

        yield {"on_progress": on_progress, "checkpoints": checkpoints}


def drop_leftovers(folder: Path) -> None:
    """Delete the files that only an unfinished stage needs."""
    for left in (*folder.glob("checkpoints-*"), *folder.glob("waves*")):
        shutil.rmtree(left, ignore_errors=True)


def kept_row(
    folder: Path, name: str, method: str, head: dict[str, Any], measure: Callable[[], Episodes]
) -> dict[str, Any]:
    """The row of a method. The first call measures it, and writes the row and its episodes; later calls read it.

    Args:
        head: the first entries of the row.
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
    """Whether a value is a valid row: the entries of ``Episodes.summary``, with method and maze."""

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
    """The file with the episodes of a row."""
    return folder / f"{slug(name)}-{slug(method)}.npz"


def _save_episodes(file: Path, episodes: Episodes) -> None:
    """Write episodes for the pictures of the report."""
    arrays = {name: getattr(episodes, name) for name in ("path", "success", "collided", "fell", "steps", "returns")}
    arrays |= {"start": episodes.pairs.start, "goal": episodes.pairs.goal}
    more = {name: getattr(episodes, name) for name in ("frontal", "grazing", "diverged")}
    more |= {"asked": episodes.target_return, "world": episodes.pairs.place}
    arrays |= {name: array for name, array in more.items() if array is not None}
    save_arrays(file, **arrays)


# ----------------------------------------------------------------------------------------------------------- mazes


def load_mazes(names: tuple[str, ...]) -> dict[str, Maze]:
    """Load mazes by name or file, in order. The name of a maze from a file is the file name without folder and suffix.

    Raises:
        UserError: a maze cannot be read, or two mazes have the same name.
    """
    mazes: dict[str, Maze] = {}
    for given in names:
        name = given if given in maze_names() else Path(given).stem
        _add(mazes, name, load_maze(given), given)
    return mazes


def random_mazes(n: int) -> list[Maze]:
    """The first n random training mazes, the same for all runs. They have about the size of the paper's mazes."""
    return [make_maze(random_walls(seed, height=9, width=13, density=0.9)) for seed in range(n)]


def join_mazes(seen: dict[str, Maze], unseen: dict[str, Maze]) -> dict[str, Maze]:
    """Seen and unseen mazes together. Raises UserError if two different mazes have the same name."""
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
    """The maze as text, in the format of a maze file."""
    return draw_walls(unpadded(maze))


def default_mazes(robot: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The paper's training and evaluation mazes for a robot; none for a robot in rooms.

    Raises:
        UserError: the robot is unknown.
    """
    if get_robot(robot).simulator != "mujoco":
        return (), ()
    return ("antmaze-large",), ("antmaze-large-eval", "hall") if robot == "humanoid" else ("antmaze-large-eval",)


def slug(name: str) -> str:
    """A maze's name as part of a file name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)


# ------------------------------------------------------------------------------------------------------ the folder


@contextmanager
def open_run(run: Run, *, resume: bool) -> Iterator[None]:
    """A context that makes and locks the run's folder. An existing folder must belong to the same run.

    Raises:
        UserError: the folder cannot be made, has a run although ``resume`` is False, has another run, or is in use by
            another process.
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
            # A process may have been killed between the end of a stage and its cleanup.
            for stage in (*map(run.folder.joinpath, STAGES), *run.folder.glob(f"{BASELINES}/*")):
                if (stage / "done.json").is_file():
                    drop_leftovers(stage)

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
    # Ignore files of a process that was killed before it wrote config.json.
    if not config.is_file() and any(path.suffix not in (".lock", ".part") for path in run.folder.iterdir()):
        raise UserError(f"{run.folder}: not empty and no run folder; choose another with --out")


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """A context that locks the folder. The system releases the lock when the process ends, even if it is killed."""
    with append_to(folder / "run.lock") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(f"{folder}: another process is training in it; wait for it or stop it") from None
        yield


def identity(run: Run) -> dict[str, Any]:
    """The configuration of a run. A run can only be continued with the same configuration."""
    settings = json.loads(json.dumps(to_dict(run.settings)))  # tuples become lists, as when the file is read
    texts = [{name: maze_text(maze) for name, maze in mazes.items()} for mazes in (run.mazes, run.eval_mazes)]
    return {
        "robot": run.robot,
        "preset": run.preset,
        "method": run.method,
        "seed": run.seed,
        "engine": run.engine,
        "mazes": texts[0],
        "eval_mazes": texts[1],
        "settings": settings,
    } | ({} if run.baseline is None else {"baseline": as_json(run.baseline)})


def as_json(config: Checked) -> dict[str, Any]:
    """A config as it is read from a file: tuples become lists."""
    return json.loads(json.dumps(asdict(config)))


def stored_run(folder: Path) -> Run:
    """The run in a folder.

    Raises:
        UserError: the folder is not the folder of a run, or its ``config.json`` is damaged.
    """
    file = folder / "config.json"
    if not file.is_file():
        raise UserError(f"{folder}: no run folder; give one that 'ct-jax train' wrote")
    config = _EARLIER | read_json(file, hint="restore it")
    try:
        settings, mazes = from_dict(config["settings"]), [_mazes_of(config[name]) for name in ("mazes", "eval_mazes")]
        words = {name: str(config[name]) for name in ("robot", "preset", "engine", "method")}
        baseline = None
        if words["method"] not in TRANSFORMERS:
            baseline = from_json(get_baseline(words["method"]).Config, config["baseline"], "baseline")
        robot = find_robot(words["robot"]).name
        return Run(
            folder=folder, settings=settings, mazes=mazes[0], eval_mazes=mazes[1], seed=int(config["seed"]),
            baseline=baseline, **words | {"robot": robot},
        )  # fmt: skip
    except (UserError, KeyError, TypeError, ValueError) as bad:
        reason = str(bad) if isinstance(bad, UserError) else f"{type(bad).__name__}: {bad}"
        raise UserError(f"{file}: not a run's configuration ({reason}); restore it") from None


def _mazes_of(texts: dict[str, str]) -> dict[str, Maze]:
    """The mazes that ``maze_text`` wrote."""
    return {name: make_maze(parse_walls(text, source=name)) for name, text in texts.items()}


def claim(file: Path, inputs: dict[str, Any], what: str) -> dict[str, Any]:
    """Record the inputs of the results in a file's folder; returns the record, with the provenance of the first one.

    Args:
        what: the name of the inputs in the error.

    Raises:
        UserError: the results in the folder have other inputs.
    """
    inputs = json.loads(json.dumps(inputs, default=str))  # tuples become lists, as when the file is read

    def record() -> dict[str, Any]:
        if not file.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, {"of": inputs} | provenance())
        return read_json(file)

    before = devices.first(record)
    if before.get("of") != inputs:
        raise UserError(f"{file.parent}: was made with other {what}; delete it to make it again")
    return before


def _check_same(run: Run, config: Path) -> None:
    before = _EARLIER | read_json(config, hint="restore it, or choose another folder with --out")
    before |= {"settings": _settings_of(config, before.get("settings"))}
    for name, now in identity(run).items():
        found = _difference(name, before.get(name), now)
        if found:
            raise UserError(f"{config}: a run with {found}; choose another folder with --out")


def _settings_of(config: Path, values: Any) -> dict[str, Any]:
    """The settings in a file, which an earlier version may have written, in the current format."""
    try:
        return json.loads(json.dumps(to_dict(from_dict(values))))
    except UserError as bad:
        raise UserError(f"{config}: {bad}; choose another folder with --out") from None


def _difference(name: str, before: Any, now: Any) -> str:
    """A description of the first difference between two values; empty if they are equal."""
    if before == now:
        return ""
    if isinstance(before, dict) and isinstance(now, dict):
        if list(before) != list(now):
            of_version = name.startswith(("settings", "baseline"))
            return f"{name} of another version" if of_version else f"{name} {', '.join(before)}, not {', '.join(now)}"
        return next(found for key in now if (found := _difference(f"{name}.{key}", before[key], now[key])))
    if isinstance(now, str) and "\n" in now:
        return f"another {name}"
    return f"{name} {before}, not {now}"


# ------------------------------------------------------------------------------------------------------ provenance


def provenance() -> dict[str, Any]:
    """Command, commit, date, hardware and versions: what is needed to reproduce a result."""
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
    # Give the path relative to the repository's root, without the folders of this machine.
    inside = program.is_relative_to(Path.cwd())
    return shlex.join(["python", str(program.relative_to(Path.cwd())) if inside else program.name, *sys.argv[1:]])


def _commit() -> str:
    """The commit of this code; "unknown" if its files are not tracked by git.

    It ends with "-dirty" if tracked files are changed. Results of experiments and docs are ignored.
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
    """A description of the devices."""
    found = jax.devices()
    accelerators = "" if found[0].platform == "cpu" else f"{len(found)} x {found[0].device_kind}, "
    hosts = f"{jax.process_count()} processes, each " if jax.process_count() > 1 else ""
    return f"{accelerators}{hosts}{platform.machine()} CPU, {cores()} core{'s' * (cores() > 1)}"


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
