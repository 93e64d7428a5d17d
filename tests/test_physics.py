"""The two physics engines: they agree, no wall is missing, and NaN does not spread to other robots."""

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

from ct_envs import ANT, HUMANOID, POINT, UserError, load_maze, make_maze, random_walls
from ct_envs.maze import load_walls
from ct_envs.physics import (
    ENGINES,
    PhysicsState,
    build_model,
    make_engine,
    model_xml,
    nearest_walls,
    static_model,
)

pytestmark = pytest.mark.rank_promotion("allow")  # MJX

N = 32  # number of robots; the same in all tests, so that they share one compiled program
LARGE = load_walls("antmaze-large")


@pytest.fixture(scope="module")
def engine():
    """Get an engine by name. Each is created once, because compiled programs belong to an engine."""
    return functools.cache(lambda name: make_engine(name, POINT))


boxes_at = jax.jit(jax.vmap(nearest_walls, (None, 0)))


@functools.partial(jax.jit, static_argnums=0)
def step(engine, maze, state, ctrl):
    walls = jax.vmap(nearest_walls, (None, 0))(maze, state.qpos[:, :2])
    return jax.vmap(engine.step)(state, ctrl, walls)[0]


@functools.partial(jax.jit, static_argnums=0)
def drive(engine, maze, state, ctrls):
    """The states after each control step, from N states with ctrls [T, N, nu]."""

    def once(state, ctrl):
        walls = jax.vmap(nearest_walls, (None, 0))(maze, state.qpos[:, :2])
        state, _ = jax.vmap(engine.step)(state, ctrl, walls)
        return state, state

    return jax.lax.scan(once, state, ctrls)[1]


def starts(seed: int, walls: np.ndarray, wall_distance, *, speed: float, n: int = N) -> PhysicsState:
    """Robots without wall contact, most of them close to a wall, with ``speed`` [m/s] in a random direction."""
    rng = np.random.default_rng(seed)
    free = np.argwhere(~walls)[:, ::-1]
    points = (free[rng.integers(len(free), size=200 * n)] + rng.random((200 * n, 2))) * 4.0
    distance = wall_distance(walls, points)
    points = points[(distance > 0.52) & (distance < 1.0)][:n]
    angle = rng.uniform(0, 2 * np.pi, n)
    velocity = speed * np.stack([np.cos(angle), np.sin(angle)], -1)
    return PhysicsState(*(jnp.asarray(leaf, jnp.float32) for leaf in (points, velocity, 0 * points)))


def pushes(seed: int, length: int, n: int = N) -> jax.Array:
    """Random full throttle, constant for about ten steps at a time."""
    rng = np.random.default_rng(seed)
    held = rng.uniform(-1.5, 1.5, (-(-length // 10), n, 2)).clip(-1, 1)
    return jnp.asarray(np.repeat(held, 10, axis=0)[:length], jnp.float32)


# -------------------------------------------------------------------------------------------- the two engines


def test_engines_agree_in_free_space_and_at_walls(engine, wall_distance):
    """MJX computes in float32, MuJoCo in float64.

    30 steps of 5 substeps round 150 times, by about 2e-6 m at coordinates of up to 40 m. Dissipation limits the growth
    of these errors. A missing contact would cause a difference of decimetres.
    """
    maze = make_maze(LARGE)
    state, ctrls = starts(0, LARGE, wall_distance, speed=2.0), pushes(0, 30)
    c = xla = state
    touching = []
    for ctrl in ctrls:
        c, xla = step(engine("mujoco"), maze, c, ctrl), step(engine("mjx"), maze, xla, ctrl)
        np.testing.assert_allclose(xla.qpos, c.qpos, atol=5e-4)
        np.testing.assert_allclose(xla.qvel, c.qvel, atol=2e-3)
        touching.append(wall_distance(LARGE, c.qpos) < 0.5)
    assert 0.1 < np.mean(touching) < 0.9  # both cases were compared


@pytest.mark.parametrize(
    ("robot", "limb_at_wall", "span", "atol"),
    # Ant: a slipping foot, or another contact point between capsule and box, causes centimetres in a step.
    [(ANT, (4.75, 6.0), 0.3, 5e-2), pytest.param(HUMANOID, (6.0, 4.36), 0.2, 1e-3, marks=pytest.mark.slow)],
)
def test_engines_agree_for_ant_and_humanoid(robot, limb_at_wall, span, atol):
    """Single steps from the same states with small random torques. MJX computes in float32, MuJoCo in float64. A
    missing contact would cause a difference of decimetres."""
    maze = load_maze("antmaze-umaze")
    engines = [make_engine(name, robot) for name in ("mujoco", "mjx")]
    model = engines[0].model
    qpos = np.tile(model.key("stand").qpos, (2, 1)).astype(np.float32)
    qpos[:, :2] = [(6.0, 6.0), limb_at_wall]
    state = PhysicsState(jnp.asarray(qpos), jnp.zeros((2, model.nv)), jnp.zeros((2, model.nv)))
    steps = [jax.jit(jax.vmap(engine.step)) for engine in engines]
    ctrls = jax.random.uniform(jax.random.key(0), (8, 2, model.nu), minval=-span, maxval=span)
    touched = []
    for ctrl in ctrls:
        boxes = boxes_at(maze, state.qpos[:, :2])
        (state, touching), (other, also) = (step(state, ctrl, boxes) for step in steps)
        np.testing.assert_allclose(other.qpos, state.qpos, atol=atol)
        np.testing.assert_array_equal(touching, also)
        touched.append(np.asarray(touching))
    assert np.stack(touched)[:, 1].any() and not np.stack(touched)[:, 0].any()
    assert np.abs(np.asarray(state.qpos[:, 7:]) - qpos[:, 7:]).max() > 0.05  # it moved


@pytest.mark.parametrize("name", ["mujoco", "mjx"])
def test_step_is_pure(engine, wall_distance, name):
    """The result does not depend on earlier steps or on other robots in the batch."""
    maze = make_maze(LARGE)
    state, other = (starts(seed, LARGE, wall_distance, speed=3.0) for seed in (1, 2))
    ctrl = pushes(1, 1)[0]
    first = step(engine(name), maze, state, ctrl)
    step(engine(name), maze, other, -ctrl)
    again = step(engine(name), maze, state, ctrl)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    order = np.random.default_rng(0).permutation(N)
    shuffled = step(engine(name), maze, jax.tree.map(lambda leaf: leaf[order], state), ctrl[order])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[order], b, atol=1e-6), first, shuffled)


def test_nested_vmap_is_one_flat_batch(engine, wall_distance):
    maze = make_maze(LARGE)
    state, ctrl = starts(3, LARGE, wall_distance, speed=3.0), pushes(3, 1)[0]
    inputs = (state, ctrl, boxes_at(maze, state.qpos))
    grid = jax.tree.map(lambda leaf: leaf.reshape(4, N // 4, *leaf.shape[1:]), inputs)
    flat = step(engine("mujoco"), maze, state, ctrl)
    nested = jax.jit(jax.vmap(jax.vmap(engine("mujoco").step)))(*grid)[0]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b.reshape(a.shape), atol=1e-6), flat, nested)
    one = jax.jit(engine("mujoco").step)(*jax.tree.map(lambda leaf: leaf[0], inputs))[0]  # a batch of one
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[0], b, atol=1e-6), flat, one)
    shapes = jax.eval_shape(jax.vmap(jax.vmap(engine("mjx").step)), *grid)[0]
    jax.tree.map(lambda a, b: np.testing.assert_equal(a.shape, b.shape), shapes, nested)


@pytest.mark.parametrize("name", ["mujoco", "mjx"])
@pytest.mark.parametrize("what", ["qpos", "qvel", "qacc_warmstart", "ctrl"])
def test_nan_does_not_spread_to_other_robots(engine, wall_distance, monkeypatch, tmp_path, name, what):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning there
    maze = make_maze(LARGE)
    state, ctrl = starts(4, LARGE, wall_distance, speed=3.0), pushes(4, 1)[0]
    clean = step(engine(name), maze, state, ctrl)
    sick = np.arange(N) % 5 == 2
    poison = lambda leaf: jnp.where(sick[:, None], jnp.nan, leaf)  # noqa: E731
    bad = state if what == "ctrl" else state.replace(**{what: poison(getattr(state, what))})
    after = step(engine(name), maze, bad, poison(ctrl) if what == "ctrl" else ctrl)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[~sick], b[~sick]), clean, after)
    if what in ("qpos", "qvel"):
        assert not np.isfinite(np.asarray(after.qpos)[sick]).all(-1).any()
    healed = step(engine(name), maze, state, ctrl)  # the engine keeps no NaN
    jax.tree.map(np.testing.assert_array_equal, clean, healed)


def test_engine_names(engine):
    assert make_engine("auto", POINT).name == ("mujoco" if jax.default_backend() == "cpu" else "mjx")
    assert [engine(name).name for name in ("mjx", "mujoco")] == ["mjx", "mujoco"]
    with pytest.raises(UserError) as refusal:
        make_engine("bullet", POINT)
    assert not [name for name in ENGINES if name not in str(refusal.value)]
    assert "\n" not in str(refusal.value)


def test_control_step_has_duration_of_robot(engine):
    for name in ("mjx", "mujoco"):
        seconds = engine(name).n_substeps * engine(name).model.opt.timestep
        assert seconds == pytest.approx(POINT.control_dt_s)


# ------------------------------------------------------------------------------------------------------ walls


@given(st.integers(0, 2**31 - 1), st.sampled_from([2.2, 4.0, 7.0]))
@settings(max_examples=30)
def test_boxes_cover_all_walls_within_reach(seed, cell_m):
    """For robots in free cells, all walls within reach have a box, and all boxes are on walls."""
    walls = random_walls(seed, height=12, width=12, density=0.6)
    maze = make_maze(walls, cell_m=cell_m)
    rng = np.random.default_rng(seed)
    free = np.argwhere(~walls)
    points = np.float32((free[rng.integers(len(free), size=128)][:, ::-1] + rng.random((128, 2))) * cell_m)
    reach = POINT.touch_m + POINT.top_speed_mps * POINT.control_dt_s
    boxes = np.asarray(boxes_at(maze, points))
    for row, column in np.argwhere(walls):
        centre = (np.array([column, row]) + 0.5) * cell_m
        beyond = np.maximum(np.abs(points - centre) - cell_m / 2, 0.0)
        touchable = np.hypot(*beyond.T) < reach - 1e-4
        there = (np.abs(boxes[..., :2] - centre).max(-1) < 1e-3) & (boxes[..., 2] > 0)
        assert there.any(-1)[touchable].all()
    up = boxes[boxes[..., 2] > 0]
    row, column = np.floor(up[:, 1] / cell_m).astype(int), np.floor(up[:, 0] / cell_m).astype(int)
    assert walls[row, column].all()
    assert (boxes[..., 2][boxes[..., 2] <= 0] < -100).all()


def test_moved_boxes_equal_model_with_all_walls(engine, wall_distance):
    """Single steps from the same states, along random drives near walls; then whole drives.

    A step differs by the rounding of its state to float32 (4e-6 m at 40 m). Whole drives may differ only where a robot
    hits a corner head-on, because rounding decides the side.
    """
    length, substeps = 300, engine("mujoco").n_substeps
    model = static_model(POINT, LARGE.tobytes(), *LARGE.shape)
    assert model.ngeom == LARGE.sum() + build_model(POINT).ngeom - build_model(POINT).nmocap
    batch = Batch(model, nsim=N, nthread=1)
    names = ("qpos", "qvel", "qacc_warmstart", "ctrl")
    truth = {name: batch.bind(name) for name in names}
    maze, ctrls = make_maze(LARGE), pushes(5, length)
    state = starts(5, LARGE, wall_distance, speed=3.0)
    whole = np.asarray(drive(engine("mujoco"), maze, state, ctrls).qpos)
    for name in names[:3]:
        truth[name][:] = np.asarray(getattr(state, name))
    path, contacts = [], 0
    for ctrl in ctrls:
        now = PhysicsState(*(jnp.asarray(truth[name], jnp.float32) for name in names[:3]))
        moved = step(engine("mujoco"), maze, now, ctrl)
        truth["ctrl"][:] = np.asarray(ctrl)
        batch.step(nstep=substeps)
        np.testing.assert_allclose(moved.qpos, truth["qpos"], atol=2e-5)
        np.testing.assert_allclose(moved.qvel, truth["qvel"], atol=1e-4)
        path.append(truth["qpos"].copy())
        contacts += (wall_distance(LARGE, path[-1]) < 0.5).sum()
    assert contacts > 0.2 * length * N
    apart = np.abs(np.stack(path) - whole).max((0, 2))
    assert np.median(apart) < 1e-3 and (apart < 1e-2).mean() > 0.9


@pytest.mark.parametrize("name", ["antmaze-large", "hall", "unseen-rooms"])
def test_point_never_passes_through_wall(engine, wall_distance, name):
    """Full throttle along both axes, from starts near walls at top speed. Walls yield by centimetres."""
    walls = load_walls(name)
    maze = load_maze(name)
    diagonal = jnp.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [1, 0], [-1, 0], [0, 1], [0, -1]], jnp.float32)
    for seed in range(4):
        state = starts(seed, walls, wall_distance, speed=POINT.top_speed_mps)
        direction = diagonal[np.random.default_rng(seed).integers(len(diagonal), size=N)]
        after = drive(engine("mujoco"), maze, state, jnp.broadcast_to(direction, (60, N, 2)))
        position = np.concatenate([np.asarray(state.qpos)[None], np.asarray(after.qpos)])
        assert wall_distance(walls, position).min() > 0.35  # so the centre is never inside a wall
        moved = np.linalg.norm(np.diff(position, axis=0), axis=-1)
        assert moved.max() <= POINT.top_speed_mps * POINT.control_dt_s + 1e-4
        assert (wall_distance(walls, position[-1]) < 0.52).mean() > 0.5  # the walls were reached


def test_too_small_cells_are_error():
    for robot in (POINT, dataclasses.replace(POINT, touch_m=0.53), dataclasses.replace(POINT, top_speed_mps=9.1)):
        least = 2 * (robot.touch_m + robot.top_speed_mps * robot.control_dt_s)
        with pytest.raises(UserError) as refusal:
            build_model(robot, cell_m=0.98 * least)
        message = str(refusal.value)
        assert robot.name in message and "\n" not in message
        enough = float(message.split("at least ")[1].removesuffix(" m"))
        assert least <= enough + 1e-9 and enough < least + 0.11
        build_model(robot, cell_m=enough)  # the suggested size works


def test_model_of_point_matches_its_data():
    model = mujoco.MjModel.from_xml_string(model_xml(POINT))
    assert model.geom("ball").size[0] == POINT.radius_m == POINT.touch_m
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.0
    for _ in range(200):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qvel, 4.0, rtol=0.01)  # the motors against the drag
    assert np.linalg.norm(data.qvel) < POINT.top_speed_mps
