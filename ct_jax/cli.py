"""The command line: ``ct-jax train | evaluate | report | mazes``."""

import contextlib
import io
import json
import os
import re
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ct_envs.errors import UserError

PROGRAM = "ct-jax"
INTERRUPTED = 130


@dataclass(frozen=True)
class Train:
    """Train a robot end to end: roadmap, controller, trajectories, transformer, evaluation, report."""

    robot: tyro.conf.Positional[str]
    """Robot: point."""
    preset: str = "cpu"
    """How much of everything: demo (minutes), cpu (an hour on two cores), paper (the published sizes; wants a GPU)."""
    out: Path | None = None
    """Run folder. Default: runs/ROBOT-PRESET-SEED."""
    seed: int = 0
    """Seed of everything."""
    maze: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Maze to train in, by name or text file; may be repeated. Default: the paper's, antmaze-large."""
    eval_maze: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Unseen maze to evaluate in besides; may be repeated. Default: the paper's, antmaze-large-eval."""
    engine: str = "auto"
    """Physics: auto, mjx or mujoco. auto is mujoco on CPU and mjx on accelerators."""
    resume: bool = False
    """Continue the run in the folder; finished stages are skipped."""


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a trained model, or the planner or the explorer with its controller, on fixed start-goal pairs."""

    run: tyro.conf.Positional[str]
    """Run folder, or zoo:point for the model that ships with the package."""
    maze: str = "antmaze-large"
    """Maze by name or text file."""
    episodes: int = 100
    """Start-goal pairs."""
    seed: int = 0
    """Seed of the pairs; the same for every method."""
    method: str = "ct"
    """ct (the transformer), planner (knows the full map) or explorer (maps what it sees)."""
    engine: str = "auto"
    """Physics: auto, mjx or mujoco."""
    json: bool = False
    """Print one JSON object and nothing else."""


@dataclass(frozen=True)
class Report:
    """Write the report of a run again, from what is on disk."""

    run: tyro.conf.Positional[Path]
    """Run folder."""


@dataclass(frozen=True)
class Mazes:
    """List the named mazes, each with a small picture."""


Command = (
    Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Mazes, tyro.conf.subcommand("mazes")]
)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 2 for bad input, 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        from ct_jax import __version__

        print(f"{PROGRAM} {__version__}")
        return 0
    try:
        command = _parse(arguments)
        _prepare_jax()
        {Train: _train, Evaluate: _evaluate, Report: _report, Mazes: _mazes}[type(command)](command)
        return 0
    except UserError as bad:
        print(f"error: {' '.join(str(bad).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; what is finished is kept, --resume continues", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _parse(arguments: list[str]) -> Train | Evaluate | Report | Mazes:
    """Parse with tyro, but say what is wrong in one line."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(Command, prog=PROGRAM, description=__doc__, args=arguments)  # pyright: ignore
    except SystemExit as stop:
        if not stop.code:
            raise
        text = re.sub(r"[╭╮╰╯─│]+", " ", said.getvalue())
        text = re.sub(r"Parsing error|For full helptext.*", " ", text, flags=re.DOTALL)
        raise UserError(f"{' '.join(text.split()) or 'unusable arguments'}; see {PROGRAM} --help") from None


def _prepare_jax() -> None:
    """Exact float32 products (TF32 hurts physics and learning), and a private cache of compiled programs."""
    with contextlib.redirect_stdout(io.StringIO()):  # brax says that warp, which we do not use, is missing
        import jax

        import ct_jax.pipeline
    jax.config.update("jax_default_matmul_precision", "highest")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ct-jax" / "compiled"
    with contextlib.suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        cache.chmod(0o700)  # compiled programs are code: nobody else may put one here
        jax.config.update("jax_compilation_cache_dir", str(cache))
    signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))


def _train(command: Train) -> None:
    from ct_envs.physics import check_engine
    from ct_jax import pipeline
    from ct_jax.presets import get_preset

    seen, unseen = pipeline.default_mazes(command.robot)
    check_engine(command.engine)
    if command.seed < 0:
        raise UserError(f"--seed {command.seed}: give a number of 0 or more")
    run = pipeline.Run(
        folder=command.out or Path("runs") / f"{command.robot}-{command.preset}-{command.seed}",
        robot=command.robot,
        preset=command.preset,
        settings=get_preset(command.preset),
        mazes=pipeline.load_mazes(command.maze or seen),
        eval_mazes=pipeline.load_mazes(command.eval_maze or unseen),
        seed=command.seed,
        engine=command.engine,
    )
    report = pipeline.train(run, resume=command.resume)
    pipeline.print_table(run.folder)
    print(f"model:  {run.folder / 'model'}\nreport: {report}")


def _evaluate(command: Evaluate) -> None:
    from ct_jax import pipeline

    row = pipeline.evaluate_model(
        command.run,
        command.maze,
        episodes=command.episodes,
        seed=command.seed,
        method=command.method,
        engine=command.engine,
    )
    if command.json:
        print(json.dumps(row))
    else:
        pipeline.print_rows([row])


def _report(command: Report) -> None:
    from ct_jax.report import write_report

    print(write_report(command.run))


def _mazes(command: Mazes) -> None:
    from rich.columns import Columns
    from rich.console import Console
    from rich.panel import Panel

    from ct_envs.maze import draw_walls, load_walls, maze_names

    def picture(name: str) -> Panel:
        text = draw_walls(load_walls(name)).replace("#", "██").replace(".", "  ")
        return Panel(text, title=name, expand=False)

    Console().print(Columns([picture(name) for name in maze_names()]))


if __name__ == "__main__":
    sys.exit(main())
