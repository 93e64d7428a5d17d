"""The controller of the Turtlebot3: it reaches goals from any pose, saturates, and is proportional below saturation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ct_envs.turtlebot3 import TOP_SPEED_MPS, TOP_TURN_RADPS, as_action, speeds, to_heading, wheel_speeds
from ct_jax.controllers.differential_drive import DifferentialDrive

DT_S = 0.2
CONTROLLERS = [DifferentialDrive(), DifferentialDrive(turn_first=0.0), DifferentialDrive(0.5, 1.0, 1.0)]
SEEDS = st.integers(0, 2**31 - 1)


def move(position: np.ndarray, yaw: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The poses after a control step with constant v and omega, on an arc."""
    v, omega = speeds(action).T
    half = omega * DT_S / 2
    chord = v * DT_S * np.sinc(half / np.pi)
    return position + chord[:, None] * np.stack([np.cos(yaw + half), np.sin(yaw + half)], -1), yaw + 2 * half


@pytest.mark.parametrize("controller", CONTROLLERS)
@given(SEEDS)
@settings(max_examples=3)
def test_controller_reaches_goal_from_any_pose(controller, seed):
    rng = np.random.default_rng(seed)
    position, yaw = rng.uniform(-3, 3, (64, 2)), rng.uniform(-np.pi, np.pi, 64)
    yaw[:4] = np.arctan2(position[:4, 1], position[:4, 0])  # the goal is behind the robot
    for _ in range(400):
        position, yaw = move(position, yaw, controller(None, to_heading(-position, yaw)))
    assert np.linalg.norm(position, axis=-1).max() < 0.05


@pytest.mark.parametrize("controller", CONTROLLERS)
@given(SEEDS)
@settings(max_examples=20)
def test_controller_respects_limits_and_never_reverses(controller, seed):
    goals = np.random.default_rng(seed).normal(size=(50, 2)) * 10.0 ** np.arange(-4, 1).repeat(10)[:, None]
    v, omega = speeds(controller(None, goals)).T
    assert (v >= 0).all() and v.max() <= TOP_SPEED_MPS and np.abs(omega).max() <= TOP_TURN_RADPS


@given(SEEDS)
@settings(max_examples=20)
def test_controller_is_proportional_below_saturation(seed):
    """The paper's equations, without slowing in turns."""
    rng = np.random.default_rng(seed)
    distance, angle = rng.uniform(0, 0.2, 20), rng.uniform(-0.9, 0.9, 20)
    goals = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    v, omega = speeds(DifferentialDrive(1.0, 3.0, 0.0)(None, goals)).T
    np.testing.assert_allclose(v, distance, atol=1e-12)
    np.testing.assert_allclose(omega, 3.0 * angle, atol=1e-9)


@pytest.mark.parametrize("controller", CONTROLLERS)
@given(SEEDS)
@settings(max_examples=20)
def test_controller_is_mirror_symmetric(controller, seed):
    goals = np.random.default_rng(seed).normal(size=(20, 2))
    np.testing.assert_allclose(controller(None, goals * [1, -1]), controller(None, goals) * [1, -1], atol=1e-12)


def test_controller_turns_before_driving():
    assert speeds(DifferentialDrive()(None, np.array([-1.0, 1.0]))).tolist() == [0.0, TOP_TURN_RADPS]
    assert DifferentialDrive()(None, np.zeros(2)).tolist() == [0.0, 0.0]


@given(SEEDS)
@settings(max_examples=20)
def test_wheel_speeds_match_motion_of_robot(seed):
    """The mean distance of the wheels is that of the robot; their difference is the turn times the wheel separation."""
    rng = np.random.default_rng(seed)
    v, omega = rng.uniform(-1, 1, (2, 30)) * [[TOP_SPEED_MPS], [TOP_TURN_RADPS]]
    left, right = 0.033 * wheel_speeds(v, omega).T
    np.testing.assert_allclose((left + right) / 2, v, atol=1e-12)
    np.testing.assert_allclose(right - left, 0.160 * omega, atol=1e-12)
    np.testing.assert_allclose(speeds(as_action(v, omega)), np.stack([v, omega], -1), atol=1e-12)
