"""The humanoid: its body, falls, contacts of its limbs with walls, and the agreement of both engines."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ct_envs import HUMANOID, MazeEnv, Tasks, load_maze
from ct_envs.frames import own_frame
from ct_envs.frames import turn as turned
from ct_envs.physics import build_model, make_engine, model_xml

pytestmark = pytest.mark.rank_promotion("allow")  # MJX

UMAZE = load_maze("antmaze-umaze")
STANDING = Tasks(start=jnp.array([[6.0, 6.0]]), goal=jnp.array([[14.0, 14.0]]), n=jnp.array(1))
N = 4


@functools.cache
def compiled(**options):
    env = MazeEnv(HUMANOID, engine="mujoco", maps=False, **options)
    return jax.jit(jax.vmap(env.reset, (0, None, None))), jax.jit(jax.vmap(env.step))


def keys(seed: int, n: int = N) -> jax.Array:
    return jax.random.split(jax.random.key(seed), n)


# ----------------------------------------------------------------------------------------------------- the body


def test_body_equals_gymnasium_humanoid():
    """Numbers of the ``humanoid.xml`` of gymnasium 1.4.0 (Humanoid-v5), computed by MuJoCo. It has the same joints in
    the same order, so its whole mass matrix, here in a bent pose, can be compared. Two numbers of its right leg differ
    from the left one's: ours are the left one's."""
    model = mujoco.MjModel.from_xml_string(model_xml(HUMANOID))
    assert (model.nq, model.nv, model.nu) == (24, 23, 17)
    for name, mass in {"torso": 8.90746237, "waist": 2.26194671, "pelvis": 6.61619413}.items():
        np.testing.assert_allclose(model.body(name).mass, mass, rtol=1e-6)
    limbs = {"thigh": 4.75175093, "shin": 2.75569617 + 1.76714587, "upper_arm": 1.66108048, "lower_arm": 1.22954019}
    for side in ("right", "left"):
        for name, mass in limbs.items():
            np.testing.assert_allclose(model.body(f"{side}_{name}").mass, mass, rtol=1e-6)
    leg, right_arm, left_arm = [[-25, 5], [-60, 35], [-110, 20], [-160, -2]], [[-85, 60]] * 2, [[-60, 85]] * 2
    ranges = [[-45, 45], [-75, 30], [-35, 35], *leg, *leg, *right_arm, [-90, 50], *left_arm, [-90, 50]]
    np.testing.assert_allclose(np.rad2deg(model.jnt_range[1:]), ranges)
    right_knee, right_hip_y = 1, 0.01  # gymnasium has 0 and 0.008
    stiffness = [20, 10, 10, 10, 10, 20, right_knee, 10, 10, 20, 1, 1, 1, 0, 1, 1, 0]
    np.testing.assert_array_equal(model.jnt_stiffness[1:], stiffness)
    np.testing.assert_array_equal(model.dof_damping[6:], [*[5] * 6, 1, *[5] * 3, 1, *[1] * 6])
    armature = [*[0.02] * 3, 0.01, 0.01, right_hip_y, 0.006, 0.01, 0.01, 0.01, 0.006, *[0.0068, 0.0051, 0.0028] * 2]
    np.testing.assert_array_equal(model.dof_armature[6:], armature)
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], np.arange(1, 18))
    np.testing.assert_array_equal(model.actuator_gear[:, 0], [*[100] * 3, *[100, 100, 300, 200] * 2, *[25] * 6])
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-0.4, 0.4]] * 17)
    data, matrix = mujoco.MjData(model), np.zeros((23, 23))
    data.qpos[:7] = [0, 0, 1.3, 1, 0, 0, 0]
    data.qpos[7:] = 0.03 * np.arange(1, 18) * (-1) ** np.arange(17)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    free = [42.11603049, 42.11603049, 42.11603049, 15.99768643, 16.15272481, 1.80446385]
    trunk, right = [1.20250791, 9.50114366, 6.40682193], [1.9537419, 0.16307173, 2.08262135 + 0.002, 0.36414598]
    left = [1.74209992, 0.37327591, 2.05712106, 0.36414598]
    arms = [0.11501569, 0.24206059, 0.06079424, 0.06804519, 0.12105641, 0.06079424]
    np.testing.assert_allclose(np.diag(matrix), [*free, *trunk, *right, *left, *arms], atol=1e-8)
    np.testing.assert_allclose(np.triu(matrix, 1).sum(), 33.78490791, atol=1e-7)


def test_reset_is_standing_with_random_heading():
    state = compiled(auto_reset=False)[0](keys(1, 200), UMAZE, STANDING)
    heading, own = own_frame(state.obs["proprio"])
    np.testing.assert_allclose(own[:, 1:4], [[0.0, 0.0, 1.0]] * 200, atol=1e-6)
    assert np.abs(np.asarray(heading).mean(0)).max() < 0.2
    assert state.obs["proprio"].shape == (200, 45)
    model = build_model(HUMANOID)
    data = mujoco.MjData(model)
    data.qpos[:] = model.key("stand").qpos
    mujoco.mj_forward(model, data)
    feet = [data.geom(f"{side}_foot").xpos[2] - model.geom(f"{side}_foot").size[0] for side in ("right", "left")]
    np.testing.assert_allclose(feet, 0.0, atol=0.01)
    assert (
        np.hypot(*(data.subtree_com[1] - 0.5 * (data.geom("right_foot").xpos + data.geom("left_foot").xpos))[:2]) < 0.05
    )


def test_turn_rad_limits_initial_heading():
    reset = compiled(auto_reset=False)[0]
    for turn in (0.0, 0.5, np.pi):
        state = reset(keys(1, 200), UMAZE, STANDING.replace(turn_rad=jnp.asarray(turn, jnp.float32)))
        heading, _ = own_frame(state.obs["proprio"])
        away = np.abs(np.arctan2(*np.asarray(turned(heading, state.obs["goal"])).T[::-1]))
        assert away.max() <= turn + 1e-3 and away.max() > 0.9 * turn


def test_action_is_share_of_actuator_range():
    reset, step = compiled(auto_reset=False)
    state, action = reset(keys(0), UMAZE, STANDING), jnp.broadcast_to(jnp.linspace(-1.0, 1.0, 17), (N, 17))
    engine, parked = make_engine("mujoco", HUMANOID), jnp.full((N, 3, 3), -1000.0)
    by_hand, _ = jax.jit(jax.vmap(engine.step))(state.pipeline_state, 0.4 * action, parked)
    np.testing.assert_allclose(step(state, action).pipeline_state.qpos, by_hand.qpos, atol=1e-5)


# -------------------------------------------------------------------------------------------------------- falls


def test_humanoid_falls_without_actions():
    reset, step = compiled(auto_reset=False)
    state = reset(keys(0), UMAZE, STANDING.replace(goal=jnp.array([[6.2, 6.0]])))
    lying = state.pipeline_state.qpos.at[1, 2:7].set(jnp.array([0.3, np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]))
    state = state.replace(pipeline_state=state.pipeline_state.replace(qpos=lying))
    state = step(state, jnp.zeros((N, 17)))
    np.testing.assert_array_equal(state.info["fall"], [0, 1, 0, 0])
    np.testing.assert_array_equal(state.info["success"], [1, 0, 1, 1])  # a fall at the goal is not a success
    state = reset(keys(0), UMAZE, STANDING)
    for _ in range(100):
        state = step(state, jnp.zeros((N, 17)))
    assert (state.done == 1).all() and (state.info["fall"] == 1).all() and not state.info["truncation"].any()
    assert ((state.pipeline_state.qpos[:, 2] < 1.0) & (state.pipeline_state.qpos[:, 2] > 0.7)).all()  # at once


# ---------------------------------------------------------------------------------------------- walls and engines


def test_all_limbs_collide_with_walls_and_floor():
    model = build_model(HUMANOID)
    names = [model.geom(i).name for i in range(model.ngeom)]
    limbs = [i for i, name in enumerate(names) if not name.startswith(("wall", "floor"))]
    obstacles = [i for i in range(model.ngeom) if i not in limbs]
    assert len(limbs) == 17 and len(obstacles) == 4
    for limb in limbs:
        for obstacle in obstacles:
            assert model.geom_contype[limb] & model.geom_conaffinity[obstacle]


def test_limbs_stay_within_touch_distance():
    """In any pose of its joints, and at the largest tilt without a fall."""
    model = mujoco.MjModel.from_xml_string(model_xml(HUMANOID))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(2000):
        lean, way = rng.uniform(0, 0.9), rng.uniform(0, 2 * np.pi)
        data.qpos[3:7] = [np.cos(lean / 2), np.sin(lean / 2) * np.cos(way), np.sin(lean / 2) * np.sin(way), 0]
        data.qpos[7:] = rng.uniform(*model.jnt_range[1:].T)
        mujoco.mj_kinematics(model, data)
        assert (np.hypot(*data.geom_xpos[1:, :2].T) + model.geom_rbound[1:]).max() < HUMANOID.touch_m
