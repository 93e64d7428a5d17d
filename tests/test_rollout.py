"""The rollout: it records what happened, and a disturbance is done but neither meant nor imitated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from ct_envs import MazeEnv, load_maze, stack_mazes
from ct_jax.collect import CollectConfig
from ct_jax.guided import Guided
from ct_jax.prm import PrmConfig
from ct_jax.rollout import as_frame, broke_off, run
from ct_jax.types import act_as_intended
from ct_jax.worlds.mazes import MazeWorld, start_episodes

N = 4
ENV = MazeEnv("point", engine="mujoco", auto_reset=False, maps=False, horizon=9)


@pytest.fixture(scope="module")
def start():
    """Four episodes in an L of free cells: the first ends at once, the second soon."""
    mazes = stack_mazes([load_maze("antmaze-umaze")] * N)
    begin = jnp.tile(jnp.array([[6.0, 6.0]]), (N, 1))
    goal = jnp.array([[6.2, 6.0], [6.9, 6.0], [14.0, 6.0], [14.0, 14.0]])
    return start_episodes(ENV, jax.random.split(jax.random.key(0), len(begin)), mazes, begin, goal)


@struct.dataclass
class Straight:
    """A guide that points at the goal, and counts how often it was asked."""

    def init(self, frame, tasks):
        return jnp.zeros(())

    def waypoint(self, memory, frame):
        return frame.obs.goal_relative, memory + 1


def roll(policy, start, steps=9):
    """The last state and memory of a rollout, and its record."""
    return run(ENV, policy, start, policy.init(as_frame(start), None), jax.random.key(0), steps)


def test_what_is_recorded_is_what_happened(start, push):
    guided = Guided(push(), Straight())
    state, (asked, _), steps = roll(guided, start)
    assert int(asked) == 9
    step, now = jax.jit(jax.vmap(ENV.step)), start
    for t in range(9):
        np.testing.assert_array_equal(steps.position[t], now.info["position"])
        np.testing.assert_array_equal(steps.proprio[t], now.obs["proprio"])
        np.testing.assert_array_equal(steps.alive[t], 1 - now.done)
        now = step(now, steps.action[t])
        np.testing.assert_allclose(steps.reward[t], now.reward, rtol=1e-5)
        np.testing.assert_array_equal(steps.success[t], now.info["success"])
    np.testing.assert_allclose(state.info["position"], now.info["position"], atol=1e-4)
    np.testing.assert_array_equal(state.done, 1.0)
    np.testing.assert_array_equal(state.info["success"], [1, 1, 0, 0])


def test_finished_episodes_stay_where_they_are(start, push):
    guided = Guided(push(), Straight())
    _, _, steps = roll(guided, start)
    alive, position = np.asarray(steps.alive), np.asarray(steps.position)
    assert (np.diff(alive, axis=0) <= 0).all()
    for i, length in enumerate(alive.sum(0).astype(int)):
        assert (position[length:, i] == position[length : length + 1, i]).all()
    assert alive.sum(0)[0] == 1 and alive.sum(0)[1] < 9


def test_a_disturbance_is_done_but_not_meant(start, push):
    guided = Guided(push(), Straight(), 0.5)
    frame = as_frame(start)
    memory, record = guided.init(frame, None), []
    intended = push()(frame.obs.proprio, frame.obs.goal_relative)
    act = jax.jit(Guided.act)
    for key in jax.random.split(jax.random.key(0), 200):
        action, memory = act(guided, memory, frame, key)
        record.append(np.asarray(action.executed - action.intended))
        np.testing.assert_allclose(action.intended, intended, atol=1e-6)
        np.testing.assert_array_equal(action.label, action.intended)
        np.testing.assert_array_equal(action.label_mask, 1.0)
    record = np.array(record)
    assert abs(record[20:].mean()) < 0.2 and 0.35 < record[20:].std() < 0.65
    held = (np.abs(np.diff(record, axis=0)) < 1e-6).all(-1)
    assert 0.85 < held.mean() < 0.95  # it lasts some ten steps
    assert not np.array_equal(held[:, 0], held[:, 1])  # each environment has its own


def test_without_noise_nothing_is_drawn(start, push):
    guided = Guided(push(), Straight())
    memory = guided.init(as_frame(start), None)
    one, other = (guided.act(memory, as_frame(start), jax.random.key(seed))[0] for seed in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, one, other)
    np.testing.assert_array_equal(one.executed, one.intended)


@pytest.mark.parametrize("horizon", [6, 60])
def test_episodes_run_until_all_are_over_or_time_is(push, horizon):
    """Each as it would run by itself; and progress tells how many are over."""
    world = MazeWorld(ENV, load_maze("antmaze-umaze"))
    tasks = world.sample_tasks(jax.random.key(1), CollectConfig(envs=N, starts="maze"), PrmConfig(samples=30))
    guided, seen = Guided(push(), Straight()), []
    rollout = world.rollout(guided, tasks, horizon=horizon, on_progress=lambda over, note: seen.append((over, note)))
    state = start_episodes(ENV.with_horizon(horizon), tasks.episode_keys, tasks.maze, tasks.start, tasks.goal)
    _, _, whole = run(ENV.with_horizon(horizon), guided, state, guided.init(as_frame(state), None), tasks.key, horizon)
    n = min(len(rollout.steps.reward), horizon)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[:n], b[:n], atol=1e-3), rollout.steps, whole)
    assert [over for over, _ in seen] == sorted(over for over, _ in seen) and seen[-1][0] == N
    assert (rollout.steps.alive.sum(0) <= horizon).all()


def test_as_meant():
    action = act_as_intended(jnp.ones((3, 2)))
    for leaf in action[:3]:
        np.testing.assert_array_equal(leaf, np.ones((3, 2)))
    np.testing.assert_array_equal(action.label_mask, np.ones(3))


def test_without_compilation(start, push):
    guided = Guided(push(), Straight(), 0.3)
    compiled = roll(guided, start, 2)[2]
    with jax.disable_jit():
        plain = roll(guided, start, 2)[2]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), plain, compiled)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_neither_recorded_nor_imitated(start, faulty, bad):
    which = jnp.array([False, False, True, False])
    state, _, steps = roll(faulty(which, bad), start)
    jax.tree.map(lambda leaf: np.testing.assert_array_equal(np.isfinite(leaf), True), steps)
    learn = np.asarray(steps.label_mask)
    assert not learn[3:, 2].any() and learn[:3].all() and learn[:, ~which].all()
    np.testing.assert_array_equal(steps.alive.sum(0), [1, 9, 4, 9])
    np.testing.assert_array_equal(state.info["diverged"], which)
    np.testing.assert_array_equal(broke_off(state.info), which)
