"""The ant: its body, falls, contacts of its limbs with walls, and the agreement of both engines."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ct_envs import ANT, MazeEnv, Tasks, UserError, load_maze, make_maze
from ct_envs.frames import own_frame
from ct_envs.physics import PhysicsState, build_model, make_engine, model_xml, nearest_walls
from ct_jax.prm import build_roadmap

pytestmark = pytest.mark.rank_promotion("allow")  # MJX

N = 4
UMAZE = load_maze("antmaze-umaze")
STANDING = Tasks(start=jnp.array([[6.0, 6.0]]), goal=jnp.array([[14.0, 14.0]]), n=jnp.array(1))


@functools.cache
def environment(**options) -> MazeEnv:
    return MazeEnv(ANT, engine="mujoco", **options)


@functools.cache
def compiled(**options):
    env = environment(**options)
    return jax.jit(jax.vmap(env.reset, (0, None, None))), jax.jit(jax.vmap(env.step))


def keys(seed: int, n: int = N) -> jax.Array:
    return jax.random.split(jax.random.key(seed), n)


def lay(state, which, quat):
    """The state with some robots rotated to a given attitude."""
    physics = state.pipeline_state
    qpos = jnp.where(jnp.asarray(which)[:, None], physics.qpos.at[:, 3:7].set(jnp.array(quat)), physics.qpos)
    return state.replace(pipeline_state=physics.replace(qpos=qpos))


# ----------------------------------------------------------------------------------------------------- the body


def test_body_equals_gymnasium_ant():
    """Numbers of the ``ant.xml`` of gymnasium 1.4.0 (Ant-v5), computed by MuJoCo. It has the same joints in the same
    order, so its whole mass matrix, here in a bent pose, can be compared."""
    model = mujoco.MjModel.from_xml_string(model_xml(ANT))
    assert (model.nq, model.nv, model.nu) == (15, 14, 8)
    np.testing.assert_allclose(model.body("torso").mass, 0.32724923 + 4 * 0.03915775, rtol=1e-6)
    for i in range(1, 5):
        np.testing.assert_allclose(model.body(f"leg{i}").mass, 0.03915775, rtol=1e-6)
        np.testing.assert_allclose(model.body(f"leg{i}").inertia, [0.00056797, 0.00056797, 0.00011844], atol=1e-8)
        np.testing.assert_allclose(model.body(f"foot{i}").mass, 0.0675922, rtol=1e-6)
        np.testing.assert_allclose(model.body(f"foot{i}").inertia, [0.00267479, 0.00267479, 0.00020943], atol=1e-8)
    ranges = np.rad2deg(model.jnt_range[1:])
    np.testing.assert_allclose(ranges[0::2], [[-30, 30]] * 4)
    np.testing.assert_allclose(ranges[1::2], [[30, 70], [-70, -30], [-70, -30], [30, 70]])
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 150)
    np.testing.assert_array_equal(model.dof_armature[6:], 1)
    np.testing.assert_array_equal(model.dof_damping[6:], 1)
    data, matrix = mujoco.MjData(model), np.zeros((14, 14))
    data.qpos[:] = model.key("stand").qpos
    data.qpos[7], data.qpos[10] = 0.3, -0.7
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    free = [0.91088008, 0.91088008, 0.91088008, 0.12888428, 0.11468946, 0.19362577]
    legs = [1.01510943, 1.00808217, 1.01984493, 1.00808217, 1.01510943, 1.00808217, 1.01510943, 1.00808217]
    np.testing.assert_allclose(np.diag(matrix), free + legs, atol=1e-8)
    np.testing.assert_allclose(matrix[3:6, 6:].sum(), 0.14189087, atol=1e-8)


def test_ant_stands_without_actions():
    reset, step = compiled(auto_reset=False, maps=False)
    state = reset(keys(0, 16), UMAZE, STANDING)
    for _ in range(30):
        state = step(state, jnp.zeros((16, 8)))
    assert not np.asarray(state.done).any()
    assert np.abs(np.asarray(state.pipeline_state.qvel)).max() < 0.1
    assert np.linalg.norm(np.asarray(state.info["position"]) - 6.0, axis=-1).max() < 0.2


def test_reset_is_upright_with_random_heading():
    state = compiled(auto_reset=False, maps=False)[0](keys(1, 200), UMAZE, STANDING)
    heading, own = own_frame(state.obs["proprio"])
    np.testing.assert_allclose(own[:, 1:4], [[0.0, 0.0, 1.0]] * 200, atol=1e-6)
    assert np.abs(np.asarray(heading).mean(0)).max() < 0.2
    assert state.obs["proprio"].shape == (200, 27)


# -------------------------------------------------------------------------------------------------------- falls


def test_fall_is_failure_of_its_own_environment_only():
    reset, step = compiled(auto_reset=False, maps=False)
    state = reset(keys(2), UMAZE, STANDING)
    fallen = np.array([False, True, False, False])
    clean, after = step(state, jnp.zeros((N, 8))), step(lay(state, fallen, [0.0, 1.0, 0.0, 0.0]), jnp.zeros((N, 8)))
    np.testing.assert_array_equal(after.info["fall"], fallen)
    np.testing.assert_array_equal(after.done, fallen)
    assert not np.asarray(after.info["success"]).any() and not np.asarray(after.info["truncation"]).any()
    for a, b in zip(jax.tree.leaves(clean.pipeline_state), jax.tree.leaves(after.pipeline_state), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[~fallen], np.asarray(b)[~fallen])


def test_fall_at_goal_is_not_success():
    reset, step = compiled(auto_reset=False, maps=False)
    state = lay(reset(keys(3), UMAZE, STANDING.replace(goal=STANDING.start)), [True, False] * 2, [0.0, 1.0, 0.0, 0.0])
    after = step(state, jnp.zeros((N, 8)))
    np.testing.assert_array_equal(after.info["success"], [0, 1, 0, 1])


def test_diverged_state_ends_its_own_episode_only(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning there
    reset, step = compiled(maps=False)
    state = reset(keys(4), UMAZE, STANDING)
    physics = state.pipeline_state
    sick = np.array([False, False, True, False])
    speed = jnp.where(jnp.asarray(sick)[:, None], 1e30, physics.qvel)
    after = step(state.replace(pipeline_state=physics.replace(qvel=speed)), jnp.zeros((N, 8)))
    clean = step(state, jnp.zeros((N, 8)))
    np.testing.assert_array_equal(after.done, sick)
    assert np.isfinite(np.asarray(after.pipeline_state.qpos)).all() and np.isfinite(np.asarray(after.reward)).all()
    np.testing.assert_array_equal(np.asarray(after.obs["proprio"])[~sick], np.asarray(clean.obs["proprio"])[~sick])
    assert not np.asarray(after.info["success"]).any()


def test_following_task_starts_at_current_position():
    reset, step = compiled(maps=False)
    goal = jnp.array([[6.1, 6.0], [10.0, 6.0]])
    tasks = Tasks(jnp.full((2, 2), 6.0), goal, jnp.array(1), follow=jnp.array([[1, 1], [0, 0]]))
    state = reset(keys(5), UMAZE, tasks)
    after = step(state, jnp.full((N, 8), 0.3))
    assert (after.done == 1).all() and (after.info["success"] == 1).all() and (after.info["task"] == 1).all()
    np.testing.assert_allclose(after.info["goal"], jnp.tile(goal[1:], (N, 1)))
    assert np.abs(np.asarray(after.pipeline_state.qvel)).max() > 0.1  # it is not reset
    assert (after.info["episode_steps"] == 0).all()
    later = step(lay(after, [True] * N, [0.0, 1.0, 0.0, 0.0]), jnp.zeros((N, 8)))
    assert (later.info["task"] == 0).all() and (later.info["fall"] == 1).all()
    np.testing.assert_allclose(later.info["position"], 6.0, atol=1e-5)  # a fall does reset


# ---------------------------------------------------------------------------------------------- walls and engines


def test_all_limbs_collide_with_walls_and_floor():
    model = build_model(ANT)
    limbs = [i for i in range(model.ngeom) if model.geom(i).name.startswith(("torso", "stub", "leg", "foot"))]
    obstacles = [i for i in range(model.ngeom) if model.geom(i).name.startswith(("wall", "floor"))]
    assert len(limbs) == 13 and len(obstacles) == 4
    for limb in limbs:
        for obstacle in obstacles:
            met = model.geom_contype[limb] & model.geom_conaffinity[obstacle]
            assert met | (model.geom_contype[obstacle] & model.geom_conaffinity[limb])


def test_leg_in_wall_is_collision_and_is_pushed_out():
    engine = make_engine("mujoco", ANT)
    walls = np.ones((5, 5), bool)
    walls[1:4, 1:4] = False
    maze = make_maze(walls)
    qpos = np.tile(engine.model.key("stand").qpos, (3, 1)).astype(np.float32)
    qpos[:, :2] = [[10.0, 10.0], [10.0, 15.2], [15.2, 15.2]]  # walls begin at 16 m, feet reach 0.95 m
    quarter = np.float32([np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)])  # legs along the axes
    qpos[:, 3:7] = quarter
    state = PhysicsState(jnp.asarray(qpos), jnp.zeros((3, 14)), jnp.zeros((3, 14)))
    told = []
    for _ in range(10):
        boxes = jax.vmap(nearest_walls, (None, 0))(maze, state.qpos[:, :2])
        state, touching = jax.vmap(engine.step)(state, jnp.zeros((3, 8)), boxes)
        told.append(np.asarray(touching))
    np.testing.assert_array_equal(told[0], [0, 1, 1])
    assert state.qpos[1, 1] < 15.12 and (state.qpos[2, :2] < 15.12).all()


def test_too_narrow_maze_is_error():
    with pytest.raises(UserError, match=r"no room for a robot of radius 1\.0 m"):
        narrow = make_maze(np.pad(np.zeros((3, 3), bool), 1, constant_values=True), cell_m=0.5)
        build_roadmap(jax.random.key(0), narrow, radius_m=ANT.radius_m)
    with pytest.raises(UserError, match=r"cells of 1\.5 m are too small for robot 'ant'"):
        build_model(ANT, cell_m=1.5)
