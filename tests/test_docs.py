"""Documentation: links, anchors, pictures, commands, files and settings in README.md and docs/ exist."""

import contextlib
import dataclasses
import importlib
import io
import re
import shlex
import sys
import tomllib
from pathlib import Path
from urllib.parse import unquote

import pytest
import tyro

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import study
from rows import RESULTS

from ct_envs import UserError
from ct_jax.cli import COMMANDS, main
from ct_jax.settings import Settings

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *DOCS]
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(!?)\[[^\]]*\]\(([^)\s]+)\)")


def name_of(file: Path) -> str:
    return str(file.relative_to(ROOT))


def prose(text: str) -> str:
    """A page without its code blocks."""
    return FENCE.sub("", text)


def spans(text: str) -> list[str]:
    """The code spans of a page, each on one line."""
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose(text))]


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub and the site make them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.+)$", prose(text), re.MULTILINE):
        words = re.sub(r"[^\w\s-]", "", heading.replace("`", "").lower()).strip()
        found.add(re.sub(r"\s", "-", words))
    return found


def broken_links(file: Path, text: str) -> list[str]:
    """The broken relative links and pictures of a page, and pictures on other hosts."""
    broken = []
    for picture, target in LINK.findall(prose(text)):
        if re.match(r"[a-z]+:", target):
            broken += [target] if picture else []
            continue
        path, _, anchor = unquote(target).partition("#")
        there = (file.parent / path) if path else file
        if not there.exists() or (anchor and anchor not in anchors(there.read_text("utf-8"))):
            broken.append(target)
    return broken


@pytest.mark.parametrize("file", PAGES, ids=name_of)
def test_links_and_pictures_exist(file):
    assert not broken_links(file, file.read_text("utf-8"))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("[a](nowhere.md)", ["nowhere.md"]),
        ("![a](nowhere.png)", ["nowhere.png"]),
        ("[a](README.md#no-such-heading)", ["README.md#no-such-heading"]),
        ("![a](https://example.org/a.png)", ["https://example.org/a.png"]),
        ("# It's `so`!\n[a](#its-so) [b](README.md) [c](https://example.org)", []),
        ("```\n[a](nowhere.md)\n```\n", []),
    ],
)
def test_broken_link_is_found(text, found, tmp_path):
    (tmp_path / "README.md").write_text("# Title\n")
    page = tmp_path / "page.md"
    page.write_text(text)
    assert broken_links(page, text) == found


def test_readme_is_short_and_its_animation_is_small():
    text = (ROOT / "README.md").read_bytes()
    assert text.count(b"\n") <= 250 and len(text) <= 15_000
    assert (ROOT / "docs" / "ant.gif").stat().st_size < 3_000_000


def test_site_has_all_pages():
    site = tomllib.loads((ROOT / "zensical.toml").read_text("utf-8"))["project"]

    def files(entries):
        for entry in entries:
            for value in entry.values():
                yield from files(value) if isinstance(value, list) else [value]

    assert sorted(files(site["nav"])) == sorted(str(file.relative_to(ROOT / "docs")) for file in DOCS)
    assert site["theme"]["font"] is False  # no font of another host
    assert all((ROOT / "docs" / style).is_file() for style in site["extra_css"])


# -------------------------------------------------------------------------------------------------------- commands


def lines_of_code(text: str) -> list[str]:
    """The lines of code blocks and the code spans, without comments."""
    blocks = [line for block in FENCE.findall(text) for line in block.splitlines()[1:-1]]
    return [re.sub(r"\s+#.*", "", line).removesuffix(" &").strip() for line in blocks] + spans(text)


def commands(start: str) -> list[str]:
    """All commands in the pages with this start, without those that have a placeholder."""
    found = [line for file in PAGES for line in lines_of_code(file.read_text("utf-8"))]
    found = [line[line.index(start) :] for line in found if re.search(rf"(^|[ /]){re.escape(start)}", line)]
    return [each for each in dict.fromkeys(found) if not re.search(r"\.\.\.|COMMAND|ROBOT|FILE| \| ", each)]


def parse(options: type, arguments: list[str]) -> object:
    """Parse arguments with tyro. An error of tyro fails the test."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(options, args=arguments)
    except SystemExit:
        pytest.fail(said.getvalue())


OURS = commands("ct-jax ")
TRAININGS = [command for command in OURS if command.startswith("ct-jax train ") and "--help" not in command.split()]


@pytest.mark.parametrize("command", sorted({*OURS} - {*TRAININGS}))
def test_ct_jax_commands_parse(command):
    _, name, *arguments = shlex.split(command)
    parse(COMMANDS[name], arguments)


@pytest.mark.parametrize("command", TRAININGS)
def test_trainings_parse_with_their_settings(command, monkeypatch, capsys):
    def train(run, *, resume):
        raise UserError("all options are known")

    monkeypatch.setattr("ct_jax.cli.prepare_jax", lambda among: None)
    monkeypatch.setattr("ct_jax.pipeline.train", train)
    monkeypatch.setattr("ct_jax.runtime.run.load_mazes", lambda names: {})
    monkeypatch.setattr("ct_jax.model.load_controller", lambda where, robot: None)
    monkeypatch.setattr("ct_envs.turtlebot3.load_pybullet", lambda: None)
    status, said = main(shlex.split(command)[1:]), capsys.readouterr()
    shown = status == 0 and "--help-all" in command and "usage:" in said.out
    assert shown or "all options are known" in said.err or "no robot named 'heavy'" in said.err  # an example's robot


def test_experiment_commands_parse():
    """This includes the commands that made the results, because users may want to repeat them."""
    found = commands("python experiments/")
    assert len(found) > 100
    classes = {"point": study.MazeOptions, "ant": study.MazeOptions, "humanoid": study.MazeOptions}
    for command in found:
        _, script, *arguments = shlex.split(command)
        module = importlib.import_module(Path(script).stem)
        assert (ROOT / script).is_file()
        options = (
            classes.get(module.__name__) or getattr(module, "RoomOptions", None) or getattr(module, "Options", None)
        )
        if options is None:
            assert not arguments
            continue
        chosen = parse(options, arguments)
        if isinstance(chosen, study.Options):
            study.choose(study.load_variants(module.__name__), chosen.preset, chosen.variants)


def test_benchmarks_and_make_targets_exist():
    assert all((ROOT / shlex.split(command)[1]).is_file() for command in commands("python benchmarks/"))
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    named = {shlex.split(command)[1] for command in commands("make ") if len(shlex.split(command)) > 1}
    assert {"docs", "test"} <= named <= targets


# ------------------------------------------------------------------------------------------------ files and settings


@pytest.mark.parametrize("file", PAGES, ids=name_of)
def test_named_files_exist(file):
    named = [span for span in spans(file.read_text("utf-8")) if re.fullmatch(r"[\w.-]+(/[\w*.-]+)+/?", span)]
    ours = [span for span in named if (ROOT / span.partition("/")[0]).is_dir() and not span.startswith("runs")]
    assert not [span for span in ours if not list(ROOT.glob(span.rstrip("/")))]


@pytest.mark.parametrize("file", [*DOCS, ROOT / "CHANGELOG.md"], ids=name_of)
def test_named_settings_exist(file):
    groups = {
        name: type(value) for name, value in vars(Settings()).items() if dataclasses.is_dataclass(value)
    } | {"last_fit": type(Settings().fit), "round_fit": type(Settings().fit)}  # fmt: skip
    for span in spans(file.read_text("utf-8")):
        if found := re.fullmatch(r"(\w+)\.(\w+)(=.*)?", span):
            group, name = found[1], found[2]
            if group in groups and name not in ("py", "md", "json"):
                assert name in {each.name for each in dataclasses.fields(groups[group])}, span


@pytest.mark.slow
@pytest.mark.rank_promotion("allow")
@pytest.mark.parametrize("name", ["README.md", "docs/api.md"])
def test_python_code_of_page_runs(name, capsys):
    blocks = re.findall(r"^```python\n(.*?)^```$", (ROOT / name).read_text("utf-8"), re.MULTILINE | re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, name, "exec"), {})
    said = capsys.readouterr().out.split()
    assert not said or 0.0 <= float(said[0]) <= 1.0


def test_all_results_files_are_shown():
    """Every results file has a page or a part of one."""
    shown = (ROOT / "experiments" / "pages.py").read_text("utf-8")
    for file in RESULTS.glob("*.json"):
        robot = file.stem.partition("-")[0]
        assert f'"{file.name}"' in shown or robot in study.ROBOTS, file
