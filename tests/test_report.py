"""The report: it is self-contained and complete, and tolerates missing or damaged parts of a run folder."""

import json
import re
from html import escape
from html.parser import HTMLParser
from io import BytesIO
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from ct_envs import UserError
from ct_envs.maze import draw_walls, load_walls
from ct_jax.report import draw_maze, draw_paths, pictures, reading, words, write_report
from ct_jax.report.page import page as to_html
from ct_jax.runtime.terminal import printable

SEEN, UNSEEN = "antmaze-umaze", "antmaze-medium"
METHODS = ("ct", "planner", "explorer", "some-other")
HORIZON = 40
VOID = {"meta", "link", "img", "br", "hr", "input", "image", "use"}


class Page(HTMLParser):
    """A parser of pages: tags, text, and whether the tags are nested correctly."""

    def __init__(self, text: str):
        super().__init__()
        self.tags, self.open, self.text, self.rows, self.nested = [], [], "", [], True
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in VOID:
            self.nested &= bool(self.open) and self.open.pop() == tag

    def handle_data(self, data):
        if "style" in self.open:
            return
        self.text += data
        if "tr" in self.open:
            self.rows[-1] += data + " "


def make_episodes(seed: int, *, failures: int, n: int = 6) -> dict[str, np.ndarray]:
    """Episodes: the first ``failures`` do not move, and the others reach their goal after half of the horizon."""
    rng = np.random.default_rng(seed)
    start, goal = rng.uniform(4, 16, (2, n, 2)).astype(np.float32)
    success = np.arange(n) >= failures
    along = np.clip(2 * np.arange(1, HORIZON + 1) / HORIZON, 0, 1)[:, None, None] * success[:, None]
    returns = -rng.uniform(10, 90, n)
    return {
        "path": np.float32(start + along * (goal - start)), "success": success, "collided": ~success,
        "steps": np.where(success, HORIZON // 2, HORIZON), "returns": returns, "start": start, "goal": goal,
        "asked": returns + 5,
    }  # fmt: skip


def make_row(maze: str, method: str, success_rate: float, n: int = 6) -> dict:
    row = {"robot": "point", "method": method, "maze": maze, "seen": maze == SEEN, "episodes": n, "seed": 0}
    row |= {"success_rate": success_rate, "spl": 0.5, "return_mean": -50.0, "return_scaled": -0.5}
    row |= {"collision_rate": 0.125, "timeout_rate": 1 - success_rate, "steps_mean": 27.0, "wall_s": 1.0}
    intervals = {"success_ci95": 0.1, "spl_ci95": 0.1, "return_scaled_ci95": 0.2, "timeout_ci95": 0.1}
    return row | {key: [-half, half] for key, half in intervals.items()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The text and the page of a complete run."""
    return read(write_run(tmp_path_factory.mktemp("whole"), failures=(2, 5), methods=METHODS))


@pytest.fixture
def make_run(tmp_path):
    """Write a small run folder."""
    return lambda **how: write_run(tmp_path, **how)


def write_run(folder, *, failures=(0, 1), unseen=UNSEEN, methods=("ct",), n=6):
    """Write a run folder. ``failures`` are those of the transformer in the seen and in the unseen maze."""
    mazes = {SEEN: "antmaze-umaze", unseen: "antmaze-medium"}
    texts = {name: draw_walls(load_walls(file)) for name, file in mazes.items()}
    config = {"robot": "point", "preset": "demo", "seed": 7, "command": "ct-jax train point", "commit": "abc"}
    config |= {"mazes": {SEEN: texts[SEEN]}, "eval_mazes": {unseen: texts[unseen]}, "engine": "mujoco"}
    config |= {"versions": {"jax": "0.10.1"}, "settings": {"fit": {"memory": 32, "sizes": [1, 2]}}}
    rows = []
    for name, failed in zip(mazes, failures, strict=True):
        for seed, method in enumerate(methods):
            arrays = make_episodes(seed, failures=failed if method == "ct" else 0, n=n)
            rows.append(make_row(name, method, float(arrays["success"].mean()), n))
            write_arrays(folder / "evaluate" / f"{reading.slug(name)}-{method}.npz", **arrays)
    points = np.random.default_rng(0).uniform(4, 16, (20, 2)).astype(np.float32)
    write_arrays(folder / "prm" / "roadmap.npz", points=points, edges=np.array([[0, 1], [1, 2]]))
    texts = {"config.json": json.dumps(config), "evaluate/results.json": json.dumps({"rows": rows})}
    texts |= {"metrics.jsonl": make_metrics(), "fit/done.json": json.dumps({"wall_s": 61.0, "trajectories": 1234})}
    for name, text in texts.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return folder


def write_arrays(file, **arrays):
    file.parent.mkdir(exist_ok=True)
    np.savez(file, **arrays)


def make_metrics() -> str:
    lines = [{"stage": "controller", "step": i, "time_s": i, "success": i / 9, "reward": i - 5.0} for i in range(10)]
    lines += [
        {"stage": s, "step": i, "time_s": i, "loss": 2.0**-i} for s in ("value", "fit", "fit-1") for i in range(10)
    ]
    return "\n".join(map(json.dumps, lines))


def read(run) -> tuple[str, Page]:
    html = write_report(run)
    assert html == run / "report.html"
    assert (run / "report.png").read_bytes().startswith(b"\x89PNG")
    text = html.read_text("utf-8")
    return text, assert_whole(text)


def path_figures(text: str) -> list[str]:
    """The drawings of the transformer's paths, one for each maze."""
    return re.findall(r"<svg[^>]*Paths of Control Transformer.*?</svg>", text, re.S)


def crosses(figure: str) -> int:
    """The number of failures that a drawing marks."""
    return sum(g.count("<use") for g in figure.split("<defs>") if "fill: var(--fail)" in g)


def assert_whole(text: str) -> Page:
    """Parse a page, and check that its tags are nested and closed correctly."""
    page = Page(text)
    assert page.nested and not page.open
    return page


# ---------------------------------------------------------------------------------------------- a whole run


def test_page_loads_nothing(whole):
    text, page = whole
    links = [(k, v) for _, attrs in page.tags for k, v in attrs.items() if k in ("src", "href", "xlink:href", "srcset")]
    assert links and all(link.startswith(("#", "data:")) for _, link in links)
    assert not re.search(r"https?:|//|@import|url\((?!#)", text)
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in page.tags}


def test_references_in_page_are_defined_once(whole):
    _, page = whole
    defined = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
    used = {v[1:] for _, attrs in page.tags for k, v in attrs.items() if k == "xlink:href"}
    used |= {v[5:-1] for _, attrs in page.tags for k, v in attrs.items() if k == "clip-path"}
    assert used <= set(defined)
    assert len(defined) == len(set(defined))


def test_pictures_have_descriptions_and_theme_colours(whole):
    text, page = whole
    shown = [attrs for tag, attrs in page.tags if tag == "svg" and "aria-hidden" not in attrs]
    assert len(shown) > 10
    assert all(attrs.get("role") == "img" and attrs.get("aria-label") for attrs in shown)
    assert all(attrs.get("alt") for tag, attrs in page.tags if tag == "img")
    used = set(re.findall(r"var\(--(\w+)\)", text))
    declared = [set(re.findall(r"--(\w+): #", part)) for part in text.split("prefers-color-scheme")[:2]]
    assert used - {"low", "at", "high", "share"} <= declared[0] & declared[1]


def test_table_has_all_methods_and_mazes(whole):
    _, page = whole
    labels = [row.strip() for row in page.rows]
    for method in METHODS:
        assert labels.count(words.method_label(method)) == 2
    figures = [row for row in page.rows if "−0.5" in row]
    assert len(figures) == 2 * len(METHODS)
    assert any("67" in row and "12" in row and "27" in row for row in figures)
    assert page.text.index(SEEN) < page.text.index(UNSEEN)


@pytest.mark.parametrize(("rates", "shown"), [((0.0, 0.0), 0), ((0.0, 0.25), 1), ((None, None), 0), (("x", 0), 0)])
def test_table_shows_divergence_only_if_it_occurred(make_run, rates, shown):
    run = make_run()
    rows = [make_row(name, "ct", 0.5) for name in (SEEN, UNSEEN)]
    rows = [row | ({} if rate is None else {"diverged_rate": rate}) for row, rate in zip(rows, rates, strict=True)]
    (run / "evaluate" / "results.json").write_text(json.dumps({"rows": rows}))
    text, _ = read(run)
    assert text.count('<th scope="col">Diverged</th>') == 2 * shown


def test_all_failures_are_listed_and_marked(whole):
    text, page = whole
    assert len([row for row in page.rows if "stayed on one spot" in row]) == 7
    assert "2 failures: Control Transformer in antmaze-umaze" in page.text
    assert [crosses(figure) for figure in path_figures(text)] == [2, 5]


def test_verdict_describes_failures(whole):
    _, page = whole
    assert "reached 4 of 6 goals in the maze it was trained in and 1 of 6 in a maze it had never seen" in page.text
    assert "all 7 times it failed, it stayed on one spot" in page.text


def test_run_without_failures(make_run):
    _, page = read(make_run(failures=(0, 0)))
    assert "did not fail once" in page.text
    assert "failures:" not in page.text


@pytest.mark.parametrize(("besides", "said"), [(100, True), (0, False), ("many", False), (None, False)])
def test_random_mazes_are_mentioned(make_run, besides, said):
    run = make_run()
    config = json.loads((run / "config.json").read_text())
    config["settings"] |= {"random_mazes": besides, "recover": {"random_mazes": besides}}
    (run / "config.json").write_text(json.dumps(config))
    page = to_html(reading.read_run(run))
    assert ("also trained in 100 random mazes" in page) == said
    assert ("also collected in 100 random mazes" in page) == said


def test_page_is_deterministic(make_run):
    run = make_run()
    assert read(run)[0] == read(run)[0]


def test_page_of_large_run_is_small(make_run):
    run = make_run()
    rng = np.random.default_rng(0)
    n, steps = 200, 500
    for file in (run / "evaluate").glob("*.npz"):
        path = np.abs(np.cumsum(rng.normal(0, 0.5, (steps, n, 2)), 0) % 40 - 20).astype(np.float32)
        ends = {"start": path[0], "goal": path[-1], "returns": np.zeros(n), "asked": np.ones(n)}
        write_arrays(file, path=path, success=np.zeros(n, bool), steps=np.full(n, steps), **ends)
    assert len(to_html(reading.read_run(run))) < 5e6


# -------------------------------------------------------------------------------------- what a run may lack


def everything(run):
    return sorted(str(f.relative_to(run)) for f in run.rglob("*") if f.is_file() and f.name != "config.json")


def strip(run):
    """Delete everything except the configuration."""
    for file in everything(run):
        (run / file).unlink()
    return run


PARTS = ["evaluate/antmaze-medium-ct.npz", "evaluate/results.json", "metrics.jsonl", "fit/done.json", "prm/roadmap.npz"]


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("kept", [0.0, 0.6, None])
def test_parts_can_be_missing_or_damaged(make_run, part, kept):
    run = make_run()
    assert set(PARTS) < set(everything(run))
    whole = (run / part).read_bytes()
    (run / part).unlink()
    if kept is not None:
        (run / part).write_bytes(whole[: int(kept * len(whole))])
    assert_whole(to_html(reading.read_run(run)))


def test_page_of_new_run_lists_missing_files(make_run):
    _, page = read(strip(make_run()))
    for file in ("evaluate/results.json", "prm/roadmap.npz", "metrics.jsonl", "*/done.json"):
        assert file in page.text
    assert "ct-jax train point" in page.text


def test_damaged_line_of_metrics_is_skipped(make_run):
    run = make_run()
    whole, _ = read(run)
    torn = '[]\n{"stage": "fit", "step": "x", "loss": 3}\n{"stage": "fit", "step": 5, "loss": NaN}\n{"stage": "fi'
    (run / "metrics.jsonl").write_text(make_metrics() + "\n" + torn)
    assert read(run)[0] == whole


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        3,
        "text",
        {"rows": 3},
        {"rows": [3, {}, {"maze": 1, "method": None}, {"maze": "x" * 500, "method": "ct"}]},
    ],
)
def test_invalid_results_are_ignored(make_run, value):
    run = make_run()
    (run / "evaluate" / "results.json").write_text(json.dumps(value))
    assert_whole(to_html(reading.read_run(run)))


@pytest.mark.parametrize("value", [None, [], 3, "text", {"a": None}, {"a": "not a maze"}])
def test_invalid_config_entries_are_ignored(make_run, value):
    run = strip(make_run())
    for key in ("mazes", "eval_mazes", "settings", "versions", "command", "created", "robot", "cell_m"):
        (run / "config.json").write_text(json.dumps({key: value}))
        assert_whole(to_html(reading.read_run(run)))
    (run / "config.json").write_text(json.dumps(dict.fromkeys(("robot", "seed", "command", "mazes"), value)))
    read(run)


def test_rows_can_lack_numbers(make_run):
    run = make_run()
    rows = [{"maze": SEEN, "method": "ct"}, make_row(UNSEEN, "ct", float("nan"))]
    (run / "evaluate" / "results.json").write_text(json.dumps({"rows": rows}))
    _, page = read(run)
    assert sum(row.strip() == words.method_label("ct") for row in page.rows) == 2


def test_too_large_number_is_ignored(make_run):
    run = make_run()
    rows = [make_row(SEEN, "ct", 0.5) | {"return_mean": 10**400, "steps_mean": 10**400}]
    (run / "evaluate" / "results.json").write_text(json.dumps({"rows": rows}))
    assert_whole(to_html(reading.read_run(run)))


@pytest.mark.parametrize("kind", ["U3", "c16", "f4"])
def test_invalid_arrays_are_ignored(make_run, kind):
    """Arrays of the roadmap and of episodes, one at a time."""
    run = make_run()
    points, edges = np.zeros((3, 2)), np.array([[0, 1], [1, 2]])
    for name, changed in (("points", points.astype(kind)), ("edges", edges.astype(kind)), ("edges", np.arange(3))):
        write_arrays(run / "prm" / "roadmap.npz", **{"points": points, "edges": edges, name: changed})
        assert (reading.read_run(run).roadmap is None) == (name == "edges" or kind != "f4")
    whole = make_episodes(0, failures=6)
    for name in ("path", "success", "steps", "start", "goal", "collided", "returns"):
        if name in whole:
            write_arrays(run / "evaluate" / f"{UNSEEN}-ct.npz", **whole | {name: whole[name].astype(kind)})
            assert_whole(to_html(reading.read_run(run)))
    write_arrays(run / "evaluate" / f"{UNSEEN}-ct.npz", **whole | {"steps": whole["steps"] * np.nan})
    assert_whole(to_html(reading.read_run(run)))


def test_damaged_episodes_are_drawn_partly(make_run):
    run = make_run()
    arrays = make_episodes(0, failures=6)
    arrays["path"][3:] = np.nan
    arrays["start"][0] = np.nan
    arrays["steps"][1] = 0
    write_arrays(run / "evaluate" / f"{UNSEEN}-ct.npz", **arrays)
    text, _ = read(run)
    _, figure = path_figures(text)
    assert crosses(figure) == 6 and "nan" not in figure


@pytest.mark.parametrize("name", ["missing", "empty", "file", "broken", "list"])
def test_invalid_run_folder_is_error_of_one_line(tmp_path, name):
    run = tmp_path / name
    if name == "file":
        run.write_text("")
    elif name != "missing":
        run.mkdir()
    if name in ("broken", "list"):
        (run / "config.json").write_text('{"robot": ' if name == "broken" else "[]")
    with pytest.raises(UserError, match=r"config\.json|not a folder") as error:
        write_report(run)
    assert str(run) in str(error.value) and "\n" not in str(error.value)
    assert run.is_file() or not (run / "report.html").exists()


@pytest.mark.parametrize(
    "name",
    [
        '<script>alert("x")</script>',
        "a'b\"c&d",
        "$\\frac{1}{$",
        "../../etc/maze",
        "迷路 🤖",
        "\ud800",
        "\x1b[31m",
        "x" * 200,
    ],
)
def test_names_are_escaped(make_run, name):
    text, page = read(make_run(unseen=name))
    shown = printable(name)
    assert not any(tag == "script" for tag, _ in page.tags)
    assert shown in page.text
    assert escape(shown) in text
    assert shown == escape(shown) or shown not in text


# ------------------------------------------------------------------------------------------------ the parts


@pytest.mark.parametrize("shape", [(3, 3), (3, 40), (40, 3), (9, 12), (120, 130)])
def test_maze_fills_figure_with_row_0_at_bottom(shape):
    walls = np.random.default_rng(0).random(shape) < 0.5
    walls[[0, -1]] = walls[:, [0, -1]] = True
    walls[1, 1:-1] = False  # the lowest free row
    figure, ax = pictures.maze_figure(walls)
    draw_maze(ax, walls, 2.0)
    low, high = ax.get_ylim()
    assert low < high and ax.get_xlim()[1] < 2.0 * shape[1]
    assert "<svg" in pictures.to_svg(figure, "maze")
    file = BytesIO()
    figure.savefig(file, format="rgba")
    pixels = np.frombuffer(file.getvalue(), np.uint8).reshape(*map(int, figure.canvas.get_width_height()[::-1]), 4)
    lowest_free = round(len(pixels) * (1 - (1.5 * 2.0 - low) / (high - low)))
    middle = pixels[min(lowest_free, len(pixels) - 1), pixels.shape[1] // 2, :3].astype(int)
    if abs(figure.get_figwidth() / figure.get_figheight() * pictures.aspect(walls) - 1) < 0.01:
        assert (middle > 240).all()


@pytest.mark.parametrize("success", [[True], [False], [True, False]])
def test_picture_has_legend_of_its_marks(tmp_path, success):
    path = np.full((3, len(success), 2), 6.0)
    pairs = SimpleNamespace(start=path[0], goal=path[0] + 4)
    steps = np.full(len(success), 3)
    episodes = SimpleNamespace(pairs=pairs, path=path, steps=steps, success=np.array(success))
    file = tmp_path / "picture.svg"
    pictures.write_paths(file, load_walls("antmaze-umaze"), episodes, "a picture")
    said = re.findall(r"<text[^>]*>([^<]*)</text>", file.read_text())
    for word in ("start", "goal"):
        assert word in said
    assert ("reached the goal, light to dark in time" in said) == (True in success)
    assert ("failed, light to dark in time" in said) == ("end of a failure" in said) == (False in success)


@given(st.integers(4, 60), st.floats(1e3, 1e9), st.randoms())
def test_outliers_do_not_compress_scale(n, far, random):
    asked = np.linspace(-90, -10, n)
    got = asked + np.array([random.uniform(-5, 5) for _ in range(n)])
    with pictures.style():
        _, alone = pictures.plot_figure()
        pictures.draw_calibration(alone, asked, got, np.ones(n, bool))
        _, ax = pictures.plot_figure()
        more = np.append(asked, -far), np.append(got, -50.0), np.ones(n + 1, bool)
        pictures.draw_calibration(ax, *more)
    (low, high), whole = ax.get_xlim(), alone.get_xlim()
    assert -200 < low < high < 50 and low <= whole[0] + 20
    points = np.concatenate([np.asarray(dots.get_offsets()) for dots in ax.collections])
    assert len(points) == n + 1 and (points >= low).all() and (points <= high).all()
    assert "hollow: 1 beyond the axes" in [text.get_text() for text in ax.texts] and not alone.texts


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50))
def test_bulk_contains_middle_half(values):
    low, high = pictures.bulk(np.array(values))
    inside = [value for value in values if low <= value <= high]
    assert 2 * len(inside) >= len(values)


@pytest.mark.parametrize("n", [1, 5])
@pytest.mark.parametrize("steps", [0, 1, 30])
def test_paths_of_any_length_are_drawn(n, steps):
    figure = Figure()
    ax = figure.add_subplot()
    path = np.zeros((30, n, 2), np.float32)
    draw_maze(ax, load_walls(SEEN))
    draw_paths(ax, path, np.arange(n) % 2 == 0, np.full(n, steps), path[0], path[0] + 1)
    assert "<path" in pictures.to_svg(figure, "paths")
    marked = [len(points.get_offsets()) for points in ax.collections if isinstance(points, PathCollection)]
    assert marked == [n, n, n // 2][: 2 + (n > 1)]  # starts, goals and ends of failures, also for short paths


def test_resampling_keeps_path_and_ends():
    angle = np.linspace(0, 6, 400)
    way = np.stack([np.cos(angle), np.sin(angle)], 1) * 10
    points, time = pictures.resample(way, 0.5)
    np.testing.assert_allclose(points[[0, -1]], way[[0, -1]])
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 10, rtol=1e-2)
    assert (np.diff(time) > 0).all() and time[0] == 0 and time[-1] == 1


def test_running_mean_of_line():
    values = np.arange(100.0)
    smooth = pictures.running_mean(values)
    np.testing.assert_allclose(smooth[5:-5], values[5:-5])
    np.testing.assert_allclose(smooth[0], values[:6].mean())
    np.testing.assert_array_equal(pictures.running_mean(values[:1]), values[:1])


@pytest.mark.parametrize(
    ("way", "steps", "kind"),
    [
        (np.full(400, 10.0), 400, "stuck"),
        (10 + 10 * np.sin(np.linspace(0, 120, 400)), 400, "circled"),
        (np.linspace(0, 40, 400), 400, "late"),
        (np.linspace(0, 40, 400), 100, "early"),
    ],
)
def test_failure_kind_depends_on_path(make_run, way, steps, kind):
    arrays = make_episodes(0, failures=1, n=2)
    path = np.repeat(np.stack([way, np.full(400, 6.0)], 1)[:, None], 2, 1)
    run = make_run()
    arrays |= {"path": path, "start": path[0], "steps": np.array([steps, 400])}
    write_arrays(run / "evaluate" / f"{SEEN}-ct.npz", **arrays)
    found = reading.read_run(run)
    episodes = next(e for e in found.episodes if e.maze == SEEN and e.method == "ct")
    assert words.failure_kind(found, episodes, 0) == kind
