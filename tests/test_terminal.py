"""Output to a terminal has no control characters, and works on terminals with any encoding."""

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from ct_jax.cli import guarded, main, print_rows
from ct_jax.runtime.progress import Bar
from ct_jax.runtime.terminal import one_line, printable, show_anything

ROOT = Path(__file__).parents[1]
EVIL = "\x1b]0;mine\x07\x1b[31m[/red]:smile:\u202e\n"  # also markup of rich
ROW = {
    "method": "ct", "success_rate": 0.5, "success_ci95": [0.25, 0.75], "spl": 0.5, "return_scaled": -1.0,
    "collision_rate": 0.0, "steps_mean": 3.0,
}  # fmt: skip
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}


def shell(*arguments, **variables):
    paths = os.pathsep.join([str(ROOT), str(ROOT / "envs")])
    environment = os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"} | variables
    command = [sys.executable, "-m", "ct_jax.cli", *arguments]
    return subprocess.run(command, capture_output=True, env=environment)


@given(st.text())
def test_printable_text_has_no_control_characters(text):
    shown = printable(text)
    assert all(c.isprintable() or c.isspace() for c in shown) and len(shown.splitlines()) <= 1
    assert printable(shown) == shown
    assert shown == text or not text.isprintable()
    assert printable(one_line(text)) == one_line(text)


@given(st.characters(exclude_categories=["Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"]))
def test_letters_of_all_languages_are_kept(letter):
    assert printable(letter) == letter


@given(st.text())
def test_any_text_can_be_printed_in_any_encoding(text):
    for encoding in ("ascii", "latin-1", "utf-8"):
        out, err = (io.TextIOWrapper(io.BytesIO(), encoding) for _ in range(2))
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            show_anything()
            print(printable(text))
            out.flush()


def test_table_shows_names_without_markup(capsys):
    print_rows([ROW | {"maze": EVIL}])
    out = capsys.readouterr().out
    assert printable(EVIL) in out and "\x1b" not in out and out.count("\n") == 2


def test_bar_shows_names_without_markup():
    screen = io.StringIO()
    with Bar(f"ct in {EVIL}", 10, console=Console(file=screen, force_terminal=True, width=200)) as bar:
        bar.update(5)
    assert one_line(EVIL) in screen.getvalue()
    screen = io.StringIO()
    with contextlib.redirect_stderr(screen), Bar(EVIL, 10):
        pass
    assert screen.getvalue().startswith(one_line(EVIL)) and screen.getvalue()[:-1].isprintable()


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "point", f"--{EVIL}"], ["train", "point", "--seed", EVIL], ["evaluate", EVIL],
        ["evaluate", "zoo:point", "--maze", EVIL], ["report", EVIL], ["train", "point", "--controller", EVIL],
        ["evaluate", "zoo:point", "--picture", EVIL], ["train", EVIL], [EVIL],
    ],
)  # fmt: skip
def test_error_shows_names_without_control_characters(arguments, monkeypatch, capsys):
    monkeypatch.setattr("ct_jax.cli.prepare_jax", lambda *_: None)
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and err[:-1].isprintable() and "x1b" in err


@pytest.mark.parametrize("variables", [ASCII, {"COLUMNS": "20"}], ids=["ascii", "narrow"])
@pytest.mark.parametrize(
    "arguments",
    [
        ["train"], ["bogus"], [], ["train", "point", "--sneed", "3"], ["evaluate", "zoo:point", "--episodes", "ten"],
        ["evaluate", "zoo:point", "--density", "a-rather-long-word-that-no-narrow-terminal-shows-in-a-single-line"],
    ],
)  # fmt: skip
def test_error_does_not_depend_on_terminal(arguments, variables):
    said = [shell(*arguments, COLUMNS="80"), shell(*arguments, **variables)]
    assert said[0].returncode == said[1].returncode == 2
    assert said[0].stderr == said[1].stderr and said[0].stderr.count(b"\n") == 1
    assert b"--- " not in said[0].stderr


@pytest.mark.parametrize("arguments", [["mazes"], ["--help"], ["train", "--help"]])
def test_ascii_terminal_shows_similar_characters(arguments):
    done = shell(*arguments, **ASCII)
    assert (done.returncode, done.stderr) == (0, b"") and len(done.stdout.decode("ascii")) > 500
    assert b"\\u" not in done.stdout


@pytest.mark.parametrize("arguments", [["mazes"], ["--version"], ["--help"], ["evaluate", "zoo:point", "--json"]])
def test_full_device_is_error_of_one_line(arguments):
    """The error comes before the evaluation, which would take longer than this test."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "envs")])
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "ct_jax.cli", *arguments], stdout=full, stderr=subprocess.PIPE, text=True,
            env=os.environ | {"PYTHONPATH": paths}, timeout=60,
        )  # fmt: skip
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("error: ") and "o space left" in done.stderr


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_not_an_error(closed):
    paths = os.pathsep.join([str(ROOT), str(ROOT / "envs")])
    command = f"{sys.executable} -m ct_jax.cli mazes {closed}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, env=os.environ | {"PYTHONPATH": paths})
    assert (done.returncode, done.stderr) == (0, b"")


def test_system_error_is_one_line(capsys):
    def fail():
        raise OSError(5, "Input/output error", EVIL)

    assert guarded(fail) == 2
    err = capsys.readouterr().err
    assert err[:-1].isprintable() and err.startswith("error: ") and "Input/output error" in err
