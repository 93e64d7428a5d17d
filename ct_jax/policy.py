"""Acting with a Control Transformer: return bookkeeping and what it keeps of the past (paper, sec. III-D)."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State
from flax import struct
from jaxtyping import Array, Float

from ct_jax.controllers.sac import SacConfig
from ct_jax.rollout import Action, act_as_intended
from ct_jax.transformer import Cache, ControlTransformer, History, ModelConfig, empty_cache, empty_history
from ct_jax.value import ValueNetwork


@struct.dataclass
class Conditioned:
    """Memory of N episodes: what the transformer keeps of the past, and the return-to-go still asked for."""

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
    return_scale: float = struct.field(pytree_node=False, default=1.0)  # k: ask for k * V (paper)
    clip_target_return: bool = struct.field(
        pytree_node=False, default=False
    )  # never ask for more than V of the present state
    sac: SacConfig | None = struct.field(pytree_node=False, default=None)  # of the controller that is its head

    @property
    def model(self) -> ControlTransformer:
        return ControlTransformer(self.config, self.action_size, self.sac)

    def init(self, state: State) -> Conditioned:
        """Ask for the return that the value network predicts from the first observation."""
        n, obs = state.done.shape[0], state.obs
        if self.config.acting == "window":
            past = empty_history(self.config, obs["proprio"].shape[-1], self.action_size, n)  # pyright: ignore
        else:
            past = empty_cache(self.config, self.action_size, n)
        return Conditioned(past, self._value(self, state))

    @staticmethod
    @jax.jit
    def _value(policy: "TransformerPolicy", state: State) -> Float[Array, "N"]:
        obs: dict = state.obs  # pyright: ignore
        value = ValueNetwork(policy.value_width).apply(policy.value_params, obs["map"], obs["proprio"], obs["goal"])
        return policy.return_scale * value  # pyright: ignore

    def act(self, memory: Conditioned, state: State, key: jax.Array) -> tuple[Action, Conditioned]:
        """The next actions; the reward just received is taken off the return-to-go."""
        del key
        obs: dict = state.obs  # pyright: ignore
        rtg = memory.rtg - state.reward
        if self.clip_target_return:
            rtg = jnp.minimum(rtg, self._value(self, state))
        method = "act_on_window" if self.config.acting == "window" else "act"
        action, past = self.model.apply(
            self.params, memory.past, obs["map"], obs["proprio"], obs["goal"], rtg, method=method
        )  # pyright: ignore
        return act_as_intended(action), Conditioned(past, rtg)
