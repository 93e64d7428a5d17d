"""The common part of all benchmarks: timing contestants in turn, a printed table, and ``benchmarks/results/NAME.json``.

Results of an accelerator are in a separate file, ``NAME-gpu.json``. ``python experiments/pages.py`` writes all results
to ``docs/speed.md``.
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
from ct_jax.cli import guarded, leave
from ct_jax.runtime import devices
from ct_jax.runtime.compilation import keep_programs
from ct_jax.runtime.files import prepare_outputs, write_text
from ct_jax.runtime.run import provenance

RESULTS = Path(__file__).parent / "results"
PEERS = ("gymnasium-robotics", "ogbench", "ompl", "stable-baselines3", "torch", "transformers")
_WIDTH = 116
_FEWEST = 2  # minimum number of rounds
COMMIT = "BENCH_COMMIT"  # ``make bench`` sets this variable to the commit, because new results would make it "dirty"


@dataclass(frozen=True)
class Options:
    """Options of all benchmarks."""

    full: bool = False
    """Also run the long sweeps."""
    repeat: int = 7
    """Number of rounds. Each round runs every contestant once."""
    limit_s: float = 4.0
    """Time limit for the rounds [s]. At least two rounds are run. --full has no limit."""
    write: bool = True
    """Write the results to a file. Otherwise they are only printed."""


@dataclass(frozen=True)
class Contestant:
    """A function to be timed."""

    run: Callable[[], object]
    work: float = 1.0  # amount of work per call, in the unit of the benchmark
    compiles: bool = True  # whether the first call compiles; it is then called once before the timing


def has_peer(module: str, name: str) -> bool:
    """Whether a peer is installed. Prints a note if it is not."""
    there = importlib.util.find_spec(module) is not None
    if not there:
        print(f"{name} is not installed, so it is not measured: pip install -e '.[bench]'")
    return there


def time_together(*contestants: Contestant, repeat: int, limit_s: float = math.inf) -> list[list[float]]:
    """Times [s] of each contestant, measured in turn (A B C A B C ...), so that a slow phase affects all.

    After two rounds, no further round starts once ``limit_s`` is reached.
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
    """Run a benchmark from the command line, and exit."""

    def run() -> None:
        chosen = tyro.cli(options, description=docstring)
        devices.check_flags()
        devices.start_backend()
        main(chosen)

    leave(guarded(run))


class Results:
    """The rows of one benchmark script, ``file``."""

    def __init__(self, file: str, options: Options):
        self.options = options
        self.file = RESULTS / f"{Path(file).stem}{'' if jax.default_backend() == 'cpu' else '-gpu'}.json"
        if options.write:
            prepare_outputs(self.file)
        self._rows: list[dict[str, Any]] = []
        self._made = provenance()  # determine the commit before any file is written
        self._made["commit"] = os.environ.get(COMMIT) or self._made["commit"]
        keep_programs()  # compile the programs that several rows share only once

    def add(
        self, name: str, unit: str, values: list[float], *, against: str = "", other: list[float] | None = None,
        ratios: list[float] | None = None, asked: float | None = None,
    ) -> None:  # fmt: skip
        """Add one row.

        Args:
            against: name of the contestant to compare with; ``other`` has its values.
            ratios: speed ratio in each round.
            asked: the aim: the smallest acceptable ratio.
        """
        spread = _spread(values)
        row = {"name": name, "value": spread.pop("median"), "unit": unit} | spread | {"against": against}
        row |= {"other": statistics.median(other) if other else None, "ratio": _spread(ratios) if ratios else None}
        self._rows.append(row | {"asked": asked})

    def race(
        self, name: str, unit: str, ours: Contestant, others: dict[str, Contestant] | None = None, *,
        asked: dict[str, float] | None = None,
    ) -> list[float]:  # fmt: skip
        """Time ours and all others in turn. Adds one row for each other contestant, with the speed ratio.

        Args:
            unit: "ms", "µs" or "s" per unit of work, or work per second, such as "steps/s".
            asked: the aims: the smallest acceptable ratios, by the name of the other contestant.

        Returns:
            The times of ours [s].
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
        """Print the table, and write the results."""
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
    for column in ("what", "median (min-max)", "unit", "compared with", "its median", "ratio (min-max)", "aim"):
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
