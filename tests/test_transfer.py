"""Transfer: the trunk comes from the old robot's model, and the body from the new robot's."""

import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))
import transfer as experiment
from plots import draw_transfer
from rows import TransferRow, read_rows

from ct_envs import UserError, load_maze, stack_mazes
from ct_jax.runtime.checkpoint import write_json
from ct_jax.transfer import BODY, transfer
from ct_jax.transformer import ControlTransformer, ModelConfig, sample_inputs

pytestmark = pytest.mark.rank_promotion("allow")  # brax's running statistics

SIZE = {"layers": 1, "heads": 2, "width": 16, "context": 4, "context_acting": 4}


def params(seed, proprio, motors, **changes):
    model = ControlTransformer(ModelConfig(**(SIZE | changes)), motors)
    return model.init(jax.random.key(seed), *sample_inputs(proprio, motors))


@pytest.mark.parametrize(("proprio", "actions", "frame"), [(27, 8, "heading"), (27, 8, "world"), (2, 2, "world")])
def test_trunk_is_transferred_and_body_is_new(proprio, actions, frame):
    source, fresh = params(0, 2, 2), params(1, proprio, actions, frame=frame)
    moved = transfer(source, fresh)
    assert jax.tree.structure(moved) == jax.tree.structure(fresh)
    assert {"encode_map", "embed_return", "embed_timestep", "embed_goal", "norm_out"} < moved["params"].keys()
    for name, leaves in moved["params"].items():
        whose = fresh if name in BODY else source
        jax.tree.map(np.testing.assert_array_equal, leaves, whose["params"][name])


def test_trunk_with_and_without_action_inputs():
    """The embedding of past actions belongs to the body."""
    blind, seeing = params(0, 2, 2, actions=False), params(1, 27, 8)
    assert "embed_action" not in transfer(seeing, blind)["params"]
    moved = transfer(blind, seeing)["params"]
    jax.tree.map(np.testing.assert_array_equal, moved["embed_action"], seeing["params"]["embed_action"])
    jax.tree.map(np.testing.assert_array_equal, moved["embed_return"], blind["params"]["embed_return"])


@pytest.mark.parametrize("changes", [{"width": 32}, {"max_timestep": 64}])
def test_models_of_other_widths_are_error(changes):
    with pytest.raises(UserError, match=r"has shape \(.*\), this robot's model needs \("):
        transfer(params(0, 2, 2), params(1, 27, 8, **changes))


def test_models_of_other_depths_are_error():
    with pytest.raises(UserError, match="different layers"):
        transfer(params(0, 2, 2), params(1, 27, 8, layers=2))


def test_curve_continues_from_mark_to_mark(tiny, tiny_run, tmp_path):
    """Training with two marks ends like one training, and a second call repeats nothing."""
    options = experiment.Options(point=tiny_run.folder, ant=tiny_run.folder, episodes=4, out=tmp_path)
    target = experiment.Target.of(tiny_run.folder, 40)
    trained_in = load_maze(tiny_run.arguments[tiny_run.arguments.index("--maze") + 1])
    jax.tree.map(np.testing.assert_array_equal, target.mazes, stack_mazes([trained_in]))
    assert target.unseen[0] == "antmaze-umaze"
    ends = []
    for marks in ((20, 40), (40,)):
        folder = tmp_path / str(len(marks))
        folder.mkdir()
        rows = experiment.curve(target, target.model, 0, replace(options, marks=marks), folder)
        assert [row["updates"] for row in rows] == list(marks)
        assert experiment.curve(target, None, 0, replace(options, marks=marks), folder) == rows
        ends.append({key: value for key, value in rows[-1].items() if key not in ("wall_s", "created")})
    assert ends[0] == ends[1]
    claimed = experiment.claim(tmp_path / "a" / "curve.json", {"episodes": 4, "point": tmp_path}, "runs or pairs")
    assert experiment.claim(tmp_path / "a" / "curve.json", {"episodes": 4, "point": tmp_path}, "") == claimed
    with pytest.raises(UserError, match="other runs or pairs"):
        experiment.claim(tmp_path / "a" / "curve.json", {"episodes": 5, "point": tmp_path}, "runs or pairs")
    both = [
        {"robot": robot, "run": "cpu-0", "start": "scratch", "source": None, "seed": 0} | row
        for robot in ("ant", "point")
        for row in rows
    ]
    write_json(tmp_path / "both.json", {"rows": both})
    draw_transfer(read_rows(tmp_path / "both.json", TransferRow), tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 0
