"""The plots of the results pages, from rows of ``experiments/results`` and the shipped controllers."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from intervals import rate_of
from matplotlib.figure import Figure
from rows import CT, Row, TransferRow

from ct_jax.runtime.files import whole

HELD_OUT_ENOUGH = 0.97  # a good success rate on held-out edges


def line_of(row: Row) -> str:
    """The variant or reference of a Turtlebot3 row."""
    return row.variant if row.method == CT else row.method


def start_of(row: TransferRow) -> str:
    """The start of a transfer curve, in words."""
    return "from scratch" if row.source is None else f"from the trunk of the {row.start}'s {row.source}"


def minutes(controller: Mapping[str, Any]) -> list[tuple[float, float]]:
    """Success on held-out edges by time [min]. All iterations take the same time."""
    made = controller["made"]
    whole = controller["sac"]["iterations"]
    return [(made["wall_s"] / 60 * step / whole, rate) for step, rate in made.get("curve", ())]


def draw_sweep(rows: Sequence[Row], axis: str, label: str, file: Path) -> None:
    """Success against ``axis``: one line for each variant and reference, with intervals over all models."""
    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    ax = figure.add_subplot()
    lines: dict[str, dict[float, list[Row]]] = {}
    for row in rows:
        lines.setdefault(line_of(row), {}).setdefault(getattr(row, axis), []).append(row)
    apart = 0.008 * np.ptp([getattr(row, axis) for row in rows])  # shift the points so that intervals do not overlap
    lowest = 100.0
    for i, (name, points) in enumerate(lines.items()):
        x = np.array(sorted(points))
        rate, low, high = np.array([rate_of(points[at], "success") for at in x]).T
        error = np.maximum([rate - low, high - rate], 0.0)
        ax.errorbar(x + apart * (i - (len(lines) - 1) / 2), rate, yerr=error, marker="o", ms=4, capsize=2, label=name)
        lowest = min(lowest, *low)
    ax.set(xlabel=label, ylabel="success [%]", ylim=(max(0.0, 10 * np.floor(lowest / 10 - 0.5)), 101))
    ax.grid(alpha=0.3)
    ax.legend()
    _save(figure, file)


def draw_transfer(rows: Sequence[TransferRow], file: Path) -> None:
    """Success against updates: means over seeds, and their range."""
    subjects = list(dict.fromkeys((row.robot, row.run) for row in rows))
    figure = Figure((4.0 * len(subjects), 3.2), layout="constrained")
    axes = figure.subplots(1, len(subjects), sharey=True, squeeze=False)[0]
    for ax, subject in zip(axes, subjects, strict=True):
        mine = [row for row in rows if (row.robot, row.run) == subject]
        for start, colour in zip(sorted({*map(start_of, mine)}), cycle(("#c8400e", "#1b6ca8", "#3a7d44"))):
            rates: dict[int, list[float]] = {}
            for row in mine:
                if start_of(row) == start:
                    rates.setdefault(row.updates, []).append(100 * row.success_rate)
            at = sorted(rates)
            ends = [[end(rates[mark]) for mark in at] for end in (min, max)]
            ax.plot(at, [np.mean(rates[mark]) for mark in at], marker="o", color=colour, label=start)
            ax.fill_between(at, *ends, color=colour, alpha=0.15)
        marks = sorted({row.updates for row in mine})
        ax.set(title=", ".join(subject), xlabel="updates", xscale="log", ylim=(0, 100))
        ax.set_xticks(marks, map(str, marks))
        ax.minorticks_off()
        ax.legend(loc="best", frameon=False)
    axes[0].set_ylabel("success in the unseen maze [%]")
    _save(figure, file)


def draw_controllers(controllers: Sequence[Mapping[str, Any]], file: Path) -> None:
    """Success on held-out edges against time."""
    figure = Figure((5.2, 3.8), layout="constrained")
    ax = figure.add_subplot()
    for found in controllers:
        if curve := minutes(found):
            label = f"{found['robot']}, {found['made']['hardware']}"
            ax.plot([at for at, _ in curve], [100 * rate for _, rate in curve], marker=".", label=label)
    ax.axhline(100 * HELD_OUT_ENOUGH, color="grey", lw=0.8, ls="--")
    ax.set(xlabel="training [min]", ylabel="held-out edges walked in time [%]", ylim=(0, 101), xscale="log")
    ax.grid(alpha=0.3)
    ax.xaxis.set_major_formatter("{x:g}")
    figure.legend(loc="outside upper center")
    _save(figure, file)


def _save(figure: Figure, file: Path) -> None:
    with whole(file) as opened:
        figure.savefig(opened, format="png", dpi=150)
