"""Actor and critics of the baselines. They have the transformer's inputs and map encoder, but no memory."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from brax.training.distribution import NormalTanhDistribution
from flax import struct
from jaxtyping import Array, Float

from ct_envs.frames import FrameName
from ct_envs.occupancy import MAP_CELLS
from ct_envs.robots import Robot
from ct_jax.controllers.augment import check_frame
from ct_jax.transformer import GOAL_SCALE_M, MapEncoder, ModelConfig, body_features, directions, goal_features
from ct_jax.types import Action, Frame, Observation, act_as_intended
from ct_jax.worlds import kind_of


def sample_observation(proprio_size: int) -> Observation:
    """An observation of zeros, to initialise parameters."""
    return Observation(
        jnp.zeros((1, 2, MAP_CELLS, MAP_CELLS), jnp.uint8), jnp.zeros((1, proprio_size)), jnp.zeros((1, 2))
    )


def tanh_gaussian(action_size: int) -> NormalTanhDistribution:
    """The distribution of actions. An ``Actor`` gives its parameters."""
    return NormalTanhDistribution(action_size)


def _perceive(seen: Observation, width: int, frame: str) -> Float[Array, "*b F"]:
    """The first hidden layer over an observation. Call it inside a module.

    With ``frame="heading"``, directions in the world are turned into the robot's own frame, as in the transformer.
    """
    distance = jnp.linalg.norm(seen.goal_relative, axis=-1, keepdims=True) / GOAL_SCALE_M
    place = [MapEncoder(width)(seen.map), goal_features(seen.goal_relative), distance]
    if frame == "world":
        return nn.relu(nn.Dense(width)(jnp.concatenate([*place, seen.proprio], -1)))
    heading, body = body_features(seen.proprio)
    x = nn.relu(nn.Dense(width)(jnp.concatenate([*place, heading, body], -1)))
    return jnp.concatenate([x, directions(x, heading, ModelConfig.directions), body], -1)


class Actor(nn.Module):
    """pi(a | s, g): the parameters of a ``tanh_gaussian``."""

    action_size: int
    width: int
    frame: str = "world"

    @nn.compact
    def __call__(self, seen: Observation) -> Float[Array, "*b 2A"]:
        x = _perceive(seen, self.width, self.frame)
        for _ in range(2):
            x = nn.relu(nn.Dense(self.width)(x))
        return nn.Dense(2 * self.action_size)(x)


class Critics(nn.Module):
    """Two critics Q(s, a | g) that share a map encoder. Each evaluates M actions in the same state."""

    width: int
    frame: str = "world"
    norm: bool = False  # layer norm after the hidden layers

    @nn.compact
    def __call__(self, seen: Observation, action: Float[Array, "*b M A"]) -> Float[Array, "*b M 2"]:
        x = _perceive(seen, self.width, self.frame)[..., None, :]
        values = []
        for _ in range(2):
            # A dense layer of state and action, written as a sum: the state's part is computed once for all M actions.
            y = nn.relu(nn.Dense(self.width)(x) + nn.Dense(self.width, use_bias=False)(action))
            y = nn.LayerNorm()(y) if self.norm else y
            y = nn.relu(nn.Dense(self.width)(y))
            y = nn.LayerNorm()(y) if self.norm else y
            values.append(nn.Dense(1)(y))
        return jnp.concatenate(values, -1)


@struct.dataclass
class ActorPolicy:
    """The deterministic policy that a baseline learned. It has no memory."""

    params: Any
    action_size: int = struct.field(pytree_node=False)
    width: int = struct.field(pytree_node=False)
    frame: str = struct.field(pytree_node=False, default="world")

    def init(self, frame: Frame, tasks: Any = None) -> tuple[()]:
        """The memory of N episodes: it is empty."""
        del frame, tasks
        return ()

    def act(self, memory: tuple[()], frame: Frame, key: jax.Array) -> tuple[Action, tuple[()]]:
        """The next actions in N environments with maps, and the empty memory."""
        del key
        return act_as_intended(_best(self, frame.obs)), memory


@jax.jit  # some worlds step in NumPy
def _best(policy: ActorPolicy, seen: Observation) -> Float[Array, "N A"]:
    logits: Any = Actor(policy.action_size, policy.width, policy.frame).apply(policy.params, seen)
    return tanh_gaussian(policy.action_size).mode(logits)


def blank_policy(robot: Robot, width: int, frame: FrameName) -> ActorPolicy:
    """A policy with the shapes of its parameters. Raises UserError for a frame that the robot does not have."""
    check_frame(frame, robot)
    proprio_size, action_size = kind_of(robot).sizes(robot)
    params = jax.eval_shape(Actor(action_size, width, frame).init, jax.random.key(0), sample_observation(proprio_size))
    return ActorPolicy(params, action_size, width, frame)
