"""The interfaces are enough: a world, a guide or a policy of one class goes through the whole method unchanged."""

import contextlib
import importlib.util
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from ct_envs import MazeEnv, UserError, load_maze
from ct_envs.robots import POINT, ROBOTS
from ct_jax.collect import CollectConfig, collect, kept_in
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.evaluate import evaluate
from ct_jax.finetune import RecoverConfig, recover
from ct_jax.pairs import Pairs
from ct_jax.prm import PrmConfig
from ct_jax.types import End, Frame, Observation, Privileged, Rollout, Steps, Tasks, act_as_intended
from ct_jax.worlds import kind_of
from ct_jax.worlds.mazes import MazeWorld
from ct_jax.worlds.rooms import RoomWorld, evaluation_rooms

pytestmark = pytest.mark.rank_promotion("allow")  # MJX

PRM = PrmConfig(samples=60, connect_m=10.0)
COLLECT = CollectConfig(trajectories=5, envs=4, horizon=60)


# --------------------------------------------------------------------------------------------------------- a world


@dataclass(frozen=True)
class Straight:
    """A guide that heads straight for the goal: enough where nothing is in the way."""

    def init(self, frame, tasks):
        return ()

    def waypoint(self, memory, frame):
        return frame.obs.goal_relative, memory


@dataclass(frozen=True)
class Step:
    """A controller for a point that moves by its action."""

    action_size: int = 2

    def __call__(self, proprio, goal_relative):
        return np.clip(goal_relative, -1.0, 1.0)


@dataclass(frozen=True)
class Square:
    """An empty square. A point moves by half its action [m] at every step, and arrives within the tolerance."""

    side_m: float = 10.0
    robot = replace(POINT, goal_tolerance_m=0.5)
    horizon: int = 60
    places: int = 1

    def sample_tasks(self, key, config, prm, *, first=0, offset=0):
        run_key, ends_key = jax.random.split(jax.random.fold_in(key, first))
        ends = np.asarray(jax.random.uniform(ends_key, (2, config.envs, 2), jnp.float32, 0.0, self.side_m))
        return Tasks(ends[0], ends[1], np.zeros(config.envs, int), run_key)

    def draw_pairs(self, seed, n):
        ends = np.random.default_rng(seed).uniform(0.0, self.side_m, (2, n, 2)).astype(np.float32)
        return Pairs(ends[0], ends[1], np.linalg.norm(ends[0] - ends[1], axis=-1), seed)

    def tasks_of(self, pairs, prm):
        if np.max(pairs.ends) > self.side_m:
            raise UserError(f"a pair is outside the square of {self.side_m} m")
        return Tasks(pairs.start, pairs.goal, pairs.place, jax.random.key(pairs.seed)), None if prm is None else 0

    def guide(self, name, prm):
        return Straight()

    def rollout(self, policy, tasks, *, horizon, on_progress=lambda over, note: None):
        position, n, records = tasks.start, len(tasks.start), []
        frame = self._frame(position, tasks, np.zeros(n, bool))
        memory = policy.init(frame, tasks)
        for i in range(horizon):
            action, memory = policy.act(memory, frame, jax.random.fold_in(tasks.key, i))
            moved = np.clip(position + 0.5 * np.asarray(action.executed), 0.0, self.side_m).astype(np.float32)
            position, alive = np.where(frame.done[:, None], position, moved), np.float32(~frame.done)
            after = self._frame(position, tasks, frame.done)
            records.append(
                Steps(
                    position=frame.privileged.position,
                    proprio=frame.obs.proprio,
                    action=np.asarray(action.intended),
                    label=np.asarray(action.label),
                    label_mask=np.asarray(action.label_mask),
                    reward=after.reward,
                    alive=alive,
                    collision=np.zeros(n, np.float32),
                    success=np.float32(after.done),
                    goal_relative=frame.obs.goal_relative,
                    map_bits=np.zeros((n, 157), np.uint8),
                )
            )
            frame = after
            if frame.done.all():
                break
        on_progress(n, "")
        steps = jax.tree.map(lambda *leaves: np.stack(leaves), *records)
        end = End(position, frame.reward, frame.done, np.zeros(n, bool), None)
        return Rollout(steps, end, tasks.goal, tasks.place, np.ones(n, bool), horizon)

    def _frame(self, position, tasks, done):
        to_go, n = tasks.goal - position, len(position)
        away = np.linalg.norm(to_go, axis=-1)
        seen = Observation(None, np.zeros((n, 2), np.float32), to_go)
        at = Privileged(position, tasks.goal, np.zeros(n, np.float32), None)
        return Frame(seen, -away, done | (away < self.robot.goal_tolerance_m), at)

    def close(self):
        pass


@struct.dataclass
class Still:
    """A baseline that never moves: it fails everywhere."""

    def init(self, frame, tasks=None):
        return jnp.zeros((), jnp.int32)

    def act(self, memory, frame, key):
        return act_as_intended(jnp.zeros((frame.done.shape[0], 2), jnp.float32)), memory + 1


@struct.dataclass
class Headlong:
    """A baseline that heads straight for the goal. It knows what a policy is to know, and nothing else."""

    gain: float = 1.0

    def init(self, frame, tasks=None):
        return ()

    def act(self, memory, frame, key):
        return act_as_intended(jnp.clip(self.gain * jnp.asarray(frame.obs.goal_relative), -1.0, 1.0)), memory


def test_a_new_world_is_collected_in(tmp_path):
    told = []
    arguments = (jax.random.key(0), Square(), Step(), COLLECT, PRM)
    data = collect(*arguments, on_progress=lambda won, of: told.append((won, of)), keep=kept_in(tmp_path, hint=""))
    assert told == [(4, 4), (8, 8)] and data.n == 5
    last = np.asarray(data.reward)[np.arange(5), np.asarray(data.length) - 1]
    assert (last > -0.5).all()
    for i, length in enumerate(data.length):
        moved = np.diff(data.position[i, :length], axis=0)
        np.testing.assert_allclose(moved, 0.5 * data.action[i, : length - 1], atol=1e-5)
    again = collect(*arguments, keep=kept_in(tmp_path, hint=""))
    jax.tree.map(np.testing.assert_array_equal, data, again)


def test_a_disturbance_in_a_new_world_is_not_imitated():
    calm, shaken = (collect(jax.random.key(0), Square(), Step(), replace(COLLECT, noise=n), PRM) for n in (0.0, 0.5))
    np.testing.assert_array_equal(shaken.action, shaken.label)
    np.testing.assert_array_equal(shaken.position[:4, 0], calm.position[:4, 0])
    before_last = np.arange(shaken.position.shape[1] - 1) < shaken.length[:, None] - 1
    off = np.diff(shaken.position, axis=1) - 0.5 * shaken.action[:, :-1]
    assert np.abs(off[before_last]).max() > 0.05


@pytest.mark.parametrize("keep", ["joined", "separate", "relabelled"])
def test_failures_in_a_new_world_are_recovered_from(keep):
    config = RecoverConfig(recoveries=3, stuck_steps=5, stuck_m=0.1, patience=9, keep=keep)
    data = recover(jax.random.key(1), Square(), Still(), Step(), config, COLLECT, PRM)  # pyright: ignore
    if keep == "separate":
        failed, recovered = np.split(np.arange(data.n), 2)
        assert (data.length[failed] == config.stuck_steps).all() and (data.action[failed, :5] == 0).all()
        assert (data.reward[recovered, data.length[recovered] - 1] > -0.5).all()
        return
    assert data.n >= 3
    for i, length in enumerate(data.length):
        np.testing.assert_array_equal(data.action[i, : config.stuck_steps], 0.0)
        begin = config.stuck_steps if keep == "joined" else 0
        np.testing.assert_array_equal(data.label_mask[i, :length], np.arange(length) >= begin)
        assert (np.abs(data.label[i, begin:length]).max(-1) > 0.4).all() and data.reward[i, length - 1] > -0.5


@pytest.mark.parametrize(("method", "rate"), [("planner", 1.0), ("explorer", 1.0), ("headlong", 1.0), ("still", 0.0)])
def test_methods_are_evaluated_in_a_new_world(method, rate):
    world, told = Square(), []
    policy = {"headlong": Headlong(), "still": Still()}.get(method)
    pairs = world.draw_pairs(3, 6)
    pairs = replace(pairs, start=np.where(np.arange(6)[:, None] == 0, 0.0, pairs.start))
    found = evaluate(
        world, pairs, method, policy=policy, controller=Step(), on_progress=lambda over, note: told.append(over)
    )  # pyright: ignore
    row = found.summary()
    assert row["success_rate"] == rate and row["timeout_rate"] == 1.0 - rate and row["collision_rate"] == 0.0
    assert (
        told == [6] and found.horizon == world.horizon and row.get("not_joined") == (0 if method == "planner" else None)
    )
    assert np.isfinite(row["spl"]) and found.target_return is None and "diverged_rate" not in row
    np.testing.assert_array_equal(found.path[0], pairs.start)
    if method == "still":
        assert (found.steps == world.horizon).all() and (found.travelled_m == 0).all()
    with pytest.raises(UserError, match="outside the square"):
        evaluate(world, replace(pairs, goal=pairs.goal + 99.0), method, policy=policy, controller=Step())


# ------------------------------------------------------------------------------------------- a guide, and a policy


@contextlib.contextmanager
def maze(push):
    """A world under jit, and its controller."""
    yield MazeWorld(MazeEnv("point", engine="mujoco", auto_reset=False), load_maze("antmaze-umaze")), push()


@contextlib.contextmanager
def room(push):
    """A world of NumPy, and its controller."""
    with contextlib.closing(RoomWorld(4, evaluation_rooms(0, 1, density=0.2), processes=1)) as world:
        yield world, DifferentialDrive()


bullet = pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="PyBullet is not installed")
WORLDS = [maze, pytest.param(room, marks=bullet)]


@dataclass(frozen=True)
class Near:
    """Straight for the goal, at most so far; and it counts its steps. It runs under jit and in NumPy."""

    look_m: float = 0.5

    def init(self, frame, tasks):
        return 0 * frame.reward

    def waypoint(self, memory, frame):
        goal = frame.obs.goal_relative
        away = (goal**2).sum(-1, keepdims=True) ** 0.5
        return goal / (1.0 + away / self.look_m), memory + 1.0


@pytest.mark.parametrize("make", WORLDS)
def test_a_new_guide_leads_in_every_world(make, push):
    """By the same class, wherever nothing is in the way; a guide of one's own goes before that of the configuration."""
    config = CollectConfig(trajectories=3, envs=4, horizon=200, guide="explorer", starts="maze", noise=0.1, give_up=30)
    with make(push) as (world, controller):
        data = collect(jax.random.key(2), world, controller, config, PRM, guide=Near())
        world_guide = collect(jax.random.key(2), world, controller, config, PRM)
    assert data.n == world_guide.n == 3
    assert (data.reward[np.arange(3), data.length - 1] > -0.6).all()
    for i, length in enumerate(data.length):  # the planner knows no walls: these ways are the straight ones
        start, goal = data.position[i, 0], data.goal_world[i]
        along = (goal - start) / np.linalg.norm(goal - start)
        off = (data.position[i, :length] - start) @ np.array([-along[1], along[0]])
        assert np.abs(off).max() < 2.0


@pytest.mark.parametrize("make", WORLDS)
def test_a_new_guide_recovers_in_every_world(make, push):
    collecting = CollectConfig(trajectories=1, envs=4, horizon=200, starts="maze", give_up=30)
    config = RecoverConfig(recoveries=1, stuck_steps=5, stuck_m=0.05, patience=9, keep="joined")
    with make(push) as (world, controller):
        data = recover(jax.random.key(3), world, Still(), controller, config, collecting, PRM, guide=Near())
    assert data.n >= 1
    assert (data.reward[np.arange(data.n), data.length - 1] > -0.6).all() and (data.label_mask.argmax(1) > 0).all()


@pytest.mark.parametrize("make", WORLDS)
def test_a_new_policy_is_evaluated_in_every_world(make, push):
    with make(push) as (world, _):
        pairs = world.draw_pairs(0, 4)
        gone, stayed = (evaluate(world, pairs, "baseline", policy=each, horizon=100) for each in (Headlong(), Still()))
        again = evaluate(world, pairs, "baseline", policy=Headlong(), horizon=100)
    assert not stayed.success.any() and stayed.timeout.all() and (stayed.steps == 100).all()
    assert (gone.travelled_m > stayed.travelled_m + 0.2).all()
    np.testing.assert_array_equal(gone.steps, again.steps)
    np.testing.assert_array_equal(gone.path, again.path)
    for each in (gone, stayed):
        assert each.horizon == 100 and each.target_return is None and each.not_joined is None
        np.testing.assert_allclose(each.path[0], pairs.start, atol=1e-4)


# ---------------------------------------------------------------------------------------------------------- kinds


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=lambda robot: robot.name)
def test_every_robot_has_its_kind_of_world(robot):
    kind = kind_of(robot)
    for name in ("open_training", "controller", "trials", "Request"):
        assert callable(getattr(kind, name))
