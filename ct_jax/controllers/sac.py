"""Soft Actor-Critic: the learner alone (Haarnoja et al., 2018; paper, sec. III-G).

It knows transitions, and nothing of where they come from. Networks, losses and running statistics are brax's.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import optax
from brax.training import gradients
from brax.training.acme import running_statistics, specs
from brax.training.agents.sac import losses as sac_losses
from brax.training.agents.sac import networks as sac_networks
from brax.training.types import Transition
from flax import struct
from jaxtyping import Array, Float

from ct_envs import UserError
from ct_envs.checked import Above, Checked, Count, Share, Within
from ct_jax.learner import Info


@dataclass(frozen=True)
class SacConfig(Checked):
    """Soft Actor-Critic. Values marked "paper" are from sec. III-G; the others are usual values."""

    envs: Annotated[int, Within(1, 100_000)] = 64  # environments stepped together
    iterations: Count = 500  # in each: one step of all environments, then the updates
    updates: Annotated[int, Within(1, 10_000)] = 8  # gradient updates in an iteration
    warmup: Annotated[int, Within(0, 10**9)] = 20  # first iterations, with random actions and no updates
    batch: Annotated[int, Within(1, 1_000_000)] = 256  # paper
    replay: Count = 200_000  # transitions in the replay buffer
    learning_rate: Annotated[float, Above(0, 1)] = 3e-4  # paper
    final_rate: Share = 1.0  # final learning rate, as a share of the first; it falls linearly
    average: Share = 0.0  # the result is a mean of policies with this decay at each update; 0: the last policy
    critic_norm: bool = False  # layer norm in the critics
    hidden: Annotated[tuple[Annotated[int, Within(1, 16_384)], ...], Within(1, 16)] = (256, 256)  # paper
    discount: Share = 0.97  # of the return, for each step
    initial_temperature: Annotated[float, Above(0, 1000)] = 0.1  # first weight of the policy's entropy; it adapts
    target_rate: Annotated[float, Above(0, 1)] = 0.005  # share of the new critic in the target critic at each update
    reward_scale: Annotated[float, Above(0, 1_000_000)] = 1.0  # factor of the reward in the losses
    action_scale: Annotated[float, Above(0, 1)] = 1.0  # share of the actuators' range that the policy uses
    # Share of the environments with deterministic actions, as in later use: they visit states in which only random
    # actions would make progress.
    greedy: Share = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.replay < self.envs:
            raise UserError(f"SacConfig.replay is {self.replay}; give at least the number of envs, {self.envs}")


@functools.cache  # learners with the same networks share their compiled programs
def make_networks(
    input_size: int, action_size: int, hidden: tuple[int, ...], *, critic_norm: bool = False
) -> sac_networks.SACNetworks:
    """Policy and critics for inputs and actions of these sizes."""
    with jax.ensure_compile_time_eval():  # the result is kept, so it must not hold tracers
        return sac_networks.make_sac_networks(
            input_size,
            action_size,
            preprocess_observations_fn=running_statistics.normalize,
            hidden_layer_sizes=hidden,
            q_network_layer_norm=critic_norm,
        )


def blank_statistics(size: int) -> running_statistics.RunningStatisticsState:
    """brax's running statistics of inputs of this size, of none so far; in 32 bits, also where JAX has 64."""
    blank = running_statistics.init_state(specs.Array((size,), jnp.dtype("float32")))
    names = ("mean", "summed_variance", "std", "std_eps")
    return blank.replace(**{name: jnp.asarray(getattr(blank, name), jnp.float32) for name in names})


@struct.dataclass
class Sac:
    """The learner: its settings, and after ``create`` the complete state of training."""

    config: SacConfig = struct.field(pytree_node=False)
    networks: sac_networks.SACNetworks = struct.field(pytree_node=False)
    action_size: int = struct.field(pytree_node=False)
    policy: Any = None
    average: Any = None  # moving average of the policies: the result
    critic: Any = None
    target_critic: Any = None
    log_alpha: Any = None
    policy_optimizer: Any = None
    critic_optimizer: Any = None
    alpha_optimizer: Any = None
    normalizer: Any = None  # running statistics of the inputs; None for networks that scale their inputs themselves

    def create(self, keys: jax.Array, input_size: int | None = None) -> "Sac":
        """The learner before training.

        Args:
            keys: two, of policy and critics.
            input_size: length of the inputs if they are normalised by their running statistics.
        """
        policy, critic = self.networks.policy_network.init(keys[0]), self.networks.q_network.init(keys[1])
        log_alpha = jnp.log(jnp.asarray(self.config.initial_temperature, jnp.float32))
        return self.replace(
            policy=policy,
            average=policy,
            critic=critic,
            target_critic=critic,
            log_alpha=log_alpha,
            policy_optimizer=self._optimizer.init(policy),
            critic_optimizer=self._optimizer.init(critic),
            alpha_optimizer=self._optimizer.init(log_alpha),
            normalizer=None if input_size is None else blank_statistics(input_size),
        )

    def act(self, inputs: Any, key: jax.Array) -> Float[Array, "N A"]:
        """Actions to learn from: samples, but for the share of ``config.greedy``."""
        logits = self.networks.policy_network.apply(self.normalizer, self.policy, inputs)
        distribution = self.networks.parametric_action_distribution
        action = distribution.sample(logits, key).astype(jnp.float32)
        if not self.config.greedy:
            return action
        without = jnp.arange(len(action)) < self.config.greedy * len(action)
        return jnp.where(without[:, None], distribution.mode(logits), action)

    def watch(self, inputs: Any) -> "Sac":
        """The learner that has seen these inputs, and normalises later ones accordingly."""
        if self.normalizer is None:
            return self
        return self.replace(normalizer=running_statistics.update(self.normalizer, inputs))

    def update(self, batch: Transition, keys: jax.Array) -> tuple["Sac", Info]:
        """One update of temperature, critics and policy.

        Args:
            batch: observations are the networks' inputs.
            keys: two, of policy and critics.
        """
        cool, criticise, act = self._descents()
        # The losses of temperature and policy use the same key, so the same actions, which are computed once.
        (_, alpha_info), log_alpha, alpha_optimizer = cool(
            self.log_alpha, self.policy, self.normalizer, batch, keys[0], optimizer_state=self.alpha_optimizer
        )
        alpha = jnp.exp(self.log_alpha)
        (_, critic_info), critic, critic_optimizer = criticise(
            self.critic, self.policy, self.normalizer, self.target_critic, alpha, batch, keys[1],
            optimizer_state=self.critic_optimizer,
        )  # fmt: skip
        (_, actor_info), policy, policy_optimizer = act(
            self.policy, self.normalizer, self.critic, alpha, batch, keys[0], optimizer_state=self.policy_optimizer
        )
        average = optax.incremental_update(policy, self.average, 1.0 - self.config.average)
        target = optax.incremental_update(critic, self.target_critic, self.config.target_rate)
        learner = self.replace(
            policy=policy, average=average, critic=critic, target_critic=target, log_alpha=log_alpha,
            policy_optimizer=policy_optimizer, critic_optimizer=critic_optimizer, alpha_optimizer=alpha_optimizer,
        )  # fmt: skip
        return learner, alpha_info | critic_info | actor_info | {"alpha": alpha}

    @property
    def _optimizer(self) -> optax.GradientTransformation:
        config = self.config
        first, last = config.learning_rate, config.final_rate * config.learning_rate
        return optax.adam(optax.linear_schedule(first, last, config.iterations * config.updates))

    def _descents(self) -> list[Callable[..., Any]]:
        """Steps of gradient descent on brax's losses of temperature, critics and policy, each in its first argument."""
        losses = sac_losses.make_losses(self.networks, self.config.reward_scale, self.config.discount, self.action_size)
        named = zip(("alpha_loss", "critic_loss", "actor_loss"), losses, strict=True)
        descend = functools.partial(gradients.gradient_update_fn, pmap_axis_name=None, has_aux=True)
        return [descend(_with_info(name, loss), self._optimizer) for name, loss in named]


def _with_info(name: str, loss: Callable[..., jax.Array]) -> Callable[..., tuple[jax.Array, Info]]:
    def informed(*arguments: Any) -> tuple[jax.Array, Info]:
        value = loss(*arguments)
        return value, {name: value}

    return informed
