"""The local occupancy map, against a plain loop over its cells and under the symmetries of the square."""

import functools

import jax
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ct_envs import load_maze, make_maze, random_walls
from ct_envs.occupancy import MAP_CELLS, local_map

SEEDS = st.integers(0, 2**31 - 1)
CELLS = st.sampled_from([0.08, 0.8, 1.3])  # the second is our setting, the first the Turtlebot3's
WORLDS = st.builds(lambda seed: random_walls(seed, height=9, width=12, density=0.7), SEEDS)


@functools.partial(jax.jit, static_argnames="cells")
def draw(walls_maze, position, goal, cell_m, cells=MAP_CELLS):
    return local_map(walls_maze, position, goal, cell_m=cell_m, cells=cells)


def naive(walls: np.ndarray, position, goal, cell_m: float, cells: int = MAP_CELLS) -> np.ndarray:
    """The same map, cell after cell, from the words of the docstring."""
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
    """A position anywhere and a goal near its window, such that no point of the map is on a cell's border."""
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
def test_the_map_is_what_a_plain_loop_draws(walls, seed, cell_m):
    position, goal = draw_pose(seed, walls, cell_m)
    picture = draw(make_maze(walls), position, goal, np.float32(cell_m))
    np.testing.assert_array_equal(picture, naive(walls, position, goal, cell_m))


@given(WORLDS, SEEDS, CELLS)
@settings(max_examples=40)
def test_the_goal_is_one_cell_just_when_the_window_holds_it(walls, seed, cell_m):
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
def test_the_map_turns_with_the_world(flip_x, flip_y, transpose, walls, seed, cell_m):
    """The 8 symmetries of the square: the map of the image is the image of the map."""

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
def test_the_number_of_cells_crops_the_window(walls, seed):
    position, goal = draw_pose(seed, walls, 0.8)
    full = np.asarray(draw(make_maze(walls), position, goal, np.float32(0.8)))
    small = draw(make_maze(walls), position, goal, np.float32(0.8), cells=9)
    np.testing.assert_array_equal(small, full[:, 8:17, 8:17])


@given(SEEDS)
@settings(max_examples=10)
def test_the_cell_size_scales_the_window(seed):
    """A world twice as large through cells twice as large looks the same."""
    walls = random_walls(seed)
    position, goal = draw_pose(seed, walls, 0.8)
    one = draw(make_maze(walls, cell_m=4.0), position, goal, np.float32(0.8))
    two = draw(make_maze(walls, cell_m=8.0), 2 * position, 2 * goal, np.float32(1.6))
    np.testing.assert_array_equal(one, two)


def test_maps_are_small_arrays_of_zeros_and_ones():
    picture = np.asarray(draw(load_maze("hall"), np.float32([6, 6]), np.float32([7, 7]), np.float32(0.8)))
    assert picture.shape == (2, MAP_CELLS, MAP_CELLS) == (2, 25, 25)
    assert picture.dtype == np.uint8
    assert set(np.unique(picture)) == {0, 1}
    assert picture[0, 12, 12] == 0
