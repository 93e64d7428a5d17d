"""The value network V_phi(s | g): the mean return of the data, from one observation (paper, sec. III-D and III-F)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from ct_jax.transformer import GOAL_SCALE_M, RETURN_DIVISOR, MapEncoder, goal_features


class ValueNetwork(nn.Module):
    """Undiscounted return, predicted from a local map, proprioception and goal. It has no memory."""

    width: int = 128

    @nn.compact
    def __call__(
        self, maps: UInt8[Array, "*b 2 k k"], proprio: Float[Array, "*b P"], goal: Float[Array, "*b 2"]
    ) -> Float[Array, "*b"]:
        """Expected return [m], at most 0."""
        distance = jnp.linalg.norm(goal, axis=-1, keepdims=True)
        x = jnp.concatenate([MapEncoder(self.width)(maps), proprio, goal_features(goal), distance / GOAL_SCALE_M], -1)
        for _ in range(2):
            x = nn.relu(nn.Dense(self.width)(x))
        return -RETURN_DIVISOR * nn.softplus(nn.Dense(1)(x)[..., 0])
