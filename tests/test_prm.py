"""Roadmaps: edges and plans are free, the table has shortest paths, and guides lead to the goal."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ct_envs import UserError, load_maze, make_maze, random_walls, stack_mazes
from ct_envs.maze import load_walls, parse_walls
from ct_envs.turtlebot3 import RADIUS_M
from ct_envs.turtlebot3_world import random_world
from ct_jax.guides.roadmap import RoadmapGuide
from ct_jax.prm import (
    NO_HOP,
    NoPath,
    Path,
    PlanTable,
    PrmConfig,
    build_roadmap,
    draw_joined,
    extend,
    joins,
    stack_tables,
)
from ct_jax.types import Frame, Observation, Privileged

RADIUS = 0.5
SMALL = PrmConfig(samples=60, most_samples=60)
TWO_ROOMS = parse_walls("#########\n#...#...#\n#...#...#\n#########")
SEEDS = st.integers(0, 2**31 - 1)


@functools.cache
def roadmap_of(name: str, config: PrmConfig = SMALL, seed: int = 0):
    return build_roadmap(jax.random.key(seed), load_maze(name), radius_m=RADIUS, config=config)


def two_rooms():
    return build_roadmap(jax.random.key(0), make_maze(TWO_ROOMS), radius_m=RADIUS, config=SMALL)


def segment_clearances(wall_distance, walls, a, b) -> np.ndarray:
    """Distance [m] from segments to the nearest wall, computed at samples; at most 2 cm too large."""
    share = np.linspace(0, 1, 301)[:, None, None]
    return wall_distance(walls, a + share * (b - a)).min(0)


# ------------------------------------------------------------------------------------- how many points there are

HALL = np.pad(np.zeros((28, 58), bool), 1, constant_values=True)  # 240 m x 120 m, empty
COILS = random_walls(5, height=33, width=33, loops=0.0)


def corners(walls: np.ndarray, n: int) -> np.ndarray:
    """n starts and goals [n, 2, 2] (m) of a maze, some of them far apart."""
    free = (np.argwhere(~walls)[:, ::-1] + 0.5) * 4.0
    ends = np.linspace(0, len(free) - 1, 2 * n).astype(int)
    return np.stack([free[ends[:n]], free[ends[::-1][:n]]], 1)


@pytest.mark.parametrize("walls", [HALL, COILS], ids=["an empty hall", "a maze of 33 x 33 cells"])
def test_roadmap_grows_until_starts_and_goals_are_connected(walls):
    maze, ends = make_maze(walls), corners(walls, 12)
    few = build_roadmap(jax.random.key(0), maze, radius_m=RADIUS, config=PrmConfig(most_samples=200))
    assert few.samples == 200 and not joins(few, ends).all()
    grown = build_roadmap(jax.random.key(0), maze, radius_m=RADIUS, ends=ends)
    assert joins(grown, ends).all()
    np.testing.assert_array_equal(grown.points[:200], few.points)
    halved = build_roadmap(jax.random.key(0), maze, radius_m=RADIUS, config=PrmConfig(most_samples=grown.samples // 2))
    assert not joins(halved, ends).all()  # half as many samples are not enough


def test_roadmap_without_pairs_connects_most_points():
    roadmap = build_roadmap(jax.random.key(0), make_maze(HALL), radius_m=RADIUS)
    largest = max(nx.connected_components(roadmap.graph), key=len)
    assert len(largest) ** 2 >= 0.4 * len(roadmap.points) ** 2


@pytest.mark.parametrize("name", ["antmaze-large", "antmaze-large-eval", "hall"])
@pytest.mark.parametrize("seed", range(4))
def test_published_number_of_samples_suffices_in_published_mazes(name, seed):
    assert roadmap_of(name, PrmConfig(), seed).samples == 200


def test_separate_regions_do_not_need_more_points():
    ends = np.array([[[6.0, 6.0], [30.0, 6.0]]])  # in different rooms
    roadmap = build_roadmap(jax.random.key(0), make_maze(TWO_ROOMS), radius_m=RADIUS, config=PrmConfig(60), ends=ends)
    assert roadmap.samples == 60 and not joins(roadmap, ends).any()


@pytest.mark.parametrize("roadmap", [two_rooms, lambda: roadmap_of("antmaze-large", PrmConfig(samples=40))])
def test_connected_pairs_are_drawn_uniformly(roadmap):
    roadmap = roadmap()
    pairs = draw_joined(jax.random.key(3), roadmap, 60_000)
    possible = {(i, j) for part in nx.connected_components(roadmap.graph) for i in part for j in part if i != j}
    found, count = np.unique(pairs, axis=0, return_counts=True)
    assert {tuple(pair) for pair in found.tolist()} == possible
    assert stats.chisquare(count).pvalue > 1e-4


def test_large_roadmap_has_table_of_its_goals_only():
    roadmap = build_roadmap(
        jax.random.key(0), make_maze(HALL), radius_m=RADIUS, config=PrmConfig(samples=2100, connect_m=6.0)
    )
    goals = np.array([17, 1500, 17])
    table = roadmap.table_to(goals)
    assert table.next_hop.shape == (2100, 2)
    for column, goal in enumerate(table.goal.tolist()):
        length = nx.single_source_dijkstra_path_length(roadmap.graph, goal)
        expected = [length.get(i, np.inf) for i in range(2100)]
        np.testing.assert_allclose(table.distance[:, column], expected, rtol=1e-5)
        assert (np.asarray(table.next_hop[:, column]) == NO_HOP).tolist() == np.isinf(expected).tolist()
        at = 3
        for _ in range(2100):
            at = int(table.next_hop[at, column])
            if at in (goal, NO_HOP):
                break
        assert at == (goal if np.isfinite(expected[3]) else NO_HOP)


# ------------------------------------------------------------------------------------------- points and edges


@given(SEEDS, st.sampled_from([0.0, 0.4]))
@settings(max_examples=5)
def test_edges_are_exactly_the_free_pairs_within_reach(wall_distance, seed, margin_m):
    walls = random_walls(seed, density=0.8)
    config = PrmConfig(samples=50, connect_m=9.0, margin_m=margin_m, most_samples=50)
    roadmap = build_roadmap(jax.random.key(seed), make_maze(walls), radius_m=RADIUS, config=config)
    clear = RADIUS + margin_m
    assert roadmap.points.shape == (50, 2)
    assert (wall_distance(walls, roadmap.points) >= clear - 1e-5).all()

    pairs = np.stack(np.triu_indices(50, 1), -1)
    a, b = roadmap.points[pairs].swapaxes(0, 1)
    near = np.linalg.norm(a - b, axis=-1) <= config.connect_m
    edges = set(map(tuple, roadmap.edges.tolist()))
    joined = np.array([tuple(pair) in edges for pair in pairs.tolist()])
    assert joined.sum() == len(roadmap.edges) == roadmap.graph.number_of_edges()
    assert near[joined].all()
    room = segment_clearances(wall_distance, walls, a[near], b[near])
    assert (room[joined[near]] >= clear - 1e-4).all()
    assert joined[near][room > clear + 0.02].all()


def test_graph_has_edges_with_lengths():
    roadmap = roadmap_of("antmaze-large")
    assert isinstance(roadmap.graph, nx.Graph) and not roadmap.graph.is_directed()
    assert list(roadmap.graph) == list(range(SMALL.samples))
    assert (roadmap.edges[:, 0] < roadmap.edges[:, 1]).all()
    for i, j in roadmap.edges:
        length = np.linalg.norm(roadmap.points[i] - roadmap.points[j])
        assert roadmap.graph[i][j]["weight"] == roadmap.graph[j][i]["weight"] == pytest.approx(length, rel=1e-6)


def test_points_are_uniform_over_free_area(wall_distance):
    """The number of points in each quarter of a cell matches its free area."""
    walls = load_walls("antmaze-umaze")
    config = PrmConfig(samples=4000, connect_m=0.01)
    points = build_roadmap(jax.random.key(0), make_maze(walls), radius_m=RADIUS, config=config).points
    bins = [np.arange(0, side * 4.0 + 1, 2.0) for side in walls.shape[::-1]]
    counted = np.histogram2d(*points.T, bins)[0]
    ticks = [np.arange(0, side * 4.0, 0.05) + 0.025 for side in walls.shape[::-1]]
    grid = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, 2)
    area = np.histogram2d(*grid[wall_distance(walls, grid) >= RADIUS].T, bins)[0]
    assert counted[area == 0].sum() == 0
    expected = area[area > 0] / area.sum() * len(points)
    assert stats.chisquare(counted[area > 0], expected).pvalue > 1e-4


def test_roadmap_is_deterministic():
    one, again, other = (
        build_roadmap(jax.random.key(seed), load_maze("antmaze-large"), radius_m=RADIUS, config=SMALL)
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(one.points, again.points)
    np.testing.assert_array_equal(one.edges, again.edges)
    assert (one.points != other.points).any()


def test_extension_keeps_points_and_edges(wall_distance):
    roadmap = roadmap_of("antmaze-large", PrmConfig(samples=60, margin_m=0.5))
    further = roadmap_of("antmaze-large", PrmConfig(samples=60), seed=9).points[:5]
    grown = extend(roadmap, further)
    np.testing.assert_array_equal(grown.points, np.concatenate([roadmap.points, further]))
    old = grown.edges[(grown.edges < 60).all(1)]
    assert set(map(tuple, old.tolist())) == set(map(tuple, roadmap.edges.tolist()))
    new = grown.edges[(grown.edges >= 60).any(1)]
    assert len(new) > 0
    room = segment_clearances(
        wall_distance, load_walls("antmaze-large"), grown.points[new[:, 0]], grown.points[new[:, 1]]
    )
    assert (room >= RADIUS - 1e-4).all()


def test_too_narrow_maze_is_error():
    with pytest.raises(UserError, match="larger cells") as refusal:
        build_roadmap(jax.random.key(0), load_maze("antmaze-umaze", cell_m=0.9), radius_m=RADIUS, config=SMALL)
    assert "0.5 m" in str(refusal.value) and "\n" not in str(refusal.value)


# -------------------------------------------------------------------------------------------------- the table


@pytest.mark.parametrize(("samples", "connect_m", "pieces"), [(200, 10.0, False), (60, 6.0, True), (60, 2.0, True)])
def test_table_has_shortest_paths(samples, connect_m, pieces):
    """Compared with networkx."""
    roadmap = roadmap_of("antmaze-large", PrmConfig(samples=samples, connect_m=connect_m))
    table, n = roadmap.table, len(roadmap.points)
    expected = np.full((n, n), np.inf)
    for i, lengths in nx.all_pairs_dijkstra_path_length(roadmap.graph):
        expected[i, list(lengths)] = list(lengths.values())
    assert np.isinf(expected).any() == pieces
    np.testing.assert_allclose(table.distance, expected, rtol=1e-5)
    np.testing.assert_array_equal(table.points, roadmap.points)

    next_hop = np.asarray(table.next_hop)
    assert ((next_hop == NO_HOP) == np.isinf(expected)).all()
    start, goal = np.nonzero(np.isfinite(expected))
    at, walked = start, np.zeros(len(start))
    for _ in range(n):
        hop = next_hop[at, goal]
        assert all(roadmap.graph.has_edge(i, j) for i, j in zip(at, hop, strict=True) if i != j)
        walked += np.linalg.norm(roadmap.points[at] - roadmap.points[hop], axis=-1)
        at = hop
    np.testing.assert_array_equal(at, goal)
    np.testing.assert_allclose(walked, expected[start, goal], rtol=1e-5, atol=1e-4)


def test_a_roadmap_without_edges_has_no_paths():
    table = roadmap_of("antmaze-umaze", PrmConfig(samples=10, connect_m=1e-3, most_samples=10)).table
    assert (np.isinf(table.distance) == ~np.eye(10, dtype=bool)).all()


# --------------------------------------------------------------------------------------------------- planning


@given(SEEDS)
@settings(max_examples=15)
def test_plans_connect_any_two_free_points(wall_distance, seed):
    walls, roadmap = load_walls("antmaze-large"), roadmap_of("antmaze-large", PrmConfig())
    rng = np.random.default_rng(seed)
    free = np.argwhere(~walls)[:, ::-1]
    start, goal = (free[rng.integers(len(free), size=2)] + rng.uniform(0.13, 0.87, (2, 2))) * 4.0
    path = roadmap.plan(start, goal)
    assert isinstance(path, Path)
    np.testing.assert_allclose(path.points[[0, -1]], [start, goal], atol=1e-5)
    legs = np.linalg.norm(np.diff(path.points, axis=0), axis=-1)
    assert path.length_m == pytest.approx(legs.sum(), rel=1e-5)
    assert path.length_m >= np.linalg.norm(goal - start) - 1e-4
    assert legs.max() <= roadmap.config.connect_m + 1e-4
    room = segment_clearances(wall_distance, walls, path.points[:-1], path.points[1:])
    assert (room >= RADIUS - 1e-4).all()


def test_plan_between_points_of_roadmap_equals_table():
    roadmap = roadmap_of("antmaze-large")
    answers = set()
    for i, j in [(0, 1), (5, 40), (12, 33), (7, 7), (2, 50), (3, 20)]:
        path = roadmap.plan(roadmap.points[i], roadmap.points[j])
        length = path.length_m if isinstance(path, Path) else np.inf
        assert length == pytest.approx(float(roadmap.table.distance[i, j]), rel=1e-5, abs=1e-5)
        answers.add(type(path))
    assert answers == {Path, NoPath}  # a small roadmap has several components


def test_separate_rooms_have_no_path():
    roadmap = two_rooms()
    answer = roadmap.plan(np.array([6.0, 6.0]), np.array([26.0, 6.0]))
    assert isinstance(answer, NoPath)
    assert "(6.00, 6.00)" in str(answer) and "(26.00, 6.00)" in str(answer) and "\n" not in str(answer)
    assert isinstance(roadmap.plan(np.array([6.0, 6.0]), np.array([10.0, 10.0])), Path)
    left = roadmap.points[:, 0] < 18
    assert (np.isfinite(np.asarray(roadmap.table.distance)) == (left[:, None] == left)).all()


@pytest.mark.parametrize("bad", [(18.0, 6.0), (4.2, 6.0), (-9.0, 6.0), (1e9, 6.0), (float("nan"), 6.0)])
def test_points_in_walls_have_no_path(bad):
    roadmap, good = two_rooms(), (6.0, 6.0)
    for name, ends in (("start", (bad, good)), ("goal", (good, bad))):
        answer = roadmap.plan(*map(np.array, ends))
        assert isinstance(answer, NoPath)
        assert f"the {name}" in answer.reason


def test_the_graph_that_is_written_has_the_ways_of_the_table(tmp_path):
    """Read by networkx alone, with the places of its nodes."""
    roadmap = roadmap_of("antmaze-large")
    roadmap.write_graph(tmp_path / "roadmap.graphml")
    graph = nx.read_graphml(tmp_path / "roadmap.graphml", node_type=int)
    places = np.array([[graph.nodes[i][name] for name in ("x_m", "y_m")] for i in range(len(roadmap.points))])
    np.testing.assert_allclose(places, roadmap.points)
    lengths = dict(nx.all_pairs_dijkstra_path_length(graph))
    for i, column in enumerate(np.asarray(roadmap.table.goal).tolist()):
        for node, distance in enumerate(np.asarray(roadmap.table.distance)[:, i].tolist()):
            assert distance == pytest.approx(lengths[node].get(column, np.inf), rel=1e-5)


# ----------------------------------------------------------------------------------------------------- guides


def frame_of(maze, position, goal):
    """Robots at positions [N, 2] (m)."""
    n = len(position)
    seen = Observation(None, jnp.zeros((n, 2)), goal - position)
    return Frame(seen, jnp.zeros(n), jnp.zeros(n, bool), Privileged(position, goal, jnp.zeros(n), maze))


class Plans(NamedTuple):
    """Roadmaps, and which of them each robot follows."""

    tables: PlanTable
    table_of: jax.Array


@functools.partial(jax.jit, static_argnames=("guide", "length"))
def walk(guide, plan, maze, start, goal, key, noise, length):
    """Positions [T, N, 2] of dummies that move 0.3 m towards their waypoints, plus random ``noise`` [m]."""

    def once(carry, key):
        position, plan = carry
        away, plan = guide.waypoint(plan, frame_of(maze, position, goal))
        far = jnp.linalg.norm(away, axis=-1, keepdims=True)
        position = position + away * jnp.minimum(1.0, 0.3 / jnp.maximum(far, 1e-6))
        return (position + noise * jax.random.normal(key, position.shape), plan), position

    return jax.lax.scan(once, (start, plan), jax.random.split(key, length))[1]


NAMES = ["antmaze-large", "antmaze-large-eval"]
WHICH = np.arange(24) % 2  # maze and roadmap of each dummy
OWN_AND_OTHER = [(PrmConfig(), 0), (SMALL, 5)]


def guided(guide: RoadmapGuide, ends: np.ndarray, *, noise: float, length: int = 500) -> np.ndarray:
    """Paths [T, N, 2] of dummies that are guided from the first to the second of ``ends`` [N, 2, 2]."""
    start, goal = jnp.asarray(ends[:, 0]), jnp.asarray(ends[:, 1])
    maze = jax.tree.map(lambda leaf: leaf[WHICH], stack_mazes([load_maze(name) for name in NAMES]))
    tables = stack_tables([roadmap_of(name, PrmConfig()).table for name in NAMES])
    plan = guide.init(frame_of(maze, start, goal), Plans(tables, jnp.asarray(WHICH)))
    return np.asarray(walk(guide, plan, maze, start, goal, jax.random.key(0), noise, length))


@pytest.mark.parametrize("shortcut", [False, True])
def test_padded_table_of_some_goals_guides_like_full_table(shortcut):
    maze, small = load_maze(NAMES[0]), roadmap_of(NAMES[0], PrmConfig())
    ends = small.points[[[3, 40], [7, 90]]]
    columns = np.unique([40, 90])
    some = small.table.replace(
        goal=jnp.asarray(columns), next_hop=small.table.next_hop[:, columns], distance=small.table.distance[:, columns]
    )
    larger = roadmap_of(NAMES[1], PrmConfig(samples=260)).table
    guide, mazes = RoadmapGuide(RADIUS, shortcut=shortcut), stack_mazes([maze, maze])
    start, goal = jnp.asarray(ends[:, 0]), jnp.asarray(ends[:, 1])

    def path(tables):
        plan = guide.init(frame_of(mazes, start, goal), Plans(tables, jnp.zeros(2, jnp.int32)))
        return np.asarray(walk(guide, plan, mazes, start, goal, jax.random.key(0), 0.0, 200))

    np.testing.assert_array_equal(path(stack_tables([some, larger])), path(stack_tables([small.table])))


@pytest.mark.parametrize("shortcut", [False, True])
def test_guides_follow_plan_to_goal(wall_distance, shortcut):
    """For two mazes and roadmaps. Starts and goals are points of this roadmap, or of another one."""
    on, off = ([roadmap_of(name, config, seed).points for name in NAMES] for config, seed in OWN_AND_OTHER)
    ends = np.stack([(on if i < 12 else off)[which][[i, i + 20]] for i, which in enumerate(WHICH)])
    path = guided(RoadmapGuide(RADIUS, shortcut=shortcut), ends, noise=0.0)
    arrived = np.linalg.norm(path - ends[None, :, 1], axis=-1) < 0.1
    assert arrived[-1].all()
    for i, which in enumerate(WHICH):
        assert wall_distance(load_walls(NAMES[which]), path[:, i]).min() > 0.7 * RADIUS
        shortest = roadmap_of(NAMES[which], PrmConfig()).plan(*ends[i])
        assert isinstance(shortest, Path)
        assert 0.3 * arrived[:, i].argmax() < 1.15 * shortest.length_m + 2.0


def test_guides_recover_from_disturbances():
    """Each step has a random push of 0.1 m, sometimes out of sight of the waypoint; the goals are still reached."""
    ends = np.stack([roadmap_of(NAMES[which], PrmConfig()).points[[i, i + 30]] for i, which in enumerate(WHICH)])
    path = guided(RoadmapGuide(RADIUS), ends, noise=0.1)
    assert (np.linalg.norm(path - ends[None, :, 1], axis=-1).min(0) < 0.5).all()


@pytest.mark.parametrize("density", [1.0, 2.0, 2.5])
def test_narrow_gaps_do_not_need_more_points(density):
    """The robot fits through the gaps, but not with its margin, so more samples cannot connect the two sides."""
    config = PrmConfig(samples=150, connect_m=2.0, margin_m=0.08)
    for seed in range(3):
        world = random_world(seed, 0.08 * density)
        assert build_roadmap(jax.random.key(seed), world, radius_m=RADIUS_M, config=config).samples == 150
