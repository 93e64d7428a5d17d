"""Every setting of the method is an option of ``ct-jax train``, and is stored in the settings of the run."""

import ast
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from ct_envs import UserError
from ct_jax import cli, pipeline
from ct_jax.configs import get_preset
from ct_jax.settings import Settings, to_dict


@pytest.fixture
def settings_of(monkeypatch, tmp_path):
    """A function from command line arguments to the settings of the run."""

    def settings_of(*arguments: str) -> Settings:
        runs = []

        def train(run, *, resume):
            runs.append(run)
            raise UserError("stop")

        monkeypatch.setattr(pipeline, "train", train)
        assert cli.main(["train", *arguments, "--out", str(tmp_path / "run")]) == cli.BAD_INPUT
        return runs[0].settings

    return settings_of


def leaves(values: dict, path: str = ""):
    for name, value in values.items():
        yield from leaves(value, f"{path}{name}.") if isinstance(value, dict) else [(path + name, value)]


def test_options_override_preset(settings_of):
    plain = get_preset("demo", "ant")
    found = settings_of(
        "ant", "--preset", "demo", "--fit.updates", "500", "--model.width=256", "--collect.noise", "0.3",
        "--sac.hidden", "64", "32", "--last-fit.no-mirror", "--rounds", "2",
    )  # fmt: skip
    changed = {name: value for name, value in leaves(to_dict(found)) if value != dict(leaves(to_dict(plain))).get(name)}
    assert changed == {
        "fit.updates": 500, "model.width": 256, "collect.noise": 0.3, "sac.hidden": (64, 32), "last_fit.mirror": False,
        "rounds": 2,
    }  # fmt: skip
    assert json.loads(json.dumps(to_dict(found)))["fit"]["updates"] == 500


def test_settings_without_options_equal_preset(settings_of):
    assert settings_of("point", "--preset", "cpu") == get_preset("cpu", "point")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--fit.updates", "-3"], "FitConfig.updates is -3"),
        (["--fit.updates", "many"], "'many' is not a whole number"),
        (["--fit.nonsense", "3"], "--fit.nonsense"),
        (["--model.frame", "sideways"], "sideways"),
        (["--model.heads", "3"], "multiple of heads"),
        (["--fit.updates"], "--fit.updates"),
        (["--nonsense"], "--nonsense"),
    ],
)
def test_wrong_setting_is_error_of_one_line(capsys, tmp_path, arguments, says):
    assert cli.main(["train", "point", *arguments, "--out", str(tmp_path / "run")]) == cli.BAD_INPUT
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and says in error[0] and "--help-all" in error[0]
    assert not (tmp_path / "run").exists()


def test_help_all_lists_all_settings(capsys):
    assert cli.main(["train", "ant", "--preset", "cpu", "--help-all"]) == 0
    shown = capsys.readouterr().out
    for name, _ in leaves(dataclasses.asdict(dataclasses.replace(get_preset("cpu", "ant"), rooms=None))):
        if name != "rooms":
            assert f"--{name.replace('_', '-')}" in shown.replace(".no-", "."), name
    assert cli.main(["evaluate", "zoo:ant", "--help-all"]) == cli.BAD_INPUT


# ---------------------------------------------------------------------------------------------------- their comments

SOURCES = sorted(Path(cli.__file__).parent.rglob("*.py"))


def wrong_comments(text: str) -> Iterator[str]:
    """The settings whose comment ``--help-all`` does not show, or not whole, or shows for another setting.

    It shows the comment on the line of the setting. Otherwise it shows the comment lines above it, or those above the
    settings just before it.
    """
    lines = text.split("\n")
    for config in ast.walk(ast.parse(text)):
        if not isinstance(config, ast.ClassDef) or "Checked" not in map(ast.unparse, config.bases):
            continue
        for field in (part for part in config.body if isinstance(part, ast.AnnAssign)):
            assert field.end_lineno is not None
            beside = "  # " in lines[field.lineno - 1]
            above = lines[field.lineno - 2].startswith("    # ")
            goes_on = lines[field.end_lineno].startswith("    # ") and not lines[field.end_lineno][6].isupper()
            if beside == above or goes_on or field.end_lineno > field.lineno:
                yield f"{config.name}.{ast.unparse(field.target)}"


@pytest.mark.parametrize("file", SOURCES, ids=lambda file: file.stem)
def test_help_all_shows_the_comment_of_every_setting(file):
    assert list(wrong_comments(file.read_text("utf-8"))) == []


def test_a_wrong_comment_is_found():
    lines = ["class A(Checked):", "    good: int = 1  # one", "    # Two.", "    fine: int = 2"]
    assert list(wrong_comments("\n".join([*lines, ""]))) == []
    lines += [
        "    none: int = 3",
        "    long: int = 4  # begins here, and",
        "    # goes on",
        "    b: int = (",
        "  5)  # five",
    ]
    assert list(wrong_comments("\n".join([*lines, "    x = 1"]))) == ["A.none", "A.long", "A.b"]


def test_help_all_shows_whole_comments(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")  # one column of options
    assert cli.main(["train", "point", "--preset", "demo", "--help-all"]) == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for part in (
        "and the planner's action is imitated at every step (DAgger).",
        "mirrored gait learns the mean of the two.",
    ):
        assert part in shown
