"""The command line: ``ct-jax train | evaluate | report | mazes``."""

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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

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
from ct_jax.interrupts import Terminated, interruptible
from ct_jax.terminal import check_stdout, one_line, printable, show_anything

if TYPE_CHECKING:
    from rich.console import Console

    from ct_jax.settings import Settings

PROGRAM = "ct-jax"
BAD_INPUT = 2
INTERRUPTED = 130
ALL_SETTINGS = "--help-all"
_stopped = False  # by a signal

ABOUT = """Robot navigation in unknown mazes: learn from a planner that knows the map, then cross mazes without one.

examples:
  ct-jax mazes                                       which mazes there are
  ct-jax train point --preset demo --out runs/demo   train the point robot in minutes; writes a report
  ct-jax evaluate runs/demo --maze unseen-rooms      try the result in a maze it has never seen
  ct-jax COMMAND --help                              more on a command"""


@dataclass(frozen=True)
class Processes:
    """Several processes, each started with the same command and the same folder."""

    cluster: FlagCreatePairsOff[bool] = False
    """This is one of several processes; JAX finds the others (Slurm, Open MPI, Kubernetes, Cloud TPU)."""
    coordinator: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="(default: none)")] = None
    """This is one of several processes; the address of the first, which listens there and nowhere else, with any port
    that is free there. Whoever reaches the port can join and disturb the training: keep it to hosts that you trust."""
    processes: Annotated[int | None, arg(metavar="N", help_behavior_hint="(with --coordinator)")] = None
    """How many there are."""
    process: Annotated[int | None, arg(metavar="I", help_behavior_hint="(with --coordinator)")] = None
    """Which of them this is, from 0."""


@dataclass(frozen=True)
class Train:
    """Train a robot end to end: roadmap, controller, trajectories, transformer, evaluation, report.

    Everything goes into one folder. Ctrl-C is safe at any moment: the same command with --resume goes on.

    examples:
      ct-jax train point --preset demo
      ct-jax train point --preset demo --resume
      ct-jax train point --maze my_floor.txt --maze hall --eval-maze my_other_floor.txt --out runs/mine
      ct-jax train ant --fit.updates 500 --model.width 256 --collect.noise 0.1

    Every setting of the method can be given after ROBOT; --help-all lists them, with the values of the preset.

    A maze file is plain text, '#' for a wall and '.' for free, closed all around; a cell is 4 m wide.
    """

    robot: Annotated[Positional[str], arg(metavar="ROBOT")]
    """Robot to train: point, ant, humanoid or turtlebot3 (in PyBullet, in cluttered rooms instead of mazes)."""
    preset: Annotated[str, arg(metavar="demo|cpu|published|paper")] = "cpu"
    """How much of everything: demo (minutes; walkers take longer), cpu (an hour on two cores, and one or two more for a
    controller of one's own that walks), published (the bare method at that size) or paper (the published sizes; wants a
    GPU)."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: runs/ROBOT-PRESET-SEED)")] = None
    """Run folder."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of everything."""
    maze: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME|FILE")] = ()
    """Maze to train in, by name or text file. By default the paper's, antmaze-large."""
    eval_maze: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME|FILE")] = ()
    """Unseen maze to evaluate in besides. By default the paper's, antmaze-large-eval."""
    random_mazes: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0)")] = None
    """Collect trajectories and recoveries in so many random mazes besides."""
    controller: Annotated[str | None, arg(metavar="own|zoo|RUN")] = None
    """Low-level controller: learn one's own (by default; walkers' demos take zoo), take the one that ships with the
    package, or that of another run."""
    engine: Annotated[str, arg(metavar="auto|mjx|mujoco")] = "auto"
    """Physics of mazes; auto is mujoco on CPU and mjx on accelerators. On a CPU, mjx is some 30 times slower."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue the run in the folder: finished stages are skipped."""
    among: Annotated[Processes, arg(name="")] = Processes()
    changes: Suppress[Fixed[tuple[str, ...]]] = ()
    """Settings in place of the preset's, as they were given."""


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a trained model, or a planner with its controller, on start-goal pairs that depend on the seed only.

    examples:
      ct-jax evaluate zoo:point --maze antmaze-large-eval
      ct-jax evaluate runs/demo --maze my_floor.txt --episodes 20
      ct-jax evaluate runs/demo --method explorer --json > explorer.json
      ct-jax evaluate zoo:ant --maze unseen-spiral --episodes 20 --picture spiral.png
      ct-jax evaluate zoo:ant --maze unseen-rooms --episodes 1 --seed 3 --video rooms.mp4
      ct-jax evaluate zoo:turtlebot3 --worlds 20 --pairs 25 --density 1.5 --noise 1
      ct-jax evaluate zoo:point --seed 7 --return_scale 0.75
    """

    run: Annotated[Positional[str], arg(metavar="RUN")]
    """Run folder, or a model that ships with the package: zoo:point, zoo:ant, zoo:humanoid or zoo:turtlebot3."""
    maze: Annotated[str | None, arg(metavar="NAME|FILE", help_behavior_hint="(default: antmaze-large)")] = None
    """Maze by name or text file."""
    episodes: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 100)")] = None
    """Start-goal pairs in a maze."""
    worlds: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 20)")] = None
    """Turtlebot3: random rooms."""
    pairs: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 25)")] = None
    """Turtlebot3: start-goal pairs in each room."""
    density: Annotated[float | None, arg(metavar="F", help_behavior_hint="(default: 1)")] = None
    """Turtlebot3: how full the rooms are, 1 as in training."""
    noise: Annotated[float | None, arg(metavar="F", help_behavior_hint="(default: 0)")] = None
    """Turtlebot3: errors of sensors and motion, 1 as on a real robot."""
    horizon: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: by the longest way)")] = None
    """Control steps of an episode. By default the robot's own (1000 for the ant), more in proportion where the longest
    way is longer than in the paper's mazes."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the pairs; the same pairs for every method."""
    method: Annotated[str, arg(metavar="ct|planner|explorer")] = "ct"
    """ct (the transformer), planner (knows the full map) or explorer (maps what it sees)."""
    return_scale: Annotated[float | None, arg(metavar="K", help_behavior_hint="(default: the model's)")] = None
    """The transformer asks for K times the return that the value network predicts; returns are negative, so less than 1
    asks to be quicker."""
    engine: Annotated[str | None, arg(metavar="auto|mjx|mujoco", help_behavior_hint="(default: auto)")] = None
    """Physics of mazes; auto is mujoco on CPU and mjx on accelerators. On a CPU, mjx is some 30 times slower."""
    picture: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Draw all episodes in the maze: a .png, .svg or .pdf file."""
    video: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Film the first episode in the maze: an .mp4 file."""
    json: FlagCreatePairsOff[bool] = False
    """Print one JSON object and nothing else."""
    among: Annotated[Processes, arg(name="")] = Processes()


@dataclass(frozen=True)
class Report:
    """Write report.html and report.png of a run again, from what is on disk; an unfinished run has one, too.

    example:
      ct-jax report runs/demo
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""


@dataclass(frozen=True)
class Mazes:
    """List the named mazes, each with a small picture."""


COMMANDS = {"train": Train, "evaluate": Evaluate, "report": Report, "mazes": Mazes}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 2 for bad input, 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    return guarded(lambda: _run(arguments), go_on=_how_to_go_on(arguments))


def guarded(action: Callable[[], None], *, go_on: str = "the same command continues") -> int:
    """Run something and return its exit status; what goes wrong is told in one line on stderr.

    Args:
        go_on: what a person whose Ctrl-C stopped it should know.
    """
    show_anything()
    go_on = printable(go_on)
    try:
        with interruptible(f"stopped; {go_on}"):
            action()
            sys.stdout.flush()
        return 0
    except UserError as bad:
        return _fail(bad)
    except BrokenPipeError:  # whoever read our output has seen enough
        _close_stdout()
        return 0
    except OSError as bad:  # a full disk, no permission, ...
        _close_stdout()
        where = f"{bad.filename}: " if bad.filename else ""
        return _fail(f"{where}{bad.strerror or bad}; make room or choose another place, what is finished is kept")
    except KeyboardInterrupt as stop:
        global _stopped
        _stopped = True
        _say(f"stopped; {go_on}")
        return 0 if isinstance(stop, Terminated) else INTERRUPTED


def _close_stdout() -> None:
    """Give up on what stdout still holds, if it cannot be written: else Python would try again at its end."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout.flush()


def leave(status: int) -> NoReturn:
    """End the program. One that was interrupted ends at once: XLA may still compute something that calls Python, and
    the two would wait for each other for ever."""
    if not _stopped:
        sys.exit(status)
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def entry() -> NoReturn:
    """The program ``ct-jax``."""
    leave(main())


def _run(arguments: list[str]) -> None:
    if arguments[:1] == ["--version"]:
        print(f"{PROGRAM} {__version__}")
        return
    command = _parse([argument for argument in arguments if argument != ALL_SETTINGS])
    if ALL_SETTINGS in arguments:
        return _print_settings(command)
    {Train: _train, Evaluate: _evaluate, Report: _report, Mazes: _mazes}[type(command)](command)


def _fail(reason: Any) -> int:
    _say(f"error: {one_line(reason)}")
    return BAD_INPUT


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # nobody can be told that stderr cannot be written
        print(text, file=sys.stderr, flush=True)


def _how_to_go_on(arguments: list[str]) -> str:
    if arguments[:1] != ["train"]:
        return "run it again"
    again = arguments if "--resume" in arguments else [*arguments, "--resume"]
    return f"what is finished is kept, continue with: {shlex.join([PROGRAM, *again])}"


# --------------------------------------------------------------------------------------------------------- parsing


def _parse(arguments: list[str]) -> Train | Evaluate | Report | Mazes:
    """Parse with tyro, but say what is wrong in one line."""
    chosen = arguments[0] if arguments else ""

    def brief(kind: type) -> str | None:
        return None if chosen in COMMANDS else (kind.__doc__ or "").partition("\n")[0]

    commands = [Annotated[kind, subcommand(name, description=brief(kind))] for name, kind in COMMANDS.items()]
    choice: Any = functools.reduce(operator.or_, commands)

    def parse() -> Any:
        if chosen != "train":
            return tyro.cli(choice, prog=PROGRAM, description=ABOUT, args=arguments)
        # What ``Train`` does not know may be a setting of the method, whose default the preset says.
        command, changes = tyro.cli(choice, prog=PROGRAM, description=ABOUT, args=arguments, return_unknown_args=True)
        return replace(command, changes=tuple(changes))

    return _in_one_line(parse, f"{PROGRAM} {chosen} --help" if chosen in COMMANDS else f"{PROGRAM} --help")


def _in_one_line(parse: Callable[[], Any], see: str) -> Any:
    """What tyro parses. Raises UserError with what it prints about mistakes, in one line, and the command to see."""
    said = io.TextIOWrapper(io.BytesIO(), "utf-8", "surrogateescape")
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), _unwrapped():
            return parse()
    except SystemExit as stop:
        if not stop.code:
            with contextlib.suppress(SystemExit):
                parse()  # once more, with the help where it belongs
            sys.stdout.flush()
            raise
        said.seek(0)
        raise UserError(f"{_reason(said.read())}; see {see}") from None


def _changed(settings: "Settings", command: Train, *more: str) -> "Settings":
    """The preset's settings with those that were given in their place."""
    from ct_jax.settings import Settings

    def parse() -> Settings:
        return tyro.cli(
            AvoidSubcommands[Settings],
            prog=f"{PROGRAM} train {command.robot} --preset {command.preset}",
            description="Every setting, with the value that the preset gives it.",
            default=settings,
            args=[*command.changes, *more],
        )

    return _in_one_line(parse, f"{PROGRAM} train --help and {PROGRAM} train {command.robot} {ALL_SETTINGS}")


def _print_settings(command: Any) -> None:
    """What ``--help-all`` shows."""
    if not isinstance(command, Train):
        raise UserError(f"{ALL_SETTINGS} is for: {PROGRAM} train ROBOT {ALL_SETTINGS}")
    import ct_envs.quiet  # noqa: F401
    from ct_jax.configs import get_preset

    with contextlib.suppress(SystemExit):
        _changed(get_preset(command.preset, command.robot), command, "--help")


@contextlib.contextmanager
def _unwrapped() -> Iterator[None]:
    """Within, nobody breaks lines for the terminal's width."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _reason(text: str) -> str:
    """The gist of tyro's error box."""
    gist = " ".join(re.sub(r"^╭.*╮$|[╰╯│─]", " ", text, flags=re.MULTILINE).split())
    gist = re.sub(r"(Argument helptext|For full helptext|Perhaps you meant|Available subcommands).*", "", gist)
    gist = re.sub(r"Missing from [\w -]+:", "missing:", gist).replace(" (required)", "")
    gist = re.sub(r"Expected one of {(.*)}\.", r"give a command: \1", gist)
    gist = re.sub(r"invalid literal for int\(\) with base 10: (.*)", r"\1 is no whole number", gist.strip())
    gist = re.sub(r"could not convert string to float: (.*)", r"\1 is no number", gist)
    gist = re.sub(r"no type matching .*<class '(?:int|float|str)'>: ", "", gist)  # of an option that may be left out
    gist = gist.replace("Unrecognized options:", "unknown:").replace("Error parsing ", "").strip(" .")
    return gist or "unusable arguments"


# -------------------------------------------------------------------------------------------------------- commands


def prepare_jax(among: Processes = Processes()) -> None:
    """One CPU device a core, exact float32 products, compiled programs that are kept, and the other processes."""
    _import_jax()
    import jax

    import ct_envs.quiet  # noqa: F401
    import ct_jax.pipeline  # noqa: F401
    from ct_jax import devices
    from ct_jax.compilation import keep_programs
    from ct_jax.run import cores

    devices.check_flags()
    logging.getLogger("absl").setLevel(logging.CRITICAL)  # Orbax logs what it also raises, in hundreds of lines
    # The fits shard their batches over devices; XLA's own threads leave much of a second core idle.
    os.environ.setdefault("XLA_FLAGS", f"--xla_force_host_platform_device_count={min(cores(), 8)}")
    jax.config.update("jax_default_matmul_precision", "highest")  # TF32 hurts physics and learning
    keep_programs()
    if among != Processes():
        devices.start(among.coordinator, among.processes, among.process)
    devices.start_backend()
    # XLA has a page of doubts about each program that it did not compile itself; what fails is raised besides.
    jax.config.update("jax_logging_level", "CRITICAL")


def _import_jax() -> None:
    """Raises UserError where JAX takes offence at its variables, or does not load."""
    try:
        import jax  # noqa: F401
    except Exception as bad:
        raise UserError(f"JAX cannot be loaded ({bad}); correct the variable, or install JAX anew") from None


def _train(command: Train) -> None:
    from ct_jax.configs import find_robot

    if find_robot(command.robot).course == "room":
        _check_in_rooms(command)  # before what takes seconds
    _check_processes(command.among)
    check_stdout()
    prepare_jax(command.among)
    from ct_envs.physics import check_engine
    from ct_jax import pipeline
    from ct_jax.configs import get_preset
    from ct_jax.devices import is_first
    from ct_jax.model import load_controller
    from ct_jax.run import Run, default_mazes, load_mazes

    seen, unseen = default_mazes(command.robot)
    check_engine(command.engine)
    pipeline.check_seed(command.seed)
    settings = _changed(get_preset(command.preset, command.robot), command)
    if command.controller is not None:
        settings = replace(settings, controller=command.controller)
    if command.random_mazes is not None:
        settings = replace(settings, random_mazes=_checked_count(command.random_mazes))
    if settings.controller != "own":
        load_controller(settings.controller, command.robot)  # before a folder is made for it
    run = Run(
        folder=command.out or Path("runs") / f"{command.robot}-{command.preset}-{command.seed}",
        robot=command.robot,
        preset=command.preset,
        settings=settings,
        mazes=load_mazes(command.maze or seen),
        eval_mazes=load_mazes(command.eval_maze or unseen),
        seed=command.seed,
        engine=command.engine,
    )
    report = pipeline.train(run, resume=command.resume)
    if is_first():
        print_rows(pipeline.results(run.folder))
        print(f"model:  {printable(run.folder / 'model')}\nreport: {printable(report)}")


def _checked_count(mazes: int) -> int:
    """Raises UserError for a number of random mazes that means nothing."""
    from ct_jax.settings import MAX_RANDOM_MAZES

    if not 0 <= mazes <= MAX_RANDOM_MAZES:
        raise UserError(f"--random-mazes {mazes}: give a number from 0 to {MAX_RANDOM_MAZES}")
    return mazes


def _check_processes(among: Processes) -> None:
    """Raises UserError unless the options say who this process is."""
    named = (among.coordinator, among.processes, among.process)
    if among.cluster:
        if any(value is not None for value in named):
            raise UserError("--cluster finds the processes by itself; leave out --coordinator, --processes, --process")
        return
    if all(value is None for value in named):
        return
    if None in named:
        raise UserError("--coordinator HOST:PORT, --processes N and --process I go together; give all three")
    assert among.coordinator is not None and among.processes is not None and among.process is not None
    host, _, port = among.coordinator.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16 or (":" in host and host[0] + host[-1] != "[]"):
        raise UserError(f"--coordinator {among.coordinator}: give HOST:PORT, such as 10.0.0.1:1234 or [fd00::1]:1234")
    if among.processes < 1:
        raise UserError(f"--processes {among.processes}: give 1 or more")
    if not 0 <= among.process < among.processes:
        raise UserError(f"--process {among.process}: give a number from 0 to {among.processes - 1}")


def _check_in_rooms(command: Train) -> None:
    """Raises UserError for options that mean nothing in rooms, or where PyBullet is missing."""
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
        from ct_jax.devices import is_first

        names = ("maze", "episodes", "horizon", "engine", "worlds", "pairs", "density", "noise")
        names += ("return_scale", "picture", "video")
        given = {name: value for name in names if (value := getattr(command, name)) is not None}

        def keep(row: Row) -> None:
            if is_first():
                with to_stdout():
                    _print_row(row, as_json=command.json)

        pipeline.evaluate_model(command.run, method=command.method, seed=command.seed, keep=keep, **given)


def _print_row(row: "Row", *, as_json: bool) -> None:
    """Print a row at once, or on stderr if stdout cannot be written: it took long to come by."""
    try:
        if as_json:
            print(json.dumps(row))
        else:
            print_rows([row])
        sys.stdout.flush()
    except BrokenPipeError:  # there may be a picture still to be drawn
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
    """Whatever libraries print, C code included, goes to stderr, but for what is printed within what this yields."""

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
            raise BrokenPipeError  # for ``guarded``; rich would end the program with status 1

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
    """What a reader of a row must know besides its figures."""
    if beyond := row.get("beyond_horizon"):
        yield (
            f"{beyond} of {row['episodes']} pairs are farther apart than the robot goes in an episode of "
            f"{row['horizon']} steps, and count as failures; give it more with --horizon"
        )
    if apart := row.get("not_joined"):
        yield f"the roadmap joins no way for {apart} of {row['episodes']} pairs, although it has all its samples"
    if straight := row.get("straight_ways"):
        yield f"of {straight} of {row['episodes']} pairs no shortest way is known; SPL takes the straight line"


if __name__ == "__main__":
    entry()
