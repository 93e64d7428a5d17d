"""A run that is killed at any point, several times, ends with the same weights as an uninterrupted run.

The command line runs in processes that are forked from a process with all imports (``fork``), so that a restart only
has to trace its programs.
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

from ct_jax import pipeline
from ct_jax.configs import point, turtlebot3
from ct_jax.fit import FitConfig, ValueConfig
from ct_jax.runtime.checkpoint import Checkpoints, run_to
from ct_jax.settings import RoomConfig

pytestmark = pytest.mark.rank_promotion("allow")

STAGES = ("prm", "controller", "collect", "fit", "finetune", "evaluate")
OPERATIONS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.scandir", "shutil.rmtree"}


# -------------------------------------------------------------------------------------------------------- SIGKILL


def live(arguments, settings, folder, stage, operations, cache):
    """Run to the end, or for a number of file operations after the first one in a stage's folder."""
    from ct_envs import robots
    from ct_jax import cli
    from ct_jax.runtime import checkpoint

    robots.ROBOTS["point"] = replace(robots.POINT, horizon=50)
    point.PRESETS["tiny"] = turtlebot3.PRESETS["tiny"] = settings
    cli.prepare_jax = lambda *_: None
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    checkpoint.SAVE_EVERY_S = 0.0
    left = operations

    def watch(event, given):
        nonlocal left
        begun = left < operations
        if event in OPERATIONS and given and str(folder if begun else folder / stage) in str(given[0]):
            left -= 1
            if not left:
                os.kill(os.getpid(), signal.SIGKILL)

    if operations:
        sys.addaudithook(watch)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.exit(cli.main([*arguments, "--out", str(folder), "--resume"]))


def weights(folder):
    """The exact weights."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.glob("*/*.safetensors")}


class Killer:
    """Run a command until it ends, and kill it several times. Each kill is for one stage, after a random number of file
    operations (an int gives the maximum) or after a random time (a float gives the maximum in seconds)."""

    def __init__(self, fork, arguments, settings, deaths, *, seed=0):
        self.fork, self.arguments, self.settings, self.deaths = fork, arguments, settings, list(deaths)
        self.rng, self.died_in = np.random.default_rng(seed), []

    def run(self, folder, stages=STAGES):
        """Run all stages to the end, with the remaining kills."""
        while True:
            now = next((stage for stage in stages if not (folder / stage / "done.json").is_file()), stages[-1])
            stage, most = self.deaths[0] if self.deaths else (now, 0)
            stage = max(stage, now, key=stages.index)  # a kill by time may come too late
            operations = int(self.rng.integers(1, most + 1)) if isinstance(most, int) and most else 0
            cache = jax.config.jax_compilation_cache_dir
            process = self.fork(live, self.arguments, self.settings, folder, stage, operations, cache)
            if isinstance(most, float):
                while process.is_alive() and not (folder / stage).exists():
                    time.sleep(0.02)
                process.join(self.rng.uniform(0.0, most))
            else:
                process.join()
            process.kill()
            process.join()
            if process.exitcode == 0:
                return
            assert process.exitcode == -signal.SIGKILL
            self.deaths.pop(0)
            self.died_in.append(next((s for s in stages if not (folder / s / "done.json").is_file()), "report"))


def assert_same_end(folder, whole):
    assert weights(folder) == weights(whole)
    for ours, theirs in zip(pipeline.results(folder), pipeline.results(whole), strict=True):
        assert ours | {"wall_s": 0} == theirs | {"wall_s": 0}
    assert not [*folder.glob("*/checkpoints*"), *folder.glob("*/waves*"), *folder.glob("*/*.part")]


def test_killed_run_equals_uninterrupted_run(fork, tiny_run, tiny_settings, tmp_path):
    killer = Killer(fork, tiny_run.arguments, tiny_settings, [("controller", 60), ("collect", 4), ("finetune", 60)])
    killer.run(tmp_path / "run")
    assert killer.died_in == ["controller", "collect", "finetune"]
    assert_same_end(tmp_path / "run", tiny_run.folder)


@pytest.mark.long
def test_fourteen_kills_in_mazes(fork, tiny_run, tiny_settings, tmp_path):
    """Kills between two file operations, and kills by time, which mostly hit tracing, compilation or computation."""
    deaths = [
        ("prm", 4), ("controller", 60), ("controller", 3.0), ("controller", 60), ("collect", 4), ("collect", 3.0),
        ("fit", 60), ("fit", 3.0), ("fit", 60), ("finetune", 60), ("finetune", 5.0), ("finetune", 60),
        ("evaluate", 20), ("evaluate", 3.0),
    ]  # fmt: skip
    killer = Killer(fork, tiny_run.arguments, tiny_settings, deaths, seed=2)
    for number in range(len(deaths)):
        if killer.deaths:
            killer.run(tmp_path / str(number))
            assert_same_end(tmp_path / str(number), tiny_run.folder)
    assert {*STAGES} <= {*killer.died_in} and not killer.deaths, killer.died_in


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="PyBullet is not installed")
def test_six_kills_in_rooms(fork, tmp_path):
    """With worker processes, which end with their pool."""
    stages = ("collect", "fit", "finetune", "evaluate")
    fit = FitConfig(updates=6, batch=4, steps=5, warmup=2)
    settings = replace(
        turtlebot3.CPU,
        collect=replace(turtlebot3.CPU.collect, trajectories=6, envs=4, reset_interval=2),
        model=replace(turtlebot3.CPU.model, layers=1, heads=2, width=16),
        value=ValueConfig(fit=replace(fit, steps=1), width=16),
        fit=fit,
        rounds=2,
        round_fit=fit,
        last_fit=None,
        recover=replace(turtlebot3.CPU.recover, recoveries=2, patience=20, stuck_steps=15, stuck_m=0.1),
        episodes=2,
        rooms=RoomConfig(worlds=2),
    )
    arguments = ["train", "turtlebot3", "--preset", "tiny"]
    Killer(fork, arguments, settings, []).run(tmp_path / "whole", stages)
    deaths = [("collect", 12), ("collect", 8.0), ("collect", 12), ("finetune", 8), ("finetune", 8.0), ("evaluate", 10)]
    killer = Killer(fork, arguments, settings, deaths, seed=3)
    killer.run(tmp_path / "killed", stages)
    assert {"collect", "finetune", "evaluate"} <= {*killer.died_in}, killer.died_in
    assert_same_end(tmp_path / "killed", tmp_path / "whole")


# -------------------------------------------------------------------------------------------------------- SIGTERM


def train_for_ever(folder):
    """A training whose second chunk takes minutes in XLA."""
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


def test_sigterm_during_long_program_saves_in_time(fork, tmp_path):
    """Python cannot handle the signal in time, but the state after the last chunk is saved."""
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
