"""The value network: it learns the undiscounted return, which is never positive."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ct_envs.occupancy import MAP_CELLS
from ct_jax.fit import value_loss
from ct_jax.trajectories import Window
from ct_jax.transformer import RETURN_DIVISOR
from ct_jax.value import ValueNetwork

MODEL = ValueNetwork(16)


def observations(seed: int, n: int):
    maps, proprio, goal = jax.random.split(jax.random.key(seed), 3)
    blocks = jax.random.bernoulli(maps, 0.5, (n, 1, 2, MAP_CELLS, MAP_CELLS)).astype(jnp.float32)
    return blocks, jax.random.normal(proprio, (n, 1, 2)), 20 * jax.random.normal(goal, (n, 1, 2))


def window(maps, proprio, goal, rtg, valid=None) -> Window:
    one = jnp.ones(rtg.shape)
    none = jnp.zeros((*rtg.shape, 2))
    valid = one if valid is None else valid
    return Window(maps, proprio, goal, none, none, rtg, one.astype(jnp.int32), valid, 0 * one, 0 * one)


apply = jax.jit(MODEL.apply)
PARAMS = jax.jit(MODEL.init)(jax.random.key(0), *observations(0, 1))


def test_predicted_return_is_never_positive():
    """Rewards are minus distances. The predicted return is at most 0 for any parameters."""
    leaves, structure = jax.tree.flatten(PARAMS)
    values = []
    for seed in range(6):
        keys = jax.random.split(jax.random.key(seed), len(leaves))
        wild = [0.3 * jax.random.normal(k, leaf.shape) for k, leaf in zip(keys, leaves, strict=True)]
        value = apply(jax.tree.unflatten(structure, wild), *observations(2, 50))
        assert value.shape == (50, 1)
        assert np.isfinite(value).all() and (value <= 0).all()
        values.append(value)
    assert np.ptp(values) > 100


def test_loss_is_squared_error_of_undiscounted_return():
    inputs = observations(3, 8)
    rtg = -100.0 * jnp.arange(1.0, 9.0)[:, None]
    valid = (jnp.arange(8) < 6).astype(jnp.float32)[:, None]
    value = apply(PARAMS, *inputs)
    expected = np.mean(((value - rtg) / RETURN_DIVISOR)[:6] ** 2)
    of_value = value_loss(MODEL)
    loss = jax.jit(lambda *inputs: of_value(*inputs)[0])
    key = jax.random.key(0)
    np.testing.assert_allclose(loss(PARAMS, window(*inputs, rtg, valid), key), expected, rtol=1e-5)
    np.testing.assert_allclose(loss(PARAMS, window(*inputs, value), key), 0.0, atol=1e-9)
    garbage = window(*inputs, jnp.where(valid > 0, rtg, 1e6), valid)
    np.testing.assert_allclose(loss(PARAMS, garbage, key), expected, rtol=1e-5)


def test_value_learns_mean_return():
    """Two kinds of states, which differ in the goal. The returns of each kind vary about their mean."""
    near, far = jnp.array([3.0, 0.0]), jnp.array([0.0, 30.0])
    maps, proprio, _ = observations(4, 64)
    which = jnp.arange(64) % 2
    goal = jnp.where(which[:, None, None] == 0, near[None, None], far[None, None])
    spread = jnp.where(jnp.arange(64) // 2 % 2 == 0, 200.0, -200.0)
    rtg = (jnp.where(which == 0, -300.0, -2500.0) + spread)[:, None]
    data, loss, optimizer = window(0 * maps, 0 * proprio, goal, rtg), value_loss(MODEL), optax.adam(1e-2)

    @jax.jit
    def learn(params):
        def step(carry, _):
            params, state = carry
            gradient, _ = jax.grad(loss, has_aux=True)(params, data, jax.random.key(0))
            change, state = optimizer.update(gradient, state)
            return (optax.apply_updates(params, change), state), None

        return jax.lax.scan(step, (params, optimizer.init(params)), length=300)[0][0]

    value = apply(learn(PARAMS), 0 * maps, 0 * proprio, goal)[:, 0]
    np.testing.assert_allclose(value[which == 0], -300.0, atol=30.0)
    np.testing.assert_allclose(value[which == 1], -2500.0, atol=30.0)


def test_value_is_the_same_without_jit(jit_disabled):
    inputs = observations(5, 2)
    plain = apply(PARAMS, *inputs)
    with jax.disable_jit(False):
        np.testing.assert_allclose(apply(PARAMS, *inputs), plain, rtol=1e-4)
