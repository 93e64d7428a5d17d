"""Dense layers and dropout: equal to those of flax, with another order of operations."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_jax.dense import Dense, Dropout


@pytest.mark.parametrize("shape", [(3,), (5, 3), (4, 5, 3)])
@pytest.mark.parametrize("features", [2, 7])
def test_dense_layer_and_gradients_equal_flax(shape, features):
    x = jax.random.normal(jax.random.key(0), shape)
    ours, flaxs = Dense(features), nn.Dense(features)
    params = jax.tree.map(lambda leaf: leaf + 0.5, ours.init(jax.random.key(1), x))

    def loss(params, x, layer):
        return jnp.sum(jnp.sin(layer.apply(params, x)))

    assert jax.tree.map(jnp.shape, params) == jax.tree.map(jnp.shape, flaxs.init(jax.random.key(1), x))
    got, expected = (jax.value_and_grad(loss, (0, 1))(params, x, layer) for layer in (ours, flaxs))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), got, expected)


@pytest.mark.parametrize("width", [16, 7])
def test_dropout_keeps_rate_and_mean(width):
    rngs = {"dropout": jax.random.key(0)}
    dropped = np.asarray(Dropout(0.25).apply({}, jnp.ones((3000, width)), deterministic=False, rngs=rngs))
    kept = dropped > 0
    np.testing.assert_allclose(dropped, kept / 0.75, rtol=1e-6)
    np.testing.assert_allclose(kept.mean(0), 0.75, atol=0.04)
    np.testing.assert_allclose(np.corrcoef(kept, rowvar=False) - np.eye(width), 0.0, atol=0.1)
