"""Pictures of mazes, paths and curves, drawn with matplotlib: PNG, or inline SVG for light and dark mode.

All pictures are drawn in the colours of ``LIGHT``. ``to_svg`` replaces each colour by a CSS variable, so that the same
picture can be shown in light mode, in dark mode and on paper. Paths of successes change from light to dark blue over
time, and those of failures from light to dark orange. Colour-blind readers can distinguish these. A cross marks the end
of a failure. The code uses only matplotlib's object interface: no global figure and no global settings.
"""

import re
from collections.abc import Iterable
from html import escape
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, StrMethodFormatter

from ct_envs.turtlebot3_world import World
from ct_jax.report.reading import Place
from ct_jax.runtime.files import whole
from ct_jax.runtime.terminal import printable

if TYPE_CHECKING:
    from ct_jax.evaluate import Episodes

LEVELS = 8  # number of colours of a path over time
LIGHT = {
    "ink": "#1a2430", "muted": "#5c6977", "rule": "#d9dfe6", "page": "#f4f6f8", "card": "#ffffff",
    "floor": "#fbfcfe", "wall": "#c2cbd6", "roadmap": "#7f8fa3", "accent": "#1b6ca8", "trace": "#9dc3e0",
    "fail": "#c8400e", "goal": "#f2b701",
    "t0": "#79ccc4", "t1": "#52b9c9", "t2": "#359fcb", "t3": "#2a84c4", "t4": "#2c69b3",
    "t5": "#2e4f9d", "t6": "#2c3884", "t7": "#272368",
    "f0": "#f7b77a", "f1": "#f49c57", "f2": "#ee813c", "f3": "#e26726", "f4": "#d15119",
    "f5": "#ba4010", "f6": "#a0320c", "f7": "#85260a",
}  # fmt: skip
DARK = {
    "ink": "#e8edf3", "muted": "#9aa8b7", "rule": "#2f3a47", "page": "#0f151c", "card": "#171f29",
    "floor": "#131a22", "wall": "#3a4756", "roadmap": "#75869b", "accent": "#63b7f0", "trace": "#2d5878",
    "fail": "#ff8b55", "goal": "#ffd044",
    "t0": "#34559c", "t1": "#3a6cb3", "t2": "#3f84c4", "t3": "#469ccf", "t4": "#57b3d4",
    "t5": "#75c8d6", "t6": "#9bdbda", "t7": "#c6ece2",
    "f0": "#8e3a14", "f1": "#a9481a", "f2": "#c35722", "f3": "#d9692d", "f4": "#ea7d3d",
    "f5": "#f49453", "f6": "#faad72", "f7": "#fdc898",
}  # fmt: skip
_NAMES = {colour: name for name, colour in LIGHT.items()}
_MOST_RUNS = 4000  # maximum number of wall runs drawn as outlines; a larger maze is drawn as an image
_HIDDEN = 0.6  # share of a cell that is cut off at the border: the outer walls carry no information
_OUTLIER = 4.0  # an outlier is farther from the middle half than this many times its range
_PIECES = 250  # number of segments of a path that crosses the maze once

_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none", "path.simplify": True, "path.simplify_threshold": 0.3, "text.usetex": False,
    "text.parse_math": False, "font.family": "DejaVu Sans", "font.size": 8.5, "text.color": LIGHT["ink"],
    "axes.edgecolor": LIGHT["muted"], "axes.labelcolor": LIGHT["muted"], "axes.linewidth": 0.8,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True,
    "axes.facecolor": "none", "figure.facecolor": "none", "savefig.facecolor": "auto",
    "grid.color": LIGHT["rule"], "grid.linewidth": 0.7,
    "xtick.color": LIGHT["muted"], "ytick.color": LIGHT["muted"],
    "xtick.major.size": 0, "ytick.major.size": 0, "axes.unicode_minus": True,
}  # fmt: skip


def style():
    """A context with this module's matplotlib style. It restores the caller's settings afterwards."""
    return matplotlib.rc_context(_STYLE)


def to_svg(figure: Figure, alt: str) -> str:
    """The figure as an ``<svg>`` element for an HTML page. Its colours are CSS variables; ``alt`` describes it."""
    stream = StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    salted: dict[Any, Any] = _STYLE | {"svg.hashsalt": ascii(alt)}  # unique ids in a page, the same in every run
    with matplotlib.rc_context(salted):
        figure.savefig(stream, format="svg", metadata=nothing, dpi=200)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<style[^>]*>.*?</style>|<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r"font(-family)?: ?([\d.]+px)? ?'DejaVu Sans'[^;\"]*", _font_size, text)
    text = re.sub(r' d="([^"]*)"', lambda hit: f' d="{_compact(hit[1])}"', text)
    text = re.sub(r"(\d\.\d\d)\d+", r"\1", text)
    text = re.sub(r"#[0-9a-f]{6}\b", lambda hit: f"var(--{_NAMES[hit[0]]})" if hit[0] in _NAMES else hit[0], text)
    box = re.search(r'viewBox="[^"]*"', text)
    opening = f'<svg role="img" aria-label="{escape(printable(alt))}" {box[0] if box else ""}>'
    return opening + text[text.index(">") + 1 :].strip()


def _compact(outline: str) -> str:
    """Path data in relative steps with a resolution of 0.1 points, to halve its length. Curves are not changed."""
    if re.search("[CQ]", outline):
        return outline
    kept, x, y = [], 0, 0
    for command, *numbers in re.findall(r"([MLz])(?: (\S+) (\S+))?", outline):
        if command == "z":
            kept.append("z")
            continue
        to_x, to_y = (round(10 * float(number)) for number in numbers)
        if command == "M":
            kept.append(f"M{to_x / 10:g} {to_y / 10:g}")
        elif (to_x, to_y) != (x, y):
            kept.append(f"l{(to_x - x) / 10:g} {(to_y - y) / 10:g}")
        x, y = to_x, to_y
    return "".join(kept)


def _font_size(hit: re.Match[str]) -> str:
    return f"font-size: {hit[2]}" if hit[2] else "font-size: 8.5px"


# -------------------------------------------------------------------------------------------- mazes and paths


def maze_figure(walls: Place, width_in: float = 5.2) -> tuple[Figure, Axes]:
    """A figure with the aspect ratio of a maze or a room, and its axes."""
    figure = Figure(figsize=(width_in, width_in * float(np.clip(aspect(walls), 0.15, 1.6))))
    return figure, figure.add_axes((0.0, 0.0, 1.0, 1.0))


def aspect(walls: Place) -> float:
    """Height divided by width of the picture of a maze or a room."""
    if isinstance(walls, World):
        return 1.0
    height, width = (side - 2 * _HIDDEN for side in walls.shape)
    return height / width


def draw_maze(ax: Axes, walls: Place, cell_m: float = 4.0) -> None:
    """Draw a maze (row 0 at the bottom) or a room in metres. Sets the limits of the axes; hides ticks and frame."""
    if isinstance(walls, World):
        _draw_room(ax, walls)
        return
    walls = np.asarray(walls, bool)
    height, width = walls.shape
    extent = (0.0, width * cell_m, 0.0, height * cell_m)
    ax.add_patch(Rectangle((0, 0), extent[1], extent[3], facecolor=LIGHT["floor"], edgecolor="none", zorder=0))
    runs = _wall_runs(walls)
    if len(runs) <= _MOST_RUNS:
        outline = Outline.make_compound_path(*(_box(column, row, length, cell_m) for row, column, length in runs))
        # A thin edge of the same colour hides the gaps between neighbours.
        ax.add_patch(PathPatch(outline, facecolor=LIGHT["wall"], edgecolor=LIGHT["wall"], linewidth=0.5, zorder=1))
    else:
        grey = np.where(walls[..., None], np.array([0.5, 0.55, 0.6, 0.55]), 0.0)
        ax.imshow(grey, extent=extent, origin="lower", interpolation="nearest", zorder=1)
    ax.set_xlim(_HIDDEN * cell_m, (width - _HIDDEN) * cell_m)
    ax.set_ylim(_HIDDEN * cell_m, (height - _HIDDEN) * cell_m)
    ax.set_aspect("equal")
    ax.set_axis_off()


def _draw_room(ax: Axes, room: World) -> None:
    """Draw a room's walls and obstacles."""
    frame = {"facecolor": LIGHT["floor"], "edgecolor": LIGHT["wall"], "linewidth": 2.5, "zorder": 0}
    ax.add_patch(Rectangle((0, 0), room.side_m, room.side_m, **frame))
    solid = {"facecolor": LIGHT["wall"], "edgecolor": LIGHT["wall"], "linewidth": 0.5, "zorder": 1}
    for x, y, half_x, half_y, yaw in room.boxes:
        box = Rectangle(
            (x - half_x, y - half_y), 2 * half_x, 2 * half_y, angle=np.degrees(yaw), rotation_point="center", **solid
        )
        ax.add_patch(box)
    for x, y, radius in room.cylinders:
        ax.add_patch(Circle((x, y), radius, **solid))
    border = 0.02 * room.side_m
    ax.set_xlim(-border, room.side_m + border)
    ax.set_ylim(-border, room.side_m + border)
    ax.set_aspect("equal")
    ax.set_axis_off()


def _wall_runs(walls: np.ndarray) -> list[tuple[int, int, int]]:
    """Horizontal runs of wall: (row, first column, length)."""
    edges = np.diff(np.pad(walls, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    first, end = np.argwhere(edges == 1), np.argwhere(edges == -1)
    return [(int(row), int(a), int(b - a)) for (row, a), (_, b) in zip(first, end, strict=True)]


def _box(column: int, row: int, length: int, cell_m: float) -> Outline:
    right, top = column + length, row + 1
    corners = np.array([(column, row), (right, row), (right, top), (column, top), (column, row)])
    return Outline(cell_m * corners, closed=True)


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
    """Draw episodes over ``draw_maze``.

    Colours show the time in each episode: blue for a success, orange for a failure. A dot is a start, a star is a
    goal, and a cross is the end of a failure. ``path`` holds the positions [m] after each step. Positions after an
    episode's ``steps`` are ignored.

    Args:
        size: scale of the markers; 1 is suitable for many episodes.
    """
    success = np.asarray(success, bool)
    tracks = [track(path, steps, start, i) for i in range(len(success))]
    spacing = _spacing(tracks)
    # Draw failures below successes: a robot that circles for a thousand steps would hide them. Crosses are on top.
    for ramp, chosen, zorder, weight in (
        ("f", ~success, 2, 0.75 if success.any() else 1.0),
        ("t", success, 3, 1.0),
    ):
        timed = [resample(tracks[i], spacing) for i in np.flatnonzero(chosen)]
        for level in range(LEVELS):
            pieces = (points[_piece(time, level)] for points, time in timed)
            how = {"linewidth": linewidth * weight, "alpha": 0.9 * weight, "zorder": zorder + level / 10}
            _stroke(ax, pieces, LIGHT[f"{ramp}{level}"], **how)
    start, goal = np.asarray(start), np.asarray(goal)
    edge = {"edgecolors": LIGHT["card"], "linewidths": 0.5}
    ax.scatter(*start.T, s=11 * size, color=LIGHT["ink"], zorder=5, **edge)
    edge = {"edgecolors": LIGHT["ink"], "linewidths": 0.35}
    ax.scatter(*goal.T, s=32 * size, marker="*", color=LIGHT["goal"], zorder=6, **edge)
    if not success.all():
        ends = np.array([tracks[i][-1] for i in np.flatnonzero(~success)])
        edge = {"edgecolors": LIGHT["card"], "linewidths": 0.6}
        ax.scatter(*ends.T, s=46 * size, marker="X", color=LIGHT["fail"], zorder=7, **edge)


def write_paths(file: Path, walls: Place, episodes: "Episodes", title: str) -> None:
    """Write a picture of a maze or a room with all episodes. The suffix of the file gives the format."""
    width, top, bottom = 5.2, 0.3, 0.42
    height = width * aspect(walls)
    whole_height = top + height + bottom
    with style():
        figure = Figure(figsize=(width, whole_height), facecolor=LIGHT["card"])
        ax = figure.add_axes((0.0, bottom / whole_height, 1.0, height / whole_height))
        draw_maze(ax, walls)
        start, goal = episodes.pairs.start, episodes.pairs.goal
        draw_paths(ax, episodes.path, episodes.success, episodes.steps, start, goal, linewidth=0.8, size=0.6)
        figure.text(0.5, 1 - 0.5 * top / whole_height, printable(title), ha="center", va="center", fontsize=9)
        _add_legend(figure, bool(episodes.success.any()), bool((~episodes.success).any()))
        with whole(file) as opened:
            figure.savefig(opened, format=file.suffix[1:], dpi=180)


def _add_legend(figure: Figure, reached: bool, failed: bool) -> None:
    """Add a legend of the marks and colours that occur in a picture of paths."""

    def mark(marker: str, colour: str, size: float, edge: str) -> Line2D:
        how = {"markeredgecolor": LIGHT[edge], "markeredgewidth": 0.4}
        return Line2D([], [], linestyle="none", marker=marker, markersize=size, color=LIGHT[colour], **how)

    def ramp(name: str) -> tuple[Line2D, ...]:
        how = {"linewidth": 2.0, "solid_capstyle": "butt"}
        return tuple(Line2D([], [], color=LIGHT[f"{name}{level}"], **how) for level in range(LEVELS))

    key: dict[str, Any] = {"start": mark("o", "ink", 4, "card"), "goal": mark("*", "goal", 7, "ink")}
    if reached:
        key["reached the goal, light to dark in time"] = ramp("t")
    if failed:
        key |= {"failed, light to dark in time": ramp("f"), "end of a failure": mark("X", "fail", 6, "card")}
    figure.legend(
        key.values(), key.keys(), loc="lower center", ncols=3, frameon=False, fontsize=7, borderaxespad=0.3,
        columnspacing=1.6, handler_map={tuple: HandlerTuple(ndivide=None, pad=0.0)},
    )  # fmt: skip


def _spacing(tracks: list[np.ndarray]) -> float:
    """Distance [m] between the drawn points of tracks."""
    return float(np.ptp(np.concatenate(tracks), axis=0).max()) / _PIECES or 1.0


def choose(
    path: np.ndarray, success: np.ndarray, steps: np.ndarray, start: np.ndarray, most: int
) -> Int[np.ndarray, "k"]:
    """The episodes that ``draw_paths`` draws with ``most`` points: failures first, then successes."""
    order = np.argsort(success, kind="stable")[: 1 + most // 20]
    tracks = [track(path, steps, start, i) for i in order]
    spacing = _spacing(tracks)
    used = np.cumsum([len(resample(one, spacing)[1]) for one in tracks])
    return np.sort(order[: max(1, np.searchsorted(used, most))])


def track(path: np.ndarray, steps: np.ndarray, start: np.ndarray, i: int) -> Float[np.ndarray, "k 2"]:
    """Positions [m] of episode ``i`` from its start to its end, without values that are not finite."""
    whole = np.concatenate([np.asarray(start)[None, i], path[: int(steps[i]), i]]).astype(np.float64)
    whole = whole[np.isfinite(whole).all(1)]
    return whole if len(whole) else np.zeros((1, 2))


def resample(points: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """The same path with points at equal distances of about ``spacing``, and the time (0 to 1) at each point."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    n = int(np.clip(np.ceil(way[-1] / spacing) + 1, 2, 4 * _PIECES))
    grid = np.linspace(0.0, way[-1], n)
    along = np.stack([np.interp(grid, way, points[:, axis]) for axis in (0, 1)], 1)
    return along, np.interp(grid, way, np.linspace(0.0, 1.0, len(points)))


def _piece(time: np.ndarray, level: int) -> slice:
    """The points of one colour and the first point of the next colour, so that the lines are connected."""
    low, high = np.searchsorted(time, (level / LEVELS, (level + 1) / LEVELS))
    return slice(low, high + 1 if high > low else low)


def _stroke(
    ax: Axes, lines: Iterable[np.ndarray], colour: str, *, linewidth: float, alpha: float, zorder: float
) -> None:
    """Draw many lines as one outline, which keeps the page small."""
    kept = [line for line in lines if len(line) > 1]
    if not kept:
        return
    codes = np.concatenate([[Outline.MOVETO] + [Outline.LINETO] * (len(line) - 1) for line in kept])
    patch = PathPatch(
        Outline(np.concatenate(kept), codes), facecolor="none", edgecolor=colour, linewidth=linewidth,
        alpha=alpha, capstyle="round", joinstyle="round", zorder=zorder,
    )  # fmt: skip
    ax.add_artist(patch)  # faster than add_patch, which computes the limits of the axes from all points


# ---------------------------------------------------------------------------------------- curves and scatters


def plot_figure(width_in: float = 2.9, height_in: float = 1.9) -> tuple[Figure, Axes]:
    """A figure with axes for a curve or a scatter plot."""
    with style():
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        return figure, figure.add_subplot()


def draw_curve(ax: Axes, step: np.ndarray, value: np.ndarray, *, rate: bool = False, log: bool = False) -> None:
    """Draw a learning curve: the values in a light colour, and their running mean.

    Args:
        rate: the values are fractions; they are shown in percent from 0 to 100.
        log: use a logarithmic axis if all values are positive and differ by more than a factor of 10.
    """
    value = 100 * value if rate else value
    smooth = running_mean(value)
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
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if value.max() < 100 * value.min() else (1,)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.minorticks_off()
    else:
        ax.yaxis.set_major_locator(MaxNLocator(5))


def running_mean(values: np.ndarray) -> np.ndarray:
    """Mean over a window of a tenth of the values. Near the ends the window is shorter."""
    reach = len(values) // 20
    total = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    low, high = np.maximum(at - reach, 0), np.minimum(at + reach + 1, len(values))
    return (total[high] - total[low]) / (high - low)


def draw_calibration(ax: Axes, asked: np.ndarray, got: np.ndarray, success: np.ndarray) -> None:
    """Scatter plot of the actual return (``got``) against the target return (``asked``) of episodes, with the diagonal.

    Outliers are drawn hollow at the edge, so that they do not compress the scale; their number is shown.
    """
    low, high = bulk(np.concatenate([asked, got]))
    margin = 0.05 * (high - low) or 1.0
    low, high = low - margin, high + margin
    beyond = (np.minimum(asked, got) < low) | (np.maximum(asked, got) > high)
    ax.plot([low, high], [low, high], color=LIGHT["muted"], linewidth=1, linestyle=(0, (4, 3)), zorder=1)
    for chosen, colour, marker, size in ((success, "accent", "o", 16), (~success, "fail", "X", 26)):
        for those, face, edge, width in ((chosen & ~beyond, colour, "card", 0.4), (chosen & beyond, None, colour, 0.9)):
            ax.scatter(
                np.clip(asked[those], low, high), np.clip(got[those], low, high), s=size, marker=marker, alpha=0.8,
                facecolors=LIGHT[face] if face else "none", edgecolors=LIGHT[edge], linewidths=width, zorder=2,
                clip_on=False,
            )  # fmt: skip
    if n := int(beyond.sum()):
        where = {"transform": ax.transAxes, "ha": "right", "va": "bottom", "fontsize": 7, "color": LIGHT["muted"]}
        ax.text(0.98, 0.03, f"hollow: {n} beyond the axes", **where)
    ax.set(xlim=(low, high), ylim=(low, high), xlabel="target return", ylabel="actual return", aspect="equal")
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.yaxis.set_major_locator(MaxNLocator(4))


def bulk(values: np.ndarray) -> tuple[float, float]:
    """Minimum and maximum of the values without outliers.

    An outlier is farther from the middle half of the values than four times the range of that half.
    """
    first, third = np.percentile(values, [25, 75])
    reach = _OUTLIER * (third - first)
    inside = values[(values >= first - reach) & (values <= third + reach)] if reach else values
    return float(inside.min()), float(inside.max())
