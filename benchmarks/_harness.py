"""What all benchmarks share: contestants timed in turn, a printed table, and ``benchmarks/results/NAME.json``.

Results of an accelerator have a file of their own, ``NAME-gpu.json``. ``python experiments/pages.py`` writes all of
them to ``docs/speed.md``.
"""

import importlib.util
import io
import json
import math
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

import jax
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

import ct_envs.quiet  # noqa: F401
from ct_jax import devices
from ct_jax.cli import guarded, leave
from ct_jax.compilation import keep_programs
from ct_jax.files import prepare_outputs, write_text
from ct_jax.run import provenance

RESULTS = Path(__file__).parent / "results"
PEERS = ("gymnasium-robotics", "ogbench", "ompl", "stable-baselines3", "torch", "transformers")
_WIDTH = 116
_FEWEST = 2  # rounds of a race
COMMIT = "BENCH_COMMIT"  # variable in which ``make bench`` names the commit: new results are no change of the code


@dataclass(frozen=True)
class Options:
    """What all benchmarks can be asked."""

    full: bool = False
    """The long sweeps, too."""
    repeat: int = 7
    """Rounds, in each of which every contestant has its turn."""
    limit_s: float = 4.0
    """Time after which a race ends with fewer rounds than that, but at least two (--full: none)."""
    write: bool = True
    """Keep the results; without it they are only printed."""


@dataclass(frozen=True)
class Contestant:
    """Something to be timed."""

    run: Callable[[], object]
    work: float = 1.0  # of one call, in the unit that is counted
    compiles: bool = True  # at its first call, which is a warm-up then


def has_peer(module: str, name: str) -> bool:
    """Whether a peer is installed; says so where it is not."""
    there = importlib.util.find_spec(module) is not None
    if not there:
        print(f"{name} is not installed, so it is not measured: pip install -e '.[bench]'")
    return there


def time_together(*contestants: Contestant, repeat: int, limit_s: float = math.inf) -> list[list[float]]:
    """Seconds of each, taken in turn (A B C A B C ...) after one warm-up, so that a drifting machine hurts none.

    No further round begins after ``limit_s``, once there have been two.
    """
    for each in contestants:
        if each.compiles:
            jax.block_until_ready(each.run())
    rounds: list[list[float]] = []
    while len(rounds) < repeat and (len(rounds) < _FEWEST or sum(map(sum, rounds)) < limit_s):
        taken = []
        for each in contestants:
            begun = time.perf_counter()
            jax.block_until_ready(each.run())
            taken.append(time.perf_counter() - begun)
        rounds.append(taken)
    return [list(times) for times in zip(*rounds, strict=True)]


_FIGURES: dict[str, Callable[[float, float], float]] = {
    "ms": lambda seconds, work: 1000.0 * seconds / work,
    "µs": lambda seconds, work: 1e6 * seconds / work,
    "s": lambda seconds, work: seconds / work,
}


def _spread(values: list[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "min": min(values), "max": max(values)}


def command_line(main: Callable[[Any], None], options: type[Options], docstring: str | None) -> NoReturn:
    """Run a benchmark from the command line, and end the program."""

    def run() -> None:
        chosen = tyro.cli(options, description=docstring)
        devices.check_flags()
        devices.start_backend()
        main(chosen)

    leave(guarded(run))


class Results:
    """Rows of one benchmark, ``file``."""

    def __init__(self, file: str, options: Options):
        self.options = options
        self.file = RESULTS / f"{Path(file).stem}{'' if jax.default_backend() == 'cpu' else '-gpu'}.json"
        if options.write:
            prepare_outputs(self.file)
        self._rows: list[dict[str, Any]] = []
        self._made = provenance()  # before anything is written
        self._made["commit"] = os.environ.get(COMMIT) or self._made["commit"]
        keep_programs()  # what several rows share is compiled once

    def add(
        self, name: str, unit: str, values: list[float], *, against: str = "", other: list[float] | None = None,
        ratios: list[float] | None = None, asked: float | None = None,
    ) -> None:  # fmt: skip
        """One figure: all its values; what it stands against with its values, pair by pair the ratio, and the least
        ratio that is asked for."""
        spread = _spread(values)
        row = {"name": name, "value": spread.pop("median"), "unit": unit} | spread | {"against": against}
        row |= {"other": statistics.median(other) if other else None, "ratio": _spread(ratios) if ratios else None}
        self._rows.append(row | {"asked": asked})

    def race(
        self, name: str, unit: str, ours: Contestant, others: dict[str, Contestant] | None = None, *,
        asked: dict[str, float] | None = None,
    ) -> list[float]:  # fmt: skip
        """Time ours and all others together: a row for each other, with how many times as fast as it ours is.

        Args:
            unit: "ms", "µs" or "s" for a unit of work, or of work in a second ("steps/s").
            asked: the least such ratio, by the other's name.

        Returns:
            Our seconds.
        """
        others, asked = others or {}, asked or {}
        figure = _FIGURES.get(unit, lambda seconds, work: work / seconds)
        every = [ours, *others.values()]
        limit_s = math.inf if self.options.full else self.options.limit_s
        times = time_together(*every, repeat=self.options.repeat, limit_s=limit_s)
        values = [[figure(t, each.work) for t in taken] for each, taken in zip(every, times, strict=True)]
        for (label, rival), taken, other in zip(others.items(), times[1:], values[1:], strict=True):
            speeds = [(ours.work / a) / (rival.work / b) for a, b in zip(times[0], taken, strict=True)]
            self.add(name, unit, values[0], against=label, other=other, ratios=speeds, asked=asked.get(label))
        if not others:
            self.add(name, unit, values[0])
        print(f"{name}: {statistics.median(values[0]):.4g} {unit}", flush=True)
        return times[0]

    def finish(self) -> None:
        """Print the table, and keep the results."""
        self._made["versions"] |= {name: metadata.version(name) for name in PEERS if _installed(name)}
        rows = [row | {"made": self._made} for row in self._rows]
        print(table_of(rows))
        if self.options.write:
            write_text(self.file, json.dumps(rows, indent=1) + "\n")
            print(f"results: {self.file}\npage:    python experiments/pages.py writes it to docs/speed.md")


def _installed(name: str) -> bool:
    try:
        return bool(metadata.version(name))
    except metadata.PackageNotFoundError:
        return False


def _number(value: float) -> str:
    return f"{value:,.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def table_of(rows: list[dict[str, Any]]) -> str:
    """Results as a heading and a table in plain text."""
    made = rows[0]["made"]
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items())
    table = Table(box=box.MARKDOWN)
    for column in ("what", "median (min-max)", "unit", "against", "its", "times (min-max)", "asked"):
        table.add_column(column)
    for row in rows:
        ratio, optional = row["ratio"], lambda value: "" if value is None else _number(value)
        figures = f"{_number(row['value'])} ({_number(row['min'])}-{_number(row['max'])})"
        times = f"{ratio['median']:.2f} ({ratio['min']:.2f}-{ratio['max']:.2f})" if ratio else ""
        table.add_row(
            row["name"], figures, row["unit"], row["against"], optional(row["other"]), times, optional(row["asked"])
        )
    console = Console(width=_WIDTH, file=io.StringIO(), color_system=None)
    console.print(f"{made['created'][:10]}, commit {made['commit']}, {made['hardware']}: {versions}\n", highlight=False)
    console.print(table)
    return "\n".join(line.rstrip() for line in console.file.getvalue().splitlines()).strip()  # pyright: ignore
