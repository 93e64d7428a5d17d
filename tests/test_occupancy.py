"""The local occupancy map, compared with a plain loop over its cells, and under the symmetries of the square."""

import functools

import jax
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ct_envs import UserError, load_maze, make_maze, random_walls
from ct_envs.occupancy import LIDAR_BEAMS, LIDAR_CELL_M, MAP_CELLS, lidar_map, local_map

SEEDS = st.integers(0, 2**31 - 1)
CELLS = st.sampled_from([0.08, 0.8, 1.3])  # the first is that of the Turtlebot3, the second that of the mazes
WORLDS = st.builds(lambda seed: random_walls(seed, height=9, width=12, density=0.7), SEEDS)


@functools.partial(jax.jit, static_argnames="cells")
def draw(walls_maze, position, goal, cell_m, cells=MAP_CELLS):
    return local_map(walls_maze, position, goal, cell_m=cell_m, cells=cells)


def naive(walls: np.ndarray, position, goal, cell_m: float, cells: int = MAP_CELLS) -> np.ndarray:
    """The same map, computed cell by cell from the definition in the docstring."""
    picture = np.zeros((2, cells, cells))
    for i in range(cells):
        for j in range(cells):
            x = position[0] + (j - (cells - 1) / 2) * cell_m
            y = position[1] + (i - (cells - 1) / 2) * cell_m
            row, column = int(np.floor(y / 4.0)), int(np.floor(x / 4.0))
            inside = 0 <= row < walls.shape[0] and 0 <= column < walls.shape[1]
            picture[0, i, j] = not inside or walls[row, column]
            picture[1, i, j] = max(abs(goal[0] - x), abs(goal[1] - y)) < cell_m / 2
    return picture


def draw_pose(seed: int, walls: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A random position, and a goal near its window. No point of the map is on the border of a cell."""
    rng = np.random.default_rng(seed)
    position = rng.random(2) * np.array(walls.shape[::-1]) * 4.0
    goal = position + rng.uniform(-0.7, 0.7, 2) * MAP_CELLS * cell_m
    ticks = position[:, None] + (np.arange(MAP_CELLS) - (MAP_CELLS - 1) / 2) * cell_m
    assume(np.abs(ticks / 4.0 - np.round(ticks / 4.0)).min() > 1e-5)
    halves = (goal - position) / cell_m + 0.5
    assume(np.abs(halves - np.round(halves)).min() > 1e-4)
    return np.float32(position), np.float32(goal)


@given(WORLDS, SEEDS, CELLS)
@settings(max_examples=40)
def test_map_equals_plain_loop(walls, seed, cell_m):
    position, goal = draw_pose(seed, walls, cell_m)
    picture = draw(make_maze(walls), position, goal, np.float32(cell_m))
    np.testing.assert_array_equal(picture, naive(walls, position, goal, cell_m))


@given(WORLDS, SEEDS, CELLS)
@settings(max_examples=40)
def test_goal_is_one_cell_if_inside_window(walls, seed, cell_m):
    position, goal = draw_pose(seed, walls, cell_m)
    channel = np.asarray(draw(make_maze(walls), position, goal, np.float32(cell_m)))[1]
    held = np.abs(goal - position).max() < MAP_CELLS * cell_m / 2
    assert channel.sum() == held
    if held:
        i, j = np.argwhere(channel)[0]
        place = position + (np.array([j, i]) - (MAP_CELLS - 1) / 2) * cell_m
        assert np.abs(place - goal).max() <= cell_m / 2 + 1e-4


@pytest.mark.parametrize("transpose", [False, True])
@pytest.mark.parametrize("flip_y", [False, True])
@pytest.mark.parametrize("flip_x", [False, True])
@given(WORLDS, SEEDS, CELLS)
@settings(max_examples=10)
def test_map_is_equivariant(flip_x, flip_y, transpose, walls, seed, cell_m):
    """For the 8 symmetries of the square: the map of the transformed world is the transformed map."""

    def image(grid: np.ndarray) -> np.ndarray:
        grid = grid[..., :: -1 if flip_y else 1, :: -1 if flip_x else 1]
        return np.swapaxes(grid, -1, -2) if transpose else grid

    def move(point: np.ndarray) -> np.ndarray:
        size = np.float32(np.array(walls.shape[::-1]) * 4.0)
        point = np.where([flip_x, flip_y], size - point, point)
        return point[::-1] if transpose else point

    position, goal = draw_pose(seed, walls, cell_m)
    here = draw(make_maze(walls), position, goal, np.float32(cell_m))
    there = draw(make_maze(image(walls)), move(position), move(goal), np.float32(cell_m))
    np.testing.assert_array_equal(there, image(np.asarray(here)))


@given(WORLDS, SEEDS)
@settings(max_examples=10)
def test_number_of_cells_crops_window(walls, seed):
    position, goal = draw_pose(seed, walls, 0.8)
    full = np.asarray(draw(make_maze(walls), position, goal, np.float32(0.8)))
    small = draw(make_maze(walls), position, goal, np.float32(0.8), cells=9)
    np.testing.assert_array_equal(small, full[:, 8:17, 8:17])


@given(SEEDS)
@settings(max_examples=10)
def test_cell_size_scales_window(seed):
    """A world twice as large, with cells twice as large, gives the same map."""
    walls = random_walls(seed)
    position, goal = draw_pose(seed, walls, 0.8)
    one = draw(make_maze(walls, cell_m=4.0), position, goal, np.float32(0.8))
    two = draw(make_maze(walls, cell_m=8.0), 2 * position, 2 * goal, np.float32(1.6))
    np.testing.assert_array_equal(one, two)


def test_maps_are_uint8_zeros_and_ones():
    picture = np.asarray(draw(load_maze("hall"), np.float32([6, 6]), np.float32([7, 7]), np.float32(0.8)))
    assert picture.shape == (2, MAP_CELLS, MAP_CELLS) == (2, 25, 25)
    assert picture.dtype == np.uint8
    assert set(np.unique(picture)) == {0, 1}
    assert picture[0, 12, 12] == 0


# ------------------------------------------------------------------------------------------------------- lidar


def draw_ranges(seed: int) -> np.ndarray:
    """Random ranges; half of them are below 1 m. No beam ends near the border of a cell."""
    ranges = np.random.default_rng(seed).uniform(0.1, 1.9, LIDAR_BEAMS)
    angle = np.radians(np.arange(LIDAR_BEAMS))
    ticks = ranges[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1) / LIDAR_CELL_M + 0.5
    near = (np.abs(ticks - np.round(ticks)) < 1e-6).any(-1)
    return np.where(near, 1.5, ranges)


@given(SEEDS)
@settings(max_examples=20)
def test_lidar_marks_exactly_the_end_cells_of_beams(seed):
    ranges = draw_ranges(seed)
    angle = np.radians(np.arange(LIDAR_BEAMS))
    expected = np.zeros((MAP_CELLS, MAP_CELLS), np.uint8)
    ticks = (np.arange(MAP_CELLS) - 12) * LIDAR_CELL_M
    for distance, a in zip(ranges, angle, strict=True):
        if distance < 1.0:
            x, y = distance * np.cos(a), distance * np.sin(a)
            expected[np.abs(ticks - y).argmin(), np.abs(ticks - x).argmin()] = 1
    np.testing.assert_array_equal(lidar_map(ranges, [3.0, 0.0])[0], expected)


@given(SEEDS, st.integers(0, 3))
@settings(max_examples=20)
def test_lidar_map_is_equivariant_to_rotation(seed, quarters):
    """A rotation of the beams or of the robot by a quarter turn rotates the map by a quarter turn."""
    ranges, goal = draw_ranges(seed), np.random.default_rng(seed).uniform(-0.9, 0.9, 2)
    here = lidar_map(ranges, goal)
    a = quarters * np.pi / 2
    turned_goal = np.round([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ goal
    turned = np.rot90(here, -quarters, axes=(1, 2))
    np.testing.assert_array_equal(lidar_map(np.roll(ranges, 90 * quarters), turned_goal), turned)
    np.testing.assert_array_equal(lidar_map(ranges, turned_goal, yaw_rad=a), turned)


@given(SEEDS)
@settings(max_examples=20)
def test_lidar_map_is_equivariant_to_reflection(seed):
    ranges, goal = draw_ranges(seed), np.random.default_rng(seed).uniform(-0.9, 0.9, 2)
    mirrored = lidar_map(np.roll(ranges[::-1], 1), goal * [1, -1])
    np.testing.assert_array_equal(mirrored, lidar_map(ranges, goal)[:, ::-1])


@given(SEEDS)
@settings(max_examples=10)
def test_batch_of_lidars_equals_single_ones(seed):
    ranges = np.stack([draw_ranges(seed + i) for i in range(6)]).reshape(2, 3, LIDAR_BEAMS)
    rng = np.random.default_rng(seed)
    goal, yaw = rng.uniform(-1.2, 1.2, (2, 3, 2)), rng.uniform(-3, 3, (2, 3))
    together = lidar_map(ranges, goal, yaw_rad=yaw)
    for i in np.ndindex(2, 3):
        np.testing.assert_array_equal(together[i], lidar_map(ranges[i], goal[i], yaw_rad=yaw[i]))
    assert together.dtype == np.uint8 and together.shape == (2, 3, 2, 25, 25)


@given(SEEDS)
@settings(max_examples=20)
def test_both_maps_have_same_goal_cell(seed):
    goal = np.random.default_rng(seed).uniform(-1.2, 1.2, 2)
    halves = goal / LIDAR_CELL_M + 0.5
    assume(np.abs(halves - np.round(halves)).min() > 1e-3)
    far = np.float32([50.0, 50.0])  # in an empty room
    maze = make_maze(random_walls(0, height=30, width=30, density=0.0))
    drawn = draw(maze, far, far + np.float32(goal), np.float32(LIDAR_CELL_M))
    np.testing.assert_array_equal(lidar_map(np.full(LIDAR_BEAMS, 3.5), goal), drawn)


def with_beam(value: float) -> np.ndarray:
    return np.where(np.arange(LIDAR_BEAMS) == 17, value, 0.5)


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        (with_beam(np.nan), "beam 17"),
        (with_beam(np.inf), "beam 17"),
        (with_beam(0.0), "beam 17"),
        (with_beam(-0.3), "beam 17"),
        (np.ones(359), "359 ranges, not 360"),
        (np.ones(361), "361 ranges, not 360"),
        ([], "0 ranges"),
        (0.5, "no list of ranges"),
    ],
)
def test_wrong_lidar_ranges_are_error_of_one_line(ranges, words):
    with pytest.raises(UserError, match=words) as caught:
        lidar_map(ranges, [1.0, 0.0])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_missing_beams_can_be_allowed(value):
    nothing = lidar_map(with_beam(1.0), [1.0, 0.0])
    np.testing.assert_array_equal(lidar_map(with_beam(value), [1.0, 0.0], missing_ok=True), nothing)
    with pytest.raises(UserError):
        lidar_map(with_beam(-0.1), [1.0, 0.0], missing_ok=True)
