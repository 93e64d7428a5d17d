"""Dense layers and dropout that are fast on CPU. On accelerators they are as fast as those of flax."""

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_CHANCES = 256  # values of the byte that decides whether an entry is kept


@jax.custom_vjp
def product(x: Float[Array, "R I"], kernel: Float[Array, "I O"]) -> Float[Array, "R O"]:
    """``x @ kernel``, with the kernel's gradient as the product of few rows that XLA's matrix products want on CPU."""
    return x @ kernel


def _product_gradient(kept: tuple[jax.Array, jax.Array], g: Float[Array, "R O"]) -> tuple[jax.Array, jax.Array]:
    x, kernel = kept
    if kernel.shape[0] <= kernel.shape[1]:
        return g @ kernel.T, x.T @ g
    # Without the barrier, XLA makes it ``x.T @ g`` again, which takes a third longer.
    return g @ kernel.T, jax.lax.optimization_barrier(g.T @ x).T


product.defvjp(lambda x, kernel: (x @ kernel, (x, kernel)), _product_gradient)


def _dot_general(x: jax.Array, kernel: jax.Array, dimensions: object, precision: object = None) -> jax.Array:
    del dimensions, precision  # those of a product of matrices
    return product(x, kernel)


class Dense(nn.Dense):
    """``flax.linen.Dense`` over rows: with two axes to sum over, XLA on CPU would transpose both of a gradient's
    operands one entry at a time."""

    dot_general: Callable[..., jax.Array] | None = _dot_general

    def __call__(self, inputs: Float[Array, "*b I"]) -> Float[Array, "*b O"]:
        rows = super().__call__(inputs.reshape(-1, inputs.shape[-1]))
        return rows.reshape(*inputs.shape[:-1], self.features)


class Dropout(nn.Module):
    """Dropout whose randomness is a byte an entry, not a word; the rate is rounded to a 256th (0.1 is 26 of them)."""

    rate: float

    def __call__(self, x: Float[Array, "*b W"], *, deterministic: bool) -> Float[Array, "*b W"]:
        if deterministic or self.rate == 0.0:
            return x
        *lead, width = x.shape
        words = jax.random.bits(self.make_rng("dropout"), (*lead, -(-width // 4)), jnp.uint32)
        chance = jax.lax.bitcast_convert_type(words, jnp.uint8).reshape(*lead, -1)[..., :width]
        drop = round(_CHANCES * self.rate)
        return jnp.where(chance >= drop, x * (_CHANCES / (_CHANCES - drop)), 0.0)
