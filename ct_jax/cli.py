"""The command line: ``ct-jax train | evaluate | report | mazes | maps``."""

import contextlib
import functools
import io
import json
import logging
import operator
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import tyro
from tyro.conf import (
    AvoidSubcommands,
    Fixed,
    FlagCreatePairsOff,
    Positional,
    Suppress,
    UseAppendAction,
    arg,
    subcommand,
)

from ct_envs.errors import UserError
from ct_jax import __version__
from ct_jax.runtime.interrupts import Terminated, interruptible
from ct_jax.runtime.terminal import check_stdout, one_line, printable, show_anything

if TYPE_CHECKING:
    from rich.console import Console

    from ct_envs.checked import Checked
    from ct_jax.settings import Settings

PROGRAM = "ct-jax"
BAD_INPUT = 2
INTERRUPTED = 130
ALL_SETTINGS = "--help-all"
_stopped = False  # whether a signal stopped the program

ABOUT = """Robot navigation in unknown mazes: learn from a planner that knows the map, then navigate without a map.

examples:
  ct-jax mazes                                       list the named mazes
  ct-jax train point --preset demo --out runs/demo   train the point robot in minutes; writes a report
  ct-jax evaluate runs/demo --maze unseen-rooms      evaluate the model in a maze that it has never seen
  ct-jax COMMAND --help                              help for one command"""


@dataclass(frozen=True)
class Processes:
    """Options for several processes. Start each of them with the same command and the same folder."""

    cluster: FlagCreatePairsOff[bool] = False
    """Run as one of several processes; JAX detects the others (Slurm, Open MPI, Kubernetes, Cloud TPU)."""
    coordinator: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="(default: none)")] = None
    """Run as one of several processes, with process 0 at this address. Process 0 listens only at this address; the port
    must be free. Anyone who can reach the port can join and disturb the training, so restrict it to hosts that you
    trust."""
    processes: Annotated[int | None, arg(metavar="N", help_behavior_hint="(with --coordinator)")] = None
    """Number of processes."""
    process: Annotated[int | None, arg(metavar="I", help_behavior_hint="(with --coordinator)")] = None
    """Index of this process, from 0."""


@dataclass(frozen=True)
class Train:
    """Train a robot end to end: roadmap, controller, trajectories, transformer, evaluation, report.

    Everything is written to one folder. Ctrl-C is safe at any time: the same command with --resume continues the run.

    examples:
      ct-jax train point --preset demo
      ct-jax train point --preset demo --resume
      ct-jax train point --maze my_floor.txt --maze hall --eval-maze my_other_floor.txt --out runs/mine
      ct-jax train ant --fit.updates 500 --model.width 256 --collect.noise 0.1
      ct-jax train point --method pt-cql --baseline.updates 500

    Every setting of the method is an option. `ct-jax train ROBOT --help-all` lists them with the values of the preset.
    With `--method`, it also lists the settings of that baseline.

    A maze file is plain text: '#' is a wall, '.' is free, and the border is closed. A cell is 4 m wide.
    """

    robot: Annotated[Positional[str], arg(metavar="ROBOT")]
    """Robot to train: point, ant, humanoid or turtlebot3 (it uses PyBullet, and cluttered rooms instead of mazes)."""
    preset: Annotated[str, arg(metavar="demo|cpu|published|paper")] = "cpu"
    """Size of the training: demo (minutes; longer for ant and humanoid), cpu (an hour on two cores; one or two hours
    more if ant or humanoid learn their own controller), published (the published method at the size of cpu) or paper
    (the published size; needs a GPU)."""
    method: Annotated[str, arg(metavar="ct|bc-ct|pt-cql|sac")] = "ct"
    """What to train: ct (the transformer) or a baseline: bc-ct (the transformer without returns), pt-cql (conservative
    Q-learning on the same trajectories), sac (SAC in the whole maze, without planner and trajectories), or one of your
    own."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: runs/ROBOT-PRESET-SEED)")] = None
    """Run folder. With another method than ct, its name is in the default, too: runs/ROBOT-METHOD-PRESET-SEED."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Random seed of the whole run."""
    maze: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME|FILE")] = ()
    """Training maze: a name or a text file. Repeat the option for several mazes. By default antmaze-large, as in the
    paper."""
    eval_maze: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME|FILE")] = ()
    """Unseen maze for the evaluation, in addition to the training mazes. By default antmaze-large-eval, as in the
    paper."""
    random_mazes: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0)")] = None
    """Number of random mazes in which trajectories and recoveries are collected, in addition to the training mazes."""
    controller: Annotated[str | None, arg(metavar="own|zoo|RUN")] = None
    """Low-level controller: own trains a new one (the default, except in the demos of ant and humanoid), zoo uses the
    one that ships with the package, and RUN uses that of another run."""
    engine: Annotated[str, arg(metavar="auto|mjx|mujoco")] = "auto"
    """Physics engine of mazes: auto is mujoco on CPU and mjx on accelerators. On a CPU, mjx is some 30 times slower."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue the run in the folder. Finished stages are skipped."""
    among: Annotated[Processes, arg(name="")] = Processes()
    changes: Suppress[Fixed[tuple[str, ...]]] = ()
    """The options that override settings of the preset, as given."""


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a trained model, or a planner with the model's controller. The seed determines the start-goal pairs.

    examples:
      ct-jax evaluate zoo:point --maze antmaze-large-eval
      ct-jax evaluate runs/demo --maze my_floor.txt --episodes 20
      ct-jax evaluate runs/demo --method explorer --json > explorer.json
      ct-jax evaluate zoo:ant --maze unseen-spiral --episodes 20 --picture spiral.png
      ct-jax evaluate zoo:ant --maze unseen-rooms --episodes 1 --seed 3 --video rooms.mp4
      ct-jax evaluate zoo:turtlebot3 --worlds 20 --pairs 25 --density 1.5 --noise 1
      ct-jax evaluate zoo:point --seed 7 --return-scale 0.75
      ct-jax evaluate runs/point-pt-cql-cpu-0 --method pt-cql
    """

    run: Annotated[Positional[str], arg(metavar="RUN")]
    """Run folder, or a model that ships with the package: zoo:point, zoo:ant, zoo:humanoid or zoo:turtlebot3."""
    maze: Annotated[str | None, arg(metavar="NAME|FILE", help_behavior_hint="(default: antmaze-large)")] = None
    """Maze: a name or a text file."""
    episodes: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 100)")] = None
    """Number of start-goal pairs in the maze."""
    worlds: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 20)")] = None
    """Turtlebot3: number of random rooms."""
    pairs: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 25)")] = None
    """Turtlebot3: number of start-goal pairs in each room."""
    density: Annotated[float | None, arg(metavar="F", help_behavior_hint="(default: 1)")] = None
    """Turtlebot3: density of obstacles, relative to the training rooms."""
    noise: Annotated[float | None, arg(metavar="F", help_behavior_hint="(default: 0)")] = None
    """Turtlebot3: errors of sensors and motion, relative to those of a real robot."""
    horizon: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: by the longest path)")] = None
    """Control steps of an episode. The default is the robot's horizon (1000 for the ant). If the longest path in the
    maze is longer than in the paper's mazes, the default grows in proportion."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the start-goal pairs. All methods get the same pairs."""
    method: Annotated[str, arg(metavar="ct|planner|explorer|BASELINE")] = "ct"
    """ct (the transformer), planner (knows the full map), explorer (maps what it sees, and plans on that map), or the
    baseline that was trained in the run: bc-ct, pt-cql, sac."""
    return_scale: Annotated[float | None, arg(metavar="K", help_behavior_hint="(default: the model's)")] = None
    """The target return is K times the return that the value network predicts. Returns are negative, so K below 1 means
    conditioning on a higher return: faster episodes."""
    engine: Annotated[str | None, arg(metavar="auto|mjx|mujoco", help_behavior_hint="(default: auto)")] = None
    """Physics engine of mazes: auto is mujoco on CPU and mjx on accelerators. On a CPU, mjx is some 30 times slower."""
    picture: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Draw all episodes in the maze: a .png, .svg or .pdf file."""
    video: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Film the first episode in the maze: an .mp4 file."""
    json: FlagCreatePairsOff[bool] = False
    """Print one JSON object, and nothing else, on stdout."""
    among: Annotated[Processes, arg(name="")] = Processes()


@dataclass(frozen=True)
class Report:
    """Write report.html and report.png of a run again, from the files in its folder. The run may be unfinished.

    example:
      ct-jax report runs/demo
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""


@dataclass(frozen=True)
class Mazes:
    """List the named mazes, each with a small picture."""


@dataclass(frozen=True)
class Maps:
    """Look at a map that somebody else made, or convert it to our text or to a map_server map.

    FILE is a map_server YAML, a picture of a floor plan, a MovingAI .map, a nested list (JSON), or our own text.

    examples:
      ct-jax maps show floor.yaml --picture floor.png
      ct-jax maps convert floor.yaml floor.txt --cell-m 0.5 --scale 8
      ct-jax maps convert plan.png plan.yaml --resolution 0.05
    """

    action: Annotated[Positional[Literal["show", "convert"]], arg(metavar="show|convert")]
    """Show what is in a map, or write it to another file."""
    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The map."""
    out: Annotated[Positional[Path | None], arg(metavar="[OUT]", help_behavior_hint="(with convert)")] = None
    """File to write: .txt for our text, or .yaml for map_server, with a .pgm beside it."""
    resolution: Annotated[float | None, arg(metavar="M", help_behavior_hint="(default: as the file says)")] = None
    """Side of a cell or pixel [m], for a file that does not say."""
    cell_m: Annotated[float | None, arg(metavar="M", help_behavior_hint="(default: as they are)")] = None
    """Bring the map to cells of this side [m]. A cell is free only if all of it is free."""
    scale: Annotated[float, arg(metavar="F")] = 1.0
    """Make all lengths so many times as long, after that: a building becomes a maze for larger robots."""
    radius_m: Annotated[float | None, arg(metavar="M", help_behavior_hint="(default: any)")] = None
    """Refuse a map that has no free space for a robot of this radius [m]."""
    picture: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Draw the map: a .png file."""


COMMANDS = {"train": Train, "evaluate": Evaluate, "report": Report, "mazes": Mazes, "maps": Maps}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 2 for bad input, 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    return guarded(lambda: _run(arguments), go_on=_how_to_go_on(arguments))


def guarded(action: Callable[[], None], *, go_on: str = "the same command continues") -> int:
    """Run an action and return the exit status. An error becomes one line on stderr.

    Args:
        go_on: the message after Ctrl-C: how to continue.
    """
    global _stopped
    _stopped = False
    show_anything()
    go_on = printable(go_on)
    try:
        with interruptible(f"stopped; {go_on}"):
            action()
            sys.stdout.flush()
        return 0
    except UserError as bad:
        return _fail(bad)
    except BrokenPipeError:  # the reader of our output has closed the pipe
        _close_stdout()
        return 0
    except OSError as bad:  # a full disk, no permission, ...
        _close_stdout()
        where = f"{bad.filename}: " if bad.filename else ""
        return _fail(f"{where}{bad.strerror or bad}; make room or choose another place; finished work is kept")
    except KeyboardInterrupt as stop:
        _stopped = True
        _say(f"stopped; {go_on}")
        return 0 if isinstance(stop, Terminated) else INTERRUPTED


def _close_stdout() -> None:
    """Discard the buffer of stdout if it cannot be written. Otherwise Python would try again at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout.flush()


def leave(status: int) -> NoReturn:
    """End the program. An interrupted program ends at once: XLA may still run a program that calls Python, and the two
    would wait for each other forever."""
    if not _stopped:
        sys.exit(status)
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def entry() -> NoReturn:
    """Entry point of ``ct-jax``."""
    leave(main())


def _run(arguments: list[str]) -> None:
    if arguments[:1] == ["--version"]:
        print(f"{PROGRAM} {__version__}")
        return
    command = _parse([argument for argument in arguments if argument != ALL_SETTINGS])
    if ALL_SETTINGS in arguments:
        return _print_settings(command)
    {Train: _train, Evaluate: _evaluate, Report: _report, Mazes: _mazes, Maps: _maps}[type(command)](command)


def _fail(reason: Any) -> int:
    _say(f"error: {one_line(reason)}")
    return BAD_INPUT


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # an error of stderr itself cannot be reported
        print(text, file=sys.stderr, flush=True)


def _how_to_go_on(arguments: list[str]) -> str:
    if arguments[:1] != ["train"]:
        return "run it again"
    again = arguments if "--resume" in arguments else [*arguments, "--resume"]
    return f"finished work is kept; continue with: {shlex.join([PROGRAM, *again])}"


# --------------------------------------------------------------------------------------------------------- parsing


def _parse(arguments: list[str]) -> Train | Evaluate | Report | Mazes | Maps:
    """Parse the command line with tyro. Raises UserError with a text of one line."""
    chosen = arguments[0] if arguments else ""

    def brief(kind: type) -> str | None:
        return None if chosen in COMMANDS else (kind.__doc__ or "").partition("\n")[0]

    commands = [Annotated[kind, subcommand(name, description=brief(kind))] for name, kind in COMMANDS.items()]
    choice: Any = functools.reduce(operator.or_, commands)

    def parse() -> Any:
        if chosen != "train":
            return tyro.cli(choice, prog=PROGRAM, description=ABOUT, args=arguments)
        # An option that ``Train`` does not know may be a setting of the method. Its default comes from the preset.
        command, changes = tyro.cli(choice, prog=PROGRAM, description=ABOUT, args=arguments, return_unknown_args=True)
        return replace(command, changes=tuple(changes))

    return _in_one_line(parse, f"{PROGRAM} {chosen} --help" if chosen in COMMANDS else f"{PROGRAM} --help")


def _in_one_line(parse: Callable[[], Any], see: str) -> Any:
    """Call a tyro parser. Raises UserError with tyro's error in one line, and with the help command ``see``."""
    said = io.TextIOWrapper(io.BytesIO(), "utf-8", "surrogateescape")
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), _unwrapped():
            return parse()
    except SystemExit as stop:
        if not stop.code:
            with contextlib.suppress(SystemExit):
                parse()  # parse again, to print the help on the real stdout
            sys.stdout.flush()
            raise
        said.seek(0)
        raise UserError(f"{_reason(said.read())}; see {see}") from None


def _settings_of(command: Train, *more: str) -> tuple["Settings", "Checked | None"]:
    """The settings of the preset and those of the method's baseline, if it is one, with the options in their place.

    Raises:
        UserError: the robot, the preset or the method is unknown, or an option is wrong.
    """
    from ct_jax.baselines import TRANSFORMERS, check_method, get_baseline
    from ct_jax.configs import find_robot, get_preset
    from ct_jax.settings import Settings

    check_method(command.method)
    settings = get_preset(command.preset, command.robot)
    settings = replace(settings, model=replace(settings.model, **TRANSFORMERS.get(command.method, {})))
    if command.method in TRANSFORMERS:
        return _changed(AvoidSubcommands[Settings], settings, command, *more), None
    baseline = get_baseline(command.method)
    # The defaults of the baseline depend on the settings, so these are parsed first, and then all together.
    settings, _ = _changed(AvoidSubcommands[Settings], settings, command, return_unknown_args=True)
    config = baseline.config_for(settings, find_robot(command.robot))
    together = make_dataclass(
        "Together", [("settings", Annotated[Settings, arg(name="")]), ("baseline", baseline.Config)], frozen=True
    )
    found = _changed(AvoidSubcommands[together], together(settings, config), command, *more)
    return found.settings, found.baseline


def _changed(kind: Any, default: Any, command: Train, *more: str, **how: Any) -> Any:
    """What ``default`` becomes with the options of the command line. Raises UserError in one line."""
    method = "" if command.method == "ct" else f" --method {command.method}"

    def parse() -> Any:
        return tyro.cli(
            kind,
            prog=f"{PROGRAM} train {command.robot} --preset {command.preset}{method}",
            description="All settings, with the values of the preset.",
            default=default,
            args=[*command.changes, *more],
            **how,
        )

    return _in_one_line(parse, f"{PROGRAM} train --help and {PROGRAM} train {command.robot}{method} {ALL_SETTINGS}")


def _print_settings(command: Any) -> None:
    """Print the list of ``--help-all``."""
    if not isinstance(command, Train):
        raise UserError(f"{ALL_SETTINGS} is for: {PROGRAM} train ROBOT {ALL_SETTINGS}")
    import ct_envs.quiet  # noqa: F401

    with contextlib.suppress(SystemExit):
        _settings_of(command, "--help")


@contextlib.contextmanager
def _unwrapped() -> Iterator[None]:
    """A context in which no library wraps lines at the width of the terminal."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _reason(text: str) -> str:
    """The message in tyro's error box, in one line."""
    gist = " ".join(re.sub(r"^╭.*╮$|[╰╯│─]", " ", text, flags=re.MULTILINE).split())
    gist = re.sub(r"(Argument helptext|For full helptext|Perhaps you meant|Available subcommands).*", "", gist)
    gist = re.sub(r"Missing from [\w -]+:", "missing:", gist).replace(" (required)", "")
    gist = re.sub(r"Expected one of {(.*)}\.", r"give a command: \1", gist)
    gist = re.sub(r"invalid literal for int\(\) with base 10: (.*)", r"\1 is not a whole number", gist.strip())
    gist = re.sub(r"could not convert string to float: (.*)", r"\1 is not a number", gist)
    gist = re.sub(r"no type matching .*<class '(?:int|float|str)'>: ", "", gist)  # for an option that may be None
    gist = gist.replace("Unrecognized options:", "unknown:").replace("Error parsing ", "").strip(" .")
    return gist or "invalid arguments"


# -------------------------------------------------------------------------------------------------------- commands


def prepare_jax(among: Processes = Processes()) -> None:
    """Configure JAX: one CPU device per core, exact float32 products, the cache of compiled programs, and several
    processes if ``among`` says so."""
    _import_jax()
    import jax

    import ct_envs.quiet  # noqa: F401
    import ct_jax.pipeline  # noqa: F401
    from ct_jax.runtime import devices
    from ct_jax.runtime.compilation import keep_programs
    from ct_jax.runtime.run import cores

    devices.check_flags()
    logging.getLogger("absl").setLevel(logging.CRITICAL)  # Orbax logs hundreds of lines about errors it also raises
    # Training shards its batches over devices, because XLA's own threads leave much of a second core idle.
    os.environ.setdefault("XLA_FLAGS", f"--xla_force_host_platform_device_count={min(cores(), 8)}")
    jax.config.update("jax_default_matmul_precision", "highest")  # TF32 hurts physics and learning
    keep_programs()
    if among != Processes():
        devices.start(among.coordinator, among.processes, among.process)
    devices.start_backend()
    # XLA logs a page of warnings for each program from the cache. Real failures raise an exception as well.
    jax.config.update("jax_logging_level", "CRITICAL")


def _import_jax() -> None:
    """Import JAX. Raises UserError if JAX rejects its environment variables or cannot be loaded."""
    try:
        import jax  # noqa: F401
    except Exception as bad:
        raise UserError(f"JAX cannot be loaded ({bad}); correct the variable, or reinstall JAX") from None


def _train(command: Train) -> None:
    from ct_jax.configs import find_robot

    if find_robot(command.robot).simulator == "pybullet":
        _check_in_rooms(command)  # before what takes seconds
    _check_processes(command.among)
    check_stdout()
    prepare_jax(command.among)
    from ct_envs.physics import check_engine
    from ct_jax import pipeline
    from ct_jax.model import load_controller
    from ct_jax.runtime.devices import is_first
    from ct_jax.runtime.run import Run, default_mazes, load_mazes

    seen, unseen = default_mazes(command.robot)
    check_engine(command.engine)
    pipeline.check_seed(command.seed)
    settings, baseline = _settings_of(command)
    if command.controller is not None:
        settings = replace(settings, controller=command.controller)
    if command.random_mazes is not None:
        settings = replace(settings, random_mazes=_checked_count(command.random_mazes))
    if settings.controller != "own":
        load_controller(settings.controller, command.robot)  # check it before the run folder is made
    run = Run(
        folder=command.out or Path("runs") / "-".join(_folder_words(command)),
        robot=command.robot,
        preset=command.preset,
        settings=settings,
        mazes=load_mazes(command.maze or seen),
        eval_mazes=load_mazes(command.eval_maze or unseen),
        seed=command.seed,
        engine=command.engine,
        method=command.method,
        baseline=baseline,
    )
    report = pipeline.train(run, resume=command.resume)
    if is_first():
        print_rows(pipeline.results(run.folder))
        print(f"model:  {printable(run.trained)}\nreport: {printable(report)}")


def _folder_words(command: Train) -> list[str]:
    """The parts of the default folder's name."""
    method = [] if command.method == "ct" else [command.method]
    return [command.robot, *method, command.preset, str(command.seed)]


def _checked_count(mazes: int) -> int:
    """The number of random mazes. Raises UserError if it is out of range."""
    from ct_jax.settings import MAX_RANDOM_MAZES

    if not 0 <= mazes <= MAX_RANDOM_MAZES:
        raise UserError(f"--random-mazes {mazes}: give a number from 0 to {MAX_RANDOM_MAZES}")
    return mazes


def _check_processes(among: Processes) -> None:
    """Raise UserError if the options for several processes are incomplete or contradict each other."""
    named = (among.coordinator, among.processes, among.process)
    if among.cluster:
        if any(value is not None for value in named):
            raise UserError("--cluster detects all processes; leave out --coordinator, --processes and --process")
        return
    if all(value is None for value in named):
        return
    if None in named:
        raise UserError("--coordinator HOST:PORT, --processes N and --process I belong together; give all three")
    assert among.coordinator is not None and among.processes is not None and among.process is not None
    host, _, port = among.coordinator.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16 or (":" in host and host[0] + host[-1] != "[]"):
        raise UserError(f"--coordinator {among.coordinator}: give HOST:PORT, such as 10.0.0.1:1234 or [fd00::1]:1234")
    if among.processes < 1:
        raise UserError(f"--processes {among.processes}: give 1 or more")
    if not 0 <= among.process < among.processes:
        raise UserError(f"--process {among.process}: give a number from 0 to {among.processes - 1}")


def _check_in_rooms(command: Train) -> None:
    """Raise UserError for options that do not apply to rooms, or if PyBullet is not installed."""
    from ct_envs.turtlebot3 import load_pybullet

    defaults = {"maze": (), "eval_maze": (), "random_mazes": None, "controller": None, "engine": "auto"}
    for name, default in defaults.items():
        if getattr(command, name) != default:
            option = name.replace("_", "-")
            raise UserError(f"--{option} is not for the {command.robot}, which drives in random rooms; leave it out")
    load_pybullet()


def _evaluate(command: Evaluate) -> None:
    _check_processes(command.among)
    check_stdout()
    with _stdout_to_stderr() if command.json else _stdout_as_it_is() as to_stdout:
        prepare_jax(command.among)
        from ct_jax import pipeline
        from ct_jax.runtime.devices import is_first

        names = ("maze", "episodes", "horizon", "engine", "worlds", "pairs", "density", "noise")
        names += ("return_scale", "picture", "video")
        given = {name: value for name in names if (value := getattr(command, name)) is not None}

        def keep(row: Row) -> None:
            if is_first():
                with to_stdout():
                    _print_row(row, as_json=command.json)

        pipeline.evaluate_model(command.run, method=command.method, seed=command.seed, keep=keep, **given)


def _print_row(row: "Row", *, as_json: bool) -> None:
    """Print a row at once. If stdout cannot be written, print it on stderr, so that a long evaluation is not lost."""
    try:
        if as_json:
            print(json.dumps(row))
        else:
            print_rows([row])
        sys.stdout.flush()
    except BrokenPipeError:  # go on: a picture may still have to be drawn
        _close_stdout()
    except OSError:
        _say(json.dumps(row))
        raise


ToStdout = Callable[[], contextlib.AbstractContextManager[None]]


@contextlib.contextmanager
def _stdout_as_it_is() -> Iterator[ToStdout]:
    yield contextlib.nullcontext


@contextlib.contextmanager
def _stdout_to_stderr() -> Iterator[ToStdout]:
    """A context in which all output of libraries, C code included, goes to stderr.

    It yields a second context, for our own output: inside it, stdout is the real stdout.
    """

    @contextlib.contextmanager
    def switched(to: int) -> Iterator[None]:
        sys.stdout.flush()
        before = os.dup(1)
        os.dup2(to, 1)
        try:
            yield
            sys.stdout.flush()
        finally:
            os.dup2(before, 1)
            os.close(before)

    kept = os.dup(1)
    try:
        with switched(2):
            yield lambda: switched(kept)
    finally:
        os.close(kept)


def _report(command: Report) -> None:
    _import_jax()
    from ct_jax.report import write_report

    print(printable(write_report(command.run)))


def _console(width: int | None = None) -> "Console":
    from rich.console import Console

    class Ours(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # ``guarded`` handles it; rich would end the program with status 1

    return Ours(width=width, markup=False, emoji=False, highlight=False)


def _mazes(command: Mazes) -> None:
    _import_jax()
    from rich.columns import Columns
    from rich.panel import Panel

    from ct_envs.maze import draw_walls, load_walls, maze_names

    def picture(name: str) -> Panel:
        text = draw_walls(load_walls(name)).replace("#", "██").replace(".", "  ")
        return Panel(text, title=name, expand=False)

    _console().print(Columns([picture(name) for name in maze_names()]))


def _maps(command: Maps) -> None:
    if (command.action == "convert") != (command.out is not None):
        raise UserError("give OUT with convert, and only there: ct-jax maps convert FILE OUT")
    if command.picture is not None and command.picture.suffix.lower() != ".png":
        raise UserError(f"--picture {command.picture}: give a .png file")
    check_stdout()
    _import_jax()
    from ct_envs import maps
    from ct_jax.runtime.files import check_writable, whole

    found = maps.read_map(command.file, cell_m=command.resolution)
    found = found if command.cell_m is None else found.with_cells(command.cell_m)
    found = found if command.scale == 1 else found.scaled(command.scale)
    for note in found.notes:
        _say(f"note: {one_line(note)}")
    if command.radius_m is not None:
        found.check_room(command.radius_m)
    files = {} if command.out is None else maps.converted(found, command.out)
    files |= {} if command.picture is None else {command.picture: maps.png_of(found)}
    check_writable(*files)
    for file, content in files.items():
        with whole(file) as opened:
            opened.write(content)
    for line in maps.in_words(found):
        print(printable(line))
    print(maps.small_picture(found) if command.out is None else f"written: {', '.join(map(printable, files))}")


# ----------------------------------------------------------------------------------------------------------- table

Row = dict[str, Any]
_COLUMNS: dict[str, Callable[[Row], str]] = {
    "maze": lambda row: f"{row['maze']}{' (seen)' if row.get('seen') else ''}",
    "method": lambda row: row["method"],
    "success %": lambda row: f"{100 * row['success_rate']:.0f}",
    "95 %": lambda row: "-".join(f"{100 * end:.0f}" for end in row["success_ci95"]),
    "SPL": lambda row: f"{row['spl']:.2f}",
    "return / 100": lambda row: f"{row['return_scaled']:.1f}",
    "collided %": lambda row: f"{100 * row['collision_rate']:.0f}",
    "fell %": lambda row: f"{100 * row.get('fall_rate', 0.0):.0f}",
    "diverged %": lambda row: f"{100 * row['diverged_rate']:.0f}" if row.get("diverged_rate") else "",
    "frontal %": lambda row: f"{100 * row['frontal_rate']:.0f}" if "frontal_rate" in row else "",
    "steps": lambda row: f"{row['steps_mean']:.0f}",
}


def print_rows(rows: list[Row]) -> None:
    """Print results as a table."""
    from rich.table import Table

    table = Table(box=None, header_style="bold")
    columns = {name: show for name, show in _COLUMNS.items() if any(map(show, rows))}
    for name in columns:
        table.add_column(name, justify="left" if name in ("maze", "method") else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(printable(show(row)) for show in columns.values()))
    console = _console(width=None if sys.stdout.isatty() else 120)
    console.print(table)
    for row in rows:
        for note in _notes(row):
            console.print(printable(f"{row['maze']}, {row['method']}: {note}"), style="dim", soft_wrap=True)


def _notes(row: Row) -> Iterator[str]:
    """Notes on a row that its numbers do not show."""
    if beyond := row.get("beyond_horizon"):
        yield (
            f"{beyond} of {row['episodes']} pairs are too far apart for an episode of {row['horizon']} steps, and "
            "count as failures; increase --horizon"
        )
    if apart := row.get("not_joined"):
        yield f"the roadmap has no path for {apart} of {row['episodes']} pairs, even with the maximum number of samples"
    if straight := row.get("straight_ways"):
        yield f"the shortest path of {straight} of {row['episodes']} pairs is unknown; SPL uses the straight line"


if __name__ == "__main__":
    entry()
