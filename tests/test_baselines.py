"""Baselines on the command line: training, resuming, evaluation, and a baseline of one's own."""

import contextlib
import json
import shutil

import numpy as np
import pytest
from safetensors.numpy import load_file

from ct_envs import UserError
from ct_jax import baselines, cli, pipeline
from ct_jax.baselines import Baseline, baseline_names, cql, get_baseline, sac_alone
from ct_jax.model import load_model
from ct_jax.runtime import checkpoint
from ct_jax.runtime.checkpoint import read_json
from ct_jax.runtime.run import identity, stored_run

pytestmark = pytest.mark.rank_promotion("allow")  # brax's replay

MAZE = "antmaze-umaze"
SMALL = {
    "pt-cql": ["--baseline.updates", "40", "--baseline.batch", "4", "--baseline.width", "8", "--baseline.samples", "1"],
    "sac": ["--baseline.sac.iterations", "50", "--baseline.sac.warmup", "1"],
    "bc-ct": ["--rounds", "0"],
}
EARLIER = {"pt-cql": ("controller", "collect"), "sac": (), "bc-ct": ("controller", "collect", "fit")}

MINE = """\
from dataclasses import dataclass, replace

import jax.numpy as jnp
from ct_envs.checked import Checked, Count
from ct_jax.baselines.networks import blank_policy

NAME = "mine"
TRAJECTORIES = False


@dataclass(frozen=True)
class Config(Checked):
    steps: Count = 3  # how often nothing is learned

    @property
    def total(self):
        return self.steps


def config_for(settings, robot):
    return Config()


def blank(run, config):
    return blank_policy(run.spec, 8, "world")


def learn(key, run, config, data, *, on_progress, checkpoints):
    import jax

    assert data is None
    on_progress(config.steps, {"loss": 0.5})
    like = blank(run, config)
    return replace(like, params=jax.tree.map(lambda leaf: jnp.full(leaf.shape, 0.25, leaf.dtype), like.params))
"""


@pytest.fixture
def command(tiny, tiny_run, tmp_path):
    """A function that trains with a method in ``tmp_path``; returns the exit status.

    The controller and the trajectories are those of the tiny run, whose settings are the same.
    """

    def train(method: str, *more: str, folder: str = "run", small: bool = True) -> int:
        options = SMALL.get(method, []) if small else []
        arguments = [*tiny_run.arguments, "--method", method, *options, "--out", str(tmp_path / folder), *more]
        return cli.main(arguments)

    return train


def weights(folder):
    return load_file(next(folder.glob("baselines/*/weights.safetensors")))


def same(a, b) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("method", SMALL)
def test_a_method_is_trained_and_evaluated(method, command, tmp_path, capsys):
    """Its folder has the stages that it needs, a row in each maze, and a report."""
    assert command(method) == 0, capsys.readouterr().err
    folder, printed = tmp_path / "run", capsys.readouterr().out
    assert method in printed and (folder / "report.html").stat().st_size > 0
    found = {done.parent.name for done in folder.glob("*/done.json")}
    assert found >= {*EARLIER[method], "evaluate"}
    assert not found & ({"controller", "collect", "fit", "finetune"} - {*EARLIER[method]})
    guided = () if method == "sac" else ("planner", "explorer")
    rows = pipeline.results(folder)
    assert [row["method"] for row in rows] == [method, *guided] * 2
    config = read_json(folder / "config.json")
    assert config["method"] == method
    assert ("baseline" in config) == (method != "bc-ct")
    if method != "bc-ct":
        assert not list(folder.glob("baselines/*/checkpoints*")) and weights(folder)
        curve = [json.loads(line)["stage"] for line in (folder / "metrics.jsonl").read_text().splitlines()]
        assert method in curve
    assert not load_model(str(folder)).settings.model.returns if method == "bc-ct" else True

    arguments = ["evaluate", str(folder), "--maze", MAZE, "--episodes", "4", "--json"]
    assert cli.main([*arguments, "--method", method]) == 0
    row, before = json.loads(capsys.readouterr().out), rows[1 + len(guided)]
    assert row["method"] == method and row["maze"] == before["maze"] == MAZE
    assert row["success_rate"] == before["success_rate"] and row["return_mean"] == before["return_mean"]
    assert cli.main([*arguments, "--method", "planner"]) == (0 if guided else cli.BAD_INPUT)
    said = capsys.readouterr()
    assert guided or "sac has no low-level controller; give --method sac" in said.err
    if method != "bc-ct":
        assert cli.main(arguments) == cli.BAD_INPUT
        assert (
            f"a run of {method}, without a transformer; evaluate it with --method {method}" in capsys.readouterr().err
        )


@pytest.mark.parametrize("method", ["pt-cql", "sac"])
def test_an_interrupted_baseline_continues_as_if_nothing_had_happened(method, command, tmp_path, monkeypatch, capsys):
    assert command(method) == 0
    save = checkpoint.Checkpoints.maybe_save

    def stop(self, step, state):
        save(self, step, state)
        if f"checkpoints-{method}" in str(self._folder):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.Checkpoints, "maybe_save", stop)
        assert command(method, folder="stopped") == cli.INTERRUPTED
    folder = tmp_path / "stopped"
    assert list(folder.glob(f"baselines/{method}/checkpoints-{method}/*"))
    assert command(method, folder="stopped") == cli.BAD_INPUT and "--resume" in capsys.readouterr().err
    assert command(method, "--resume", folder="stopped") == 0
    assert same(weights(folder), weights(tmp_path / "run"))

    def no_training(*arguments, **options):
        raise AssertionError("trained again")

    monkeypatch.setattr(get_baseline(method), "learn", no_training)
    shutil.rmtree(folder / "evaluate")
    assert command(method, "--resume", folder="stopped") == 0  # a finished baseline is read back


@pytest.mark.parametrize(
    ("begun", "more", "says"),
    [
        ("sac", ["pt-cql"], "method sac, not pt-cql"),
        ("sac", ["ct"], "method sac, not ct"),
        ("sac", ["sac", "--baseline.sac.batch", "16"], "baseline.sac.batch 8, not 16"),
        ("ct", ["sac"], "method ct, not sac"),
    ],
)
def test_a_run_is_only_continued_as_what_it_was_begun(begun, more, says, command, tmp_path, monkeypatch, capsys):
    class StopError(UserError):
        pass

    def stop(run, *rest):
        raise StopError("stop")

    monkeypatch.setattr(pipeline, "learned_baseline", stop)
    monkeypatch.setattr(pipeline, "_model", stop)
    assert command(begun) == cli.BAD_INPUT
    capsys.readouterr()
    assert command(*more, "--resume") == cli.BAD_INPUT
    assert f"a run with {says}" in capsys.readouterr().err


def test_a_run_of_an_earlier_version_is_a_transformers(command, tiny_run, tmp_path, capsys):
    shutil.copytree(tiny_run.folder, tmp_path / "run")
    file = tmp_path / "run" / "config.json"
    config = read_json(file)
    assert config.pop("method") == "ct" and "baseline" not in config
    file.write_text(json.dumps(config))
    assert stored_run(tmp_path / "run").method == "ct"
    assert command("ct", "--resume") == 0
    assert command("bc-ct", "--resume") == cli.BAD_INPUT and "method ct, not bc-ct" in capsys.readouterr().err
    assert cli.main(["evaluate", str(tmp_path / "run"), "--method", "sac"]) == cli.BAD_INPUT
    assert "has no trained sac; train it with: ct-jax train point --method sac" in capsys.readouterr().err
    assert cli.main(["evaluate", str(tmp_path / "run"), "--method", "bc-ct"]) == cli.BAD_INPUT
    assert "give --method ct" in capsys.readouterr().err


def test_reading_a_run_back_is_the_identity(command, tmp_path, monkeypatch):
    runs = []

    def keep(run, *rest):
        runs.append(run)
        raise UserError("stop")

    monkeypatch.setattr(pipeline, "learned_baseline", keep)
    assert command("pt-cql") == cli.BAD_INPUT
    assert identity(stored_run(tmp_path / "run")) == identity(runs[0])


# ---------------------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["point", "--method", "luck"], "no method named 'luck'; methods: ct, bc-ct, pt-cql, sac"),
        (["point", "--method", "luck", "--help-all"], "no method named 'luck'; methods: ct, bc-ct, pt-cql, sac"),
        (["point", "--method", "pt-cql", "--baseline.updates", "-3"], "CqlConfig.updates is -3"),
        (["point", "--method", "pt-cql", "--baseline.nonsense", "3"], "--baseline.nonsense"),
        (["point", "--method", "pt-cql", "--nonsense", "3"], "--nonsense"),
        (["point", "--method", "pt-cql", "--baseline.frame", "heading"], "robot 'point' has no heading"),
        (["point", "--baseline.updates", "3"], "--baseline.updates"),
        (["point", "--method", "bc-ct", "--model.returns"], "--method bc-ct has model.returns=False"),
        (["turtlebot3", "--method", "sac"], "the turtlebot3 drives in PyBullet"),
    ],
)
def test_wrong_input_is_an_error_of_one_line_before_a_folder_is_made(arguments, says, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli, "prepare_jax", lambda *_: None)
    assert cli.main(["train", *arguments, "--out", str(tmp_path / "run")]) == cli.BAD_INPUT
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and says in error[0]
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("method", "shown"),
    [
        ("pt-cql", ["--baseline.updates", "--baseline.alpha", "--fit.updates"]),
        ("sac", ["--baseline.sac.iterations", "--baseline.reward.arrival-bonus", "--baseline.frame"]),
        ("bc-ct", ["--model.returns", "--fit.updates"]),
    ],
)
def test_help_all_lists_the_settings_of_the_method(method, shown, capsys):
    assert cli.main(["train", "ant", "--method", method, "--help-all"]) == 0
    found = capsys.readouterr().out.replace(".no-", ".")
    assert all(name in found for name in shown)
    assert ("--baseline" in found) == (method != "bc-ct")


def test_defaults_follow_the_settings(tiny, tmp_path, monkeypatch):
    """The controller's learner, as the options change it, is the learner of SAC alone."""
    runs = []
    monkeypatch.setattr(pipeline, "train", lambda run, resume: runs.append(run) or contextlib.nullcontext())
    monkeypatch.setattr(pipeline, "results", lambda folder: [])
    arguments = ["train", "point", "--method", "sac", "--sac.batch", "33", "--baseline.sac.envs", "5"]
    cli.main([*arguments, "--preset", "tiny"])
    (run,) = runs
    assert run.folder.name == "point-sac-tiny-0" and run.method == "sac"
    assert (run.baseline.sac.batch, run.baseline.sac.envs, run.settings.sac.envs) == (33, 5, 4)


def test_names_and_their_errors():
    assert baseline_names() == ["pt-cql", "sac"]
    assert get_baseline("pt-cql") is cql and get_baseline("sac") is sac_alone
    with pytest.raises(UserError, match="no baseline named 'luck'; baselines: pt-cql, sac"):
        get_baseline("luck")


# --------------------------------------------------------------------------------------------------- one of your own


def test_a_new_baseline_is_one_file(command, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "mine.py").write_text(MINE)
    monkeypatch.setattr(baselines, "__path__", [*baselines.__path__, str(folder)])
    assert baseline_names() == ["mine", "pt-cql", "sac"]
    mine: Baseline = get_baseline("mine")
    assert command("mine", "--baseline.steps", "5") == 0, capsys.readouterr().err
    assert read_json(tmp_path / "run" / "config.json")["baseline"] == {"steps": 5}
    assert all((array == 0.25).all() for array in weights(tmp_path / "run").values())
    assert "mine" in (tmp_path / "run" / "report.html").read_text()
    capsys.readouterr()
    assert cli.main(["evaluate", str(tmp_path / "run"), "--maze", MAZE, "--episodes", "2", "--method", "mine"]) == 0
    assert "mine" in capsys.readouterr().out
    assert cli.main(["train", "point", "--method", "mine", "--help-all"]) == 0
    assert "how often nothing is learned" in capsys.readouterr().out
    assert mine.NAME == "mine"
