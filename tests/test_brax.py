"""``MazeEnv`` with brax's training wrappers and PPO: a restarted episode has its original goal and step count."""

import functools

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import VmapWrapper
from brax.training.agents.ppo import networks, train

from ct_envs import MazeEnv, Tasks, load_maze
from ct_envs.maze_env import FlatObservation

pytestmark = pytest.mark.rank_promotion("allow")  # brax

N = 5
UMAZE = load_maze("antmaze-umaze")


def point(*, maps=False, **options) -> MazeEnv:
    return MazeEnv("point", engine="mujoco", maze=UMAZE, maps=maps, **options)


def keys(seed: int) -> jax.Array:
    return jax.random.split(jax.random.PRNGKey(seed), N)  # brax's wrappers need old-style keys


@pytest.mark.parametrize("auto_reset", [True, False])
@pytest.mark.parametrize(("horizon", "length"), [(8, 100), (100, 8)], ids=["its horizon", "brax's"])
def test_reset_by_brax_restores_goal_and_steps(auto_reset, horizon, length):
    env = brax.envs.training.wrap(point(auto_reset=auto_reset, horizon=horizon), length, 1)
    step, state = jax.jit(env.step), jax.jit(env.reset)(keys(0))
    first, ends = state, []
    for _ in range(60):
        state = step(state, jnp.tile(jnp.array([0.6, 0.2]), (N, 1)))
        goal, position = state.pipeline_state.goal, state.pipeline_state.qpos[:, :2]
        np.testing.assert_array_equal(state.obs["goal"], goal - position)
        np.testing.assert_array_equal(state.obs["goal"], state.info["goal"] - state.info["position"])
        np.testing.assert_array_equal(state.info["episode_steps"], state.pipeline_state.episode_steps)
        ends.append(np.asarray(state.done) > 0)
        same = jax.tree.map(
            lambda now, then: np.array_equal(now[ends[-1]], then[ends[-1]]),
            (state.obs, state.pipeline_state, state.info["goal"], state.info["task"]),
            (first.obs, first.pipeline_state, first.info["goal"], first.info["task"]),
        )
        assert all(jax.tree.leaves(same)), same
    lengths = [np.diff(np.flatnonzero(each), prepend=-1) for each in np.stack(ends).T]
    assert max(map(max, lengths)) == 8  # some episodes reach the time limit
    for each in lengths:  # the same start, goal and actions: the same episode again
        assert len(each) >= 7 and (each == each[0]).all()


def test_info_follows_replaced_pipeline_state():
    env = point()
    reset, tasks = jax.jit(env.reset), Tasks(jnp.array([[6.0, 6.0]]), jnp.array([[14.0, 14.0]]), jnp.array(1))
    one, other = reset(jax.random.key(0), None, tasks), reset(jax.random.key(1))
    mixed = one.replace(pipeline_state=other.pipeline_state, reward=jnp.ones(()))
    for name in ("goal", "position", "task", "episode_steps"):
        np.testing.assert_array_equal(mixed.info[name], other.info[name])
    assert mixed.info["key"] is one.info["key"] and mixed.reward == 1.0 and type(mixed) is type(one)


@pytest.mark.parametrize("maps", [False, True])
def test_flat_observation_concatenates_the_dict(maps):
    env = point(maps=maps, auto_reset=False, horizon=3)
    flat = FlatObservation(env)
    assert flat.observation_size == 4 + maps * 2 * 25 * 25 and flat.action_size == 2
    plain_step, flat_step = (jax.jit(VmapWrapper(e).step) for e in (env, flat))
    plain, one = (jax.jit(VmapWrapper(e).reset)(keys(1)) for e in (env, flat))
    for _ in range(4):  # one more than there are
        parts = [plain.obs[name].reshape(N, -1) for name in env.observation_size]
        np.testing.assert_array_equal(one.obs, np.concatenate(parts, -1))
        np.testing.assert_array_equal(one.done, plain.done)
        plain, one = (f(s, jnp.ones((N, 2))) for f, s in ((plain_step, plain), (flat_step, one)))
    assert (plain.done == 1).all()


def test_ppo_trains(monkeypatch):
    """brax's PPO needs a function that was removed from jax."""
    copies = lambda tree, devices: jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)  # noqa: E731
    monkeypatch.setattr(jax, "device_put_replicated", copies, raising=False)
    small = {"policy_hidden_layer_sizes": (16,), "value_hidden_layer_sizes": (16,)}
    told = []
    _, (_, policy, *_), _ = train.train(
        FlatObservation(point()), num_timesteps=10_000, episode_length=50, num_envs=16, unroll_length=10,
        batch_size=16, num_minibatches=2, num_updates_per_batch=1, num_evals=2, num_eval_envs=8,
        max_devices_per_host=1, network_factory=functools.partial(networks.make_ppo_networks, **small),
        progress_fn=lambda steps, metrics: told.append((steps, metrics)),
    )  # fmt: skip
    (begin, _), (steps, metrics) = told
    assert begin == 0 and steps >= 10_000
    assert metrics["eval/avg_episode_length"] <= 50 and np.isfinite(metrics["eval/episode_reward"])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy))
