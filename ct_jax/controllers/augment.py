"""What a controller sees of itself, and the symmetries that multiply what it learns from."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from brax.training.types import Transition
from jaxtyping import Array, Float

from ct_envs import Robot, UserError
from ct_envs.checked import Checked
from ct_envs.frames import FrameName, own_frame, symmetries, transform, turn


@dataclass(frozen=True)
class AugmentConfig(Checked):
    """The frame and the symmetries of a controller."""

    frame: FrameName = "world"  # frame of the networks' inputs: the "world"'s, or the robot's own "heading"
    mirror: bool = False  # transform each replayed transition by a random symmetry of the robot


def check_frame(frame: FrameName, robot: Robot) -> None:
    """Raise UserError for a frame that the robot does not have."""
    if frame == "heading" and not robot.has_heading:
        raise UserError(f"robot '{robot.name}' has no heading; use frame='world'")


def controller_inputs(observation: Float[Array, "*b P+2"], frame: FrameName) -> Float[Array, "*b I"]:
    """The networks' inputs: proprioception and the vector to the goal [m], in the given frame."""
    if frame == "world":
        return observation
    proprio, goal = observation[..., :-2], observation[..., -2:]
    heading, own = own_frame(proprio)
    return jnp.concatenate([own, turn(heading, goal)], -1)


def input_size(proprio_size: int, frame: FrameName) -> int:
    """Length of ``controller_inputs``."""
    whole = jax.ShapeDtypeStruct((proprio_size + 2,), jnp.float32)
    return jax.eval_shape(lambda seen: controller_inputs(seen, frame), whole).shape[0]


def mirrored(batch: Transition, robot: Robot, key: jax.Array) -> Transition:
    """The batch with each transition transformed by a random symmetry of the robot.

    Raises:
        UserError: the robot has no known symmetries.
    """
    group = symmetries(robot)
    pick = jax.random.randint(key, (len(batch.action),), 0, len(group.world), jnp.int32)
    world, proprio, joints = (jnp.asarray(matrices)[pick] for matrices in group)

    def transformed(seen: Float[Array, "B P+2"]) -> Float[Array, "B P+2"]:
        return jnp.concatenate([transform(proprio, seen[:, :-2]), transform(world, seen[:, -2:])], -1)

    return batch._replace(
        observation=transformed(batch.observation),
        next_observation=transformed(batch.next_observation),
        action=transform(joints, batch.action),
    )
