"""The HTML page. Each part is a function from a run to HTML, and names the files that are missing.

The page has no scripts and loads nothing. Pictures are inline SVG, with colours for light and dark mode. All text from
files is escaped.
"""

from collections.abc import Callable, Iterator
from datetime import datetime
from html import escape
from importlib import resources
from itertools import zip_longest
from typing import Any

import numpy as np

from ct_envs.turtlebot3_world import World
from ct_jax import __version__
from ct_jax.report import pictures, words
from ct_jax.report.pictures import LIGHT
from ct_jax.report.reading import STAGES, Curve, Episodes, Run, number
from ct_jax.runtime.terminal import printable

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"  # forbids the browser to load anything
MOST_MAZES = 12  # maximum number of mazes that are drawn
MOST_FAILURES = 8  # maximum number of failures that are drawn singly
MOST_SUCCESSES = 4
MOST_POINTS = 360_000  # maximum number of points of all paths, so that the page is smaller than 5 MB
MOST_DOTS = 400  # maximum number of episodes in a scatter plot
MOST_LISTED = 200  # maximum number of failures in one list

_COLUMNS: tuple[tuple[str, str, str, Callable[[float], str]], ...] = (
    ("Success", "success_rate", "success_ci95", words.percent),
    ("SPL", "spl", "spl_ci95", words.decimal),
    ("Scaled return", "return_scaled", "return_scaled_ci95", lambda x: words.decimal(x, 1)),
    ("Collisions", "collision_rate", "collision_ci95", words.percent),
    ("Frontal", "frontal_rate", "frontal_ci95", words.percent),
    ("Grazing", "grazing_rate", "grazing_ci95", words.percent),
    ("Falls", "fall_rate", "fall_ci95", words.percent),
    ("Diverged", "diverged_rate", "diverged_ci95", words.percent),
    ("Time-outs", "timeout_rate", "timeout_ci95", words.percent),
    ("Mean steps", "steps_mean", "steps_ci95", lambda x: words.decimal(x, 0)),
)
_GLOSSARY = {
    "Success": "share of episodes that reached the goal in time; the small numbers are 95 % intervals",
    "SPL": "success weighted by path length: 1 means the shortest path in every episode",
    "Scaled return": "minus the distance to the goal, summed over all steps, divided by 100; higher is better",
    "Collisions": "share of episodes in which the robot touched something",
    "Frontal": "share of episodes with a contact at the front of the robot",
    "Grazing": "share of episodes with a contact at the side of the robot",
    "Falls": "share of episodes that ended with a fall",
    "Diverged": "share of episodes that ended because a state or an action was not finite",
    "Time-outs": "share of episodes that did not reach the goal in time",
}
CURVES = {  # the curves of a stage: the scalar, its description, and the options of ``draw_curve``
    "controller": (
        ("success", "success on edges", {"rate": True}),
        ("held_out", "success on held-out edges, no noise", {"rate": True}),
        ("reward", "reward", {}),
    ),
    "value": (("loss", "loss", {"log": True}),),
    "fit": (("loss", "loss", {"log": True}),),
    "pt-cql": (("error", "squared error of the critics", {"log": True}), ("gap", "conservative penalty", {})),
}
_ANY_CURVE = (
    ("success", "success", {"rate": True}),
    ("reward", "reward", {}),
    ("loss", "loss", {"log": True}),
)


def page(run: Run) -> str:
    """The whole page."""
    parts = (_results, _mazes, _trajectories, _gallery, _curves, _calibration, _stages, _settings)
    style = _variables() + resources.files("ct_jax.report").joinpath("page.css").read_text("utf-8")
    body = "\n".join((_header(run), *(part(run) for part in parts), _footer(run)))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{_text(words.headline(run))}</title>
<style>
{style}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""


def _variables() -> str:
    def declare(colours: dict[str, str]) -> str:
        return " ".join(f"--{name}: {colour};" for name, colour in colours.items())

    dark = f":root {{ color-scheme: dark; {declare(pictures.DARK)} }}"
    light = f":root {{ color-scheme: light; {declare(LIGHT)} }}"
    return f"{light}\n@media screen and (prefers-color-scheme: dark) {{ {dark} }}\n"


def _text(value: Any) -> str:
    """Any value as text that is safe in HTML and on a terminal."""
    return escape(printable(value))


def _missing(what: str, file: str) -> str:
    return f'<p class="missing">{what}: <code>{file}</code> is missing or unfinished.</p>'


def _section(title: str, *body: str) -> str:
    return f"<section>\n<h2>{title}</h2>\n" + "\n".join(body) + "\n</section>"


def _grid(figures: list[str], kind: str = "") -> str:
    return f'<div class="grid {kind}">\n' + "\n".join(figures) + "\n</div>"


def _figure(svg: str, title: str, note: str = "", tag: str = "") -> str:
    """A picture with a caption above it. ``title`` and ``note`` are plain text, ``tag`` is HTML."""
    note = f"<span>{_text(note)}</span>" if note else ""
    return f"<figure><figcaption><b>{_text(title)}</b>{tag}{note}</figcaption>{svg}</figure>"


def _seen_tag(seen: bool) -> str:
    return '<span class="tag seen">seen</span>' if seen else '<span class="tag unseen">unseen</span>'


# ----------------------------------------------------------------------------------------- header and results


def _header(run: Run) -> str:
    config = run.config
    versions = config.get("versions")
    versions = ", ".join(f"{k} {v}" for k, v in versions.items()) if isinstance(versions, dict) else versions
    facts = {
        "Command": f"<code>{_text(config['command'])}</code>" if config.get("command") else "",
        "Seed": _text(config.get("seed", "")),
        "Hardware": _text(config.get("hardware", "")),
        "Versions": _text(versions or ""),
        "Commit": f"<code>{_text(config['commit'])}</code>" if config.get("commit") else "",
        "Created": _text(_date(config.get("created", ""))),
    }
    eyebrow = f"Control Transformer · {config.get('robot', 'unknown')} robot"
    for name in ("preset", "engine"):
        eyebrow += f" · {config[name]} {name}" if config.get(name) else ""
    listed = "".join(f"<dt>{name}</dt><dd>{fact}</dd>" for name, fact in facts.items() if fact)
    title = f'<p class="eyebrow">{_text(eyebrow)}</p>\n<h1>{_text(words.headline(run))}</h1>'
    return f'<header>\n{title}\n<dl class="facts">{listed}</dl>\n</header>'


def _date(created: Any) -> str:
    try:
        return datetime.fromisoformat(str(created)).strftime("%Y-%m-%d %H:%M %Z").strip()
    except ValueError:
        return str(created)


def _results(run: Run) -> str:
    title = "Success"
    if not run.rows:
        return _section(title, _missing("No evaluation yet", "evaluate/results.json"))
    mazes = list(dict.fromkeys(row["maze"] for row in run.rows))
    tables = [_table(run, maze, [row for row in run.rows if row["maze"] == maze]) for maze in mazes]
    lead = f'<p class="lead">{_text(words.verdict(run))}</p>'
    present = dict.fromkeys(row["method"] for row in run.rows)
    methods = {words.METHOD_LABELS[m]: words.METHOD_NOTES[m] for m in present if m in words.METHOD_NOTES}
    shown = {name for name, *_ in _columns(run)}
    terms = methods | {name: text for name, text in _GLOSSARY.items() if name in shown}
    terms = "".join(f"<li><b>{_text(k)}</b>: {_text(v)}.</li>" for k, v in terms.items())
    return _section(title, lead, _grid(tables, "results"), f'<ul class="glossary">{terms}</ul>')


def _columns(run: Run) -> list[tuple[str, str, str, Callable[[float], str]]]:
    """The columns of the tables. Columns for contacts and for diverged episodes are shown only if they have data."""

    def shown(key: str) -> bool:
        if key in ("frontal_rate", "grazing_rate"):
            return any(key in row for row in run.rows)
        return key != "diverged_rate" or any(number(row.get(key)) for row in run.rows)

    return [column for column in _COLUMNS if shown(column[1])]


def _table(run: Run, maze: str, rows: list[dict[str, Any]]) -> str:
    """The success table of one maze."""
    seeds = {str(row.get("seed")) for row in rows}
    episodes = {int(n) for row in rows if (n := number(row.get("episodes"))) is not None}
    pairs = words.count(min(episodes), "start-goal pair") if len(episodes) == 1 else ""
    head = "".join(f'<th scope="col">{name}</th>' for name, *_ in _columns(run))
    body = "".join(_row(run, row, several=len(seeds) > 1) for row in rows)
    seen = bool(rows[0].get("seen"))
    caption = f'<b>{_text(maze)}</b>{_seen_tag(seen)} <span class="quiet">{pairs}</span>'
    table = f"<table><caption>{caption}</caption><thead><tr>{head}</tr></thead>"
    return f'<div class="card">{table}{body}</table></div>'


def _row(run: Run, row: dict[str, Any], *, several: bool) -> str:
    """One method in one maze: its name, and its numbers below. The name contains the seed if there are ``several``."""
    label = words.method_label(row["method"]) + (f" (seed {row.get('seed')})" if several else "")
    cells = "".join(_cell(row, name, key, interval, show) for name, key, interval, show in _columns(run))
    first = ' class="first"' if row["method"] == words.main_method(run) else ""
    name = f'<th scope="rowgroup" colspan="{len(_columns(run))}">{_text(label)}</th>'
    return f"<tbody{first}><tr>{name}</tr><tr>{cells}</tr></tbody>"


def _cell(row: dict[str, Any], name: str, key: str, interval: str, show: Callable[[float], str]) -> str:
    """A number with its 95 % interval below; for the success rate also a bar of both."""
    value = number(row.get(key))
    if value is None:
        return f'<td class="none" data-label="{name}">{words.DASH}</td>'
    html = f"<span>{show(value)}</span>"
    if (ends := words.ends(row.get(interval))) is not None:
        html += f"<small>{words.interval([*ends], show)}</small>"
        if key == "success_rate":
            places = f"--low:{100 * ends[0]:.1f}%;--at:{100 * value:.1f}%;--high:{100 * ends[1]:.1f}%"
            html += f'<span class="range" style="{places}" aria-hidden="true"><i></i><b></b></span>'
    return f'<td data-label="{name}">{html}</td>'


# --------------------------------------------------------------------------------------------------- pictures


def _mazes(run: Run) -> str:
    rooms = any(isinstance(place, World) for place in run.walls.values())
    title = "The rooms" if rooms else "The mazes"
    if not run.walls:
        return _section(title, _missing("No mazes", "config.json"))
    figures = []
    for name, walls in list(run.walls.items())[:MOST_MAZES]:
        figure, ax = pictures.maze_figure(walls)
        pictures.draw_maze(ax, walls, run.cell_m)
        note, size = "", words.size(walls, run.cell_m)
        if not figures and run.roadmap:
            points, edges = run.roadmap
            pictures.draw_roadmap(ax, points, edges)
            parts = words.count(len(points), "point"), words.count(len(edges), "edge")
            note = " with a roadmap of {} and {}".format(*parts)
        svg = pictures.to_svg(figure, f"{'' if rooms else 'Maze '}{name}, {size}{note}.")
        figures.append(_figure(svg, name, size + note, _seen_tag(run.seen.get(name, False))))
    method = words.method_label(run.method)
    lead = f"The planner knows these maps. The {_text(method)} sees only the walls near the robot."
    if besides := _random_mazes(run):
        lead += f" It was also trained in {words.count(besides, 'random maze')}."
    if besides := _random_mazes(run, "recover"):
        lead += f" Recoveries were also collected in {words.count(besides, 'random maze')}."
    lead = f'<p class="quiet">{lead}</p>'
    more = len(run.walls) - len(figures)
    rest = f'<p class="quiet">{words.count(more, "other " + ("room" if rooms else "maze"))} not drawn.</p>'
    rest = rest if more else ""
    missing = "" if run.roadmap or rooms or run.is_baseline else _missing("No roadmap", "prm/roadmap.npz")
    return _section(title, lead, _grid(figures, "wide"), rest, missing)


def _random_mazes(run: Run, *stage: str) -> int:
    """The number of random mazes in the settings of a run, or in a group of its settings; 0 if they are damaged."""
    found: object = run.config.get("settings")
    for key in (*stage, "random_mazes"):
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, int) else 0


def _trajectories(run: Run) -> str:
    title = "Paths"
    drawn = [episodes for episodes in run.episodes if episodes.maze in run.walls]
    if not drawn:
        return _section(title, _missing("No trajectories", "evaluate/*.npz"))
    parts = [_key()]
    for method in dict.fromkeys(episodes.method for episodes in drawn):
        mine = [e for e in drawn if e.method == method]
        if len(mine) > MOST_MAZES:  # keep those with the most failures
            mine = sorted(mine, key=lambda e: int(e.success.sum()) - len(e.success))[:MOST_MAZES]
        figures = [_paths_figure(run, e, MOST_POINTS // len(drawn)) for e in mine]
        parts.append(f"<h3>{_text(words.method_label(method))}</h3>{_grid(figures, 'wide')}")
    return _section(title, *parts)


def _paths_figure(run: Run, episodes: Episodes, most: int) -> str:
    """The paths of one method in one maze. At most about ``most`` points are drawn, failures first."""
    n, reached = len(episodes.success), int(episodes.success.sum())
    chosen = pictures.choose(episodes.path, episodes.success, episodes.steps, episodes.start, most)
    failed = f"{n - reached} failed" if reached < n else "none failed"
    note = f"{reached} of {n} reached the goal, {failed}"
    title = f"{episodes.maze}"
    alt = f"Paths of {words.method_label(episodes.method)} in maze {title}: {note}."
    if len(chosen) < n:
        note += f"; {len(chosen)} paths drawn"
    return _figure(_paths_svg(run, episodes, chosen, alt), title, note, _seen_tag(episodes.seen))


def _paths_svg(run: Run, episodes: Episodes, chosen: np.ndarray, alt: str, *, alone: bool = False) -> str:
    """A maze and the chosen episodes in it. A single episode (``alone``) has thicker lines."""
    walls = run.walls[episodes.maze]
    figure, ax = pictures.maze_figure(walls, 2.9 if alone else 5.2)
    pictures.draw_maze(ax, walls, run.cell_m)
    path, success, steps = episodes.path[:, chosen], episodes.success[chosen], episodes.steps[chosen]
    bold = {"linewidth": 1.7, "size": 2.3} if alone else {}
    pictures.draw_paths(ax, path, success, steps, episodes.start[chosen], episodes.goal[chosen], **bold)
    return pictures.to_svg(figure, alt)


def _key() -> str:
    """The legend of the marks and colours of paths."""

    def ramp(name: str, text: str) -> str:
        colours = ", ".join(f"var(--{name}{level})" for level in range(pictures.LEVELS))
        return f'<li><span class="ramp" style="background:linear-gradient(90deg,{colours})"></span>{text}</li>'

    def mark(shape: str, text: str) -> str:
        return f'<li><svg viewBox="0 0 16 16" aria-hidden="true">{shape}</svg>{text}</li>'

    star = "8,1 9.8,5.9 15,6 10.9,9.2 12.4,14.2 8,11.3 3.6,14.2 5.1,9.2 1,6 6.2,5.9"
    cross = '<path d="M3.5 3.5 12.5 12.5M12.5 3.5 3.5 12.5" stroke="var(--fail)" stroke-width="3.2"/>'
    return '<ul class="key">{}</ul>'.format(
        mark('<circle cx="8" cy="8" r="4" fill="var(--ink)"/>', "start")
        + mark(f'<polygon points="{star}" fill="var(--goal)" stroke="var(--ink)" stroke-width=".8"/>', "goal")
        + ramp("t", "reached the goal, from start to end")
        + ramp("f", "failed, from start to end")
        + mark(cross, "where a failure ended")
    )


def _failure_list(run: Run, episodes: Episodes) -> str:
    """A list of all failures of one method in one maze. It is collapsed at first."""
    failures = np.flatnonzero(~episodes.success)
    if not len(failures):
        return ""
    rows = "".join(
        f'<tr><th scope="row">{i}</th><td>{_place(episodes.start[i])}</td><td>{_place(episodes.goal[i])}</td>'
        f"<td>{words.failure_text(run, episodes, i)}"
        f"{'; touched a wall' if episodes.collided[i] else ''}</td></tr>"
        for i in failures[:MOST_LISTED]
    )
    head = "".join(f'<th scope="col">{name}</th>' for name in ("Pair", "Start [m]", "Goal [m]", "What happened"))
    what = f"{words.count(len(failures), 'failure')}: {words.method_label(episodes.method)} in {episodes.maze}"
    if len(failures) > MOST_LISTED:
        what += f" (the first {MOST_LISTED})"
    table = f'<table class="failures"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
    return f"<details><summary>{_text(what)}</summary><div>{table}</div></details>"


def _place(point: np.ndarray) -> str:
    return f"{point[0]:.1f}, {point[1]:.1f}"


def _gallery(run: Run) -> str:
    method = words.main_method(run)
    mine = [e for e in run.episodes if e.method == method and e.maze in run.walls]
    if not mine:
        return ""
    label = _text(words.method_label(method))
    failures = [_single(run, episodes, i) for episodes, i in _pick_failures(run, mine)]
    successes = [_single(run, episodes, i) for episodes, i in _pick_successes(mine)]
    failed = sum(int((~episodes.success).sum()) for episodes in mine)
    some = f"{len(failures)} of {failed} failures" if len(failures) < failed else "All failures"
    parts = [f"<h3>{some}</h3>" + _grid(failures, "small")] if failures else []
    if not failures:
        parts.append(f'<p class="quiet">The {label} has no failures.</p>')
    parts += [f"<h3>Some successes</h3>{_grid(successes, 'small')}"] if successes else []
    lists = (_failure_list(run, episodes) for episodes in run.episodes)
    return _section(f"Single episodes: {label}", *parts, *lists)


def _single(run: Run, episodes: Episodes, i: int) -> str:
    """A picture of one episode."""
    failed = not episodes.success[i]
    reached = f"reached in {words.count(int(episodes.steps[i]), 'step')}"
    what = words.failure_text(run, episodes, i) if failed else reached
    alt = f"Path of pair {i} in maze {episodes.maze}: {what}."
    tag = '<span class="tag failed">failed</span>' if failed else ""
    svg = _paths_svg(run, episodes, np.array([i]), alt, alone=True)
    return _figure(svg, f"{episodes.maze}, pair {i}", what, tag)


def _pick_failures(run: Run, mine: list[Episodes]) -> list[tuple[Episodes, int]]:
    """Failures of all kinds in all mazes in turn, unseen mazes first."""
    kinds: dict[tuple[str, str], list[tuple[Episodes, int]]] = {}
    for episodes in sorted(mine, key=lambda e: e.seen):
        for i in map(int, np.flatnonzero(~episodes.success)):
            kind = words.failure_kind(run, episodes, i)
            kinds.setdefault((episodes.maze, kind), []).append((episodes, i))
    return [pick for picks in zip_longest(*kinds.values()) for pick in picks if pick][:MOST_FAILURES]


def _pick_successes(mine: list[Episodes]) -> list[tuple[Episodes, int]]:
    """Successes of all mazes in turn, from long to short, unseen mazes first."""

    def spread(episodes: Episodes) -> Iterator[tuple[Episodes, int]]:
        reached = np.flatnonzero(episodes.success)
        reached = reached[np.argsort(-episodes.steps[reached], kind="stable")]
        for i in dict.fromkeys(np.linspace(0, len(reached) - 1, MOST_SUCCESSES).astype(int) if len(reached) else ()):
            yield episodes, int(reached[i])

    each = [spread(episodes) for episodes in sorted(mine, key=lambda e: e.seen)]
    return [pick for picks in zip_longest(*each) for pick in picks if pick][:MOST_SUCCESSES]


# -------------------------------------------------------------------------------- curves, calibration, stages


def curves_of(run: Run) -> Iterator[tuple[str, str, Curve, dict[str, bool]]]:
    """The learning curves to draw: stage, description, curve, and options of ``draw_curve``."""
    for stage, named in run.curves.items():
        wanted = CURVES.get(words.without_round(stage)[0], _ANY_CURVE)
        for name, what, how in wanted:
            if name in named:
                yield stage, what, named[name], how


def _curves(run: Run) -> str:
    title = "Learning curves"
    figures = []
    for stage, what, curve, how in curves_of(run):
        figure, ax = pictures.plot_figure()
        pictures.draw_curve(ax, curve.step, curve.value, **how)
        end = pictures.running_mean(curve.value)[-1]
        last = words.percent(end) if how.get("rate") else f"{end:.3g}"
        note = f"{what}, {last.replace('-', words.MINUS)} at the end"
        name = words.stage_label(stage)
        figures.append(_figure(pictures.to_svg(figure, f"Learning curve. {name}: {note}."), name, note))
    if not figures:
        return _section(title, _missing("No learning curves", "metrics.jsonl"))
    return _section(title, _grid(figures, "plots"))


def _calibration(run: Run) -> str:
    title = "Target return and actual return"
    figures = []
    for episodes in run.tested:
        if episodes.asked is None or episodes.returns is None:
            continue
        figure, ax = pictures.plot_figure(3.9, 3.5)
        some = np.unique(np.linspace(0, len(episodes.asked) - 1, MOST_DOTS).astype(int))
        pictures.draw_calibration(ax, episodes.asked[some], episodes.returns[some], episodes.success[some])
        note = words.calibration_text(episodes.asked, episodes.returns)
        name = f"{episodes.maze}" + ("" if episodes.method == "ct" else f", {words.method_label(episodes.method)}")
        svg = pictures.to_svg(figure, f"Actual return against target return, {name}: {note}.")
        figures.append(_figure(svg, name, note, _seen_tag(episodes.seen)))
    if not figures and run.is_baseline:
        return ""
    if not figures:
        return _section(title, _missing("No target returns", "evaluate/*-ct.npz"))
    lead = "The value network predicts the target return at the start. On the dashed line, both returns are equal. "
    lead += "Crosses are failures."
    return _section(title, f'<p class="quiet">{lead}</p>', _grid(figures))


def _stages(run: Run) -> str:
    title = "Time per stage"
    times = {stage: number(done.get("wall_s")) or 0.0 for stage, done in run.done.items()}
    if not times:
        return _section(title, _missing("No finished stage", "*/done.json"))
    longest = max(times.values()) or 1.0
    rows = "".join(
        _stage(words.stage_label(stage, timing=True), words.stage_facts(run.done[stage]), time, time / longest)
        for stage, time in times.items()
    )
    total = _stage("Total", "", sum(times.values()), 0.0)
    table = f'<div class="card"><table class="stages"><tbody>{rows}</tbody><tfoot>{total}</tfoot></table></div>'
    absent = [words.stage_label(stage) for stage in STAGES if stage not in run.done]
    note = f'<p class="missing">Not finished, or not part of this run: {", ".join(absent)}.</p>' if absent else ""
    return _section(title, table, note)


def _stage(name: str, facts: str, time: float, share: float) -> str:
    """A row with a stage, its facts, and its time as a bar and as text."""
    bar = f'<i style="--share:{100 * share:.1f}%"></i>' if share else ""
    return (
        f'<tr><th scope="row">{_text(name)}</th><td>{_text(facts)}</td>'
        f'<td class="share" aria-hidden="true">{bar}</td><td class="time">{words.duration(time)}</td></tr>'
    )


def _settings(run: Run) -> str:
    settings = dict(_flat(run.config.get("settings")))
    if not settings:
        return ""
    rows = "".join(
        f'<tr><th scope="row"><code>{_text(k)}</code></th><td>{_text(v)}</td></tr>' for k, v in settings.items()
    )
    summary = f"<summary>All {len(settings)} settings</summary>"
    return _section(
        "Settings",
        f'<details>{summary}<div><table class="settings"><tbody>{rows}</tbody></table></div></details>',
    )


def _flat(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested settings as dotted names."""
    if isinstance(settings, dict):
        for key, value in settings.items():
            yield from _flat(value, f"{prefix}.{key}" if prefix else str(key))
    elif prefix:
        yield prefix, settings


def _footer(run: Run) -> str:
    name = _text(run.folder.resolve().name)
    return f'<footer class="quiet">Run <code>{name}</code>, reported by ct-jax {__version__}.</footer>'
