"""The symmetries match the physics, and the robot's own frame is invariant to rotations of the world."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_envs import ANT, HUMANOID, POINT, MazeEnv, UserError, make_maze
from ct_envs.frames import own_frame, symmetries, transform, turn, turns
from ct_envs.physics import PhysicsState
from ct_envs.robots import Robot

OPEN = make_maze(np.pad(np.zeros((7, 7), bool), 1, constant_values=True))
CENTRE = 18.0  # centre of the maze [m]


def drive(robot: Robot, proprio: jax.Array, ctrls: jax.Array) -> jax.Array:
    """Positions relative to the centre, and proprioception [T, G, 2 + P], for ctrls [T, G, A] in G worlds."""
    env = MazeEnv(robot, engine="mujoco", maps=False)
    nq = env.engine.model.nq
    qpos = jnp.concatenate([jnp.full((len(proprio), 2), CENTRE), proprio[:, : nq - 2]], 1)
    state = PhysicsState(qpos, proprio[:, nq - 2 :], jnp.zeros((len(proprio), env.engine.model.nv)))
    parked = jnp.full((len(proprio), 3, 3), -1000.0)
    rows = []
    for ctrl in ctrls:
        state, _ = jax.vmap(env.engine.step)(state, ctrl, parked)
        rows.append(jnp.concatenate([state.qpos[:, :2] - CENTRE, state.qpos[:, 2:], state.qvel], 1))
    return jnp.stack(rows)


def first_proprio(robot: Robot) -> jax.Array:
    state = MazeEnv(robot, engine="mujoco", maps=False, maze=OPEN, reset_velocity_mps=0.5).reset(jax.random.key(1))
    return state.obs["proprio"]


@pytest.mark.parametrize(("robot", "size"), [(POINT, 8), (ANT, 32), (HUMANOID, 8)], ids=["point", "ant", "humanoid"])
def test_physics_is_symmetric(robot, size):
    group = symmetries(robot)
    assert len(group.world) == len(group.proprio) == len(group.action) == size
    np.testing.assert_array_equal(group.action[0], np.eye(group.action.shape[1]))
    proprio = first_proprio(robot)
    steps = 4  # with more steps, contacts of the ant amplify rounding
    ctrl = jax.random.uniform(jax.random.key(2), (steps, group.action.shape[1]), minval=-1.0, maxval=1.0)
    after = np.asarray(
        drive(robot, jnp.einsum("gij,j->gi", group.proprio, proprio), jnp.einsum("gij,tj->tgi", group.action, ctrl))
    )
    position = np.einsum("gij,tj->tgi", group.world, after[:, 0, :2])
    felt = np.einsum("gij,tj->tgi", group.proprio, after[:, 0, 2:])
    np.testing.assert_allclose(after[..., :2], position, atol=1e-3)
    np.testing.assert_allclose(after[..., 2:], felt, atol=2e-2)
    assert np.abs(after[-1, 0, 2:] - np.asarray(proprio)).max() > 0.1  # something happened


@pytest.mark.parametrize("robot", [POINT, ANT, HUMANOID], ids=["point", "ant", "humanoid"])
def test_symmetries_are_a_group(robot):
    group = symmetries(robot)
    rows = np.concatenate([group.world.reshape(len(group.world), -1), group.action.reshape(len(group.action), -1)], 1)
    known = {tuple(row) for row in np.round(rows).astype(int)}
    assert len(known) == len(rows)
    for a in range(len(rows)):
        for b in range(len(rows)):
            product = np.concatenate([(m[a] @ m[b]).ravel() for m in (group.world, group.action)])
            assert tuple(np.round(product).astype(int)) in known


@pytest.mark.parametrize(("robot", "size"), [(POINT, 1), (ANT, 4), (HUMANOID, 4)], ids=["point", "ant", "humanoid"])
def test_turns_do_not_change_joints(robot, size):
    """They are quarter turns of the world. The point has only the identity, because its action is a world vector."""
    group = turns(symmetries(robot))
    angles = np.arctan2(group.world[:, 1, 0], group.world[:, 0, 0])
    np.testing.assert_allclose(np.sort(angles % (2 * np.pi)), np.arange(size) * np.pi / 2, atol=1e-6)
    if size > 1:
        proprio = jnp.broadcast_to(first_proprio(robot), (size, group.proprio.shape[-1]))
        heading, own = own_frame(transform(group.proprio, proprio))
        np.testing.assert_allclose(own, own_frame(proprio)[1], atol=1e-5)
        np.testing.assert_allclose(heading, transform(group.world, own_frame(proprio)[0]), atol=1e-5)


def test_own_frame_is_invariant_to_rotation():
    proprio = first_proprio(ANT)
    angle = 0.7
    cosine, sine = np.cos(angle), np.sin(angle)
    spin = np.array([[cosine, -sine], [sine, cosine]])
    w, x, y, z = np.asarray(proprio[1:5])
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    quat = np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
    turned = proprio.at[1:5].set(quat).at[13:15].set(spin @ proprio[13:15])
    heading, own = own_frame(proprio)
    heading_turned, own_turned = own_frame(turned)
    np.testing.assert_allclose(own, own_turned, atol=1e-5)
    np.testing.assert_allclose(heading_turned, spin @ heading, atol=1e-5)
    goal = jnp.array([3.0, -1.0])
    np.testing.assert_allclose(
        turn(heading, goal), turn(heading_turned, jnp.asarray(spin, jnp.float32) @ goal), atol=1e-5
    )
    np.testing.assert_allclose(own_frame(-proprio.at[5:].multiply(-1).at[0].multiply(-1))[1], own, atol=1e-5)  # -q is q


def test_robot_without_symmetries_is_error():
    with pytest.raises(UserError, match="no known symmetries"):
        symmetries(Robot(**{**POINT.__dict__, "name": "stranger"}))
