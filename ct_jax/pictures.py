"""Pictures of mazes, paths and curves: matplotlib axes in, and PNG or theme-aware inline SVG out.

Everything is drawn once, with the colours of ``LIGHT``. ``to_svg`` then replaces each colour by a CSS variable of the
same name, so that one picture in a page is right in light and in dark mode, on paper and at any size. Success is a
ramp of blues and failure a ramp of oranges over time, which colour-blind readers tell apart; failures bear a cross
besides. Only matplotlib's object interface is used: no global figure, no global settings.
"""

import re
from collections.abc import Iterable
from html import escape
from io import StringIO

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.ticker import EngFormatter, MaxNLocator

LEVELS = 8  # steps of the time ramps
LIGHT = {
    "ink": "#1a2430", "muted": "#5c6977", "rule": "#d9dfe6", "page": "#f4f6f8", "card": "#ffffff",
    "floor": "#fbfcfe", "wall": "#c2cbd6", "roadmap": "#7f8fa3", "accent": "#1b6ca8", "trace": "#9dc3e0",
    "fail": "#c8400e", "goal": "#f2b701",
    **dict(zip([f"t{i}" for i in range(LEVELS)], "#79ccc4 #52b9c9 #359fcb #2a84c4 #2c69b3 #2e4f9d #2c3884 #272368".split(), strict=True)),
    **dict(zip([f"f{i}" for i in range(LEVELS)], "#f7b77a #f49c57 #ee813c #e26726 #d15119 #ba4010 #a0320c #85260a".split(), strict=True)),
}  # fmt: skip
DARK = {
    "ink": "#e8edf3", "muted": "#9aa8b7", "rule": "#2f3a47", "page": "#0f151c", "card": "#171f29",
    "floor": "#131a22", "wall": "#3a4756", "roadmap": "#75869b", "accent": "#63b7f0", "trace": "#2d5878",
    "fail": "#ff8b55", "goal": "#ffd044",
    **dict(zip([f"t{i}" for i in range(LEVELS)], "#34559c #3a6cb3 #3f84c4 #469ccf #57b3d4 #75c8d6 #9bdbda #c6ece2".split(), strict=True)),
    **dict(zip([f"f{i}" for i in range(LEVELS)], "#8e3a14 #a9481a #c35722 #d9692d #ea7d3d #f49453 #faad72 #fdc898".split(), strict=True)),
}  # fmt: skip
_NAMES = {colour: name for name, colour in LIGHT.items()}
_MOST_RUNS = 4000  # wall runs drawn as outlines; a larger maze becomes an image
_PIECES = 250  # pieces a path is cut into for each crossing of the maze

_STYLE = {
    "svg.fonttype": "none", "path.simplify": True, "path.simplify_threshold": 0.3, "text.usetex": False,
    "text.parse_math": False, "font.family": "DejaVu Sans", "font.size": 8.5, "text.color": LIGHT["ink"],
    "axes.edgecolor": LIGHT["muted"], "axes.labelcolor": LIGHT["muted"], "axes.linewidth": 0.8,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True,
    "axes.facecolor": "none", "figure.facecolor": "none", "savefig.facecolor": "auto", "grid.color": LIGHT["rule"],
    "grid.linewidth": 0.7, "xtick.color": LIGHT["muted"], "ytick.color": LIGHT["muted"],
    "xtick.major.size": 0, "ytick.major.size": 0, "axes.unicode_minus": True,
}  # fmt: skip


def style():
    """A context in which matplotlib draws in this module's style; the caller's settings return afterwards."""
    return matplotlib.rc_context(_STYLE)


def to_svg(figure: Figure, alt: str) -> str:
    """The figure as one ``<svg>`` element for an HTML page: scalable, coloured by CSS variables, with ``alt`` text."""
    stream = StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context(_STYLE | {"svg.hashsalt": alt}):  # the salt keeps ids apart and runs alike
        figure.savefig(stream, format="svg", metadata=nothing, dpi=200)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<style[^>]*>.*?</style>|<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r"font(-family)?: ?([\d.]+px)? ?'DejaVu Sans'[^;\"]*", _font_size, text)
    text = re.sub(r"(\d\.\d\d)\d+", r"\1", text)
    text = re.sub(r"#[0-9a-f]{6}\b", lambda hit: f"var(--{_NAMES[hit[0]]})" if hit[0] in _NAMES else hit[0], text)
    box = re.search(r'viewBox="[^"]*"', text)
    opening = f'<svg role="img" aria-label="{escape(alt)}" {box[0] if box else ""}>'
    return opening + text[text.index(">") + 1 :].strip()


def _font_size(hit: re.Match[str]) -> str:
    return f"font-size: {hit[2]}" if hit[2] else "font-size: 8.5px"


# -------------------------------------------------------------------------------------------------- mazes and paths


def maze_figure(walls: Bool[np.ndarray, "H W"], width_in: float = 5.2) -> tuple[Figure, Axes]:
    """A figure that a maze of this shape fills, and its axes."""
    height, width = walls.shape
    figure = Figure(figsize=(width_in, float(np.clip(width_in * height / width, 0.6, 1.6 * width_in))))
    return figure, figure.add_axes((0.0, 0.0, 1.0, 1.0))


def draw_maze(ax: Axes, walls: Bool[np.ndarray, "H W"], cell_m: float = 4.0) -> None:
    """Draw a maze, row 0 lowest, in metres, and set the axes to it without ticks or frame."""
    walls = np.asarray(walls, bool)
    height, width = walls.shape
    extent = (0.0, width * cell_m, 0.0, height * cell_m)
    ax.add_patch(Rectangle((0, 0), extent[1], extent[3], facecolor=LIGHT["floor"], edgecolor="none", zorder=0))
    runs = _wall_runs(walls)
    if len(runs) <= _MOST_RUNS:
        boxes = [_box(column, row, length) for row, column, length in runs]
        outline = Outline.make_compound_path(*boxes) if boxes else Outline(np.zeros((0, 2)))
        outline = Outline(outline.vertices * cell_m, outline.codes)
        # a thin edge of the same colour closes the hairlines between neighbours
        ax.add_patch(PathPatch(outline, facecolor=LIGHT["wall"], edgecolor=LIGHT["wall"], linewidth=0.5, zorder=1))
    else:
        grey = np.zeros((*walls.shape, 4)) + (0.5, 0.55, 0.6, 0.0)
        grey[..., 3] = 0.55 * walls
        ax.imshow(grey, extent=extent, origin="lower", interpolation="nearest", zorder=1)
    ax.set_xlim(extent[0], extent[1])
    ax.set_ylim(extent[2], extent[3])
    ax.set_aspect("equal")
    ax.set_axis_off()


def _wall_runs(walls: np.ndarray) -> list[tuple[int, int, int]]:
    """Horizontal runs of wall: (row, first column, length)."""
    edges = np.diff(np.pad(walls, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    first, end = np.argwhere(edges == 1), np.argwhere(edges == -1)
    return [(int(row), int(a), int(b - a)) for (row, a), (_, b) in zip(first, end, strict=True)]


def _box(x: float, y: float, length: float) -> Outline:
    return Outline([(x, y), (x + length, y), (x + length, y + 1), (x, y + 1), (x, y)], closed=True)


def draw_roadmap(ax: Axes, points: Float[np.ndarray, "n 2"], edges: Int[np.ndarray, "m 2"]) -> None:
    """Draw a roadmap (points in metres) over a maze."""
    if len(edges):
        _stroke(ax, (points[edge] for edge in edges), LIGHT["roadmap"], linewidth=0.45, alpha=0.75, zorder=2)
    ax.scatter(points[:, 0], points[:, 1], s=6, color=LIGHT["accent"], linewidths=0, zorder=3)


def draw_paths(
    ax: Axes,
    path: Float[np.ndarray, "T n 2"],
    success: Bool[np.ndarray, "n"],
    steps: Int[np.ndarray, "n"],
    start: Float[np.ndarray, "n 2"],
    goal: Float[np.ndarray, "n 2"],
    *,
    linewidth: float = 1.0,
    size: float = 1.0,
) -> None:
    """Draw episodes: colour runs with each episode's own time, blues for successes and oranges for failures.

    A dot is a start, a star a goal, and a cross the place where a failure ended. ``path`` holds the positions [m]
    after each step; what comes after an episode's ``steps`` is ignored.

    Args:
        size: of the markers, 1 for a crowd.
    """
    success = np.asarray(success, bool)
    tracks = [track(path, steps, start, i) for i in range(len(success))]
    spacing = float(np.ptp(np.concatenate([*tracks, np.zeros((1, 2))]), axis=0).max()) / _PIECES or 1.0
    for ramp, chosen, zorder in (("t", success, 2), ("f", ~success, 3)):
        timed = [resample(tracks[i], spacing) for i in np.flatnonzero(chosen)]
        for level in range(LEVELS):
            pieces = (points[_piece(time, level)] for points, time in timed)
            _stroke(ax, pieces, LIGHT[f"{ramp}{level}"], linewidth=linewidth, alpha=0.85, zorder=zorder + level / 10)
    start, goal = np.asarray(start), np.asarray(goal)
    edge = {"edgecolors": LIGHT["card"], "linewidths": 0.5}
    ax.scatter(*start.T, s=13 * size, color=LIGHT["ink"], zorder=5, **edge)
    edge = {"edgecolors": LIGHT["ink"], "linewidths": 0.5}
    ax.scatter(*goal.T, s=42 * size, marker="*", color=LIGHT["goal"], zorder=6, **edge)
    if not success.all():
        ends = np.array([tracks[i][-1] for i in np.flatnonzero(~success)])
        edge = {"edgecolors": LIGHT["card"], "linewidths": 0.6}
        ax.scatter(*ends.T, s=46 * size, marker="X", color=LIGHT["fail"], zorder=7, **edge)


def track(path: np.ndarray, steps: np.ndarray, start: np.ndarray, i: int) -> Float[np.ndarray, "k 2"]:
    """Positions [m] of episode ``i`` from its start to where it ended, without values that are not finite."""
    whole = np.concatenate([np.asarray(start)[None, i], path[: int(steps[i]), i]]).astype(np.float64)
    whole = whole[np.isfinite(whole).all(1)]
    return whole if len(whole) else np.zeros((1, 2))


def resample(points: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """The same way in equal lengths of about ``spacing``, and the time (0 to 1) at each of its points."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    n = int(np.clip(np.ceil(way[-1] / spacing) + 1, 2, 4 * _PIECES))
    grid = np.linspace(0.0, way[-1], n)
    along = np.stack([np.interp(grid, way, points[:, axis]) for axis in (0, 1)], 1)
    return along, np.interp(grid, way, np.linspace(0.0, 1.0, len(points)))


def _piece(time: np.ndarray, level: int) -> slice:
    """The points of one level of a ramp and the first of the next, so that pieces meet."""
    low, high = np.searchsorted(time, (level / LEVELS, (level + 1) / LEVELS))
    return slice(low, high + 1 if high > low else low)


def _stroke(
    ax: Axes, lines: Iterable[np.ndarray], colour: str, *, linewidth: float, alpha: float, zorder: float
) -> None:
    """Draw many lines as one outline: a hundred paths cost a page no more than their points."""
    kept = [line for line in lines if len(line) > 1]
    if not kept:
        return
    codes = np.concatenate([[Outline.MOVETO] + [Outline.LINETO] * (len(line) - 1) for line in kept])
    ax.add_patch(
        PathPatch(
            Outline(np.concatenate(kept), codes), facecolor="none", edgecolor=colour, linewidth=linewidth,
            alpha=alpha, capstyle="round", joinstyle="round", zorder=zorder,
        )
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------- curves and scatters


def plot_figure(width_in: float = 3.9, height_in: float = 2.3) -> tuple[Figure, Axes]:
    """A figure with one pair of axes for a curve or a scatter."""
    with style():
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        return figure, figure.add_subplot()


def draw_curve(ax: Axes, step: np.ndarray, value: np.ndarray, *, rate: bool = False, log: bool = False) -> None:
    """Draw a learning curve: the values faint, and their running mean.

    Args:
        rate: the values are fractions, shown as per cent from 0 to 100.
        log: logarithmic values (ignored unless all are positive).
    """
    value = 100 * value if rate else value
    smooth = running_mean(value, max(1, len(value) // 20))
    few = {"marker": "o", "markersize": 3} if len(value) < 8 else {}
    ax.plot(step, value, color=LIGHT["trace"], linewidth=0.9)
    ax.plot(step, smooth, color=LIGHT["accent"], linewidth=1.7, solid_capstyle="round", **few)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    ax.set_xlabel("steps")
    if rate:
        ax.set_ylim(-2, 102)
        ax.set_yticks([0, 25, 50, 75, 100], ["0", "25", "50", "75", "100 %"])
    elif log and (value > 0).all() and value.max() > 10 * value.min():
        ax.set_yscale("log")
        ax.minorticks_off()
    else:
        ax.yaxis.set_major_locator(MaxNLocator(5))


def running_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """Mean over ``reach`` values on each side, over fewer near the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    reach_here = np.minimum(reach, np.minimum(at, at[::-1]))
    return (total[at + reach_here + 1] - total[at - reach_here]) / (2 * reach_here + 1)


def draw_calibration(ax: Axes, asked: np.ndarray, got: np.ndarray, success: np.ndarray) -> None:
    """Scatter the return an episode was asked for against what it got; on the line, the promise was kept."""
    both = np.concatenate([asked, got])
    margin = 0.05 * float(np.ptp(both)) or 1.0
    low, high = float(both.min()) - margin, float(both.max()) + margin
    ax.plot([low, high], [low, high], color=LIGHT["muted"], linewidth=1, linestyle=(0, (4, 3)), zorder=1)
    for chosen, colour, marker, size in ((success, "accent", "o", 16), (~success, "fail", "X", 26)):
        ax.scatter(
            asked[chosen], got[chosen], s=size, marker=marker, color=LIGHT[colour], alpha=0.8,
            edgecolors=LIGHT["card"], linewidths=0.4, zorder=2,
        )  # fmt: skip
    ax.set(xlim=(low, high), ylim=(low, high), xlabel="return asked for", ylabel="return got", aspect="equal")
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.yaxis.set_major_locator(MaxNLocator(4))
