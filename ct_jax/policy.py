"""Acting with a Control Transformer: return bookkeeping and what it keeps of the past (paper, sec. III-D)."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from ct_jax.transformer import Cache, ControlTransformer, History, ModelConfig, empty_cache, empty_history
from ct_jax.types import Action, Frame, Observation, act_as_intended
from ct_jax.value import ValueNetwork


@struct.dataclass
class Conditioned:
    """Memory of N episodes: what the transformer keeps of the past, and the return-to-go that it is conditioned on."""

    past: Cache | History
    rtg: Float[Array, "N"]


@struct.dataclass
class TransformerPolicy:
    """pi_theta in N environments at once, all of them at the same step of their episodes."""

    params: Any
    value_params: Any
    config: ModelConfig = struct.field(pytree_node=False)
    action_size: int = struct.field(pytree_node=False)
    value_width: int = struct.field(pytree_node=False, default=128)
    return_scale: float = struct.field(pytree_node=False, default=1.0)  # k: condition on k * V (paper)
    clip_target_return: bool = struct.field(pytree_node=False, default=False)  # condition on at most V of this state
    head: nn.Module | None = struct.field(pytree_node=False, default=None)  # of the transformer: ``heads.make_head``

    @property
    def model(self) -> ControlTransformer:
        return ControlTransformer(self.config, self.action_size, self.head)

    def init(self, frame: Frame, tasks: Any = None) -> Conditioned:
        """The memory, with the return that the value network predicts from the first observation."""
        del tasks
        n, proprio_size = frame.obs.proprio.shape
        if self.config.acting == "window":
            past = empty_history(self.config, proprio_size, self.action_size, n)
        else:
            past = empty_cache(self.config, self.action_size, n)
        return Conditioned(past, _predicted_return(self, frame.obs))

    def act(self, memory: Conditioned, frame: Frame, key: jax.Array) -> tuple[Action, Conditioned]:
        """The next actions; the reward just received is taken off the return-to-go."""
        del key
        return _act(self, memory, frame.obs, frame.reward)


@jax.jit
def _predicted_return(policy: TransformerPolicy, obs: Observation) -> Float[Array, "N"]:
    """k * V."""
    value = ValueNetwork(policy.value_width).apply(policy.value_params, obs.map, obs.proprio, obs.goal_relative)
    return policy.return_scale * value  # pyright: ignore


@jax.jit
def _act(
    policy: TransformerPolicy, memory: Conditioned, obs: Observation, reward: Float[Array, "N"]
) -> tuple[Action, Conditioned]:
    rtg = memory.rtg - reward
    if policy.clip_target_return:
        rtg = jnp.minimum(rtg, _predicted_return(policy, obs))
    method = "act_on_window" if policy.config.acting == "window" else "act"
    action, past = policy.model.apply(
        policy.params, memory.past, obs.map, obs.proprio, obs.goal_relative, rtg, method=method
    )  # pyright: ignore
    return act_as_intended(action, rtg), Conditioned(past, rtg)
