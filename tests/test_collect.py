"""Collection: successes only, exactly as many as asked for, told as they were towards the final goal."""

from dataclasses import replace
from typing import get_args

import jax
import numpy as np
import pytest

from ct_envs import POINT, MazeEnv, UserError, load_maze, make_maze, random_walls, stack_mazes
from ct_jax.collect import CollectConfig, GuideName, collect
from ct_jax.prm import PrmConfig
from ct_jax.trajectories import to_trajectories
from ct_jax.types import End, Rollout, Steps
from ct_jax.worlds.mazes import MazeWorld

pytestmark = pytest.mark.rank_promotion("allow")

PRM = PrmConfig(samples=60)
SMALL = CollectConfig(trajectories=10, reset_interval=4, envs=8, horizon=150)
MAZES = stack_mazes([load_maze("antmaze-umaze"), make_maze(random_walls(3, height=7, width=7))])
ENV = MazeEnv(POINT, engine="mujoco", auto_reset=False, maps=False)
WORLD = MazeWorld(ENV, MAZES)


@pytest.fixture(scope="module")
def collected(push):
    seen = []
    data = collect(jax.random.key(0), WORLD, push(), SMALL, PRM, on_progress=lambda won, of: seen.append((won, of)))
    return data, seen


def test_as_many_as_asked_for(collected):
    data, seen = collected
    assert data.n == SMALL.trajectories
    assert [of for _, of in seen] == [8 * (i + 1) for i in range(len(seen))]
    assert seen[-1][0] >= SMALL.trajectories > ([0] + [won for won, _ in seen])[-2]


def after(data, i) -> np.ndarray:
    """Positions after each step but the last of a trajectory."""
    return np.asarray(data.position)[i, 1 : data.length[i]]


def test_only_successes_and_only_at_the_end(collected):
    """The last step ends at the goal and no earlier one does. The goal is the final one, whatever was followed."""
    data, _ = collected
    for i in range(data.n):
        reward = data.reward[i, : data.length[i]]
        assert reward[-1] > -POINT.goal_tolerance_m
        assert (reward[:-1] <= -POINT.goal_tolerance_m).all()


def test_rewards_are_minus_the_distance_to_the_final_goal(collected):
    data, _ = collected
    for i in range(data.n):
        away = np.linalg.norm(after(data, i) - data.goal_world[i], axis=-1)
        np.testing.assert_allclose(data.reward[i, : data.length[i] - 1], -away, atol=1e-4)
    assert (data.label_mask.sum(1) == data.length).all()
    np.testing.assert_array_equal(data.label, data.action)


def test_trajectories_go_through_free_space_of_their_own_maze(collected, wall_distance):
    data, _ = collected
    assert set(data.maze.tolist()) == {0, 1}
    for i in range(data.n):
        walls = np.asarray(MAZES.walls)[data.maze[i]]
        assert wall_distance(walls, data.position[i, : data.length[i]]).min() > 0.4
        assert (np.linalg.norm(np.diff(data.position[i, : data.length[i]], axis=0), axis=-1) < 0.7).all()


def test_the_key_decides(collected, push):
    config = replace(SMALL, trajectories=3)
    first, other = (collect(jax.random.key(k), WORLD, push(), config, PRM) for k in (0, 1))
    np.testing.assert_array_equal(first.goal_world, collected[0].goal_world[:3])
    assert not np.array_equal(first.goal_world, other.goal_world)


def test_a_controller_that_never_arrives_is_an_error_and_no_hang(push):
    """One that stands still; and exactly as many episodes as it was given."""
    seen = []
    config = replace(SMALL, trajectories=4, give_up=4.0, starts="maze")
    with pytest.raises(UserError, match=r"reached only \d of 16 goals, but 4 are needed"):
        collect(jax.random.key(0), WORLD, push(0.0), config, PRM, on_progress=lambda *counts: seen.append(counts))
    assert [of for _, of in seen] == [8, 16]


@pytest.mark.parametrize("guide", get_args(GuideName))
def test_every_guide_arrives_with_noise_and_the_noise_is_not_imitated(push, guide):
    config = replace(SMALL, trajectories=4, envs=4, guide=guide, noise=0.4, starts="maze")
    data = collect(jax.random.key(2), WORLD, push(), config, PRM)
    inside = np.arange(data.reward.shape[1]) < data.length[:, None]
    np.testing.assert_array_equal(data.label, data.action)
    assert (np.abs(data.action[inside]) <= 1).all()
    # What was done differs from what was meant: with drag 20 N s/m, 5 kg and 80 N, speeds tell what was done.
    i = int(np.argmax(data.length))
    speed, meant = data.proprio[i, : data.length[i]], data.action[i, : data.length[i] - 1]
    decay = np.exp(-0.1 * 20 / 5)
    done = (speed[1:] - decay * speed[:-1]) / ((1 - decay) * 4.0)
    assert np.abs(done - meant).mean() > 0.1


def test_a_new_roadmap_and_maze_after_every_interval():
    tasks = WORLD.sample_tasks(jax.random.key(0), replace(SMALL, reset_interval=2), PRM, offset=1)
    np.testing.assert_array_equal(tasks.table_of, np.repeat(range(4), 2))
    np.testing.assert_array_equal(tasks.place, [1, 1, 0, 0, 1, 1, 0, 0])
    for i in range(8):
        np.testing.assert_array_equal(tasks.maze.walls[i], MAZES.walls[tasks.place[i]])
    points = np.asarray(tasks.tables.points)
    assert all(not np.array_equal(points[i], points[j]) for i in range(4) for j in range(i))


@pytest.mark.parametrize(("envs", "interval"), [(8, 3), (5, 25), (1, 1), (7, 7)])
def test_any_number_of_environments_and_any_interval(envs, interval):
    config = replace(SMALL, envs=envs, reset_interval=interval)
    tasks = WORLD.sample_tasks(jax.random.key(0), config, PrmConfig(samples=30))
    assert len(tasks.start) == len(tasks.place) == len(tasks.table_of) == envs
    counts = np.bincount(tasks.table_of)
    assert len(counts) == max(1, envs // interval) and counts.min() >= 1


@pytest.mark.parametrize("starts", ["vertices", "maze"])
def test_ends_are_joined_by_their_roadmap(starts):
    config = replace(SMALL, starts=starts)
    tasks = WORLD.sample_tasks(jax.random.key(1), config, PRM)
    points, distance = np.asarray(tasks.tables.points), np.asarray(tasks.tables.distance)
    at_vertex = []
    for i in range(SMALL.envs):
        own = points[tasks.table_of[i]]
        ends = [np.flatnonzero((own == np.asarray(end[i])).all(1)) for end in (tasks.start, tasks.goal)]
        at_vertex.append(all(len(end) for end in ends))
        if at_vertex[-1]:
            assert 0 < distance[tasks.table_of[i], ends[0][0], ends[1][0]] < np.inf
    assert all(at_vertex) if starts == "vertices" else not any(at_vertex)


def test_what_came_after_the_end_counts_for_nothing():
    """In the record, episodes go on being there after their end; in trajectories, only their padding does."""
    alive = np.array([[1, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    ones = np.ones((4, 2), np.float32)
    pairs = np.arange(16, dtype=np.float32).reshape(4, 2, 2)
    steps = Steps(pairs, pairs, pairs, pairs, label_mask=ones, reward=-ones, alive=alive, collision=ones, success=ones)
    flags = np.zeros(2, bool)
    end = End(pairs[0], -ones[0], flags, flags, flags)
    data = to_trajectories(Rollout(steps, end, np.zeros((2, 2)), np.array([0, 1]), ~flags, horizon=4))
    np.testing.assert_array_equal(data.length, [3, 2])
    np.testing.assert_array_equal(data.label_mask, alive.T)
    np.testing.assert_array_equal(data.collision, alive.T)
    np.testing.assert_array_equal(np.asarray(data.rtg)[:, 0], [-3, -2])
    np.testing.assert_array_equal(data.position[1, 0], pairs[0, 1])


def test_without_compilation(push):
    """The very first steps of a collection that is cut short: it gives up, and says so."""
    config = CollectConfig(trajectories=1, reset_interval=1, envs=1, horizon=1, give_up=1.0)
    maze = jax.tree.map(lambda leaf: leaf[:1], MAZES)
    with jax.disable_jit(), pytest.raises(UserError, match="0 of 1"):
        collect(jax.random.key(0), MazeWorld(ENV, maze), push(), config, PrmConfig(samples=12))
