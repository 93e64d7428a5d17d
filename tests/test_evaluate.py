"""Evaluation: the same fair pairs for every method, honest rates, and references that arrive."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from hypothesis import given, settings
from hypothesis import strategies as st

import ct_jax
from ct_envs import POINT, MazeEnv, UserError, load_maze, make_maze, random_walls
from ct_envs.maze import load_walls
from ct_jax.evaluate import (
    Episodes,
    bootstrap,
    check_horizon,
    evaluate,
    wilson,
)
from ct_jax.pairs import Pairs, beyond_horizon, horizon_for, shortest_ways
from ct_jax.policy import TransformerPolicy
from ct_jax.prm import PrmConfig
from ct_jax.runtime.devices import data_mesh, fill_up
from ct_jax.transformer import ControlTransformer, ModelConfig, sample_inputs
from ct_jax.types import act_as_intended
from ct_jax.value import ValueNetwork
from ct_jax.worlds.maze_runs import Request, as_film
from ct_jax.worlds.mazes import MazeWorld

pytestmark = pytest.mark.rank_promotion("allow")

ENV = MazeEnv(POINT, engine="mujoco", auto_reset=False)
MAZES = {name: load_maze(name) for name in ("antmaze-large", "antmaze-large-eval")}


def draw(maze, n=20, seed=0):
    return MazeWorld(ENV, maze).draw_pairs(seed, n)


@pytest.fixture(scope="module")
def pairs():
    return {name: draw(maze) for name, maze in MAZES.items()}


# ------------------------------------------------------------------------------------------------------------ pairs


def test_the_seed_decides_the_pairs(pairs):
    again, other = (draw(MAZES["antmaze-large"], seed=seed) for seed in (0, 1))
    for name in ("start", "goal", "shortest_m"):
        np.testing.assert_array_equal(getattr(again, name), getattr(pairs["antmaze-large"], name))
        assert not np.array_equal(getattr(other, name), getattr(again, name))
    assert (again.seed, other.seed) == (0, 1)


@pytest.mark.parametrize("name", MAZES)
def test_pairs_are_clear_apart_and_joined(pairs, wall_distance, name):
    start, goal, shortest = pairs[name].start, pairs[name].goal, pairs[name].shortest_m
    assert start.shape == goal.shape == (20, 2)
    for ends in (start, goal):
        assert wall_distance(load_walls(name), ends).min() >= POINT.radius_m
    straight = np.linalg.norm(start - goal, axis=1)
    assert straight.min() > 2 * POINT.goal_tolerance_m
    assert np.isfinite(shortest).all() and (shortest >= straight - 1e-3).all()
    assert shortest.max() > 1.3 * straight[shortest.argmax()]  # some way leads round a corner


def test_pairs_in_a_large_maze_have_shortest_ways():
    """A thousand samples do not join all of a maze of thousands of cells: there are as many as it takes."""
    pairs = draw(make_maze(random_walls(0, height=61, width=61, loops=0.0)), 10)
    straight = np.linalg.norm(pairs.start - pairs.goal, axis=1)
    assert pairs.straight == 0
    assert (pairs.shortest_m >= straight - 1e-3).all() and pairs.shortest_m.max() > 1.5 * straight.max()


def test_ways_that_no_roadmap_knows_are_counted():
    """With hardly a point, the straight line takes the way's place, and is said to be one."""
    maze = MAZES["antmaze-large"]
    pairs = draw(maze)
    config = PrmConfig(samples=5, most_samples=5)
    way, straight = shortest_ways(jax.random.key(0), maze, pairs.ends, radius_m=POINT.radius_m, config=config)
    lines = np.isclose(way, np.linalg.norm(pairs.start - pairs.goal, axis=1))
    assert 0 < straight <= lines.sum()
    assert episodes(pairs=replace(pairs_of(4), straight=3)).summary()["straight_ways"] == 3


# ---------------------------------------------------------------------------------------------------------- horizon


def test_the_horizon_grows_with_the_longest_way():
    """The paper's mazes keep the paper's horizon; a maze with ways k times as long has k times the steps."""
    for name in ("antmaze-large", "antmaze-large-eval", "hall"):
        assert horizon_for(POINT, draw(load_maze(name), 100)) == POINT.horizon
    pairs = pairs_of(3)
    far = replace(pairs, shortest_m=np.array([10.0, 3 * POINT.way_m, 20.0]))
    assert horizon_for(POINT, far) == 3 * POINT.horizon
    assert beyond_horizon(POINT, far, horizon_for(POINT, far)) == 0
    assert beyond_horizon(POINT, far, 40) == 2  # 13 m
    for wrong in (0, -5, 10**9):
        with pytest.raises(UserError, match="--horizon"):
            check_horizon(wrong)


@pytest.mark.parametrize("horizon", [30, None])
def test_episodes_last_as_long_as_the_horizon(pairs, push, horizon):
    """And pairs beyond it are counted."""
    maze, few = MAZES["antmaze-large"], pairs["antmaze-large"]
    done = evaluate(MazeWorld(ENV, maze), few, "planner", controller=push(), horizon=horizon)
    assert done.horizon == (horizon or ENV.horizon) and done.steps.max() <= done.horizon
    assert done.summary()["beyond_horizon"] == beyond_horizon(POINT, few, done.horizon)
    assert done.summary()["not_joined"] == 0
    if horizon:
        assert done.timeout.any() and done.summary()["beyond_horizon"] > 0
        assert (done.steps[done.timeout] == horizon).all()


# ------------------------------------------------------------------------------------------------------- statistics


def test_wilson_against_known_values():
    """Newcombe (1998), table I, method 3, and the closed form."""
    for k, n, low, high in [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ]:
        np.testing.assert_allclose(wilson(np.arange(n) < k), [low, high], atol=6e-5)


@given(st.lists(st.floats(-5000, 0), min_size=1, max_size=30))
@settings(max_examples=30)
def test_intervals_contain_the_mean(values):
    values = np.array(values)
    low, high = bootstrap(values)
    slack = 1e-6 * (1 + np.abs(values).max())
    assert low - slack <= values.mean() <= high + slack or len(values) < 4
    assert values.min() - slack <= low <= high <= values.max() + slack
    assert bootstrap(values) == [low, high]


@given(st.integers(1, 200), st.data())
@settings(max_examples=30)
def test_rates_are_inside_their_intervals(n, data):
    k = data.draw(st.integers(0, n))
    low, high = wilson(np.arange(n) < k)
    assert 0 <= low <= k / n <= high <= 1


def pairs_of(n: int) -> Pairs:
    return Pairs(np.zeros((n, 2)), np.zeros((n, 2)), np.full(n, 10.0), 3)


def episodes(n=4, **changes) -> Episodes:
    pairs = pairs_of(n)
    ones = np.ones(n)
    values = {
        "success": ones > 0, "collided": ones < 0, "fell": ones < 0, "timeout": ones < 0,
        "steps": 20 * ones, "returns": -100 * ones,
        "travelled_m": 10 * ones, "path": np.zeros((5, n, 2), np.float32), "pairs": pairs, "wall_s": 1.0,
        "horizon": 1000,
    }  # fmt: skip
    return Episodes(**values | changes)


def test_spl():
    """1 for the shortest way, its share for a longer one, 0 for a failure (Anderson et al., 2018)."""
    assert episodes().summary()["spl"] == 1.0
    assert (
        episodes(travelled_m=np.full(4, 9.5)).summary()["spl"] == 1.0
    )  # shorter than the roadmap's way: no more than 1
    assert episodes(travelled_m=np.full(4, 40.0)).summary()["spl"] == pytest.approx(0.25)
    mixed = episodes(success=np.array([True, True, False, False]), travelled_m=np.array([10, 20, 5, 50.0]))
    assert mixed.summary()["spl"] == pytest.approx((1 + 0.5) / 4)


def test_the_row_of_the_table_has_what_other_tools_rely_on():
    with Request(maze="hall", episodes=4).open(ct_jax.load("zoo:point"), 3) as trial:
        row = {"robot": "point", "method": "ct"} | trial.head | episodes().summary()
    contract = (
        "robot method maze episodes seed success_rate success_ci95 return_mean return_scaled spl collision_rate "
        "timeout_rate steps_mean wall_s"
    )
    assert set(contract.split()) <= set(row)
    assert (row["robot"], row["method"], row["maze"], row["episodes"], row["seed"]) == ("point", "ct", "hall", 4, 3)
    assert row["return_scaled"] == pytest.approx(row["return_mean"] / 100)
    for name in ("success", "return", "return_scaled", "spl", "collision", "timeout"):
        low, high = row[f"{name}_ci95"]
        value = next(row[key] for key in (f"{name}_rate", f"{name}_mean", name) if key in row)
        assert low <= value <= high


# ------------------------------------------------------------------------------------------------------- references


@pytest.mark.parametrize("method", ["planner", "explorer"])
def test_the_references_reach_every_goal(pairs, push, method):
    """With a controller that does as it is told, in both of the paper's mazes; in about the shortest ways."""
    for name, maze in MAZES.items():
        done = evaluate(MazeWorld(ENV, maze), pairs[name], method, controller=push())
        assert done.success.all(), (name, np.flatnonzero(~done.success))
        row = done.summary()
        assert row["success_rate"] == 1.0 and row["timeout_rate"] == 0.0
        assert (0.85 if method == "planner" else 0.4) < row["spl"] <= 1.0
        assert (done.travelled_m >= np.linalg.norm(pairs[name].start - pairs[name].goal, axis=1) - 1.0).all()
        np.testing.assert_array_equal(done.path[0], pairs[name].start)
        assert (done.returns < 0).all()


def test_what_is_reported_is_what_happened(push):
    """A straight run, a run into the wall, and the sums by hand."""
    maze = load_maze("antmaze-umaze")
    start = np.float32([[6, 6], [6, 6]])
    goal = np.float32([[12, 6], [6, 14]])
    two = Pairs(start, goal, np.float32([6, 8]), 0)
    env = MazeEnv(POINT, engine="mujoco", auto_reset=False, horizon=40)

    done = evaluate(MazeWorld(env, maze), two, "planner", controller=push())
    path, steps = done.path, done.steps.astype(int)
    assert done.success[0] and 10 < steps[0] < 40
    away = np.linalg.norm(path[1 : steps[0], 0] - goal[0], axis=1)
    assert -done.returns[0] == pytest.approx(away.sum(), abs=POINT.goal_tolerance_m)
    assert done.travelled_m[0] == pytest.approx(5.5, abs=0.5)
    assert done.summary()["spl"] <= 1
    film = as_film("point", done)
    np.testing.assert_array_equal(film, path[: len(film), 0])  # a point's coordinates are its position

    blind = evaluate(MazeWorld(env, maze), two, "planner", controller=push(0.0))
    np.testing.assert_array_equal(blind.success, False)
    np.testing.assert_array_equal(blind.timeout, True)
    np.testing.assert_array_equal(blind.steps, 40)
    np.testing.assert_allclose(blind.returns, [-6 * 40, -8 * 40], rtol=1e-4)
    assert blind.summary()["spl"] == 0 and blind.target_return is None


@pytest.fixture(scope="module")
def policy():
    config = ModelConfig(layers=1, heads=1, width=4, context=2, context_acting=2, max_timestep=8)
    inputs = sample_inputs(2, 2)
    return TransformerPolicy(
        jax.jit(ControlTransformer(config, 2).init)(jax.random.key(0), *inputs),
        jax.jit(ValueNetwork(4).init)(jax.random.key(0), *inputs[:3]), config, 2, value_width=4,
    )  # fmt: skip


def test_the_transformer_is_asked_for_its_value(policy, pairs):
    env = MazeEnv(POINT, engine="mujoco", auto_reset=False, horizon=50)
    few = replace(pairs["antmaze-large"], **{
        name: getattr(pairs["antmaze-large"], name)[:2] for name in ("start", "goal", "shortest_m", "place")
    })  # fmt: skip
    seen = []
    done = evaluate(
        MazeWorld(env, MAZES["antmaze-large"]), few, "ct", policy=policy, on_progress=lambda *at: seen.append(at)
    )
    assert done.target_return is not None and (done.target_return <= 0).all() and done.target_return.shape == (2,)
    assert done.path.shape == (50, 2, 2) and seen[-1] == (2, "step 50")
    np.testing.assert_array_equal(done.timeout, ~done.success)


def test_without_compilation(policy):
    maze = load_maze("antmaze-umaze")
    two = Pairs(np.float32([[6, 6]]), np.float32([[6.7, 6]]), np.float32([0.7]), 0)
    env = MazeEnv(POINT, engine="mujoco", auto_reset=False, horizon=1)
    with jax.disable_jit():
        done = evaluate(MazeWorld(env, maze), two, "ct", policy=policy)
    assert done.steps.tolist() == [1]
    assert done.returns[0] == pytest.approx(-0.7, abs=0.1)


def test_any_policy_can_be_evaluated():
    """Whatever begins an episode by itself and acts: here straight into the wall."""

    @struct.dataclass
    class East:
        def init(self, frame, tasks):
            return jnp.zeros(frame.done.shape[0])

        def act(self, memory, frame, key):
            return act_as_intended(jnp.tile(jnp.array([[1.0, 0.0]]), (len(memory), 1))), memory + 1

    two = Pairs(np.float32([[6, 6], [6, 6]]), np.float32([[12, 6], [6, 14]]), np.float32([6, 8]), 0)
    env = MazeEnv(POINT, engine="mujoco", auto_reset=False, horizon=40)
    done = evaluate(MazeWorld(env, load_maze("antmaze-umaze")), two, "east", policy=East())
    assert (
        done.success.tolist() == [True, False]
        and done.collided.tolist() == [False, True]
        and done.target_return is None
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_counted_apart_and_paid_like_a_fall(faulty, bad):
    """Three that stand still: one for all the time, one that breaks off in its fourth step, one at its goal."""
    goal = np.float32([[12, 6], [12, 6], [6.2, 6]])
    three = Pairs(np.float32([[6, 6]] * 3), goal, np.linalg.norm(goal - 6, axis=1), 0)
    env = MazeEnv(POINT, engine="mujoco", auto_reset=False, horizon=20)
    n = len(fill_up(3, data_mesh()))
    policy = faulty(jnp.arange(n) % 3 == 1, bad)
    done = evaluate(MazeWorld(env, load_maze("antmaze-umaze")), three, "faulty", policy=policy)
    assert done.diverged.tolist() == [False, True, False] and not done.fell.any()
    assert done.timeout.tolist() == [True, False, False] and done.success.tolist() == [False, False, True]
    assert done.steps.tolist() == [20, 4, 1]
    assert done.returns[1] == pytest.approx(done.returns[0], rel=1e-5)  # no better for having broken off
    row = done.summary()
    assert row["diverged_rate"] == row["timeout_rate"] == row["success_rate"] == pytest.approx(1 / 3)
    low, high = row["diverged_ci95"]
    assert low < 1 / 3 < high
    assert np.isfinite(done.path).all()


def test_pairs_of_another_maze_are_refused(pairs, push):
    few, world = pairs["antmaze-large"], MazeWorld(ENV, MAZES["antmaze-large"])
    for name, at in (("start", [2.0, 2.0]), ("goal", [np.nan, 6.0])):
        wrong = getattr(few, name).copy()
        wrong[3] = at
        with pytest.raises(UserError, match=rf"{name}\[3\]"):
            evaluate(world, replace(few, **{name: wrong}), "planner", controller=push())
