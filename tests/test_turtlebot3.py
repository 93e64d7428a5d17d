"""The Turtlebot3: worlds are exact, the robot drives as its wheels turn and sees what is there, no process is lost."""

import contextlib
import functools
import importlib.util
import itertools
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from importlib import resources
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ct_envs import UserError
from ct_envs.lidar import LIDAR_RANGE_M
from ct_envs.occupancy import LIDAR_BEAMS, LIDAR_CELL_M, lidar_map
from ct_envs.robots import ROBOTS
from ct_envs.turtlebot3 import MAX_NOISE, RADIUS_M, Turtlebot3Config, Turtlebot3Env, load_pybullet
from ct_envs.turtlebot3_noise import Belief, Noise
from ct_envs.turtlebot3_pool import _EMPTY, Episode, PoolFrame, Turtlebot3Pool
from ct_envs.turtlebot3_world import TRAIN_DENSITY, World, load_world, make_world, random_world, save_world
from ct_jax.collect import CollectConfig, collect
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.guided import Guided
from ct_jax.guides.lidar_explorer import Charted, LidarExplorer
from ct_jax.guides.room_roadmap import ShortcutGuide
from ct_jax.prm import NoPath, PrmConfig, build_roadmap
from ct_jax.prm import Path as Way
from ct_jax.trajectories import to_trajectories, unpack_maps
from ct_jax.types import Frame, Privileged
from ct_jax.worlds.rooms import RoomWorld, as_frame, clutter, draw_ends, make_room

SEEDS = st.integers(0, 2**31 - 1)
DT_S = 0.2
EMPTY = make_world()
bullet = pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="PyBullet is not installed")


def outline(world: World, n: int = 300) -> np.ndarray:
    """Points [m, 2] all around every obstacle of a world and its walls."""
    t = np.linspace(-1, 1, n)
    square = np.concatenate(
        [np.stack(side, -1) for side in ((t, 1 + 0 * t), (t, -1 + 0 * t), (1 + 0 * t, t), (-1 + 0 * t, t))]
    )
    parts = [(square + 1) * world.side_m / 2]
    for x, y, half_x, half_y, yaw in world.boxes:
        local = square * [half_x, half_y]
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        parts.append(local @ turn.T + [x, y])
    for x, y, radius in world.cylinders:
        parts.append([x, y] + radius * np.stack([np.cos(np.pi * t), np.sin(np.pi * t)], -1))
    return np.concatenate(parts)


def cast(world: World, position: np.ndarray, yaw: float) -> np.ndarray:
    """Ranges of a lidar within 1 m, by steps as long as the clearance."""
    angle = yaw + np.radians(np.arange(LIDAR_BEAMS))
    way, ranges = np.stack([np.cos(angle), np.sin(angle)], -1), np.zeros(LIDAR_BEAMS)
    for _ in range(300):
        ranges = np.minimum(ranges + np.maximum(world.clearance(position + ranges[:, None] * way), 0.0), 1.0)
    return ranges


# --------------------------------------------------------------------------------------------------------- worlds


@given(SEEDS)
@settings(max_examples=4)
def test_clearance_is_the_distance_to_the_nearest_outline(seed):
    world = random_world(seed, 0.15)
    points = np.random.default_rng(seed).uniform(0, world.side_m, (50, 2))
    near = np.linalg.norm(points[:, None] - outline(world)[None], axis=-1).min(1)
    np.testing.assert_allclose(np.abs(world.clearance(points)), near, atol=0.012)


@given(SEEDS)
@settings(max_examples=10)
def test_what_is_inside_has_no_clearance(seed):
    world, rng = random_world(seed, 0.15), np.random.default_rng(seed)
    for x, y, half_x, half_y, yaw in world.boxes:
        along, across = rng.uniform(-0.99, 0.99, 2) * [half_x, half_y]
        inside = [x + along * np.cos(yaw) - across * np.sin(yaw), y + along * np.sin(yaw) + across * np.cos(yaw)]
        assert world.clearance(np.array(inside)) < 0
    assert (world.clearance(world.cylinders[:, :2]) <= -world.cylinders[:, 2] + 1e-9).all()
    assert (world.clearance(np.array([[-0.1, 2.0], [2.0, world.side_m + 0.3]])) < 0).all()


@given(SEEDS)
@settings(max_examples=4)
def test_a_segment_has_the_least_clearance_of_its_points(seed):
    world, rng = random_world(seed, 0.15), np.random.default_rng(seed)
    a, b = rng.uniform(0, world.side_m, (2, 100, 2))
    share = np.linspace(0, 1, 400)[:, None, None]
    sampled = world.clearance(a + share * (b - a)).min(0)
    exact = world.segment_clearance(a, b)
    clear = sampled > 0.02
    assert (np.abs(exact - sampled)[clear] < 0.02).all() and (exact <= sampled + 1e-9)[clear].all()
    assert (exact[sampled < 0] <= 0).all()
    np.testing.assert_array_equal(world.segment_free(np.stack([a, b], -2), 0.1), exact >= 0.1)


def test_an_empty_room_has_its_walls_only():
    assert EMPTY.clearance(np.array([2.0, 1.0])) == 1.0
    assert EMPTY.segment_free(np.array([[1.0, 1.0], [4.0, 1.0]]), 0.99)
    assert not EMPTY.segment_free(np.array([[1.0, 1.0], [4.0, 1.0]]), 1.01)


@given(SEEDS, st.sampled_from([None, 0.0, 0.05, 0.15, 0.25]))
@settings(max_examples=20)
def test_random_worlds_are_as_dense_as_asked_for_and_do_not_overlap(seed, density):
    world = random_world(seed, density)
    low, high = TRAIN_DENSITY if density is None else (density, density)
    largest = 0.6**2 / world.side_m**2
    assert low - largest <= world.covered() <= high + largest
    radius = np.concatenate([np.hypot(*world.boxes[:, 2:4].T), world.cylinders[:, 2]])
    centre = np.concatenate([world.boxes[:, :2], world.cylinders[:, :2]])
    apart = np.linalg.norm(centre[:, None] - centre[None], axis=-1) - radius[:, None] - radius[None]
    assert (apart[~np.eye(len(centre), dtype=bool)] >= 0).all()
    assert ((centre >= radius[:, None]) & (centre <= world.side_m - radius[:, None])).all()


def test_the_seed_decides():
    first, again, other = random_world(3), random_world(3), random_world(4)
    np.testing.assert_array_equal(first.boxes, again.boxes)
    np.testing.assert_array_equal(first.cylinders, again.cylinders)
    assert first.covered() != other.covered()


@given(SEEDS)
@settings(max_examples=5)
def test_starts_and_goals_are_apart_free_and_joined(seed):
    world, rng = random_world(seed, 0.2), np.random.default_rng(seed)
    for _ in range(5):
        start, goal = world.sample_pair(rng, RADIUS_M)
        assert np.linalg.norm(goal - start) >= 1.0
        assert (world.clearance(np.stack([start, goal])) >= RADIUS_M + 0.05).all()
        assert world.reachable(start, goal, RADIUS_M)


def test_what_is_walled_off_is_out_of_reach():
    fence = make_world([[2.5, 2.5, 2.5, 0.1, 0.0]])
    assert not fence.reachable(np.array([1.0, 1.0]), np.array([1.0, 4.0]), RADIUS_M)
    gap = make_world([[2.3, 2.5, 2.3, 0.1, 0.0]])  # 0.4 m are left
    assert gap.reachable(np.array([1.0, 1.0]), np.array([1.0, 4.0]), RADIUS_M)
    with pytest.raises(UserError, match="no room"):
        make_world([[2.5, 2.5, 2.45, 2.45, 0.0]]).sample_free(np.random.default_rng(0), 5, RADIUS_M)


@given(SEEDS, st.sampled_from([0.0, 0.1]))
@settings(max_examples=5)
def test_world_files_keep_all(tmp_path_factory, seed, density):
    world, file = random_world(seed, density), tmp_path_factory.mktemp("world") / "w.json"
    save_world(world, file)
    read = load_world(file)
    assert read.side_m == world.side_m
    np.testing.assert_array_equal(read.boxes, world.boxes)
    np.testing.assert_array_equal(read.cylinders, world.cylinders)


BOX = {"x_m": 1, "y_m": 1, "half_x_m": 0.1, "half_y_m": 0.1, "yaw_rad": 0}


def with_boxes(*boxes: dict) -> str:
    return json.dumps({"side_m": 5, "boxes": boxes, "cylinders": []})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no world file"),
        ("", r"w\.json:1: not JSON"),
        ('{"side_m": 5,\n "boxes": [,', r"w\.json:2: not JSON"),
        ("[" * 100_000, "not JSON"),
        ("[]", "needs just boxes, cylinders, side_m"),
        ('{"side_m": 5, "boxes": []}', "needs just"),
        ('{"side_m": -1, "boxes": [], "cylinders": []}', "side -1.0 m"),
        ('{"side_m": NaN, "boxes": [], "cylinders": []}', "side nan m"),
        ('{"side_m": "5", "boxes": [], "cylinders": []}', "side_m is '5'"),
        ('{"side_m": 5, "boxes": 3, "cylinders": []}', "boxes is not a list"),
        ('{"side_m": 5, "boxes": [], "cylinders": [{"x_m": 1}]}', r"cylinders\[0\]: needs just x_m, y_m, radius_m"),
        (with_boxes(BOX, BOX | {"half_x_m": -1}), r"boxes\[1\]: half_x_m is -1"),
        (with_boxes(BOX | {"x_m": 9}), r"boxes\[0\]: its centre is outside"),
        (with_boxes(BOX | {"x_m": None}), r"boxes\[0\]: x_m is None"),
        (b"\xff\xfe", "not UTF-8"),
        ("x" * 1_000_001, "too large"),
    ],
)  # fmt: skip
def test_a_broken_world_file_is_one_line(tmp_path, text, words):
    file = tmp_path / "w.json"
    if text is not None:
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError, match=words) as caught:
        load_world(file)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("density", [-0.1, 0.3, float("nan")])
def test_a_density_out_of_range_is_one_line(density):
    with pytest.raises(UserError, match="obstacle density"):
        random_world(0, density)


# ------------------------------------------------------------------------------------------------------- roadmaps


@pytest.mark.parametrize("seed", [0, 1])
def test_a_roadmap_of_a_world_has_the_free_edges_only(seed):
    world, config = random_world(seed), PrmConfig(samples=60, connect_m=2.0, margin_m=0.05)
    roadmap = build_roadmap(jax.random.key(seed), world, radius_m=RADIUS_M, config=config)
    a, b = roadmap.points[roadmap.edges[:, 0]], roadmap.points[roadmap.edges[:, 1]]
    share = np.linspace(0, 1, 100)[:, None, None]
    assert world.clearance(a + share * (b - a)).min() >= RADIUS_M + 0.05 - 1e-5
    i, j = np.triu_indices(60, 1)
    near = np.linalg.norm(roadmap.points[i] - roadmap.points[j], axis=-1) <= 2.0
    free = world.segment_free(roadmap.points[np.stack([i, j], -1)], RADIUS_M + 0.05)
    expected = np.stack([i, j], -1)[near & free]
    assert {tuple(edge) for edge in roadmap.edges.tolist()} == {tuple(pair) for pair in expected.tolist()}
    way = roadmap.plan(*world.sample_pair(np.random.default_rng(seed), RADIUS_M))
    assert isinstance(way, Way) and world.segment_free(np.stack([way.points[:-1], way.points[1:]], -2), RADIUS_M).all()


def test_a_plan_through_a_wall_is_none():
    fence = make_world([[2.5, 2.5, 2.5, 0.1, 0.0]])
    roadmap = build_roadmap(jax.random.key(0), fence, radius_m=RADIUS_M, config=PrmConfig(samples=60, connect_m=2.0))
    assert isinstance(roadmap.plan(np.array([1.0, 1.0]), np.array([1.0, 4.0])), NoPath)
    assert isinstance(roadmap.plan(np.array([1.0, 2.45]), np.array([1.0, 1.0])), NoPath)
    alone = build_roadmap(jax.random.key(0), fence, radius_m=RADIUS_M, config=PrmConfig(2, 0.01))
    with pytest.raises(UserError, match="joins no start and goal"):
        draw_ends(fence, alone, np.random.default_rng(0))


# --------------------------------------------------------------------------------------------- one simulation


@pytest.fixture(scope="module")
def env():
    with Turtlebot3Env() as made:
        yield made


def run(env, world, start, goal, actions, **reset):
    """Observations (the first too) and the further steps of an episode."""
    first = env.reset(world, start, goal, **reset)
    return first, [env.step(action) for action in actions]


@bullet
@pytest.mark.parametrize(
    "action", [(1, 0), (0.5, 0), (-1, 0), (0, 1), (0, -0.4), (0.5, 0.3), (1, 1), (0.8, -0.5), (-0.6, 0.4)]
)
def test_the_robot_drives_as_its_wheels_turn(env, action):
    """Once it has its speed: the arc of the closed form, at the speeds asked for."""
    _, steps = run(env, EMPTY, (2.5, 2.5), (4.5, 4.5), [action] * 8, yaw_rad=0.3)
    v, omega = action[0] * 0.22, action[1] * 2.84
    for before, after in itertools.pairwise(steps[2:]):
        yaw, turn = before.info["yaw_rad"], omega * DT_S
        chord = v * DT_S * np.sinc(turn / 2 / np.pi)
        way = chord * np.array([np.cos(yaw + turn / 2), np.sin(yaw + turn / 2)])
        np.testing.assert_allclose(after.info["position"] - before.info["position"], way, atol=5e-4)
        np.testing.assert_allclose(np.angle(np.exp(1j * (after.info["yaw_rad"] - yaw - turn))), 0, atol=5e-3)


@bullet
def test_more_than_the_top_speed_is_the_top_speed(env):
    _, fast = run(env, EMPTY, (1, 1), (4, 4), [(9, 0)] * 5, yaw_rad=0.0)
    _, top = run(env, EMPTY, (1, 1), (4, 4), [(1, 0)] * 5, yaw_rad=0.0)
    np.testing.assert_array_equal(fast[-1].info["position"], top[-1].info["position"])


@bullet
@pytest.mark.parametrize("seed", range(3))
def test_no_wall_is_entered_and_contacts_are_told(env, seed):
    """Full speed into whatever comes: the body stays outside, and what is said to be touched is."""
    world, rng = random_world(seed, 0.25), np.random.default_rng(seed)
    start, goal = world.sample_pair(rng, RADIUS_M)
    actions = np.repeat(rng.uniform([0.5, -0.4], [1.0, 0.4], (4, 2)), 15, axis=0)
    _, steps = run(env, world, start, goal, actions, seed=seed)
    clearance = np.array([world.clearance(step.info["position"]) for step in steps])
    collision = np.array([step.info["collision"] for step in steps])
    assert clearance.min() > RADIUS_M - 0.003
    assert not collision[1:][np.minimum(clearance[1:], clearance[:-1]) > RADIUS_M + 0.05].any()
    pressed = (clearance[1:] < RADIUS_M + 5e-4) & (clearance[:-1] < RADIUS_M + 5e-4)
    assert pressed.any() and collision[1:][pressed].mean() > 0.9


@bullet
@pytest.mark.parametrize("turned", [0.0, 1.1, np.pi / 2])
@pytest.mark.parametrize(
    ("angle", "speed", "frontal"),
    [(0, 1, True), (30, 1, True), (-30, 1, True), (65, 1, False), (-65, 1, False), (180, -1, True)],
)
def test_frontal_and_grazing_are_told_apart(env, turned, angle, speed, frontal):
    """Against the side of a box, at an angle to its normal; the box is turned, too."""
    centre, normal = np.array([2.5, 2.5]), np.array([np.cos(turned), np.sin(turned)])
    world = make_world([[*(centre + 0.5 * normal), 0.2, 1.0, turned]])
    start = centre + (0.3 - RADIUS_M - 0.02) * normal
    _, steps = run(env, world, start, (0.5, 0.5), [(speed, 0.0)] * 4, yaw_rad=turned + np.radians(angle))
    touched = [step for step in steps if step.info["collision"]]
    assert touched[0].info["frontal"] == frontal and touched[0].info["grazing"] != frontal


@bullet
@pytest.mark.parametrize("seed", range(4))
def test_the_lidar_sees_what_is_there(env, seed):
    """Ranges are the world's, and so is the map."""
    world, rng = random_world(seed, 0.15), np.random.default_rng(seed)
    start, goal = world.sample_pair(rng, RADIUS_M)
    obs = env.reset(world, start, goal, seed=seed)
    position, yaw = env.pose
    expected = cast(world, position, yaw)
    off = np.abs(env.lidar() - expected)
    assert np.median(off) < 1e-3 and np.quantile(off, 0.98) < 0.01  # but for beams that just miss a corner
    away = lidar_map(expected, obs["goal"])[0] != obs["map"][0]
    assert away.sum() <= 4
    ticks = (np.arange(25) - 12) * LIDAR_CELL_M
    local = np.stack(np.meshgrid(ticks, ticks), -1)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    room = np.abs(world.clearance(local @ turn.T + position))
    assert (room[obs["map"][0] > 0] <= LIDAR_CELL_M * 0.5**0.5 + 0.01).all()  # every mark is on an outline


@bullet
@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_what_is_seen_turns_with_the_robot(env, quarters):
    """The world turned about the room's centre, robot and goal with it: nothing changes in the robot's frame."""
    world, middle = random_world(5, 0.15), np.array([2.5, 2.5])
    start, goal = world.sample_pair(np.random.default_rng(5), RADIUS_M)
    angle = quarters * np.pi / 2
    turn = np.round([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def turned(points):
        return (points - middle) @ turn.T + middle

    boxes, cylinders = world.boxes.copy(), world.cylinders.copy()
    boxes[:, :2], cylinders[:, :2] = turned(boxes[:, :2]), turned(cylinders[:, :2])
    boxes[:, 4] += angle
    here = env.reset(world, start, goal, yaw_rad=0.7)
    there = env.reset(make_world(boxes, cylinders), turned(start), turned(goal), yaw_rad=0.7 + angle)
    for name in ("proprio", "goal"):
        np.testing.assert_allclose(here[name], there[name], atol=1e-4)
    assert (here["map"] != there["map"]).sum() <= 4  # an end of a beam may be on the border of two cells


@bullet
def test_observations_are_in_the_robots_frame(env):
    obs = env.reset(EMPTY, (1.0, 1.0), (1.0, 1.8), yaw_rad=0.0)  # the goal at the left
    np.testing.assert_allclose(obs["proprio"], [0.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(obs["goal"], [0.0, 0.8], atol=1e-3)
    assert obs["map"].shape == (2, 25, 25) and obs["map"].dtype == np.uint8
    assert np.argwhere(obs["map"][1]).tolist() == [[22, 12]]


@bullet
def test_rewards_and_ends():
    config = Turtlebot3Config(horizon=4, collision_penalty=2.5)
    with Turtlebot3Env(config) as env:
        world = make_world([[1.4, 1.0, 0.2, 1.0, 0.0]])
        _, steps = run(env, world, (1.08, 1.0), (3.0, 1.0), [(1, 0)] * 4, yaw_rad=0.0)
        for step in steps:
            away = np.linalg.norm(step.info["position"] - [3.0, 1.0])
            np.testing.assert_allclose(step.reward, -away - 2.5 * step.info["collision"])
        assert [step.done for step in steps] == [False, False, False, True]
        assert steps[-1].info["truncation"] and not steps[-1].info["success"] and steps[-1].info["collision"]
        with pytest.raises(UserError, match="call reset"):
            env.step((0, 0))
        _, steps = run(env, EMPTY, (1.0, 1.0), (1.22, 1.0), [(1, 0)], yaw_rad=0.0)
        assert steps[0].done and steps[0].info["success"] and not steps[0].info["truncation"]


@bullet
def test_an_episode_does_not_depend_on_the_one_before(env):
    world, rng = random_world(2, 0.2), np.random.default_rng(2)
    start, goal = world.sample_pair(rng, RADIUS_M)
    actions = np.repeat(rng.uniform([0.5, -0.4], [1.0, 0.4], (3, 2)), 8, axis=0)
    with Turtlebot3Env() as fresh:
        one, other = (run(each, world, start, goal, actions, seed=9) for each in (env, fresh))
    for (first, steps), (first_too, steps_too) in [(one, other)]:
        np.testing.assert_array_equal(first["map"], first_too["map"])
        for step, step_too in zip(steps, steps_too, strict=True):
            assert step.reward == step_too.reward
            np.testing.assert_array_equal(step.info["position"], step_too.info["position"])
            np.testing.assert_array_equal(step.info["ranges"], step_too.info["ranges"])


FENCE = make_world([[2.5, 2.5, 2.5, 0.1, 0.0]])


@bullet
@pytest.mark.parametrize(
    ("start", "goal", "words"),
    [
        ((1.0, 2.5), (1.0, 1.0), r"the start \(1\.00, 2\.50\) is in an obstacle"),
        ((1.0, 1.0), (1.0, 2.35), "the goal .* is in an obstacle or wall, or too near"),
        ((0.05, 1.0), (1.0, 1.0), "the start"),
        ((1.0, 1.0), (9.0, 1.0), "the goal"),
        ((1.0, 1.0), (1.0, 4.0), "out of the robot's reach"),
        ((1.0, np.nan), (1.0, 1.0), "not a point"),
        ((1.0, 1.0, 0.0), (1.0, 1.0), "not a point"),
    ],
)
def test_a_task_that_cannot_be_is_one_line(env, start, goal, words):
    with pytest.raises(UserError, match=words) as caught:
        env.reset(FENCE, start, goal)
    assert "\n" not in str(caught.value)


@bullet
@pytest.mark.parametrize("action", [(np.nan, 0.0), (np.inf, 0.0), (1.0,), (1.0, 0.0, 0.0)])
def test_an_action_that_is_none_is_one_line(env, action):
    env.reset(EMPTY, (1, 1), (4, 4))
    with pytest.raises(UserError, match="two finite numbers"):
        env.step(action)


WHEELLESS = '<robot name="r"><link name="a"/></robot>'
NO_LINKS = '<robot name="r"><joint name="wheel_left_joint"/><joint name="wheel_right_joint"/></robot>'


@bullet
@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no URDF file"),
        ("<robot>\n<link", r"r\.urdf:2: not XML"),
        ("", "not XML"),
        (WHEELLESS, "has no joint wheel_left_joint and no wheel_right_joint"),
        (NO_LINKS, "PyBullet cannot load it"),
    ],
)
def test_a_broken_urdf_is_one_line(tmp_path, capfd, text, words):
    file = tmp_path / "r.urdf"
    if text is not None:
        file.write_text(text)
    with pytest.raises(UserError, match=words) as caught, Turtlebot3Env(Turtlebot3Config(urdf=str(file))) as broken:
        broken.reset(EMPTY, (1, 1), (4, 4))
    assert "\n" not in str(caught.value) and str(file) in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("make", [load_pybullet, Turtlebot3Env, lambda: Turtlebot3Pool(1)])
def test_without_pybullet_there_is_one_line(monkeypatch, make):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(UserError, match=r"needs PyBullet.*Python 3\.11.*pip install") as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wrong", [{"physics_dt_s": 0.0}, {"physics_dt_s": 1.0}, {"horizon": 0}, {"urdf": 3}])
def test_a_wrong_setting_is_one_line(wrong):
    with pytest.raises(UserError, match=next(iter(wrong))):
        Turtlebot3Config(**wrong)


# ------------------------------------------------------------------------------------------------------- the pool


@functools.cache
def tasks(n: int = 3) -> list[Episode]:
    episodes = []
    for seed in range(n):
        world = random_world(seed, 0.15)
        start, goal = world.sample_pair(np.random.default_rng(seed), RADIUS_M)
        episodes.append(Episode(world, start, goal, seed))
    return episodes


def script(n: int = 3, steps: int = 12) -> np.ndarray:
    return np.random.default_rng(0).uniform([0.4, -0.5], [1.0, 0.5], (steps, n, 2))


def play(pool, actions, at=lambda i: None):
    frames = [pool.reset(tasks())]
    for i, action in enumerate(actions):
        at(i)
        frames.append(pool.step(action))
    return frames


def assert_equal_frames(one, other):
    for here, there in zip(one, other, strict=True):
        for name in here._fields:
            np.testing.assert_array_equal(getattr(here, name), getattr(there, name), err_msg=name)


@pytest.fixture(scope="module")
def pool():
    with Turtlebot3Pool(3, processes=2) as made:
        yield made


@pytest.fixture(scope="module")
def played(pool):
    return play(pool, script())


@bullet
def test_a_pool_is_its_simulations_one_by_one(played, env):
    for slot, task in enumerate(tasks()):
        first, steps = run(env, task.world, task.start, task.goal, script()[:, slot], seed=task.seed)
        np.testing.assert_array_equal(played[0].map[slot], first["map"])
        for frame, step in zip(played[1:], steps, strict=True):
            np.testing.assert_array_equal(frame.position[slot], step.info["position"])
            np.testing.assert_array_equal(frame.map[slot], step.obs["map"])
            assert frame.reward[slot] == np.float32(step.reward) and frame.done[slot] == step.done
            assert frame.believed_reward[slot] == -np.float32(np.linalg.norm(step.obs["goal"]))


@bullet
def test_the_number_of_processes_changes_nothing(played):
    with Turtlebot3Pool(3, processes=1) as alone:
        assert_equal_frames(played, play(alone, script()))


@bullet
@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").is_file(), reason="only Linux says how much it takes")
def test_a_slot_takes_little_memory():
    """PyBullet alone takes 35 MB."""
    world = random_world(0)
    point = next(p for p in np.random.default_rng(0).uniform(1, world.side_m - 1, (100, 2)) if world.clearance(p) > 0.2)
    episode, most = Episode(world, point, point + 0.01), 9

    def used_mb(pool):
        text = Path(f"/proc/{pool.pids[0]}/smaps_rollup").read_text()
        return int(re.search(r"Private_Dirty: *(\d+)", text)[1]) / 1024

    with Turtlebot3Pool(most, processes=1) as pool:
        pool.reset([episode])
        first = used_mb(pool)
        pool.reset([episode] * most)
        pool.step(np.ones((most, 2)))
        assert (used_mb(pool) - first) / (most - 1) < 15


@bullet
def test_a_killed_process_is_replaced_and_nothing_lost(pool, played):
    """Killed before one step, and during another."""
    before = pool.pids

    def kill(i):
        if i == 5:
            os.kill(pool.pids[0], signal.SIGKILL)
        if i == 8:
            os.kill(pool.pids[1], signal.SIGSTOP)  # so that it surely dies over its work
            threading.Timer(0.3, os.kill, (pool.pids[1], signal.SIGKILL)).start()

    assert_equal_frames(played, play(pool, script(), kill))
    assert set(before).isdisjoint(pool.pids)


@bullet
def test_an_interrupted_step_is_done_again(pool, played, monkeypatch):
    def interrupt(i):
        if i == 4:
            with monkeypatch.context() as patch:
                patch.setattr(pool, "_answer", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
                with pytest.raises(KeyboardInterrupt):
                    pool.step(script()[4])

    assert_equal_frames(played, play(pool, script(), interrupt))


@bullet
def test_an_error_in_what_is_driven_again_leaves_nothing_behind(played, tmp_path):
    """A worker dies, and its successor lacks its URDF: an error; once the file is back, all goes on where it was."""
    ours = resources.files("ct_envs") / "assets" / ROBOTS["turtlebot3"].xml
    file, away = tmp_path / "robot.urdf", tmp_path / "away"
    file.write_bytes(ours.read_bytes())
    with Turtlebot3Pool(3, processes=1, config=Turtlebot3Config(urdf=str(file))) as fragile:

        def lose(i):
            if i == 5:
                os.kill(fragile.pids[0], signal.SIGKILL)
                file.rename(away)
                with pytest.raises(UserError, match="no URDF file"):
                    fragile.step(script()[5])
                away.rename(file)

        assert_equal_frames(played, play(fragile, script(), lose))


@bullet
def test_a_process_that_always_dies_is_one_line(pool, monkeypatch):
    pool.reset(tasks())
    monkeypatch.setattr("multiprocessing.connection.Connection.recv", _raise_eof)
    monkeypatch.setattr("ct_envs.turtlebot3_pool._start", lambda config: pool._workers[0])
    for method in ("send", "end"):
        monkeypatch.setattr(f"ct_envs.turtlebot3_pool._Worker.{method}", lambda *_: None)
    with pytest.raises(UserError, match="died 5 times in one step"):
        pool.step(np.zeros((3, 2)))


def _raise_eof(*_):
    raise EOFError


@bullet
def test_what_a_pool_cannot_do_is_one_line(pool):
    walled = Episode(FENCE, np.array([1.0, 1.0]), np.array([1.0, 4.0]))
    with pytest.raises(UserError, match="out of the robot's reach"):
        pool.reset([*tasks(2), walled])
    assert pool.reset([]).done.all()  # all three were emptied
    with pytest.raises(UserError, match="do not fit"):
        pool.reset(tasks(4))
    pool.reset(tasks())
    for wrong in (np.zeros((2, 2)), np.full((3, 2), np.nan)):
        with pytest.raises(UserError, match="finite actions"):
            pool.step(wrong)
    for n, processes in ((0, 1), (1, 0)):
        with pytest.raises(UserError, match="at least one"):
            Turtlebot3Pool(n, processes=processes)
    closed = Turtlebot3Pool(1)
    closed.close()
    with pytest.raises(UserError, match="closed"):
        closed.reset([])


INTERRUPTED = """
import signal

import numpy as np
from ct_envs.turtlebot3_pool import Episode, Turtlebot3Pool
from ct_envs.turtlebot3_world import make_world
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job is born deaf to it
    with Turtlebot3Pool(2, processes=2) as pool:
        pool.reset([Episode(make_world(), np.array([1.0, 1.0]), np.array([4.0, 4.0]))] * 2)
        print(*pool.pids, flush=True)
        while True:
            pool.step(np.zeros((2, 2)))
"""


@bullet
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_ctrl_c_and_a_killed_pool_leave_no_process(tmp_path, number):
    file = tmp_path / "interrupted.py"
    file.write_text(INTERRUPTED)
    paths = os.pathsep.join(str(Path(__file__).parents[1] / folder) for folder in ("envs", "."))
    process = subprocess.Popen(
        [sys.executable, str(file)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": paths}, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    pids = [int(pid) for pid in process.stdout.readline().split()]
    assert len(pids) == 2
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does: every process of the group gets it
    else:
        process.kill()
    try:
        _, errors = process.communicate(timeout=30)
    finally:
        process.kill()
    assert number != signal.SIGINT or (errors.count("Traceback") == 1 and errors.rstrip().endswith("KeyboardInterrupt"))
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{pid}/cmdline").exists() and Path(f"/proc/{pid}/cmdline").read_bytes() for pid in pids):
        assert time.monotonic() < deadline
        time.sleep(0.05)


# ------------------------------------------------------------------------------------------------------ collection

SMALL = CollectConfig(trajectories=3, reset_interval=2, envs=3, horizon=400)
PRM = PrmConfig(samples=150, connect_m=2.0, margin_m=0.08)


class Noting:
    """A policy that keeps the frames it is shown."""

    def __init__(self, policy):
        self.policy, self.frames = policy, []

    def init(self, frame, tasks):
        return self.policy.init(frame, tasks)

    def act(self, memory, frame, key):
        self.frames.append(frame)
        return self.policy.act(memory, frame, key)


@pytest.fixture(scope="module")
def rooms():
    with contextlib.closing(RoomWorld(3, processes=2)) as made:
        yield made


@pytest.fixture(scope="module")
def wave(rooms):
    return rooms.sample_tasks(jax.random.key(0), SMALL, PRM)


@pytest.fixture(scope="module")
def driven(rooms, wave):
    """The record of three guided episodes, and the frames that the policy was shown."""
    policy = Noting(Guided(DifferentialDrive(), rooms.guide("roadmap", PRM)))
    return rooms.rollout(policy, wave, horizon=SMALL.horizon), policy.frames


def one_by_one(rollout):
    """The episodes of a rollout, each until its end; and all its positions, the last one too."""
    path = np.concatenate([rollout.steps.position, rollout.end.position[None]])
    for slot, length in enumerate(rollout.steps.alive.sum(0).astype(int)):
        alive = type(rollout.steps)(*(None if leaf is None else leaf[:length, slot] for leaf in rollout.steps))
        yield alive, path[: length + 1, slot]


@bullet
def test_episodes_are_recorded_as_they_were(driven):
    rollout, frames = driven
    assert rollout.end.success.all() and rollout.counted.all() and (rollout.place == 0).all()
    for slot, (each, path) in enumerate(one_by_one(rollout)):
        goal, length = rollout.goal_world[slot], len(each.reward)
        away = np.linalg.norm(path[1:] - goal, axis=-1)
        assert away[-1] < 0.2 and (away[:-1] >= 0.2).all() and length > 10
        assert each.success.tolist() == [0.0] * (length - 1) + [1.0] and (each.alive == 1).all()
        np.testing.assert_allclose(each.reward, -away - each.collision, atol=1e-3)
        np.testing.assert_array_equal(each.collision, np.maximum(each.frontal, each.grazing))
        yaw_rad = np.array([frame.privileged.scene.yaw_rad[slot] for frame in frames[:length]])
        turn = np.exp(-1j * yaw_rad) * ((goal - each.position) @ [1, 1j])
        np.testing.assert_allclose(each.goal_relative @ [1, 1j], turn, atol=1e-3)
        np.testing.assert_allclose(each.proprio @ [1, 1j], turn / np.abs(turn), atol=1e-3)
        held = np.abs(each.goal_relative).max(-1) < 0.99
        maps = np.asarray(unpack_maps(each.map_bits))
        np.testing.assert_array_equal(maps[held, 1].sum((1, 2)), 1)
        np.testing.assert_array_equal(maps, [frame.obs.map[slot] for frame in frames[:length]])
        np.testing.assert_array_equal(each.action, each.label)
        assert each.map_bits.shape == (length, 157) and (each.label_mask == 1).all()


@bullet
def test_trajectories_are_the_episodes(driven):
    rollout, _ = driven
    data = to_trajectories(rollout)
    assert data.n == 3
    np.testing.assert_array_equal(data.goal_world, rollout.goal_world)
    for i, (each, _) in enumerate(one_by_one(rollout)):
        length = data.length[i]
        assert length == len(each.reward)
        for name in ("position", "proprio", "action", "label", "reward", "collision", "goal_relative", "map_bits"):
            np.testing.assert_array_equal(getattr(data, name)[i, :length], getattr(each, name))
        assert not data.label_mask[i, length:].any() and not data.collision[i, length:].any()


@bullet
def test_the_key_decides_what_is_collected_and_only_successes_are(driven, rooms):
    told = []
    data = collect(
        jax.random.key(0), rooms, DifferentialDrive(), SMALL, PRM, on_progress=lambda won, of: told.append((won, of))
    )
    assert told[-1][0] >= 3 and data.n == 3
    for i, (each, _) in enumerate(one_by_one(driven[0])):
        np.testing.assert_array_equal(data.map_bits[i, : len(each.reward)], each.map_bits)


@bullet
@pytest.mark.parametrize(("guide", "noise"), [("shortcut", 0.5), ("explorer", 0.1)])
def test_other_guides_arrive_too_and_a_disturbance_is_not_imitated(guide, noise, rooms, wave):
    policy = Guided(DifferentialDrive(), rooms.guide(guide, PRM), noise)
    rollout = rooms.rollout(policy, wave, horizon=SMALL.horizon)
    assert rollout.end.success.all()
    np.testing.assert_array_equal(rollout.steps.action, rollout.steps.label)
    each, path = next(one_by_one(rollout))
    driven = np.linalg.norm(np.diff(path[:-1], axis=0), axis=-1) / (0.22 * DT_S)
    assert np.abs(driven - each.action[:-1, 0]).max() > 0.4 * noise


def unturned_frame(positions, **scene):
    """What guides see of robots [n] at these positions [n, 2] (m), all of which head along x."""
    n = len(positions)
    scene = SimpleNamespace(yaw_rad=np.zeros(n), done=np.zeros(n, bool), **scene)
    return Frame(None, np.zeros(n), scene.done, Privileged(positions, None, np.zeros(n), scene))  # pyright: ignore


@given(SEEDS)
@settings(max_examples=5)
def test_a_shortcut_is_in_sight_and_no_detour(seed):
    """From anywhere free, also right beside an obstacle: the straight way to the waypoint touches nothing."""
    rng = np.random.default_rng(seed)
    room, roadmap = make_room(jax.random.key(seed % 7), PRM)
    start, goal = draw_ends(room, roadmap, rng, "maze")
    guide = ShortcutGuide(0.08)
    memory = guide.init(
        unturned_frame(start[None]), SimpleNamespace(goal=[goal], worlds=[room], roadmaps=[roadmap])
    )  # fmt: skip
    (field,) = memory
    assert np.isfinite(field.to_go).mean() > 0.9 and field.to_go[-1] == 0

    def waypoints(positions):
        return positions + guide.waypoint(memory * len(positions), unturned_frame(positions))[0]

    free = room.sample_free(rng, 20, RADIUS_M + 1e-3)
    for position, target in zip(free, waypoints(free), strict=True):
        assert room.segment_free(np.stack([position, target]), RADIUS_M - 2e-3) or np.allclose(target, goal)
    at = field.points[rng.integers(len(field.points) - 1, size=10)] + 0.02  # at a waypoint, it goes on
    targets = waypoints(at)
    far = np.linalg.norm(targets - at, axis=-1) >= guide.waypoint_tolerance_m - 1e-9
    assert (far | np.isclose(targets, goal).all(-1)).all()


@bullet
def test_a_goal_never_reached_is_an_error_and_no_hang():
    with contextlib.closing(RoomWorld(2, processes=1)) as short:
        config = CollectConfig(trajectories=1, envs=2, horizon=3, give_up=3.0)
        with pytest.raises(UserError, match="reached only 0 of 4 goals"):
            collect(jax.random.key(0), short, DifferentialDrive(), config, PRM)


@bullet
def test_a_world_runs_any_number_of_episodes_of_any_length(rooms, wave):
    """More episodes than slots, and another horizon than before: nothing has to fit."""
    policy = Guided(DifferentialDrive(), rooms.guide("roadmap", PRM))
    whole = rooms.rollout(policy, wave, horizon=5)
    assert whole.horizon == 5 and whole.steps.alive.sum(0).tolist() == [5.0] * 3 and not whole.end.success.any()
    with contextlib.closing(RoomWorld(2, processes=1)) as small:
        told = []
        cut = small.rollout(policy, wave, horizon=5, on_progress=lambda over, note: told.append(over))
    assert told == [2, 3]
    jax.tree.map(np.testing.assert_array_equal, cut.steps, whole.steps)
    jax.tree.map(np.testing.assert_array_equal, cut.end, whole.end)


@bullet
def test_a_closed_world_leaves_no_process(wave):
    with contextlib.closing(RoomWorld(3, processes=1)) as world:
        policy = Guided(DifferentialDrive(), world.guide("roadmap", PRM))
        began = {child.pid for child in multiprocessing.active_children()}
        for horizon in (2, 3):  # the processes of the first horizon go, too
            world.rollout(policy, wave, horizon=horizon)
            assert len({child.pid for child in multiprocessing.active_children()} - began) == 1
    assert {child.pid for child in multiprocessing.active_children()} <= began


def test_rooms_and_guides():
    (one, roadmap), (again, same), (dense, _) = (
        make_room(jax.random.key(3), PRM, densities=(d, d)) for d in (1.0, 1.0, 2.0)
    )
    np.testing.assert_array_equal(one.boxes, again.boxes)
    np.testing.assert_array_equal(roadmap.points, same.points)
    assert dense.covered() > one.covered()
    np.testing.assert_array_equal(clutter(5, 1.0).boxes, random_world(5).boxes)


def test_rooms_of_many_densities():
    factors = []
    for number in range(12):
        key = jax.random.key(number)
        drawn, sparse, dense = (
            make_room(key, PRM, densities=d)[0].covered() for d in ((0.5, 2), (0.5, 0.5), (2, 2))
        )  # fmt: skip
        assert sparse - 0.01 <= drawn <= dense + 0.01  # to half an obstacle
        factors.append((drawn - sparse) / (dense - sparse))
    assert min(factors) < 0.3 and max(factors) > 0.7


@given(SEEDS)
@settings(max_examples=10)
def test_a_margin_keeps_the_explorer_away_where_there_is_room(seed):
    """Past a gap of one cell straight on, with a wide way round; and through it where there is no other."""
    wide, cell = bool(seed % 2), 0.08
    n = round(14 / cell)
    occupied = np.zeros((n, n), bool)
    occupied[n // 2 + 8] = True
    gap = n // 2 + seed % 5 - 2
    occupied[n // 2 + 8, gap - 2 : gap + 3] = False
    occupied[n // 2 + 8, gap + 6 : gap + 18 if wide else 0] = False
    position, goal = np.zeros((1, 2)), np.array([0.0, 1.6])
    chart = Charted(np.full(2, -7.0), goal, occupied)
    nothing_met = {"ranges": np.full((1, LIDAR_BEAMS), LIDAR_RANGE_M), "believed_yaw_rad": np.zeros(1)}
    frame = unturned_frame(position, believed_position=position, **nothing_met)
    bold, wary = (
        LidarExplorer(RADIUS_M + 0.05, margin, look_m=5.0).waypoint((chart,), frame)[0][0] for margin in (0.0, 0.2)
    )
    if wide:
        assert wary[0] > bold[0] + 0.1
    else:
        np.testing.assert_allclose(wary[0], bold[0], atol=0.2)


# ---------------------------------------------------------------------------------------------------------- noise


@bullet
@pytest.mark.parametrize("seed", range(3))
def test_noise_is_in_what_is_believed_and_not_in_the_truth(seed):
    """The belief drifts and the ranges err, by about what the level says; what is told of the truth is the truth."""
    world = random_world(seed)
    start, goal = world.sample_pair(np.random.default_rng(seed), RADIUS_M)
    actions = np.tile([0.5, 0.6], (60, 1))
    with Turtlebot3Env(Turtlebot3Config(noise=1.0)) as noisy:
        first, steps = run(noisy, world, start, goal, actions, seed=seed)
        again = run(noisy, world, start, goal, actions, seed=seed)[1]
        last = steps[-1].info
        np.testing.assert_array_equal(last["position"], noisy.pose.position)
        off = np.linalg.norm(last["believed"].position - last["position"])
        assert 1e-4 < off < 0.3
        assert 1e-4 < abs(np.angle(np.exp(1j * (last["believed"].yaw_rad - last["yaw_rad"])))) < 0.3
        err = last["ranges"] - noisy.lidar()
        met = np.isfinite(err) & (noisy.lidar() < 1.0)
        assert 0 < np.isinf(last["ranges"]).mean() < 0.2 and 1e-3 < np.std(err[met]) < 0.06
        assert steps[-1].reward == pytest.approx(-np.linalg.norm(goal - last["position"]) - last["collision"])
        for one, other in zip(steps, again, strict=True):
            np.testing.assert_array_equal(one.obs["map"], other.obs["map"])
    assert np.linalg.norm(first["goal"]) == pytest.approx(np.linalg.norm(goal - start), abs=0.01)


@bullet
@pytest.mark.parametrize("away", [0.5, 0.0])
def test_with_noise_an_episode_ends_where_the_robot_believes_to_have_arrived(away):
    """Beside the goal without knowing it, it drives on; where it takes itself to be there, that is the end."""
    with Turtlebot3Env(Turtlebot3Config(noise=1.0, horizon=30)) as noisy:
        noisy.reset(EMPTY, (1.0, 1.0), (1.5, 1.0), yaw_rad=0.0)
        noisy._belief.position = noisy._belief.position - [0.0, away]
        steps = []
        while not steps or not steps[-1].done:
            steps.append(noisy.step((0.5, 0.0)))
    passed = min(np.linalg.norm(step.info["position"] - [1.5, 1.0]) for step in steps)
    believed = np.linalg.norm(steps[-1].info["believed"].position - [1.5, 1.0])
    assert passed < 0.15  # of it the truth knows
    assert steps[-1].info["success"] == (away == 0.0) and steps[-1].info["truncation"] == (away > 0.0)
    assert (believed < 0.1) == (away == 0.0)


@bullet
def test_the_first_command_comes_late():
    """By a tenth of a second at level 1, a half of the control step; at level 2 by all of it."""
    gone = []
    for level in (1e-3, 1.0, 2.0):
        with Turtlebot3Env(Turtlebot3Config(noise=level)) as late:
            late.reset(EMPTY, (1.0, 1.0), (4.0, 1.0), yaw_rad=0.0)
            gone.append(late.step((1.0, 0.0)).info["position"][0] - 1.0)
    assert gone[0] - gone[1] == pytest.approx(0.1 * 0.22, rel=0.1) and abs(gone[2]) < 1e-3


@pytest.mark.parametrize("level", [0.5, 1.0, 2.0])
def test_errors_have_the_sizes_that_their_level_says(level):
    """Standard deviations over 400 robots, each part by itself, to a fifth."""
    robots = [Belief(level, np.zeros(2), 0.0, seed) for seed in range(400)]
    size = Noise()
    rolls = np.array([[robot.roll() for _ in range(30)] for robot in robots])
    wheels, slips = rolls.mean(1) - 1.0, rolls - rolls.mean(1, keepdims=True)
    np.testing.assert_allclose(wheels.std(), level * np.hypot(size.wheel, size.slip / 30**0.5), rtol=0.2)
    np.testing.assert_allclose(slips.std(), level * size.slip, rtol=0.2)
    for robot in robots:
        for _ in range(30):  # three turns to the left, in six seconds
            robot.move(0.0 * robot.roll(), 6 * np.pi / 30, 0.2)
    yaws = np.array([robot.yaw_rad for robot in robots]) - 6 * np.pi
    drift = [size.gyro_scale * 6 * np.pi, size.gyro_bias_radps * 6.0, size.gyro_walk * 6.0**0.5]
    np.testing.assert_allclose(yaws.std(), level * np.linalg.norm(drift), rtol=0.2)
    scans = np.array([robot.scan(np.repeat([0.3, 0.8], 180)) for robot in robots])
    np.testing.assert_allclose(np.isinf(scans).mean(), level * size.dropped, rtol=0.2)
    for beams, sigma in ((scans[:, :180], size.near_m), (scans[:, 180:], size.far * 0.8)):
        np.testing.assert_allclose(beams[np.isfinite(beams)].std(), level * sigma, rtol=0.2)


def test_odometry_is_what_the_encoders_tell():
    """A metre rolled by wheels that carry the robot farther than they tell is believed to be less."""
    robot = Belief(1.0, np.zeros(2), 0.0, 0, Noise(slip=0.0, gyro_scale=0.0, gyro_bias_radps=0.0, gyro_walk=0.0))
    carried = robot.roll()
    robot.move(np.ones(2), 0.0, 0.2)
    np.testing.assert_allclose(robot.position, [np.mean(1.0 / carried), 0.0])


@given(seed=st.integers(0, 1000), level=st.floats(0.1, MAX_NOISE))
def test_noise_puts_no_obstacle_where_nothing_was_met(seed, level):
    ranges = np.where(np.arange(360) < 100, 0.6, LIDAR_RANGE_M)
    scan = Belief(level, np.zeros(2), 0.0, seed).scan(ranges)
    assert (scan[100:] >= LIDAR_RANGE_M).all()
    came_back = np.isfinite(scan[:100])
    assert came_back.any() and (scan[:100][came_back] != 0.6).all()


@bullet
def test_a_pool_with_noise_is_its_simulations_one_by_one():
    config = Turtlebot3Config(noise=1.0)
    with Turtlebot3Pool(3, processes=1, config=config) as noisy, Turtlebot3Env(config) as alone:
        frames = play(noisy, script())
        for slot, task in enumerate(tasks()):
            first, steps = run(alone, task.world, task.start, task.goal, script()[:, slot], seed=task.seed)
            np.testing.assert_array_equal(frames[0].map[slot], first["map"])
            np.testing.assert_array_equal(frames[-1].goal[slot], steps[-1].obs["goal"])
            np.testing.assert_array_equal(frames[-1].believed_position[slot], steps[-1].info["believed"].position)
            assert frames[-1].believed_reward[slot] == -np.float32(np.linalg.norm(steps[-1].obs["goal"]))


def test_what_a_policy_is_told_has_nothing_of_the_truth():
    """Wherever the robot is in truth, and whatever it touches: what it acts on stays the same."""
    rng = np.random.default_rng(0)
    frame, goal = PoolFrame(*(np.stack([leaf] * 2) for leaf in _EMPTY)), np.ones((2, 2))
    other = frame._replace(
        position=rng.normal(size=(2, 2)), yaw_rad=rng.normal(size=2), reward=np.float32([-5, -9]),
        collision=np.ones(2, bool), frontal=np.ones(2, bool), grazing=np.ones(2, bool), success=np.ones(2, bool),
    )  # fmt: skip
    one, same = as_frame(frame, goal), as_frame(other, goal + 1.0)
    np.testing.assert_array_equal(one.reward, same.reward)
    jax.tree.map(np.testing.assert_array_equal, one.obs, same.obs)
    assert as_frame(frame._replace(believed_reward=np.float32([-1, -2])), goal).reward.tolist() == [-1, -2]


@pytest.mark.parametrize("level", [-0.1, 9.0, float("nan")])
def test_a_noise_level_out_of_range_is_one_line(level):
    with pytest.raises(UserError, match=r"noise is .*; give a number from 0 to 2"):
        Turtlebot3Config(noise=level)
