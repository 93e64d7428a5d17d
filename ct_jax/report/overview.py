"""The summary of a run as one picture: blocks from top to bottom. Blocks without data are left out."""

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ct_jax.report import pictures, words
from ct_jax.report.page import curves_of
from ct_jax.report.pictures import LIGHT
from ct_jax.report.reading import Run, number
from ct_jax.runtime.files import whole

WIDTH, MARGIN, GAP = 8.27, 0.6, 0.3  # [in]
_INNER = WIDTH - 2 * MARGIN
_HALF = (_INNER - GAP) / 2
_THIRD = (_INNER - 2 * 0.42) / 3
_ROW = 0.25  # height of a line of the table
_POINTS = 100_000  # of all paths in a maze

Block = tuple[float, Callable[["Sheet", float], None]]  # height, and a function that draws the block below a given top


class Sheet:
    """A figure with coordinates in inches from its upper left corner."""

    def __init__(self, height: float):
        self.height = height
        self.figure = Figure(figsize=(WIDTH, height), dpi=180, facecolor=LIGHT["card"])

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Axes with this upper left corner."""
        return self.figure.add_axes(
            (left / WIDTH, 1 - (top + height) / self.height, width / WIDTH, height / self.height)
        )

    def text(self, left: float, top: float, text: str, **how: Any) -> None:
        """Text with this upper left corner."""
        how = {"va": "top", "fontsize": 8.5, "color": LIGHT["ink"], "parse_math": False} | how
        self.figure.text(left / WIDTH, 1 - top / self.height, plain(text), **how)

    def rule(self, top: float) -> None:
        """A thin line across."""
        ax = self.axes(MARGIN, top, _INNER, 0.01)
        ax.set_axis_off()
        ax.axhline(0, color=LIGHT["rule"], linewidth=0.8)


def write_overview(run: Run, path: Path) -> None:
    """Draw the overview of a run as a PNG."""
    with pictures.style():
        blocks = [*_title(run), *_table(run), *_paths(run), *_curves(run), *_last_row(run)]
        sheet = Sheet(2 * MARGIN + sum(height for height, _ in blocks))
        top = MARGIN
        for height, draw in blocks:
            draw(sheet, top)
            top += height
        with whole(path) as opened:
            sheet.figure.savefig(opened, format="png")


def plain(text: str, most: int = 2000) -> str:
    """Text with only those characters that matplotlib's font can draw."""
    text = text.replace(words.NARROW, "\N{THIN SPACE}")
    return "".join(c if c == "\n" or 32 <= ord(c) < 127 or c in "\u2009·–−" else "?" for c in text[:most])


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def _heading(sheet: Sheet, top: float, text: str) -> None:
    sheet.text(MARGIN, top, text, fontsize=11, fontweight="bold")


# ------------------------------------------------------------------------------------------------- the blocks


def _title(run: Run) -> list[Block]:
    config = run.config
    eyebrow = f"Control Transformer · {config.get('robot', 'unknown')} robot · seed {config.get('seed', '?')}"
    title = textwrap.fill(words.headline(run), 54)
    lead = textwrap.fill(words.verdict(run), 98)
    command = textwrap.fill(_short(str(config.get("command", "")), 200), 104)
    lines = [
        (eyebrow, {"fontsize": 8.5, "color": LIGHT["accent"], "fontweight": "bold"}, 0.24),
        (
            title,
            {"fontsize": 16, "fontweight": "bold", "linespacing": 1.15},
            0.3 * (title.count("\n") + 1) + 0.1,
        ),
        (lead, {"fontsize": 9.5, "linespacing": 1.4}, 0.2 * (lead.count("\n") + 1) + 0.08),
        (
            command,
            {"fontsize": 7.5, "color": LIGHT["muted"], "linespacing": 1.35},
            0.155 * (command.count("\n") + 1) + 0.2,
        ),
    ]
    lines = [line for line in lines if line[0].strip()]

    def draw(sheet: Sheet, top: float) -> None:
        for text, how, height in lines:
            sheet.text(MARGIN, top, text, **how)
            top += height

    return [(sum(height for *_, height in lines), draw)]


def _table(run: Run) -> list[Block]:
    """The success table: the first seen and the first unseen maze side by side."""
    mazes = [m for seen in (True, False) for m in [r["maze"] for r in run.rows if bool(r.get("seen")) == seen][:1]]
    methods = list(dict.fromkeys(row["method"] for row in run.rows if row["maze"] in mazes))[:10]
    if not mazes:
        return []
    columns = (("success", 0.5), ("", 1.12), ("SPL", 1.6), ("collisions", 2.35))
    lefts = {maze: WIDTH - MARGIN - 2.35 - i * 2.72 for i, maze in enumerate(reversed(mazes))}

    def draw(sheet: Sheet, top: float) -> None:
        muted = {"color": LIGHT["muted"], "fontsize": 7.5}
        for maze, left in lefts.items():
            kind = "seen" if run.seen.get(maze) else "unseen"
            sheet.text(left, top, f"{_short(maze, 26)}, {kind}", fontweight="bold", fontsize=8.5)
            for name, right in columns:
                sheet.text(left + right, top + 0.21, name, ha="right", **muted)
        top += 0.4
        for i, method in enumerate(methods):
            sheet.rule(top + i * _ROW)
            weight = "bold" if method == words.main_method(run) else "normal"
            here = top + i * _ROW + 0.065
            sheet.text(MARGIN, here, _short(words.method_label(method), 28), fontweight=weight)
            for maze, left in lefts.items():
                row = next((r for r in run.rows if (r["maze"], r["method"]) == (maze, method)), {})
                for text, (name, right) in zip(_figures(row), columns, strict=True):
                    how = {"fontweight": weight} if name else muted
                    sheet.text(left + right, here + 0.012 * (not name), text, ha="right", **how)

    return [(0.4 + _ROW * len(methods) + GAP, draw)]


def _figures(row: dict[str, Any]) -> tuple[str, str, str, str]:
    """Success rate, its interval, SPL and collision rate, as text."""

    def show(key: str, how: Callable[[float], str]) -> str:
        value = number(row.get(key))
        return words.DASH if value is None else how(value)

    success = show("success_rate", words.percent)
    span = words.interval(row.get("success_ci95"), words.percent)
    return success, span, show("spl", words.decimal), show("collision_rate", words.percent)


def _paths(run: Run) -> list[Block]:
    """The main method's paths in the first seen and the first unseen maze, or in the two worst rooms."""
    mine = [e for e in run.episodes if e.method == words.main_method(run) and e.maze in run.walls]
    if words.in_rooms(run.rows):
        mine = sorted(mine, key=lambda e: int(e.success.sum()) - len(e.success))
    shown = ([e for e in mine if e.seen][:1] + [e for e in mine if not e.seen])[:2]
    if not shown:
        return []
    tallest = max(_HALF * pictures.aspect(run.walls[e.maze]) for e in shown)
    tallest = min(tallest, 1.4 * _HALF)

    def draw(sheet: Sheet, top: float) -> None:
        for i, e in enumerate(shown):
            left = MARGIN + i * (_HALF + GAP)
            ax = sheet.axes(left, top + 0.25, _HALF, tallest)
            pictures.draw_maze(ax, run.walls[e.maze], run.cell_m)
            ax.set_anchor("NW")
            few = pictures.choose(e.path, e.success, e.steps, e.start, _POINTS)
            chosen = e.path[:, few], e.success[few], e.steps[few], e.start[few], e.goal[few]
            pictures.draw_paths(ax, *chosen, linewidth=0.8, size=0.6)
            failed = words.count(int((~e.success).sum()), "failure")
            kind = "seen" if e.seen else "unseen"
            sheet.text(left, top, f"{_short(e.maze, 28)}, {kind}: {failed}", fontweight="bold")
        key = "blue: reached the goal · orange: failed · darker: later · dot: start · star: goal"
        key += " · cross: end of a failure"
        sheet.text(MARGIN, top + 0.25 + tallest + 0.07, key, fontsize=7.5, color=LIGHT["muted"])

    return [(0.25 + tallest + 0.22 + GAP, draw)]


def _curves(run: Run) -> list[Block]:
    """The last training of each network."""
    several = list(curves_of(run))
    several = [c for c in several if c[1] != "reward"] or several
    curves = list({words.without_round(curve[0])[0]: curve for curve in several}.values())[:3]
    if not curves:
        return []

    def draw(sheet: Sheet, top: float) -> None:
        for i, (stage, what, curve, how) in enumerate(curves):
            left = MARGIN + i * (_THIRD + 0.42)
            name, _, again = words.stage_label(stage).partition(", ")
            sheet.text(left, top, _short(name, 26), fontsize=8, fontweight="bold")
            sheet.text(left, top + 0.16, f"{what}, {again}" if again else what, fontsize=7.5, color=LIGHT["muted"])
            ax = sheet.axes(left + 0.3, top + 0.42, _THIRD - 0.3, 1.2)
            pictures.draw_curve(ax, curve.step, curve.value, **how)
            ax.tick_params(labelsize=7)
            ax.set_xlabel("steps", fontsize=7.5, labelpad=2)

    return [(0.42 + 1.2 + 0.38 + GAP, draw)]


def _last_row(run: Run) -> list[Block]:
    """Calibration on the left, timing on the right."""
    asked = [e for e in run.tested if e.asked is not None and e.returns is not None]
    asked = sorted(asked, key=lambda e: (e.method != words.main_method(run), e.seen))[:1]
    times = [(s, t) for s, done in run.done.items() if (t := number(done.get("wall_s"))) is not None]
    if not asked and not times:
        return []
    height = max(2.1 if asked else 0.0, 0.3 + _ROW * (len(times) + 1))

    def draw(sheet: Sheet, top: float) -> None:
        for e in asked:
            assert e.asked is not None and e.returns is not None
            sheet.text(
                MARGIN,
                top,
                f"Target and actual return: {_short(e.maze, 18)}",
                fontsize=8,
                fontweight="bold",
            )
            ax = sheet.axes(MARGIN + 0.5, top + 0.25, 2.1, 1.75)
            pictures.draw_calibration(ax, e.asked, e.returns, e.success)
            ax.tick_params(labelsize=7)
        left = MARGIN + (_HALF + GAP if asked else 0.0)
        _draw_times(sheet, left, top, times)

    return [(height + 0.1, draw)]


def _draw_times(sheet: Sheet, left: float, top: float, times: list[tuple[str, float]]) -> None:
    """Bars of the times of the stages."""
    if not times:
        return
    longest = max(time for _, time in times) or 1.0
    total = sum(time for _, time in times)
    sheet.text(left, top, f"Time per stage: {words.duration(total)} in total", fontsize=8, fontweight="bold")
    for i, (stage, time) in enumerate(times):
        here = top + 0.28 + i * _ROW
        sheet.text(left, here, words.stage_label(stage, timing=True), fontsize=8)
        sheet.text(left + _HALF, here, words.duration(time), ha="right", fontsize=8)
        bar = sheet.axes(left + 1.5, here - 0.005, _HALF - 2.35, 0.1)
        bar.set_axis_off()
        bar.set_xlim(0, 1)
        bar.barh([0], [np.clip(time / longest, 0.004, 1)], color=LIGHT["accent"])
