"""Mazes with cells smaller than a robot: no wall in reach is missing, nothing else is there, and queries are safe."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco.batch import Batch

from ct_envs import ANT, POINT, MazeEnv, UserError, load_maze, make_maze, random_walls, stack_mazes
from ct_envs.fine import fit_maze, load_fitted, merge_walls, wall_distance
from ct_envs.maze import clearance, load_walls, sample_pair, segment_free, segment_reach
from ct_envs.occupancy import local_map
from ct_envs.physics import PhysicsState, add_wall, make_engine, model_xml, nearest_walls
from ct_jax.evaluate import evaluate
from ct_jax.prm import PrmConfig
from ct_jax.worlds.mazes import MazeWorld
from tests.refusals import refusal

pytestmark = pytest.mark.rank_promotion("allow")  # MJX

SMALL = dataclasses.replace(POINT, name="small", radius_m=0.1, touch_m=0.1, top_speed_mps=0.5)
GRIDS = st.builds(
    lambda seed, height, width, share: np.pad(
        np.random.default_rng(seed).random((height, width)) < share, 1, constant_values=True
    ),
    st.integers(0, 2**31 - 1), st.integers(3, 30), st.integers(3, 30), st.floats(0, 0.9),
)  # fmt: skip


def speckled(seed: int, cell_m: float) -> np.ndarray:
    """A hall of about 8 m with walls of one cell, a slanted wall and small obstacles."""
    rng = np.random.default_rng(seed)
    side = round(8.0 / cell_m)
    walls = np.ones((side, side), bool)
    walls[1:-1, 1:-1] = rng.random((side - 2, side - 2)) < 0.1 * cell_m**2
    walls[side // 2, : side // 3] = True
    walls[np.arange(side), (np.arange(side) // 3 + side // 2)] = True
    return walls


def points_in(seed: int, cells: np.ndarray, cell_m: float, n: int = 64) -> np.ndarray:
    """Random points [n, 2] (m) of the cells that are True."""
    rng = np.random.default_rng(seed)
    at = np.argwhere(cells)
    return np.float32((at[rng.integers(len(at), size=n)][:, ::-1] + rng.random((n, 2))) * cell_m)


def to_walls(walls: np.ndarray, points: np.ndarray, cell_m: float) -> np.ndarray:
    """Distances [n] (m) from points to the nearest wall cell, one by one."""
    centres = (np.argwhere(np.pad(walls, 1, constant_values=True))[:, ::-1] - 0.5) * cell_m
    return np.array([np.hypot(*np.maximum(np.abs(centres - p) - cell_m / 2, 0.0).T).min() for p in points])


# -------------------------------------------------------------------------------------------------- merged walls


@given(GRIDS)
def test_merged_walls_are_the_walls(walls):
    """Each wall cell lies in one rectangle, and each cell of a rectangle is wall."""
    covered = np.zeros(walls.shape, int)
    for left, bottom, right, top in merge_walls(walls):
        covered[bottom:top, left:right] += 1
    np.testing.assert_array_equal(covered, walls)


def test_straight_walls_become_few_boxes():
    walls = np.pad(np.zeros((500, 700), bool), 3, constant_values=True)
    assert len(merge_walls(walls)) == 4


@given(GRIDS)
@settings(max_examples=30)
def test_the_distance_to_the_walls_is_exact(walls):
    centres = np.argwhere(np.ones_like(walls))[:, ::-1] + 0.5
    np.testing.assert_allclose(wall_distance(walls).ravel(), to_walls(walls, centres, 1.0), atol=1e-9)


# ------------------------------------------------------------------------------------------------ walls in reach

boxes_at = jax.jit(jax.vmap(nearest_walls, (None, 0)))


@given(st.integers(0, 2**31 - 1), st.sampled_from([0.02, 0.05, 0.11, 0.4]), st.sampled_from([0.25, 0.5]))
@settings(max_examples=60, deadline=None)
def test_no_wall_that_could_be_touched_is_missing(seed, cell_m, reach_m):
    """Every part of a wall within reach of a robot is in a box, and every box is in a wall."""
    robot = dataclasses.replace(SMALL, touch_m=reach_m - SMALL.top_speed_mps * SMALL.control_dt_s)
    assert robot.reach_m == pytest.approx(reach_m)
    walls = random_walls(seed, height=12, width=12, density=0.6).repeat(4, 0).repeat(4, 1)
    walls |= np.random.default_rng(seed).random(walls.shape) < 0.02
    try:
        maze = fit_maze(walls, robot, cell_m=cell_m)
    except UserError as refused:
        assert "no free space" in str(refused)  # the whole maze is smaller than the robot
        return
    points = points_in(seed, ~walls, cell_m, 32)
    boxes = np.asarray(boxes_at(maze, points), np.float64)
    inner = (np.argwhere(walls)[:, None, ::-1] + [[0.1, 0.1], [0.9, 0.1], [0.5, 0.5], [0.1, 0.9], [0.9, 0.9]]) * cell_m
    inner = inner.reshape(-1, 2)
    for point, around in zip(points, boxes, strict=True):
        up = around[around[:, 2] > 0]
        low, high = up[:, :2] - up[:, 3:], up[:, :2] + up[:, 3:]
        parts = inner[np.hypot(*(inner - point).T) < robot.reach_m]
        held = ((low - 1e-5 <= parts[:, None]) & (parts[:, None] <= high + 1e-5)).all(-1).any(-1)
        assert held.all()
        for (left, bottom), (right, top) in zip(low / cell_m, high / cell_m, strict=True):
            rows, columns = (
                slice(int(bottom + 0.01), int(np.ceil(top - 0.01))),
                slice(int(left + 0.01), int(np.ceil(right - 0.01))),
            )
            assert walls[rows, columns].all()
        assert (around[:, 2][around[:, 2] <= 0] < -100).all()


@pytest.mark.parametrize("cell_m", [4.0, 10.0])
def test_large_cells_need_no_boxes(cell_m):
    walls = random_walls(0)
    fitted, plain = fit_maze(walls, POINT, cell_m=cell_m), make_maze(walls, cell_m=cell_m)
    assert fitted.boxes is None
    jax.tree.map(np.testing.assert_array_equal, fitted, plain)


# ------------------------------------------------------------------------------------------------------ physics

N = 16
FINE = speckled(0, 0.1)


@functools.cache
def hall():
    return fit_maze(FINE, POINT, cell_m=0.1)


@functools.cache
def engine(name):
    return make_engine(name, POINT, cell_m=0.1, boxes=hall().boxes.near.shape[-1])


@functools.partial(jax.jit, static_argnums=0)
def step(engine, maze, state, ctrl):
    walls = jax.vmap(nearest_walls, (None, 0))(maze, state.qpos[:, :2])
    return jax.vmap(engine.step)(state, ctrl, walls)


def starts(seed: int, speed: float) -> PhysicsState:
    """Robots that touch no wall, at ``speed`` [m/s] in any direction."""
    rng = np.random.default_rng(seed)
    points = points_in(seed, np.asarray(hall().boxes.room_m)[: len(FINE), : len(FINE)] > 0.6, 0.1, N)
    angle = rng.uniform(0, 2 * np.pi, N)
    velocity = speed * np.stack([np.cos(angle), np.sin(angle)], -1)
    return PhysicsState(*(jnp.asarray(leaf, jnp.float32) for leaf in (points, velocity, 0 * points)))


def built_in() -> mujoco.MjModel:
    """The point robot with all boxes built in."""
    spec = mujoco.MjSpec.from_string(model_xml(POINT))
    for left, bottom, right, top in merge_walls(np.asarray(hall().walls)) * 0.1:
        body = spec.worldbody.add_body(pos=[(left + right) / 2, (bottom + top) / 2, 1.0])
        add_wall(body, 1.0)
        body.geoms[0].size = [(right - left) / 2, (top - bottom) / 2, 1.0]
    return spec.compile()


def test_boxes_near_the_robot_equal_a_model_with_all_of_them():
    """One step each from the same state, along random drives into walls of 0.1 m."""
    names = ("qpos", "qvel", "qacc_warmstart", "ctrl")
    merged = min(merge_walls(np.asarray(hall().walls)), merge_walls(np.asarray(hall().walls).T), key=len)
    assert len(merged) == len(merge_walls(np.asarray(hall().walls)))  # the model has the same boxes
    batch = Batch(built_in(), nsim=N, nthread=1)
    truth = {name: batch.bind(name) for name in names}
    rng = np.random.default_rng(1)
    state = starts(1, 3.0)
    for name in names[:3]:
        truth[name][:] = np.asarray(getattr(state, name))
    touched = 0.0
    for i in range(150):
        if i % 10 == 0:
            ctrl = jnp.asarray(rng.uniform(-1, 1, (N, 2)), jnp.float32)
        now = PhysicsState(*(jnp.asarray(truth[name], jnp.float32) for name in names[:3]))
        moved, touching = step(engine("mujoco"), hall(), now, ctrl)
        truth["ctrl"][:] = np.asarray(ctrl)
        batch.step(nstep=engine("mujoco").n_substeps)
        np.testing.assert_allclose(moved.qpos, truth["qpos"], atol=2e-5)
        np.testing.assert_allclose(moved.qvel, truth["qvel"], atol=2e-4)
        touched += float(np.mean(touching))
    assert touched > 0.1 * 150


def test_engines_agree():
    state, rng, touched = starts(2, 2.0), np.random.default_rng(2), 0.0
    other = state
    for _ in range(20):
        ctrl = jnp.asarray(rng.uniform(-1, 1, (N, 2)), jnp.float32)
        state, touching = step(engine("mujoco"), hall(), state, ctrl)
        other, _also = step(engine("mjx"), hall(), other, ctrl)
        np.testing.assert_allclose(other.qpos, state.qpos, atol=5e-4)
        np.testing.assert_allclose(other.qvel, state.qvel, atol=5e-3)
        touched += float(np.mean(touching))
        other = state
    assert touched > 0.5


def test_no_speed_carries_the_point_through_a_thin_wall():
    """Full throttle at top speed against walls of 0.1 m: the centre of the robot never enters one."""
    for seed in range(4):
        state = starts(seed, POINT.top_speed_mps)
        ctrl = jnp.sign(state.qvel)
        for _ in range(40):
            before = np.asarray(state.qpos)
            state, _ = step(engine("mujoco"), hall(), state, ctrl)
            assert to_walls(FINE, np.asarray(state.qpos), 0.1).min() > 0.25
            assert np.linalg.norm(np.asarray(state.qpos) - before, axis=1).max() < 0.61


@pytest.mark.parametrize(
    ("robot", "cell_m"), [("point", 0.02), ("point", 0.05), ("ant", 0.1), ("ant", 2.0), ("point", 2.0), ("point", 10.0)]
)
def test_an_environment_runs_in_cells_of_any_size(robot, cell_m):
    """Starts and goals are clear of walls, episodes go on, and observations are finite."""
    which = {"point": POINT, "ant": ANT}[robot]
    walls = speckled(1, cell_m) if cell_m < 1 else random_walls(1)
    maze = fit_maze(walls, which, cell_m=cell_m)
    env = MazeEnv(robot, maze=maze, cell_m=cell_m, engine="mujoco")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 8))
    for name in ("position", "goal"):
        assert to_walls(walls, np.asarray(state.info[name]), cell_m).min() >= which.radius_m - 1e-4
    step = jax.jit(jax.vmap(env.step))
    for _ in range(3):
        state = step(state, jnp.zeros((8, env.action_size)))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.obs))


# ------------------------------------------------------------------------------------------------------- queries

CLEARANCES = jax.jit(jax.vmap(clearance, (None, 0)))


@given(st.integers(0, 2**31 - 1), st.sampled_from([0.05, 0.1, 0.25]))
@settings(max_examples=20, deadline=None)
def test_clearance_is_a_lower_bound_and_near(seed, cell_m):
    walls = speckled(seed, cell_m)
    points = points_in(seed, np.ones_like(walls), cell_m)
    true, found = to_walls(walls, points, cell_m), np.asarray(CLEARANCES(fit_maze(walls, SMALL, cell_m=cell_m), points))
    if fit_maze(walls, SMALL, cell_m=cell_m).boxes is None:
        return
    assert (found <= true + 1e-4).all() and (found >= true - 1.5 * cell_m).all()


@given(st.integers(0, 2**31 - 1), st.sampled_from([0.05, 0.1]), st.floats(0.05, 0.5))
@settings(max_examples=20, deadline=None)
def test_a_free_way_is_free_and_a_wide_one_is_found(seed, cell_m, radius):
    walls = speckled(seed, cell_m)
    maze = fit_maze(walls, SMALL, cell_m=cell_m)
    a, b = (points_in(seed + i, ~walls, cell_m) for i in (0, 1))
    b = np.float32(a + (b - a) * np.minimum(1.0, 2.0 / np.linalg.norm(b - a, axis=1, keepdims=True)))
    reach = segment_reach(2.0, radius, cell_m)
    free = jax.vmap(lambda a, b: segment_free(maze, a, b, radius=radius, reach=reach))(a, b)
    along = np.linspace(0, 1, 101)[:, None]
    room = np.array([to_walls(walls, p + along * (q - p), cell_m).min() for p, q in zip(a, b, strict=True)])
    assert (room[np.asarray(free)] >= radius - 1e-4).all()
    assert np.asarray(free)[room >= radius + 2 * cell_m].all()


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=10, deadline=None)
def test_starts_and_goals_are_clear_and_of_one_region(seed):
    """A way of cells with room for the robot joins them."""
    walls = speckled(seed, 0.1)
    walls[len(walls) // 2] = True  # two regions at least
    maze = fit_maze(walls, SMALL, cell_m=0.1)
    keys = jax.random.split(jax.random.key(seed), 64)
    start, goal = map(np.asarray, jax.vmap(lambda key: sample_pair(key, maze, radius=SMALL.radius_m))(keys))
    for points in (start, goal):
        assert to_walls(walls, points, 0.1).min() >= SMALL.radius_m - 1e-4
    assert ((start[:, 1] < 0.1 * (len(walls) // 2)) == (goal[:, 1] < 0.1 * (len(walls) // 2))).all()


@given(st.integers(0, 2**31 - 1), st.sampled_from([0.05, 0.1]), st.sampled_from([0.08, 0.8]))
@settings(max_examples=10, deadline=None)
def test_the_local_map_shows_walls_that_are_thinner_than_its_cells(seed, cell_m, map_cell_m):
    walls = speckled(seed, cell_m)
    maze = fit_maze(walls, SMALL, cell_m=cell_m)
    at = points_in(seed, ~walls, cell_m, 4)
    maps = np.asarray(jax.vmap(lambda p: local_map(maze, p, p, cell_m=map_cell_m))(at))[:, 0]
    height, width = walls.shape
    for point, shown in zip(at.astype(np.float64), maps, strict=True):
        for i, j in np.ndindex(25, 25):
            low = (point[::-1] + (np.array([i, j]) - 12.5) * map_cell_m) / cell_m
            high = low + map_cell_m / cell_m
            if (np.abs(low - np.round(low)) < 1e-3).any() or (np.abs(high - np.round(high)) < 1e-3).any():
                continue  # rounding decides
            (bottom, left), (top, right) = np.floor(low).astype(int), np.floor(high).astype(int) + 1
            inside = walls[max(bottom, 0) : max(top, 0), max(left, 0) : max(right, 0)]
            beyond = bottom < 0 or left < 0 or top > height or right > width
            assert bool(shown[i, j]) == (beyond or bool(inside.any()))


def test_methods_are_evaluated_in_a_fine_maze(push):
    """By the world that evaluates them in any other maze."""
    maze = hall()
    env = MazeEnv("point", maze=maze, cell_m=0.1, engine="mujoco", auto_reset=False, horizon=40)
    world = MazeWorld(env, maze)
    pairs = world.draw_pairs(0, 3)
    done = evaluate(world, pairs, "planner", controller=push(), prm=PrmConfig(samples=30))
    assert done.path.shape[1:] == (3, 2) and done.travelled_m.min() > 0.5


# ------------------------------------------------------------------------------------------------- what is refused


def test_what_cannot_be_is_refused():
    narrow = np.pad(np.zeros((6, 100), bool), 1, constant_values=True)
    assert "no free space for robot 'point'" in refusal(lambda: fit_maze(narrow, POINT, cell_m=0.1))
    noise = np.pad(np.indices((60, 60)).sum(0) % 2 == 0, 1, constant_values=True)
    noise[20:40, 20:40] = False
    message = refusal(lambda: fit_maze(noise, dataclasses.replace(SMALL, touch_m=1.0), cell_m=0.1))
    assert "pieces of wall" in message and "--cell-m" in message
    assert "cannot be stacked" in refusal(lambda: stack_mazes([hall(), hall()]))
    env = MazeEnv("point", maze=hall(), cell_m=0.1, engine="mujoco")
    other = hall().replace(boxes=hall().boxes.replace(near=hall().boxes.near[..., :1]))
    assert "1 boxes near a robot" in refusal(lambda: env.reset(jax.random.key(0), other))
    assert "0 boxes near a robot" in refusal(lambda: env.reset(jax.random.key(0), hall().replace(boxes=None)))


def test_a_map_is_loaded_at_its_own_scale(tmp_path):
    file = tmp_path / "hall.txt"
    rows = "\n".join("".join(".#"[cell] for cell in row) for row in FINE[::-1].astype(int))
    file.write_text(f"cell_m: 0.1\n{rows}\n")
    jax.tree.map(np.testing.assert_array_equal, load_fitted(file, POINT), hall())
    jax.tree.map(np.testing.assert_array_equal, load_fitted("antmaze-large", ANT), load_maze("antmaze-large"))
    file.write_text("\n".join("".join(".#"[cell] for cell in row) for row in load_walls("hall")[::-1].astype(int)))
    jax.tree.map(np.testing.assert_array_equal, load_fitted(file, ANT), load_maze("hall"))
