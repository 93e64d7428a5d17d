"""The Turtlebot3 end to end: the same command line and stages as in mazes, and what is its own."""

import contextlib
import importlib.util
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from ct_envs import UserError
from ct_envs.turtlebot3 import Turtlebot3Config
from ct_jax import cli, pipeline, settings
from ct_jax.cli import main
from ct_jax.collect import CollectConfig, Wave, collect, kept_in
from ct_jax.configs import turtlebot3
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.evaluate import METHODS, Episodes, evaluate
from ct_jax.finetune import RecoverConfig, recover
from ct_jax.fit import FitConfig
from ct_jax.model import load_model
from ct_jax.pairs import Pairs
from ct_jax.runtime.run import episodes_file, kept_row
from ct_jax.trajectories import load, unpack_maps
from ct_jax.types import act_as_intended
from ct_jax.worlds.room_runs import SevenPairs, grades
from ct_jax.worlds.rooms import PLANNER, RoomWorld, evaluation_rooms

pytestmark = [
    pytest.mark.rank_promotion("allow"),
    pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="PyBullet is not installed"),
]

FIT = FitConfig(updates=6, batch=4, steps=5, warmup=2, mirror=True)
COLLECT = CollectConfig(trajectories=3, reset_interval=2, guide="shortcut", starts="maze", envs=4, horizon=400)
TINY = replace(
    turtlebot3.CPU,
    collect=COLLECT,
    model=replace(turtlebot3.CPU.model, layers=1, heads=2, width=16),
    value=settings.ValueConfig(fit=replace(FIT, steps=1), width=16),
    fit=FIT,
    rounds=1,
    round_fit=FIT,
    last_fit=None,
    recover=RecoverConfig(recoveries=2, patience=20, stuck_steps=15, stuck_m=0.1, keep="relabelled"),
    episodes=2,
    rooms=settings.RoomConfig(worlds=2),
)


@dataclass(frozen=True)
class Trained:
    folder: str
    arguments: list[str]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(turtlebot3.PRESETS, "tiny", TINY)
        patch.setattr(cli, "prepare_jax", lambda *_: None)
        folder = str(tmp_path_factory.mktemp("runs") / "turtlebot3")
        arguments = ["train", "turtlebot3", "--preset", "tiny", "--out", folder]
        assert main(arguments) == 0
        yield Trained(folder, arguments)


def test_a_run_leaves_everything_behind(trained):
    model = load_model(trained.folder)
    assert model.controller == DifferentialDrive() and model.settings == TINY and model.robot == "turtlebot3"
    rows = {row["method"]: row for row in pipeline.results(Path(trained.folder))}
    assert tuple(rows) == METHODS
    for row in rows.values():
        told = row["worlds"], row["pairs"], row["episodes"], row["density"], row["noise"], row["seen"]
        assert told == (2, 2, 4, 1.0, 0.0, False)
        assert max(row["frontal_rate"], row["grazing_rate"]) <= row["collision_rate"]
        assert row["success_rate"] + row["timeout_rate"] == pytest.approx(1.0)
    page = (Path(trained.folder) / "report.html").read_text()
    assert "The rooms" in page and "room 2" in page and "Frontal" in page and "goals reached in rooms" in page


def test_what_was_seen_is_kept(trained):
    data = load(Path(trained.folder) / "collect" / "trajectories.npz")
    assert data.n == 3
    for i, length in enumerate(data.length):
        maps = np.asarray(unpack_maps(data.map_bits[i, :length]))
        assert maps[:, 0].any() and (maps[:, 1].sum((1, 2)) <= 1).all()
        np.testing.assert_allclose(
            np.linalg.norm(data.goal_relative[i, :length], axis=-1),
            np.linalg.norm(data.goal_world[i] - data.position[i, :length], axis=-1), atol=1e-4,
        )  # fmt: skip


def test_a_finished_run_is_not_run_again(trained, monkeypatch):
    for name in ("collect", "fit", "recover", "evaluate"):
        monkeypatch.setattr(pipeline, name, lambda *a, **k: pytest.fail("run again"))
    assert main([*trained.arguments, "--resume"]) == 0


def test_evaluate_gives_the_row_of_the_run(trained, capfd):
    """The same seed means the same rooms and pairs, in the run and afterwards."""
    whole = pipeline.results(Path(trained.folder))[0]
    assert main(["evaluate", trained.folder, "--worlds", "2", "--pairs", "2", "--json"]) == 0
    row = json.loads(capfd.readouterr().out)
    for name in set(whole) - {"wall_s", "seen"}:
        assert row[name] == pytest.approx(whole[name]), name


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "turtlebot3", "--maze", "hall"], ["--maze", "turtlebot3", "rooms"]),
        (["train", "turtlebot3", "--eval-maze", "hall"], ["--eval-maze", "turtlebot3"]),
        (["train", "turtlebot3", "--engine", "mjx"], ["--engine", "turtlebot3"]),
        (["train", "turtlebot3", "--controller", "zoo"], ["--controller", "turtlebot3"]),
        (["train", "turtlebot3", "--preset", "huge"], ["no preset named 'huge'", "cpu, demo"]),
        (["evaluate", "RUN", "--maze", "hall"], ["--maze is not for the turtlebot3", "--worlds"]),
        (["evaluate", "RUN", "--worlds", "0"], ["--worlds 0", "from 1"]),
        (["evaluate", "RUN", "--pairs", "9999999"], ["--pairs 9999999", "to"]),
        (["evaluate", "RUN", "--noise", "-1"], ["--noise -1", "from 0"]),
        (["evaluate", "RUN", "--noise", "nan"], ["--noise nan"]),
        (["evaluate", "RUN", "--density", "9"], ["density"]),
        (["evaluate", "RUN", "--density", "nan"], ["density"]),
        (["evaluate", "zoo:point", "--worlds", "3"], ["--worlds is not for the point", "--maze"]),
    ],
)
def test_bad_arguments_are_named_with_the_mend(arguments, words, trained, capsys):
    assert main([trained.folder if each == "RUN" else each for each in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1
    assert [word for word in words if word not in err] == [], err


def test_without_pybullet_training_is_one_line(trained, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    assert main([*trained.arguments[:-1], "elsewhere"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "needs PyBullet" in err


# ------------------------------------------------------------------------------------------------------ evaluation


def test_rooms_of_an_evaluation_depend_on_the_seed_alone_and_fill_up():
    one, again, fuller, other = (evaluation_rooms(s, 3, density=d) for s, d in ((0, 1.0), (0, 1.0), (0, 2.0), (1, 1.0)))
    for a, b, c, d in zip(one, again, fuller, other, strict=True):
        np.testing.assert_array_equal(a.boxes, b.boxes)
        assert c.covered() > a.covered() != d.covered()
    pairs = RoomWorld(1, one).draw_pairs(0, 4)
    np.testing.assert_array_equal(pairs.place, np.repeat([0, 1, 2], 4))
    straight = np.linalg.norm(pairs.goal - pairs.start, axis=1)
    assert (straight >= 1.0).all() and (pairs.shortest_m >= straight - 1e-5).all()


def test_the_references_arrive_however_the_waves_are_cut():
    rooms, found = evaluation_rooms(3, 2), []
    for slots, methods in ((3, ("planner", "explorer")), (4, ("planner",))):
        with contextlib.closing(RoomWorld(slots, rooms, processes=1)) as world:
            pairs = world.draw_pairs(3, 2)
            found += [evaluate(world, pairs, m, controller=DifferentialDrive(), prm=PLANNER) for m in methods]
    cut, explored, whole = found
    assert cut.success.all() and explored.success.all()
    np.testing.assert_array_equal(cut.steps, whole.steps)
    np.testing.assert_allclose(cut.path[0], pairs.start, atol=1e-4)
    assert cut.target_return is None and cut.not_joined == 0 and explored.not_joined is None
    assert (cut.travelled_m > 0.9 * (pairs.shortest_m - Turtlebot3Config().goal_tolerance_m)).all()


def test_grades_count_as_the_paper_does():
    success, frontal, grazing = (np.array(x, bool) for x in ([1, 1, 1, 0, 0], [0, 0, 1, 0, 1], [0, 1, 1, 0, 0]))
    none = np.zeros(5)
    rest = dict.fromkeys(("fell", "timeout", "steps", "returns", "travelled_m", "path"), none)
    episodes = Episodes(
        success=success, collided=frontal | grazing, **rest, pairs=None, wall_s=0.0, horizon=400,
        frontal=frontal, grazing=grazing,
    )  # fmt: skip
    assert grades(episodes) == {"full": 1, "partial": 1, "failed": 3}


# ---------------------------------------------------------------------------------------------------- Algorithm 4


@struct.dataclass
class Ahead:
    """Full speed ahead, whatever comes: it gets stuck at the first wall."""

    def init(self, frame, tasks=None):
        return jnp.zeros(())

    def act(self, memory, frame, key):
        return act_as_intended(jnp.tile(jnp.array([1.0, 0.0]), (len(frame.done), 1))), memory


CONFIG = RecoverConfig(recoveries=1, stuck_steps=10, stuck_m=0.05, patience=150, keep="joined")


@pytest.fixture(scope="module")
def recoveries():
    with contextlib.closing(RoomWorld(4, processes=1)) as world:

        def run(**changes):
            config = replace(CONFIG, **changes)
            return recover(jax.random.key(1), world, Ahead(), DifferentialDrive(), config, COLLECT, PLANNER)

        yield run


def test_the_planner_brings_home_whom_it_takes_over(recoveries):
    """What failed is stuck or out of patience; from there on it is led, and arrives."""
    joined = recoveries()
    last = joined.reward[np.arange(joined.n), joined.length - 1]
    assert joined.n >= 1 and (last > -1.3).all()
    for i, begin in enumerate(joined.label_mask.argmax(1)):
        np.testing.assert_allclose(joined.action[i, :begin], np.tile([1.0, 0.0], (begin, 1)))
        position = joined.position[i]
        stuck = np.linalg.norm(position[begin] - position[max(begin - CONFIG.stuck_steps, 0)]) < CONFIG.stuck_m
        assert stuck or begin == CONFIG.patience
    pieces = recoveries(keep="separate")
    assert pieces.n == 2 * joined.n and pieces.map_bits.shape[:2] == pieces.reward.shape
    np.testing.assert_array_equal(pieces.length[: joined.n] + pieces.length[joined.n :], joined.length)


def test_relabelled_steps_are_all_told_what_the_planner_would_do(recoveries):
    data = recoveries(keep="relabelled")
    for i, length in enumerate(data.length):
        assert (data.label_mask[i, :length] == 1).all()
        assert np.abs(data.label[i, :length] - data.action[i, :length]).max() > 0.05


def test_waves_are_run_once_and_read_back(toy_data, tmp_path):
    ran = []

    def wave(first):
        ran.append(first)
        if ran == [0, 50]:
            raise KeyboardInterrupt
        return Wave(toy_data([3, 5], seed=first), np.array([True, False]), np.array([False, first > 0]))

    keep = kept_in(tmp_path / "waves", hint="begin anew")(wave)
    one = keep(0)
    with pytest.raises(KeyboardInterrupt):
        keep(50)
    again = keep(0)
    assert keep(50).broke_off.tolist() == [False, True]
    assert ran == [0, 50, 50]
    for name in ("success", "broke_off"):
        assert getattr(again, name).dtype == bool
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
    for name in ("position", "reward", "length"):
        np.testing.assert_array_equal(getattr(one.data, name), getattr(again.data, name))
    (tmp_path / "waves" / "0.npz").write_bytes(b"half")
    with pytest.raises(UserError, match=r"0\.npz.*begin anew"):
        keep(0)
    for flags in FLAGS:
        (tmp_path / "waves" / "50.json").write_text(flags)
        with pytest.raises(UserError, match=r"50\.json.*begin anew"):
            keep(50)


FLAGS = (
    "{}", '{"flags": 3}', '{"flags": [[true, true]]}', '{"flags": [[true], [true]]}', '{"flags": [[1, 0], [1, 0]]}',
    '{"flags": [[true, true], 3]}', '{"flags": [[true, true], [true, true]] }\n]',
)  # fmt: skip


def test_a_collection_that_was_kept_is_read_back_whole(tmp_path):
    """The world runs nothing again, and what is read back is what was collected."""
    with contextlib.closing(RoomWorld(4, processes=1)) as world:
        arguments = (jax.random.key(0), world, DifferentialDrive(), COLLECT, PLANNER)
        one = collect(*arguments, keep=kept_in(tmp_path, hint=""))
        world.close()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RoomWorld, "rollout", lambda *_, **__: pytest.fail("run again"))
            again = collect(*arguments, keep=kept_in(tmp_path, hint=""))
    jax.tree.map(np.testing.assert_array_equal, one, again)


def test_the_seven_pairs_are_each_run_several_times():
    with SevenPairs(repeats=2).open(load_model("zoo:turtlebot3")) as trial:
        assert len(trial.pairs.start) == trial.head["episodes"] == 14 and trial.head["maze"] == "seven pairs"
        np.testing.assert_array_equal(trial.pairs.start[::2], trial.pairs.start[1::2])
        assert len(np.unique(trial.pairs.start, axis=0)) == 7
        episodes = pipeline.measured(trial, "planner", policy=None, controller=DifferentialDrive())  # pyright: ignore
        assert sum(grades(episodes).values()) == 14 and episodes.success.all()


def test_pt_cql_is_trained_and_evaluated_in_rooms(tmp_path, monkeypatch, capsys):
    """It learns from the trajectories, which keep their local maps. The planner comes with the known controller."""
    monkeypatch.setitem(turtlebot3.PRESETS, "tiny", TINY)
    monkeypatch.setattr(cli, "prepare_jax", lambda *_: None)
    folder, small = str(tmp_path / "run"), ["--baseline.updates", "4", "--baseline.width", "8", "--baseline.batch", "4"]
    assert main(["train", "turtlebot3", "--preset", "tiny", "--method", "pt-cql", *small, "--out", folder]) == 0
    assert [row["method"] for row in pipeline.results(Path(folder))] == ["pt-cql", "planner", "explorer"]
    for method in ("pt-cql", "planner"):
        capsys.readouterr()
        command = ["evaluate", folder, "--worlds", "1", "--pairs", "1", "--method", method, "--json"]
        assert main(command) == 0 and json.loads(capsys.readouterr().out)["method"] == method


def test_episodes_of_a_single_room_name_it(tmp_path):
    """The report draws episodes by room, also where there is only one."""
    ones, pairs = np.ones(3), Pairs(np.zeros((3, 2)), np.ones((3, 2)), np.ones(3), 0)
    episodes = Episodes(
        success=ones > 0, collided=ones < 0, fell=ones < 0, timeout=ones < 0, steps=4 * ones, returns=-ones,
        travelled_m=ones, path=np.zeros((4, 3, 2), np.float32), pairs=pairs, wall_s=1.0, horizon=4,
    )  # fmt: skip
    kept_row(tmp_path, "rooms", "ct", {"robot": "turtlebot3", "method": "ct", "maze": "rooms"}, lambda: episodes)
    with np.load(episodes_file(tmp_path, "rooms", "ct")) as arrays:
        np.testing.assert_array_equal(arrays["world"], [0, 0, 0])
