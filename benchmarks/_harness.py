"""Paired timings, printed as a table and written to ``benchmarks/results/NAME.json``."""

import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import jax
from rich.console import Console
from rich.table import Table

from ct_jax.run import provenance

RESULTS = Path(__file__).parent / "results"


def time_pairs(
    ours: Callable[[], object], other: Callable[[], object], *, repeat: int = 15
) -> tuple[list[float], list[float]]:
    """Seconds of both, taken in turn (A B A B ...) after one warm-up each, so that a drifting machine hurts neither."""
    times: tuple[list[float], list[float]] = ([], [])
    for round_ in range(repeat + 1):
        for function, taken in zip((ours, other), times, strict=True):
            begun = time.perf_counter()
            jax.block_until_ready(function())
            if round_:
                taken.append(time.perf_counter() - begun)
    return times


def time_alone(function: Callable[[], object], *, repeat: int = 15) -> list[float]:
    """Seconds of each call after one warm-up."""
    return time_pairs(function, lambda: None, repeat=repeat)[0]


def _figure(value: float) -> str:
    return f"{value:,.3g}" if value < 1000 else f"{value:,.0f}"


class Results:
    """Rows of one benchmark."""

    def __init__(self, name: str):
        self.name = name
        self._rows: list[dict] = []

    def add(self, name: str, unit: str, values: list[float], *, against: str = "", ratios: list[float] | None = None):
        """One figure: all its values, and pair by pair its ratio to something else."""
        row = {"name": name, "value": statistics.median(values), "unit": unit, "min": min(values), "max": max(values)}
        ratio = {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios)} if ratios else None
        self._rows.append(row | {"against": against, "ratio": ratio})

    def finish(self) -> None:
        """Print the table and write the file."""
        made = provenance()
        table = Table(title=f"{self.name}: {made['hardware']}, jax {made['versions']['jax']}, commit {made['commit']}")
        for column in ("what", "median", "min", "max", "unit", "against", "ratio (min-max)"):
            table.add_column(column, justify="left" if column in ("what", "unit", "against") else "right")
        for row in self._rows:
            ratio = row["ratio"]
            table.add_row(
                row["name"], *(_figure(row[name]) for name in ("value", "min", "max")),
                row["unit"], row["against"],
                f"{ratio['median']:.2f} ({ratio['min']:.2f}-{ratio['max']:.2f})" if ratio else "",
            )  # fmt: skip
        Console(width=140).print(table)
        RESULTS.mkdir(exist_ok=True)
        rows = [row | {"made": made} for row in self._rows]
        (RESULTS / f"{self.name}.json").write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
