"""The pipeline: the folder of a run, and resuming after any interruption."""

import contextlib
import dataclasses
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from ct_envs import UserError, load_maze, robots
from ct_jax import pipeline
from ct_jax import trajectories as storage
from ct_jax.cli import main
from ct_jax.evaluate import METHODS
from ct_jax.model import load_model
from ct_jax.runtime import run as runs
from ct_jax.runtime.checkpoint import read_json
from ct_jax.runtime.progress import Bar, Metrics
from ct_jax.runtime.run import Run, load_mazes, maze_text, open_run, random_mazes
from ct_jax.settings import Settings
from ct_jax.worlds import Trial, kind_of, maze_runs
from ct_jax.worlds.mazes import MazeWorld

pytestmark = pytest.mark.rank_promotion("allow")

WEIGHTS = (
    "controller/weights.safetensors", "fit/value.safetensors", "fit/fit.safetensors",
    "finetune/value-1.safetensors", "finetune/fit-1.safetensors", "model/weights.safetensors",
)  # fmt: skip
STAGES = ("prm", "controller", "collect", "fit", "finetune", "evaluate")


def make_run(folder, settings, **changes):
    mazes = load_mazes(("antmaze-umaze",))
    run = Run(folder, "point", "tiny", settings, mazes, {}, seed=0, engine="auto")
    return dataclasses.replace(run, **changes)


def copy(tiny_run, tmp_path):
    return Path(shutil.copytree(tiny_run.folder, tmp_path / "copy"))


def read_array(file, name):
    with np.load(file) as arrays:
        return arrays[name]


def times(folder):
    return {str(file): file.stat().st_mtime_ns for file in folder.glob("*/done.json")}


# ---------------------------------------------------------------------------------------------------- a whole run


def test_run_writes_all_files(tiny_run):
    folder = tiny_run.folder
    for stage in STAGES:
        assert read_json(folder / stage / "done.json")["wall_s"] >= 0
    for name in (*WEIGHTS, "report.html", "report.png", "model/model.json", "collect/trajectories.npz"):
        assert (folder / name).stat().st_size > 0
    assert list((folder / "tensorboard").glob("events.*"))
    assert not list(folder.glob("*/checkpoints*")), "checkpoints of finished stages are not needed"
    text = (folder / "metrics.jsonl").read_text()
    lines = [json.loads(line, parse_constant=pytest.fail) for line in text.splitlines()]
    assert {line["stage"] for line in lines} == {"controller", "value", "fit", "value-1", "fit-1"}


def test_config_describes_run(tiny_run, tiny_settings):
    config = read_json(tiny_run.folder / "config.json")
    assert (config["robot"], config["preset"], config["seed"], config["engine"]) == ("point", "tiny", 0, "auto")
    assert list(config["mazes"]) == ["islands"] and list(config["eval_mazes"]) == ["antmaze-umaze"]
    assert config["mazes"]["islands"].splitlines()[1] == "#...#...#"
    assert config["settings"]["fit"]["updates"] == tiny_settings.fit.updates
    assert config["versions"].keys() >= {"ct-jax", "python", "jax", "flax", "mujoco"}
    assert config["hardware"] and config["commit"] and config["command"] and config["created"].startswith("20")


def test_all_methods_have_same_pairs(tiny_run):
    rows = pipeline.results(tiny_run.folder)
    places = [("islands", True), ("antmaze-umaze", False)]
    assert [(row["maze"], row["seen"], row["method"]) for row in rows] == [(*p, m) for p in places for m in METHODS]
    for maze, _ in places:
        for name in ("start", "goal"):
            drawn = [read_array(tiny_run.folder / "evaluate" / f"{maze}-{method}.npz", name) for method in METHODS]
            assert len(drawn[0]) == 4 and all((each == drawn[0]).all() for each in drawn)
    assert all(np.isfinite(row["spl"]) for row in rows)


def test_start_and_goal_are_in_same_region(tiny_run):
    pairs = read_json(next((tiny_run.folder / "evaluate").glob("pairs-islands-*.json")))
    side = [np.array(pairs[name])[:, 0] < 18.0 for name in ("start", "goal")]  # the wall is 16 m to 20 m from the left
    assert (side[0] == side[1]).all()


def test_model_round_trip_is_identity(tiny_run, tiny_settings):
    model = load_model(str(tiny_run.folder))
    assert (model.robot, model.settings, model.made["seed"]) == ("point", tiny_settings, 0)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves((model.policy, model.controller)))


def test_random_mazes_are_in_data_but_not_in_evaluation(tiny_settings, tmp_path):
    collecting = dataclasses.replace(tiny_settings.collect, trajectories=6, reset_interval=2)
    settings = dataclasses.replace(tiny_settings, controller="zoo", random_mazes=3, collect=collecting, rounds=0)
    run = make_run(tmp_path / "run", settings)  # a trained controller succeeds in every maze
    pipeline.train(run)
    data = storage.load(run.folder / "collect" / "trajectories.npz")
    assert set(data.maze.tolist()) > {0} and data.maze.max() <= 3
    walls, cell_m = np.asarray(run.stacked.walls), 4.0
    for i in range(data.n):
        column, row = np.floor(data.position[i, : data.length[i]] / cell_m).astype(int).T
        assert not walls[data.maze[i], row, column].any()
    assert {row["maze"] for row in pipeline.results(run.folder)} == {"antmaze-umaze"}


def test_recoveries_come_from_random_mazes(tiny_settings, tmp_path):
    collecting = dataclasses.replace(tiny_settings.collect, reset_interval=2)
    recovering = dataclasses.replace(tiny_settings.recover, random_mazes=3, keep="relabelled")
    settings = dataclasses.replace(tiny_settings, controller="zoo", collect=collecting, recover=recovering)
    run = make_run(tmp_path / "run", settings)
    pipeline.train(run)
    plans, recoveries = (
        storage.load(run.folder / name) for name in ("collect/trajectories.npz", "finetune/trajectories-1.npz")
    )
    assert plans.maze.max() == 0 < recoveries.maze.max() <= 3
    walls, cell_m = np.asarray(run.stacked.walls), 4.0
    for i in range(recoveries.n):
        column, row = np.floor(recoveries.position[i, : recoveries.length[i]] / cell_m).astype(int).T
        assert not walls[recoveries.maze[i], row, column].any()


@pytest.mark.rank_promotion("allow")  # brax's running statistics
def test_skill_head_equals_controller_after_all_rounds(tiny_settings, tmp_path):
    model = dataclasses.replace(tiny_settings.model, skill=True)
    run = make_run(tmp_path / "run", dataclasses.replace(tiny_settings, model=model))
    pipeline.train(run)
    trained = load_model(str(run.folder))
    skill, controller = trained.policy.params["skill"]["head"]["controller"], trained.controller
    found = (skill["mean"], skill["std"], skill["policy"])
    meant = (controller.normalizer.mean, controller.normalizer.std, controller.policy)
    jax.tree.map(np.testing.assert_array_equal, found, meant)
    assert "predict_action" not in trained.policy.params["params"]


def test_run_keeps_copy_of_given_controller(tiny_run, tiny_settings, tmp_path):
    """Later changes at the source do not affect the run."""
    source = tmp_path / "source"
    shutil.copytree(tiny_run.folder / "controller", source / "controller")
    settings = dataclasses.replace(tiny_settings, controller=str(source), controller_action_scale=0.5)
    run = make_run(tmp_path / "run", settings)
    with open_run(run, resume=False), contextlib.closing(Metrics(run.folder)) as metrics:
        given, config = kind_of(run.spec).controller(run, metrics)
        shutil.rmtree(source)
        again, _ = kind_of(run.spec).controller(run, metrics)
    jax.tree.map(np.testing.assert_array_equal, given, again)
    done = run.done("controller")
    assert done is not None and done["given"] == str(source)
    assert given.action_scale == config.sac.action_scale == 0.5 * tiny_settings.sac.action_scale


def test_random_mazes_are_fixed():
    """The config of a run contains only their number."""
    few, many = random_mazes(2), random_mazes(4)
    assert all((a.walls == b.walls).all() for a, b in zip(few, many, strict=False))
    text = "".join(maze_text(maze) for maze in many)
    assert hashlib.sha256(text.encode()).hexdigest()[:12] == "8b7c1ab2a05e"
    assert len({maze_text(maze) for maze in random_mazes(100)}) == 100


# ------------------------------------------------------------------------------------------------------- resuming


def test_finished_run_is_not_repeated(tiny, tiny_run, tmp_path, monkeypatch):
    folder = copy(tiny_run, tmp_path)
    before = times(folder)
    stages = [(pipeline, name) for name in ("collect", "fit", "recover", "evaluate")]
    for module, name in [*stages, (maze_runs, "build_roadmap"), (maze_runs, "train_controller")]:
        monkeypatch.setattr(module, name, lambda *a, **k: pytest.fail("run again"))
    (folder / "report.html").unlink()
    assert main([*tiny_run.arguments, "--out", str(folder), "--resume"]) == 0
    assert times(folder) == before and (folder / "report.html").is_file()


def interrupt_in(monkeypatch, name, number):
    """Send a signal at the first update of the bar with this name."""
    update = Bar.update

    def moved(bar, done, note=""):
        update(bar, done, note)
        if bar.name == name:
            monkeypatch.setattr(Bar, "update", update)
            os.kill(os.getpid(), number)

    monkeypatch.setattr(Bar, "update", moved)


def test_interrupted_run_equals_uninterrupted_run(tiny, tiny_run, tmp_path, monkeypatch, capsys):
    """It is interrupted in all stages, by Ctrl-C and by SIGTERM. Finished work is kept, and the final weights and
    results equal those of an uninterrupted run bit for bit."""
    folder = tmp_path / "stopped"
    command = [*tiny_run.arguments, "--out", str(folder), "--resume"]
    kept: dict[str, int] = {}
    bars = ("controller", "collect", "fit", "recover-1", "fit-1", "planner in islands")
    for i, name in enumerate(bars):
        number = (signal.SIGINT, signal.SIGTERM)[i % 2]
        interrupt_in(monkeypatch, name, number)
        assert main(command) == {signal.SIGINT: 130, signal.SIGTERM: 0}[number], name
        told = capsys.readouterr().err.splitlines()[-1]
        assert told.startswith("stopped; ") and "--resume" in told and str(folder) in told
        now = times(folder)
        assert kept.items() <= now.items(), "a finished stage was run again"
        kept = now
    assert main(command) == 0
    assert kept.items() <= times(folder).items()
    assert "ct in islands" not in capsys.readouterr().err, "a finished row was made again"
    for name in WEIGHTS:
        assert (folder / name).read_bytes() == (tiny_run.folder / name).read_bytes(), name
    for ours, whole in zip(pipeline.results(folder), pipeline.results(tiny_run.folder), strict=True):
        assert ours | {"wall_s": 0} == whole | {"wall_s": 0}


def test_signal_during_physics_is_pending(tiny, tiny_run, tmp_path, monkeypatch, capsys):
    from ct_envs.physics import MujocoEngine

    step, calls = MujocoEngine._step, []

    def signalling(engine, *arguments):
        calls.append(1)
        if len(calls) == 10:
            os.kill(os.getpid(), signal.SIGINT)
        return step(engine, *arguments)

    monkeypatch.setattr(MujocoEngine, "_step", signalling)
    assert main([*tiny_run.arguments, "--out", str(tmp_path / "run")]) == 130
    err = capsys.readouterr().err
    assert "Traceback" not in err and err.splitlines()[-1].startswith("stopped; ")
    assert list((tmp_path / "run" / "controller" / "checkpoints-controller").glob("[0-9]*"))


def test_wall_time_includes_interrupted_attempts(tmp_path, tiny_settings, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(runs.time, "perf_counter", lambda: now[0])
    run = make_run(tmp_path, tiny_settings)
    for error in (KeyboardInterrupt, UserError, None):
        try:
            with run.stage("fit"):
                now[0] += 10.0
                if error:
                    raise error
        except (KeyboardInterrupt, UserError):
            assert run.done("fit") is None
    assert run.done("fit") == {"wall_s": 30.0} and not (tmp_path / "fit" / "spent.json").exists()


# ------------------------------------------------------------------------------------------------- damaged folders


def test_unfinished_stage_is_repeated(tiny, tiny_run, tmp_path):
    folder = copy(tiny_run, tmp_path)
    weights = (folder / WEIGHTS[0]).read_bytes()
    shutil.rmtree(folder / "model")
    for name in ("controller", "collect"):
        (folder / name / "done.json").unlink()
    (folder / WEIGHTS[0]).write_bytes(weights[:50])
    (folder / "collect" / "trajectories.npz").write_bytes(b"half")
    assert main([*tiny_run.arguments, "--out", str(folder), "--resume"]) == 0
    assert (folder / WEIGHTS[0]).read_bytes() == weights


@pytest.mark.parametrize(
    "name", [*WEIGHTS, "controller/done.json", "fit/done.json", "collect/trajectories.npz", "model/model.json"]
)
def test_damaged_file_is_named_with_remedy(name, tiny, tiny_run, tmp_path, capsys):
    """The file is cut in half. The error names the file and what to delete; deleting it helps."""
    folder = copy(tiny_run, tmp_path)
    if not name.startswith("model/"):
        shutil.rmtree(folder / "model")
    (folder / name).write_bytes((folder / name).read_bytes()[: (folder / name).stat().st_size // 2])
    capsys.readouterr()
    command = [*tiny_run.arguments, "--out", str(folder), "--resume"]
    if name == WEIGHTS[-1]:
        command = ["evaluate", str(folder)]
    assert main(command) == 2
    err = capsys.readouterr().err
    line = err.splitlines()[-1]
    assert line.startswith("error: ") and err.count("error") == 1 and "Traceback" not in err
    assert str(folder / name) in line and f"delete {folder / Path(name).parent}" in line and "--resume" in line


@pytest.mark.parametrize(
    "changes",
    [
        {"start": None}, {"start": 3}, {"start": {"a": 1}}, {"start": [["x", 2]]}, {"start": [["nan", 2]]},
        {"start": [[1e300, 2]]}, {"start": [[10**400, 2]]}, {"start": [[1, 2], [1]]}, {"goal": [[1, 2, 3]]},
        {"shortest_m": [1, 2]}, {"shortest_m": 1}, {"start": [], "goal": [], "shortest_m": []},
    ],
    ids=lambda changes: str(changes)[:30],
)  # fmt: skip
def test_invalid_pairs_are_error(changes, tmp_path, tiny_settings):
    run = make_run(tmp_path, tiny_settings)
    (tmp_path / "evaluate").mkdir()
    pairs = {"start": [[1, 2]], "goal": [[1, 2]], "shortest_m": [1]} | changes
    (tmp_path / "evaluate" / "pairs-antmaze-umaze-4-0.json").write_text(json.dumps(pairs))
    with pytest.raises(UserError, match=r"pairs-antmaze-umaze-4-0\.json: not an evaluation's pairs .*; delete it"):
        next(kind_of(run.spec).trials(run, tmp_path / "evaluate"))


TRIAL = Trial("antmaze-umaze", None, None, {}, None, 1)  # pyright: ignore  # that nobody runs


@pytest.mark.parametrize(
    "name", ["method", "maze", "success_rate", "success_ci95", "spl", "return_scaled", "steps_mean"]
)
@pytest.mark.parametrize("value", [None, [], {}, "x" * 3, [1], True])
def test_invalid_rows_are_error(name, value, tiny_run, tmp_path, tiny_settings):
    """The row of an interrupted evaluation, and the rows of a finished one."""
    rows = pipeline.results(tiny_run.folder)
    row = rows[0] | {name: value}
    if value is None:
        del row[name]
    elif isinstance(value, str) and name in ("method", "maze"):
        return
    run, folder = make_run(tmp_path, tiny_settings), tmp_path / "evaluate"
    folder.mkdir()
    (folder / "antmaze-umaze-ct.json").write_text(json.dumps(row))
    with pytest.raises(UserError, match=r"antmaze-umaze-ct\.json: not a row"):
        pipeline.evaluated(run, folder, TRIAL, "ct", policy=None)  # pyright: ignore
    for found in ({"rows": [*rows, row]}, {"rows": row}, {"rows": None}, {}):
        (folder / "results.json").write_text(json.dumps(found))
        with pytest.raises(UserError, match=r"results\.json: not the rows of a table; delete .*evaluate and continue"):
            pipeline.results(tmp_path)


@pytest.mark.parametrize("changes", [{"proprio": 3}, {"action": 3, "label": 3}, {"maze": 9}])
def test_trajectories_of_other_run_are_error(changes, toy_data, tiny_run, tiny_settings, tmp_path):
    """Trajectories of another robot, or of mazes that do not belong to the run."""
    folder = copy(tiny_run, tmp_path)
    data = toy_data([3, 4])
    wider = {name: np.repeat(getattr(data, name)[..., :1], n, -1) for name, n in changes.items() if name != "maze"}
    data = data.replace(maze=data.maze + np.int32(changes.get("maze", 0)), **wider)
    storage.save(data, folder / "collect" / "trajectories.npz")
    with pytest.raises(UserError, match=r"trajectories\.npz: trajectories of another run; delete .*collect"):
        pipeline.planning_trajectories(make_run(folder, tiny_settings), None)


def test_config_without_provenance_is_error(tiny_run, tmp_path, tiny_settings):
    folder = copy(tiny_run, tmp_path)
    config = read_json(folder / "config.json")
    del config["commit"]
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"config\.json: 'commit' is missing; restore the file"):
        _ = make_run(folder, tiny_settings).made


def test_invalid_wall_time_is_error(tmp_path, tiny_settings):
    run = make_run(tmp_path, tiny_settings)
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit" / "spent.json").write_text('{"wall_s": "long"}')
    with pytest.raises(UserError, match=r"spent\.json: 'wall_s' is no number"), run.stage("fit"):
        pass


# ------------------------------------------------------------------------------------------------ the run's folder


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"preset": "demo"}, "preset tiny, not demo"),
        ({"seed": 1}, "seed 0, not 1"),
        ({"engine": "mjx"}, "engine auto, not mjx"),
        ({"robot": "ant"}, "robot point, not ant"),
        ({"settings": Settings(rounds=3)}, r"settings\.\w+"),
        ({"mazes": load_mazes(("antmaze-medium",))}, "mazes antmaze-umaze, not antmaze-medium"),
        ({"mazes": {"antmaze-umaze": load_maze("antmaze-medium")}}, "another mazes.antmaze-umaze"),
        ({"eval_mazes": load_mazes(("antmaze-medium",))}, "eval_mazes"),
        ({"method": "bc-ct"}, "method ct, not bc-ct"),
    ],
)
def test_run_resumes_only_with_same_configuration(changes, words, tmp_path, tiny_settings):
    run = make_run(tmp_path / "run", tiny_settings)
    with open_run(run, resume=False):
        pass
    for resume in (True, False):
        with (
            pytest.raises(UserError, match=f"config.json: a run with .*{words}.*--out"),
            open_run(dataclasses.replace(run, **changes), resume=resume),
        ):
            pass
    with pytest.raises(UserError, match="--resume"), open_run(run, resume=False):
        pass
    with open_run(run, resume=True):
        pass


def test_run_folder_is_locked(tmp_path, tiny_settings):
    run = make_run(tmp_path / "run", tiny_settings)
    with open_run(run, resume=True):
        code = f"import fcntl; fcntl.flock(open({str(run.folder / 'run.lock')!r}), fcntl.LOCK_EX | fcntl.LOCK_NB)"
        held = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert "BlockingIOError" in held.stderr
        with pytest.raises(UserError, match="another process"), open_run(run, resume=True):
            pass


def test_different_mazes_with_same_name_are_error(tmp_path):
    for folder, text in (("a", "####\n#..#\n####"), ("b", "#####\n#...#\n#####")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "floor.txt").write_text(text)
    same, other = str(tmp_path / "a" / "floor.txt"), str(tmp_path / "b" / "floor.txt")
    assert list(load_mazes((same, same, "hall"))) == ["floor", "hall"]
    with pytest.raises(UserError, match=r"b/floor\.txt: .*'floor' already"):
        load_mazes((same, other))
    with pytest.raises(UserError, match="'floor' already"):
        runs.join_mazes(load_mazes((same,)), load_mazes((other,)))
    assert list(runs.join_mazes(load_mazes((same,)), load_mazes((same, "hall")))) == ["floor", "hall"]


# ------------------------------------------------------------------------------------------- without compilation


@pytest.mark.slow
def test_all_stages_run_without_jit(jit_disabled, tmp_path, tiny_settings, monkeypatch, islands):
    spec = dataclasses.replace(robots.POINT, horizon=2, goal_tolerance_m=1.5)
    monkeypatch.setitem(robots.ROBOTS, "point", spec)
    change = dataclasses.replace
    fit = change(tiny_settings.fit, updates=1, batch=1, steps=2)
    settings = change(
        tiny_settings,
        prm=change(tiny_settings.prm, samples=12),
        sac=change(tiny_settings.sac, envs=1, iterations=3, batch=1, replay=4),
        edges=change(tiny_settings.edges, episode_steps=2, held_out=0.05),
        collect=change(tiny_settings.collect, trajectories=1, envs=4, horizon=2, reset_interval=4, guide="roadmap"),
        rounds=0,  # a round would be a second fit; recoveries have their own test without jit
        fit=fit,
        value=change(tiny_settings.value, fit=change(fit, steps=1)),
        episodes=2,
    )

    # What would take minutes op by op, and is tested elsewhere: planner and explorer, a roadmap of a thousand points,
    # and first parameters.
    monkeypatch.setattr(pipeline, "GUIDED", ())
    for module, name in ((MazeWorld, "draw_pairs"), (pipeline, "init_params")):
        monkeypatch.setattr(module, name, jax.disable_jit(False)(getattr(module, name)))
    run = make_run(tmp_path / "run", settings, mazes=load_mazes((str(islands),)))
    assert pipeline.train(run).is_file()
    assert [row["method"] for row in pipeline.results(run.folder)] == ["ct"]


def test_changed_results_do_not_make_commit_dirty(tmp_path, monkeypatch):
    def git(*arguments):
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        return subprocess.run(
            ["git", *who, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout

    code, found = tmp_path / "ct_jax" / "run.py", tmp_path / "experiments" / "results" / "x.json"
    git("init", "-q")
    for file in (code, found):
        file.parent.mkdir(parents=True)
        file.write_text("1")
    git("add", ".")
    git("commit", "-qm", "first")
    commit = git("describe", "--always").strip()
    monkeypatch.setattr(runs, "__file__", str(code))
    assert runs._commit() == commit
    found.write_text("2")
    (tmp_path / "new").write_text("not tracked")
    assert runs._commit() == commit
    code.write_text("2")
    assert runs._commit() == f"{commit}-dirty"
    monkeypatch.setattr(runs, "__file__", str(tmp_path / "new"))
    assert runs._commit() == "unknown"
