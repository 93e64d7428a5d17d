"""A run that is stopped, anywhere and again and again, ends with the weights of one that nothing stopped.

The command line runs in processes that are forked from one which has imported everything (``fork``), so that a life
costs what it takes to trace the programs it needs.
"""

import importlib.util
import os
import signal
import sys
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_jax import pipeline, presets
from ct_jax.checkpoint import Checkpoints, run_to
from ct_jax.fit import FitConfig

pytestmark = pytest.mark.rank_promotion("allow")

STAGES = ("prm", "controller", "collect", "fit", "finetune", "evaluate")
OPERATIONS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.scandir", "shutil.rmtree"}


# -------------------------------------------------------------------------------------------------------- SIGKILL


def live(arguments, settings, folder, operations, cache):
    """One life of a run: to its end, or so many file operations in its folder."""
    from ct_envs import robots
    from ct_jax import checkpoint, cli, presets

    robots.ROBOTS["point"] = replace(robots.POINT, horizon=50)
    presets.PRESETS["tiny"] = presets.TURTLEBOT3_PRESETS["tiny"] = settings
    cli.prepare_jax = lambda: None
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    checkpoint.SAVE_EVERY_S = 0.0
    left = iter(range(operations - 1, -1, -1))

    def watch(event, given):
        if event in OPERATIONS and given and str(folder) in str(given[0]) and not next(left):
            os.kill(os.getpid(), signal.SIGKILL)

    if operations:
        sys.addaudithook(watch)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.exit(cli.main([*arguments, "--out", str(folder), "--resume"]))


def unfinished(folder):
    """The stage in which a run was killed."""
    return next((stage for stage in STAGES if not (folder / stage / "done.json").is_file()), "report")


def weights(folder):
    """What was learned, to the last bit."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.glob("*/*.safetensors")}


class Killer:
    """Runs a command again and again, and kills it so many times in all, every other time by the clock."""

    def __init__(self, fork, arguments, settings, *, kills, operations, seconds=0.0, seed=0):
        self.fork, self.arguments, self.settings, self.kills = fork, arguments, settings, kills
        self.operations, self.seconds, self.rng = operations, seconds, np.random.default_rng(seed)
        self.where = []

    def run(self, folder):
        """To the end; as many deaths on the way as are left."""
        while True:
            dying = len(self.where) < self.kills
            by_clock = dying and self.seconds > 0 and len(self.where) % 2 == 1
            operations = int(self.rng.integers(1, self.operations)) if dying and not by_clock else 0
            cache = jax.config.jax_compilation_cache_dir
            process = self.fork(live, self.arguments, self.settings, folder, operations, cache)
            process.join(self.rng.uniform(0.0, self.seconds) if by_clock else None)
            process.kill()
            process.join()
            if process.exitcode == 0:
                return
            assert process.exitcode == -signal.SIGKILL
            self.where.append(unfinished(folder))


def assert_same_end(folder, whole):
    assert weights(folder) == weights(whole)
    for ours, theirs in zip(pipeline.results(folder), pipeline.results(whole), strict=True):
        assert ours | {"wall_s": 0} == theirs | {"wall_s": 0}
    assert not [*folder.glob("*/checkpoints*"), *folder.glob("*/waves*"), *folder.glob("*/*.part")]


def test_a_killed_run_ends_like_one_that_was_not(fork, tiny_run, tiny_settings, tmp_path):
    killer = Killer(fork, tiny_run.arguments, tiny_settings, kills=3, operations=200, seed=1)
    killer.run(tmp_path / "run")
    assert len(killer.where) == 3, killer.where
    assert_same_end(tmp_path / "run", tiny_run.folder)


def kill_often(killer, root, whole):
    """As many whole runs as the deaths last; returns where it died."""
    number = 0
    while len(killer.where) < killer.kills:
        number += 1
        killer.run(root / str(number))
        assert_same_end(root / str(number), whole)
    return killer.where


@pytest.mark.long
def test_fourteen_deaths_in_mazes(fork, tiny_run, tiny_settings, tmp_path):
    """Between two file operations, and by the clock: mostly while something is traced, compiled or computed."""
    killer = Killer(fork, tiny_run.arguments, tiny_settings, kills=14, operations=200, seconds=20.0, seed=2)
    where = kill_often(killer, tmp_path, tiny_run.folder)
    assert {"controller", "collect", "fit", "finetune", "evaluate"} <= {*where}, where


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="PyBullet is not installed")
def test_six_deaths_in_rooms(fork, tmp_path):
    """With worker processes, which go when their pool is gone."""
    fit = FitConfig(updates=6, batch=4, steps=5, warmup=2)
    settings = replace(
        presets.TURTLEBOT3_CPU,
        collect=replace(presets.TURTLEBOT3_CPU.collect, trajectories=6, envs=4, reset_interval=2),
        model=replace(presets.TURTLEBOT3_CPU.model, layers=1, heads=2, width=16),
        value=presets.ValueConfig(fit=replace(fit, steps=1), width=16),
        fit=fit,
        round_fit=fit,
        recover=replace(presets.TURTLEBOT3_CPU.recover, recoveries=2, patience=20, stuck_steps=15, stuck_m=0.1),
        episodes=2,
        rooms=presets.RoomConfig(worlds=2),
    )
    arguments = ["train", "turtlebot3", "--preset", "tiny"]
    Killer(fork, arguments, settings, kills=0, operations=0).run(tmp_path / "whole")
    killer = Killer(fork, arguments, settings, kills=6, operations=150, seconds=30.0, seed=3)
    where = kill_often(killer, tmp_path, tmp_path / "whole")
    assert {"collect", "finetune"} <= {*where}, where


# -------------------------------------------------------------------------------------------------------- SIGTERM


def train_for_ever(folder):
    """A training whose second chunk takes XLA minutes."""
    from ct_jax.cli import guarded

    @jax.jit
    def spin(state):
        steps = jnp.where(state["step"] < 1, 1, 2**31 - 1)
        x = jax.lax.fori_loop(0, steps, lambda i, x: jnp.sin(x) + i, state["x"])
        return {"x": x, "step": state["step"] + 1}, {"loss": x}

    state = {"x": jnp.zeros(()), "step": jnp.zeros((), jnp.int32)}
    checkpoints = Checkpoints(folder / "checkpoints")
    sys.exit(
        guarded(
            lambda: run_to(
                9, state, lambda state, n: spin(state), lambda state: int(state["step"]),
                lambda done, report: (folder / "begun").touch(), checkpoints, 1,
            )
        )
    )  # fmt: skip


def test_sigterm_is_obeyed_in_time_in_the_middle_of_a_long_program(fork, tmp_path):
    """Python cannot even see the signal; what the last chunk left is saved all the same."""
    process = fork(train_for_ever, tmp_path)
    while not (tmp_path / "begun").exists():
        assert process.is_alive()
        time.sleep(0.05)
    time.sleep(0.5)
    begun = time.monotonic()
    process.terminate()
    process.join(60.0)
    assert process.exitcode == 0
    assert time.monotonic() - begun < 10.0
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    step, state = checkpoints.restore({"x": np.zeros((), np.float32), "step": np.zeros((), np.int32)})
    checkpoints.close()
    assert (step, int(state["step"])) == (1, 1)
