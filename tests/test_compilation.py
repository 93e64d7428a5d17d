"""Each program is compiled once per process, and once for all processes of a user."""

import json
import os
import stat
import sys
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from ct_envs import MazeEnv, load_maze
from ct_envs.maze import sample_pair
from ct_jax.evaluate import evaluate
from ct_jax.model import load_model
from ct_jax.pairs import Pairs
from ct_jax.rollout import run
from ct_jax.runtime import compilation
from ct_jax.worlds.mazes import MazeWorld

pytestmark = pytest.mark.rank_promotion("allow")

FOLDER = "jax_compilation_cache_dir"


def count(arguments, settings, home, file):
    """Run a command in a separate process, which records the number of programs and of cache hits."""
    from ct_envs import robots
    from ct_jax import cli
    from ct_jax.configs import point

    robots.ROBOTS["point"] = replace(robots.POINT, horizon=50)
    point.PRESETS["tiny"] = settings
    os.environ["XDG_CACHE_HOME"] = str(home)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    seen = Counter()
    jax.monitoring.register_event_listener(lambda name, **_: seen.update([name.rpartition("/")[2]]))
    status = cli.main(arguments)
    file.write_text(json.dumps([seen["compile_requests_use_cache"], seen["cache_hits"]]))
    sys.exit(status)


def counts(fork, arguments, settings, tmp_path):
    process = fork(count, arguments, settings, tmp_path / "home", tmp_path / "counts.json")
    process.join()
    assert process.exitcode == 0
    return json.loads((tmp_path / "counts.json").read_text())


def test_second_evaluation_compiles_nothing(fork, tiny_run, tiny_settings, tmp_path):
    """This includes programs that step MuJoCo. Other users cannot access the cache."""
    command = ["evaluate", str(tiny_run.folder), "--maze", "antmaze-umaze", "--episodes", "2"]
    asked, there = counts(fork, command, tiny_settings, tmp_path)
    assert there < asked
    again, there = counts(fork, command, tiny_settings, tmp_path)
    assert again == there > 10
    folders = [path for path in (tmp_path / "home").rglob("*") if path.is_dir()]
    assert folders and {stat.S_IMODE(path.stat().st_mode) for path in folders} == {0o700}


@pytest.mark.long
def test_second_training_compiles_nothing(fork, tiny_run, tiny_settings, tmp_path):
    asked = []
    for name in ("first", "second"):
        command = [*tiny_run.arguments, "--out", str(tmp_path / name)]
        asked.append(counts(fork, command, tiny_settings, tmp_path))
    (first, _), (second, there) = asked
    assert first == second == there > 100


def test_acting_compiles_once_for_mazes_of_same_size(tiny_run, islands):
    """Of horizons each, too, whenever it comes again."""
    model, env = load_model(str(tiny_run.folder)), MazeEnv("point", engine="mujoco", auto_reset=False)
    before = run._cache_size()
    for horizon, programs in ((20, 1), (25, 2), (20, 2)):
        for name in (str(islands), "antmaze-umaze", "antmaze-large"):
            maze = load_maze(name)
            draw = jax.vmap(lambda key, maze=maze: sample_pair(key, maze, radius=0.5))
            start, goal = map(np.asarray, draw(jax.random.split(jax.random.key(0), 2)))
            pairs = Pairs(start, goal, np.ones(2), 0)
            evaluate(MazeWorld(env, maze), pairs, "ct", policy=model.policy, horizon=horizon)
        assert run._cache_size() == before + programs


# ------------------------------------------------------------------------------------------------- the folder


@pytest.fixture
def kept(monkeypatch, tmp_path):
    """Call ``keep_programs`` without configuration; returns the chosen folder and the expected home folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))

    def keep():
        chosen = {FOLDER: None}
        with monkeypatch.context() as patch:
            patch.setattr(compilation.jax, "config", SimpleNamespace(values=chosen, update=chosen.__setitem__))
            compilation.keep_programs()
        return chosen[FOLDER]

    return keep


def test_cache_folder_is_private(kept, tmp_path):
    home = tmp_path / "home" / "ct-jax"
    home.mkdir(parents=True, mode=0o777)
    home.chmod(0o777)
    folder = kept()
    assert folder.startswith(str(home)) and kept() == folder
    assert stat.S_IMODE(home.stat().st_mode) == stat.S_IMODE(os.stat(folder).st_mode) == 0o700


def test_cache_folder_of_other_user_is_not_used(kept, monkeypatch):
    monkeypatch.setattr(compilation.os, "getuid", lambda: os.geteuid() + 1)
    assert kept() is None


def test_unwritable_home_is_not_an_error(kept, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    assert kept() is None


def test_each_kind_of_processor_has_its_own_cache(kept, monkeypatch):
    ours = kept()
    monkeypatch.setattr(compilation, "_processor", lambda: "another")
    assert kept() != ours


def test_configured_cache_folder_is_kept():
    before = jax.config.values[FOLDER]
    quickest = jax.config.jax_persistent_cache_min_compile_time_secs
    try:
        compilation.keep_programs()
        assert before and jax.config.values[FOLDER] == before
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", quickest)
