"""The explorer: it arrives in mazes it does not know, and knows no more than its maps showed."""

import functools

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ct_envs import Maze, make_maze, random_walls
from ct_envs.maze import load_walls, sample_pair
from ct_envs.occupancy import MAP_CELLS, local_map
from ct_jax.guides.explorer import ExplorerGuide, Seen, path_lengths
from ct_jax.types import Frame, Observation, Privileged

RADIUS, MAP_CELL = 0.5, 0.8
GUIDE = ExplorerGuide(RADIUS, MAP_CELL, 4.0)
NAMES = ["antmaze-large", "antmaze-large-eval", "unseen-spiral"] * 12
N, SHAPE, LENGTH = len(NAMES), (12, 24), 25  # of all walks, so that they share a program
SEEDS = st.integers(0, 2**31 - 1)


def frame_of(mazes, position, goal):
    """What the explorer sees at positions [N, 2] (m)."""
    n = len(position)
    seen = Observation(None, jnp.zeros((n, 2)), goal - position)
    return Frame(seen, jnp.zeros(n), jnp.zeros(n, bool), Privileged(position, goal, jnp.zeros(n), mazes))


@jax.jit
def ask(seen, mazes, position, goal):
    """Waypoints [N, 2] in the world (m), and what is seen."""
    vector, seen = GUIDE.waypoint(seen, frame_of(mazes, position, goal))
    return position + vector, seen


def unseen(mazes):
    """The memory before anything is seen."""
    start = jnp.zeros((len(mazes.walls), 2))
    return GUIDE.init(frame_of(mazes, start, start))


@jax.jit
def walk(mazes, position, seen, goal):
    """LENGTH steps of 0.3 m to where the explorer says: the end, what was seen, the way there [T, N, 2]."""

    def once(carry, _):
        position, seen = carry
        away, seen = GUIDE.waypoint(seen, frame_of(mazes, position, goal))
        far = jnp.linalg.norm(away, axis=-1, keepdims=True)
        return (position + away * jnp.minimum(1.0, 0.3 / jnp.maximum(far, 1e-6)), seen), position

    (position, seen), path = jax.lax.scan(once, (position, seen), length=LENGTH)
    return position, seen, path


@jax.jit
def draw_ends(key, mazes):
    """Starts and goals [N, 2] of N mazes."""
    return jax.vmap(functools.partial(sample_pair, radius=RADIUS))(jax.random.split(key, N), mazes)


def stack(grids) -> Maze:
    mazes = [make_maze(grid, shape=SHAPE) for grid in grids]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *mazes)


def test_it_reaches_random_goals_in_mazes_it_does_not_know(wall_distance):
    mazes = stack(load_walls(name) for name in NAMES)
    position, goal = draw_ends(jax.random.key(0), mazes)
    seen, parts = unseen(mazes), []
    for _ in range(32):
        position, seen, path = walk(mazes, position, seen, goal)
        parts.append(path)
    away = np.linalg.norm(position - goal, axis=-1)
    assert not [name for name, distance in zip(NAMES, away, strict=True) if distance > 0.1]
    for i, name in enumerate(NAMES[:12]):
        assert wall_distance(load_walls(name), np.concatenate(parts)[:, i]).min() > 0.7 * RADIUS


@pytest.mark.parametrize("name", NAMES[:3])
def test_it_never_says_to_stay_short_of_the_goal(name):
    """From the middle of every free cell: the next cell's way to the goal is then just as long, by a tie."""
    walls = load_walls(name)
    centres = np.float32((np.argwhere(~walls)[:, ::-1] + 0.5) * 4.0)
    for i in range(0, len(centres), N):
        position = np.resize(centres[i : i + N], (N, 2))
        goal = np.broadcast_to(centres[-1] + np.float32([0.7, -0.3]), (N, 2))
        mazes = stack([walls] * N)
        target, _ = ask(Seen(jnp.ones((N, *SHAPE), bool)), mazes, position, goal)
        assert (np.linalg.norm(target - position, axis=-1) > 0.5).all()


def cells_shown(path: np.ndarray) -> np.ndarray:
    """Cells [H, W] that hold a point of a local map along a path [T, 2], by the words of its docstring."""
    ticks = (np.arange(MAP_CELLS) - (MAP_CELLS - 1) / 2) * MAP_CELL
    shown = np.zeros(SHAPE, bool)
    for point in np.asarray(path):
        columns, rows = (np.unique(np.floor((at + ticks) / 4.0).astype(int)) for at in point)
        columns, rows = columns[(columns >= 0) & (columns < SHAPE[1])], rows[(rows >= 0) & (rows < SHAPE[0])]
        shown[np.ix_(rows, columns)] = True
    return shown


@jax.jit
def maps_along(mazes, path):
    one = functools.partial(local_map, cell_m=MAP_CELL)
    return jax.vmap(jax.vmap(one), (None, 0, 0))(mazes, path, path)


@given(SEEDS)
@settings(max_examples=3)
def test_what_no_map_showed_changes_nothing(seed):
    """Walls flipped at random where no map along the way held a point: the way is the same, to the bit."""
    rng = np.random.default_rng(seed)
    mazes = stack(random_walls(seed + i, density=0.9) for i in range(N))
    start, goal = draw_ends(jax.random.key(seed), mazes)
    _, seen, path = walk(mazes, start, unseen(mazes), goal)
    shown = np.stack([cells_shown(path[:, i]) for i in range(N)])
    np.testing.assert_array_equal(seen.cells, shown)

    walls = np.asarray(mazes.walls)
    flipped = walls ^ (~shown & (rng.random(walls.shape) < 0.5))
    assert (flipped[..., :9, :12] != walls[..., :9, :12]).any()
    other = mazes.replace(walls=jnp.asarray(flipped))
    np.testing.assert_array_equal(walk(other, start, unseen(mazes), goal)[2], path)
    np.testing.assert_array_equal(maps_along(mazes, path), maps_along(other, path))


def test_what_a_map_showed_counts():
    """The goal is straight ahead: it heads there, unless a wall between is in its maps; it remembers that."""
    walls = np.ones((7, 24), bool)
    walls[1:-1, 1:-1] = False
    walled = walls.copy()
    walled[2:-1, 5] = True
    free, blocked = stack([walls] * N), stack([walled] * N)
    here, goal, far = (jnp.tile(jnp.array([[x, 18.0]]), (N, 1)) for x in (18.0, 26.0, 80.0))
    target, _ = ask(unseen(free), free, here, goal)
    np.testing.assert_allclose(target, goal, atol=1e-5)
    target, seen = ask(unseen(blocked), blocked, here, goal)
    assert (target[:, 1] < 18.0).all()  # down, to the gap
    for memory in (seen, unseen(blocked)):
        _, later = ask(memory, blocked, far, goal)
        assert (later.cells[:, 4, 5] == (memory is seen)).all()


@given(SEEDS)
@settings(max_examples=15)
def testpath_lengths_are_the_shortest_ways_over_free_cells(seed):
    rng = np.random.default_rng(seed)
    grids = [random_walls(seed + i, density=0.9) & (rng.random((9, 12)) < 0.95) for i in range(4)]
    mazes = stack(np.pad(grid[1:-1, 1:-1], 1, constant_values=True) for grid in grids)
    cells = np.stack([rng.choice(np.argwhere(~walls)) for walls in np.asarray(mazes.walls)])
    goals = np.float32((cells[:, ::-1] + rng.uniform(0.13, 0.87, (4, 2))) * 4.0)
    distances = np.asarray(jax.jit(path_lengths)(mazes, goals))
    for walls, cell, goal, found in zip(np.asarray(mazes.walls), cells, goals, distances, strict=True):
        graph = nx.grid_2d_graph(*walls.shape)
        graph.remove_nodes_from(map(tuple, np.argwhere(walls)))
        steps = nx.single_source_shortest_path_length(graph, tuple(cell))
        last = np.linalg.norm((cell[::-1] + 0.5) * 4.0 - goal)
        expected = np.full(walls.shape, np.inf)
        for node, count in steps.items():
            expected[node] = 4.0 * count + last
        np.testing.assert_allclose(found, expected, rtol=1e-5)
