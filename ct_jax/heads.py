"""Action heads of the transformer, besides its linear one: modules from the trunk and the body to actions."""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from brax.training.acme.running_statistics import NestedMeanStd
from jaxtyping import Array, Float

from ct_jax.controller import ControllerConfig, SacController, blank_controller, make_controller
from ct_jax.dense import Dense
from ct_jax.transformer import GOAL_SCALE_M, ModelConfig, body_features, directions


def make_head(config: ModelConfig, action_size: int, controller: ControllerConfig | None = None) -> nn.Module | None:
    """The head that the settings ask for; None for the transformer's own, which is linear (paper).

    Args:
        controller: the settings of the controller that is the head, with ``config.skill``.
    """
    if config.skill:
        assert controller is not None
        return SkillHead(controller, action_size, config.modes)
    return HeadingHead(config.directions, action_size, config.modes) if config.frame == "heading" else None


class HeadingHead(nn.Module):
    """Actions of a robot that can turn: where to go in the world, turned into the robot's frame, and how it stands.

    The same gait then serves every heading, and the trunk need not know which way the body looks.
    """

    directions: int  # a mode
    action_size: int
    modes: int = 1
    width: int = 256

    @nn.compact
    def __call__(self, x: Float[Array, "*b W"], proprio: Float[Array, "*b P"]) -> Float[Array, "*b M A"]:
        heading, own = body_features(proprio)
        where = directions(x, heading, self.modes * self.directions)
        where = where.reshape(*where.shape[:-1], self.modes, -1)
        own = jnp.broadcast_to(own[..., None, :], (*where.shape[:-1], own.shape[-1]))
        hidden = jnp.concatenate([where, own], -1)
        for _ in range(2):
            hidden = nn.relu(Dense(self.width)(hidden))
        return Dense(self.action_size)(hidden)


class SkillHead(nn.Module):
    """Actions of the trained low-level controller. For each mode, the trunk gives it a goal in the world's plane.

    It is for robots that fall easily, such as the humanoid: a head that learns the gait from examples falls. The
    weights are in the collection "skill" (see ``with_skill``) and get no gradient.
    """

    controller: ControllerConfig
    action_size: int
    modes: int = 1

    @nn.compact
    def __call__(self, x: Float[Array, "*b W"], proprio: Float[Array, "*b P"]) -> Float[Array, "*b M A"]:
        where = GOAL_SCALE_M * Dense(2 * self.modes)(x)
        where = where.reshape(*where.shape[:-1], self.modes, 2)
        body = jnp.broadcast_to(proprio[..., None, :], (*where.shape[:-1], proprio.shape[-1]))
        sizes = proprio.shape[-1], self.action_size
        blank = functools.partial(blank_controller, jax.random.key(0), *sizes, self.controller)
        skill = self.variable("skill", "controller", lambda: _skill(blank()))
        mean, std, policy = jax.lax.stop_gradient(tuple(skill.value[name] for name in ("mean", "std", "policy")))
        controller = make_controller(NestedMeanStd(mean, std), policy, self.action_size, self.controller)
        action = controller(body.reshape(-1, body.shape[-1]), where.reshape(-1, 2))
        return action.reshape(*where.shape[:-1], self.action_size)


def _skill(controller: SacController) -> dict[str, Any]:
    """What of a controller a ``SkillHead`` keeps."""
    return {"mean": controller.normalizer.mean, "std": controller.normalizer.std, "policy": controller.policy}


def with_skill(params: Any, controller: SacController) -> Any:
    """The parameters of a model with a ``SkillHead``, which now is that controller."""
    return params | {"skill": {"head": {"controller": _skill(controller)}}}
