"""Acting: the return that is asked for, step by step, along real episodes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_envs import MazeEnv, load_maze, stack_mazes
from ct_jax.policy import TransformerPolicy
from ct_jax.rollout import as_frame, run
from ct_jax.transformer import ControlTransformer, ModelConfig, sample_inputs
from ct_jax.value import ValueNetwork
from ct_jax.worlds.mazes import start_episodes

pytestmark = pytest.mark.rank_promotion("allow")

N, STEPS = 3, 12
CONFIG = ModelConfig(layers=1, heads=1, width=8, context=4, context_acting=4, max_timestep=32)
ENV = MazeEnv("point", engine="mujoco", auto_reset=False)
MODEL, VALUE = ControlTransformer(CONFIG, 2), ValueNetwork(8)


@pytest.fixture(scope="module")
def policy():
    inputs = sample_inputs(2, 2)
    params = jax.jit(MODEL.init)(jax.random.key(0), *inputs)
    params = jax.tree.map(lambda leaf: leaf + 0.3 * jax.random.normal(jax.random.key(1), leaf.shape), params)
    return TransformerPolicy(params, jax.jit(VALUE.init)(jax.random.key(2), *inputs[:3]), CONFIG, 2, value_width=8)


@pytest.fixture(scope="module")
def start():
    mazes = stack_mazes([load_maze("antmaze-umaze")] * N)
    begin = jnp.array([[6.0, 6.0], [14.0, 6.0], [6.0, 14.0]])
    return start_episodes(ENV, jax.random.split(jax.random.key(0), len(begin)), mazes, begin, begin[::-1] + 0.7)


@jax.jit
def walk(policy, state):
    """Steps one by one: returns-to-go asked for, values of the states, rewards and actions, each [T, N]."""

    def once(carry, key):
        state, memory = carry
        value = VALUE.apply(policy.value_params, *(state.obs[name] for name in ("map", "proprio", "goal")))
        action, memory = policy.act(memory, as_frame(state), key)
        after = jax.vmap(ENV.step)(state, action.executed)
        return (after, memory), (memory.rtg, value, after.reward, action)

    return jax.lax.scan(once, (state, policy.init(as_frame(state))), jax.random.split(jax.random.key(0), STEPS))[1]


@pytest.mark.parametrize("k", [1.0, 0.7, 1.5])
def test_the_return_asked_for_is_k_v_and_then_what_is_left_of_it(policy, start, k):
    rtg, value, reward, _ = map(np.asarray, jax.tree.leaves(walk(policy.replace(return_scale=k), start))[:4])
    np.testing.assert_allclose(policy.replace(return_scale=k).init(as_frame(start)).rtg, k * value[0], rtol=1e-5)
    np.testing.assert_allclose(rtg[0], k * value[0], rtol=1e-5)
    np.testing.assert_allclose(rtg[1:], rtg[:-1] - reward[:-1], rtol=1e-5)
    assert (rtg[1:] > rtg[:-1]).all()  # rewards are negative, so ever less is left


def test_with_reprompt_no_more_is_asked_for_than_v(policy, start):
    rtg, value, reward, _ = map(np.asarray, jax.tree.leaves(walk(policy.replace(clip_target_return=True), start))[:4])
    assert (rtg <= value + 1e-3).all()
    np.testing.assert_allclose(rtg[1:], np.minimum(rtg[:-1] - reward[:-1], value[1:]), rtol=1e-5)
    plain = np.asarray(walk(policy, start)[0])
    assert (plain > value + 1e-3).any()  # without it, more would have been


def test_actions_are_within_bounds_meant_and_done(policy, start):
    action = walk(policy, start)[3]
    assert (np.abs(action.executed) <= 1).all() and np.ptp(action.executed) > 0.1
    np.testing.assert_array_equal(action.intended, action.executed)
    np.testing.assert_array_equal(action.label, action.executed)


def test_a_policy_acts_on_a_window_as_its_settings_say(policy, start):
    """As with a cache for K steps, with the same return asked for, and then otherwise."""
    deep = replace(CONFIG, layers=2)
    params = jax.jit(ControlTransformer(deep, 2).init)(jax.random.key(3), *sample_inputs(2, 2))
    params = jax.tree.map(lambda leaf: leaf + 0.3 * jax.random.normal(jax.random.key(1), leaf.shape), params)
    cached = policy.replace(config=deep, params=params)
    window = cached.replace(config=replace(deep, acting="window"))
    (rtg, _, _, kept), (rtg_window, _, _, anew) = walk(cached, start), walk(window, start)
    np.testing.assert_allclose(rtg[: CONFIG.context], rtg_window[: CONFIG.context], rtol=1e-5)
    np.testing.assert_allclose(kept.executed[: CONFIG.context], anew.executed[: CONFIG.context], atol=1e-4)
    assert np.abs(np.asarray(kept.executed) - anew.executed).max() > 1e-4


def test_a_rollout_is_the_forward_pass_on_what_it_recorded(policy, start):
    """State, return and action tokens come from the episode as it went, in the order of training."""
    _, memory, steps = run(ENV, policy, start, policy.init(as_frame(start)), jax.random.key(0), STEPS)
    assert int(memory.past.now) == STEPS
    rtg = np.asarray(walk(policy, start)[0])
    mazes = start.info["maze"]

    @jax.jit
    def forward(position, proprio, action, rtg):
        from ct_envs.occupancy import local_map

        goal = start.info["goal"]
        see = jax.vmap(jax.vmap(lambda m, p, g: local_map(m, p, g, cell_m=0.8)), (None, 0, None))
        maps = jnp.swapaxes(see(mazes, position, goal), 0, 1)
        swap = lambda leaf: jnp.swapaxes(leaf, 0, 1)  # noqa: E731
        timestep = jnp.tile(jnp.arange(STEPS), (N, 1))
        return MODEL.apply(
            policy.params, maps, swap(proprio), goal[:, None] - swap(position), swap(action), swap(rtg), timestep,
            jnp.ones((N, STEPS)),
        )  # fmt: skip

    predicted = np.clip(forward(steps.position, steps.proprio, steps.action, rtg), -1, 1)
    alive = np.asarray(steps.alive).T > 0
    np.testing.assert_allclose(np.swapaxes(steps.action, 0, 1)[alive], predicted[alive], atol=1e-4)


def test_behaviour_cloning_asks_for_nothing(policy, start):
    """Without returns, k changes what is kept in memory but nothing that is done."""
    cloned = policy.replace(config=replace(CONFIG, returns=False))
    one, other = (walk(cloned.replace(return_scale=k), start)[3].executed for k in (1.0, 3.0))
    np.testing.assert_array_equal(one, other)
    one, other = (walk(policy.replace(return_scale=k), start)[3].executed for k in (1.0, 3.0))
    assert np.abs(np.asarray(one) - other).max() > 1e-3


def test_without_compilation(policy, start):
    frame = as_frame(start)
    action, after = jax.jit(TransformerPolicy.act)(policy, policy.init(frame), frame, jax.random.key(0))
    with jax.disable_jit():
        plain, plain_after = policy.act(policy.init(frame), frame, jax.random.key(0))
    np.testing.assert_allclose(plain.executed, action.executed, atol=1e-5)
    np.testing.assert_allclose(plain_after.rtg, after.rtg, rtol=1e-5)
