"""Python functions that compiled programs call by name: they get XLA's buffers, and their exceptions are raised."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_envs import host_call


def call(name, argument, *shape):
    result = jax.ShapeDtypeStruct(shape, argument.dtype)
    return jax.ffi.ffi_call(name, result, vmap_method="broadcast_all")(argument)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0, 3)])
def test_function_gets_shapes_and_values(shape):
    host_call.register("test_twice", lambda x, y: np.copyto(y, 2 * x))
    x = jnp.asarray(np.random.default_rng(0).normal(size=shape), jnp.float32)
    np.testing.assert_array_equal(jax.jit(lambda x: call("test_twice", x, *shape))(x), 2 * x)


def test_batch_is_one_call():
    shapes = []

    def total(x, y):
        shapes.append((x.shape, y.shape))
        np.copyto(y, x.sum(-1))

    host_call.register("test_total", total)
    x = jnp.arange(24.0).reshape(2, 4, 3)
    found = jax.jit(jax.vmap(jax.vmap(lambda row: call("test_total", row))))(x)
    np.testing.assert_array_equal(found, x.sum(-1))
    assert shapes == [((2, 4, 3), (2, 4))]


def test_first_function_with_name_is_kept():
    host_call.register("test_one", lambda x, y: np.copyto(y, x + 1))
    host_call.register("test_one", lambda x, y: np.copyto(y, x + 2))
    assert call("test_one", jnp.zeros(())) == 1.0


def test_exception_is_raised_and_next_call_works():
    def picky(x, y):
        if x < 0:
            raise ValueError(f"no roots of {x:.1f}")
        np.copyto(y, np.sqrt(x))

    host_call.register("test_picky", picky)
    for _ in range(2):
        with pytest.raises(jax.errors.JaxRuntimeError, match=r"ValueError: no roots of -1\.0"):
            jax.block_until_ready(call("test_picky", jnp.float32(-1.0)))
        assert call("test_picky", jnp.float32(4.0)) == 2.0
