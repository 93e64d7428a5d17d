"""A robot's own frame, and the symmetries of its body.

The symmetries of the square rotate and reflect the world. They permute the cells of its local maps, and they transform
proprioception and actions by matrices (mostly signed permutations). If the robot's body is symmetric, there are
additional symmetries that do not change the world.
"""

import functools
import itertools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ct_envs.errors import UserError
from ct_envs.robots import Robot

FrameName = Literal["world", "heading"]  # frame of vectors: the world's, or the robot's own frame


class Symmetries(NamedTuple):
    """A group of G symmetries; the first is the identity."""

    world: np.ndarray  # [G, 2, 2], acts on planar vectors
    proprio: np.ndarray  # [G, P, P]
    action: np.ndarray  # [G, A, A]


def transform(matrices: Float[Array, "B i j"], vectors: Float[Array, "B *s j"]) -> Float[Array, "B *s i"]:
    """Multiply the vectors of each row by the matrix of that row."""
    return jnp.einsum("bij,b...j->b...i", matrices, vectors)


_FLIP_X = np.array([[-1.0, 0.0], [0.0, 1.0]])
_SWAP = np.array([[0.0, 1.0], [1.0, 0.0]])


@functools.cache
def symmetries(robot: Robot) -> Symmetries:
    """The robot's symmetries that match those of the square. Raises UserError if none are known."""
    if robot.name not in _GENERATORS:
        raise UserError(f"robot '{robot.name}' has no known symmetries; train it with mirror=False")
    generators = _GENERATORS[robot.name]()
    found = [tuple(np.eye(len(matrix)) for matrix in generators[0])]
    for element in found:  # ``found`` grows during the loop
        for generator in generators:
            new = tuple(g @ e for g, e in zip(generator, element, strict=True))
            # Proprioception is not compared: a quaternion and its negative are the same attitude.
            if not any(np.allclose(new[0], old[0]) and np.allclose(new[2], old[2]) for old in found):
                found.append(new)
    return Symmetries(*(np.stack(matrices).astype(np.float32) for matrices in zip(*found, strict=True)))


def turns(found: Symmetries) -> Symmetries:
    """The symmetries that rotate the world and the robot together, without changes of its joints."""
    plain = (np.linalg.det(found.world) > 0) & np.isclose(found.action, np.eye(found.action.shape[-1])).all((1, 2))
    return Symmetries(*(matrices[plain] for matrices in found))


def _point() -> list[tuple[np.ndarray, ...]]:
    return [(matrix, matrix, matrix) for matrix in (_FLIP_X, _SWAP)]


def _ant() -> list[tuple[np.ndarray, ...]]:
    """Two reflections of the world and the body, and a quarter turn of the body in an unchanged world."""
    # New leg i is old leg source[i]; its hip and ankle have these signs. See assets/ant.xml for the axes of the joints.
    flip_x = _ant_element(_FLIP_X, -1, [1, 0, 3, 2], -1, [-1, -1, -1, -1], quat=np.diag([1.0, 1.0, -1.0, -1.0]))
    swap = _ant_element(_SWAP, -1, [0, 3, 2, 1], -1, [1, -1, 1, -1], quat=_signed([0, 2, 1, 3], [1, -1, -1, -1]))
    half = np.sqrt(0.5)  # right-multiplication by a quarter turn about z
    turn = half * np.array([[1.0, 0, 0, -1], [0, 1, 1, 0], [0, -1, 1, 0], [1, 0, 0, 1]])
    quarter = _ant_element(np.eye(2), 1, [1, 2, 3, 0], 1, [-1, 1, -1, 1], quat=turn, spin=_SWAP @ _FLIP_X)
    return [flip_x, swap, quarter]


def _ant_element(
    world: np.ndarray, parity: int, source: list[int], hip: int, ankle: list[int], *, quat: np.ndarray,
    spin: np.ndarray | None = None,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    order = list(itertools.chain.from_iterable((2 * leg, 2 * leg + 1) for leg in source))
    signs = list(itertools.chain.from_iterable((hip, sign) for sign in ankle))
    angular = _blocks(parity * world if spin is None else spin, parity * np.eye(1))
    return _element(world, quat, angular, _signed(order, signs))


def _element(world: np.ndarray, quat: np.ndarray, angular: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, ...]:
    """A symmetry of a robot with a free torso: velocity is a world vector, angular velocity an axial body vector."""
    return world, _blocks(np.eye(1), quat, joints, _blocks(world, np.eye(1)), angular, joints), joints


def _humanoid() -> list[tuple[np.ndarray, ...]]:
    """A reflection that swaps left and right, and a quarter turn of the world and the robot together."""
    # New joint i is old joint order[i] with this sign: abdomen z, y, x; right leg x, z, y, knee; left leg; right arm
    # (two shoulder joints, elbow); left arm. See assets/humanoid.xml for the axes.
    order = [0, 1, 2, 7, 8, 9, 10, 3, 4, 5, 6, 14, 15, 16, 11, 12, 13]
    joints = _signed(order, [-1, 1, -1] + [1] * 8 + [-1, -1, 1] * 2)
    flip_y = _element(-_FLIP_X, np.diag([1.0, -1.0, 1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), joints)
    half = np.sqrt(0.5)  # left-multiplication by a quarter turn about z
    turn = half * np.array([[1.0, 0, 0, -1], [0, 1, -1, 0], [0, 1, 1, 0], [1, 0, 0, 1]])
    return [flip_y, _element(_FLIP_X @ _SWAP, turn, np.eye(3), np.eye(17))]


def _signed(order: list[int], signs: list[int]) -> np.ndarray:
    return np.diag(np.asarray(signs, float)) @ np.eye(len(order))[order]


def _blocks(*blocks: np.ndarray) -> np.ndarray:
    size = sum(len(block) for block in blocks)
    whole, at = np.zeros((size, size)), 0
    for block in blocks:
        whole[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return whole


def _turtlebot3() -> list[tuple[np.ndarray, ...]]:
    """A reflection that swaps left and right, for the goal's direction (cos, sin) and the action (v, omega)."""
    flip_y = np.diag([1.0, -1.0])
    return [(flip_y, flip_y, flip_y)]


_GENERATORS = {"point": _point, "ant": _ant, "humanoid": _humanoid, "turtlebot3": _turtlebot3}


def own_frame(proprio: Float[Array, "*b P"]) -> tuple[Float[Array, "*b 2"], Float[Array, "*b P-1"]]:
    """The heading of a robot with a free torso (a unit vector in the plane), and its proprioception relative to it.

    The relative proprioception is height, the up vector in the torso's frame, joint angles, velocity with x along the
    heading, angular velocity and joint velocities. It does not change when the world is rotated.
    """
    joints = (proprio.shape[-1] - 11) // 2
    height, quat, angles, velocity, rest = jnp.split(proprio, np.cumsum([1, 4, joints, 3]).tolist(), -1)
    w, x, y, z = jnp.moveaxis(quat, -1, 0)
    up = jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)], -1)
    heading = jnp.stack([1 - 2 * (y**2 + z**2), 2 * (x * y + w * z)], -1)
    heading = heading / jnp.sqrt(jnp.sum(heading**2, -1, keepdims=True) + 1e-6)
    velocity = jnp.concatenate([turn(heading, velocity[..., :2]), velocity[..., 2:]], -1)
    return heading, jnp.concatenate([height, up, angles, velocity, rest], -1)


def turn(heading: Float[Array, "*b 2"], vector: Float[Array, "*b 2"]) -> jax.Array:
    """The components along and across the heading of a vector in the world frame."""
    cosine, sine = heading[..., 0], heading[..., 1]
    along = cosine * vector[..., 0] + sine * vector[..., 1]
    return jnp.stack([along, cosine * vector[..., 1] - sine * vector[..., 0]], -1)
