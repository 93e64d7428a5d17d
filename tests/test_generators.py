"""The benchmark UnseenMaze: generators, splits, starts and goals, and the measures of mazes."""

import hashlib
import itertools
import os
import subprocess
import sys
from pathlib import Path

import jax
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from ct_envs import UserError, generators, make_maze, random_walls, unseen
from ct_envs import maze as mazes
from ct_envs.generators import GENERATORS, LEAST_FREE, SIDES, VERSION, generate_walls
from ct_envs.maze_statistics import count_islands, free_cells, measure_maze, neighbour_table, shortest_ways

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import unseen_maze

SIDE = st.integers(*SIDES)
GENERATED = st.builds(generate_walls, st.sampled_from(list(GENERATORS)), st.integers(0, 2**63 - 1), SIDE, SIDE)
SMALL = st.builds(
    lambda seed, height, width, loops, density: random_walls(
        seed, height=height, width=width, loops=loops, density=density
    ),
    st.integers(0, 2**31), st.integers(5, 8), st.integers(5, 8), st.floats(0, 1), st.floats(0, 1),
)  # fmt: skip
NUMBERS = st.integers(0, unseen.LARGEST_NUMBER)
EIGHT = [lambda m, k=k, flip=flip: np.rot90(m.T if flip else m, k) for k in range(4) for flip in (False, True)]
# Of the first 40 test mazes of each generator, and of pairs in 40 of them. If they change, the benchmark has changed:
# raise VERSION, and say so in CHANGELOG.md.
DIGESTS = {
    "perfect": "e467f05015f250b1",
    "loops": "19bcca019070fb4b",
    "rooms": "48c92372c2c696d8",
    "open": "3f00dc3d013e4847",
    "pairs": "1776dd58a07f88f9",
}
clearances = jax.jit(jax.vmap(mazes.clearance, (None, 0)))


@pytest.fixture(scope="module")
def test_mazes() -> list[np.ndarray]:
    return [unseen.test_maze(number) for number in range(unseen.TEST_MAZES)]


def graph_of(walls: np.ndarray) -> nx.Graph:
    """The free cells, numbered as ``free_cells`` lists them, and the steps between them."""
    place = {tuple(cell): i for i, cell in enumerate(np.argwhere(~walls))}
    graph = nx.Graph()
    graph.add_nodes_from(place.values())
    for (row, column), i in place.items():
        graph.add_edges_from((i, place[there]) for there in ((row + 1, column), (row, column + 1)) if there in place)
    return graph


def digest(chunks) -> str:
    return hashlib.blake2b(b"".join(chunks), digest_size=8).hexdigest()


def digests_now() -> dict[str, str]:
    found = {}
    for place, name in enumerate(GENERATORS):
        numbers = range(place, 40 * len(GENERATORS), len(GENERATORS))
        found[name] = digest(np.packbits(unseen.test_maze(number)).tobytes() for number in numbers)
    pairs = [unseen.test_pairs(number, 3) for number in range(40)]
    return found | {"pairs": digest(np.ascontiguousarray(part).tobytes() for pair in pairs for part in pair)}


# ----------------------------------------------------------------------------------------------------- generators


@given(GENERATED)
@settings(max_examples=200, deadline=None)
def test_a_maze_is_closed_connected_and_a_third_free(walls):
    height, width = walls.shape
    assert walls.dtype == bool
    assert walls[[0, -1]].all() and walls[:, [0, -1]].all()
    assert ndimage.label(~walls)[1] == 1
    assert (~walls).sum() >= LEAST_FREE * (height - 2) * (width - 2)


@given(st.sampled_from(list(GENERATORS)), st.integers(0, 2**63 - 1), SIDE, SIDE)
@settings(max_examples=50, deadline=None)
def test_a_maze_has_its_size_and_is_a_function_of_its_arguments(name, seed, height, width):
    walls = generate_walls(name, seed, height, width)
    assert walls.shape == (height, width)
    np.testing.assert_array_equal(walls, generate_walls(name, seed, height, width))


@given(st.integers(0, 2**63 - 1), SIDE, SIDE)
@settings(max_examples=50, deadline=None)
def test_perfect_mazes_have_no_loop_and_the_others_what_their_name_says(seed, height, width):
    made = {name: measure_maze(generate_walls(name, seed, height, width)) for name in GENERATORS}
    assert made["perfect"].cycle_rank == 0
    assert made["loops"].islands == made["loops"].cycle_rank > 0  # loops of corridors, no open squares
    assert made["rooms"].cycle_rank > made["rooms"].islands  # rooms are wider than a corridor
    assert made["open"].islands > 0


def test_seeds_give_different_mazes():
    for name in GENERATORS:
        made = {unseen.fingerprint(generate_walls(name, seed, 20, 24)) for seed in range(100)}
        assert len(made) == 100


def test_the_mazes_are_those_of_this_version():
    assert VERSION == 1
    assert digests_now() == DIGESTS


def test_another_version_has_other_mazes(monkeypatch):
    before = generate_walls("perfect", 0, 20, 20)
    monkeypatch.setattr(generators, "VERSION", VERSION + 1)
    assert (generate_walls("perfect", 0, 20, 20) != before).any()


def test_another_process_makes_the_same_mazes():
    """Even if it hashes text otherwise."""
    code = "from ct_envs import unseen; print([unseen.fingerprint(unseen.test_maze(n)).hex() for n in range(100)])"
    environment = {**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str([unseen.fingerprint(unseen.test_maze(n)).hex() for n in range(100)])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("spiral", 0, 9, 9), "no generator of mazes named 'spiral'; there are perfect, loops, rooms, open"),
        (("rooms", -1, 9, 9), "seed -1"),
        (("rooms", 2**63, 9, 9), "seed 9223372036854775808"),
        (("rooms", 0, 6, 9), "6 x 9 cells; the generators make 7 to 24 a side"),
        (("rooms", 0, 9, 25), "9 x 25 cells"),
    ],
)
def test_bad_arguments_are_told_in_a_line(arguments, said):
    with pytest.raises(UserError, match=said) as error:
        generate_walls(*arguments)
    assert "\n" not in str(error.value)


# --------------------------------------------------------------------------------------------------------- splits


def test_a_quarter_of_the_test_mazes_is_of_each_generator_and_all_sizes_occur(test_mazes):
    for place, name in enumerate(GENERATORS):
        numbers = range(place, unseen.TEST_MAZES, len(GENERATORS))
        assert len(numbers) == 250 and {unseen.generator_of(number) for number in numbers} == {name}
        for axis in (0, 1):
            assert {test_mazes[number].shape[axis] for number in numbers} == set(range(SIDES[0], SIDES[1] + 1))


def test_all_test_mazes_differ_and_are_test_mazes_by_content(test_mazes):
    assert len({unseen.fingerprint(walls) for walls in test_mazes}) == unseen.TEST_MAZES
    assert {unseen.split_of(walls) for walls in test_mazes} == {"test"}


@pytest.mark.parametrize("make", [unseen.training_maze, unseen.validation_maze])
def test_no_training_or_validation_maze_is_a_test_maze_however_it_is_turned(make, test_mazes):
    """Compared cell by cell, without the fingerprint that the splits are made by."""
    tests = {(walls.shape, walls.tobytes()) for walls in test_mazes}
    for number in range(2000):
        walls = make(number)
        turned = [np.ascontiguousarray(turn(walls)) for turn in EIGHT]
        assert not tests & {(form.shape, form.tobytes()) for form in turned}, number


@given(GENERATED)
@settings(max_examples=50, deadline=None)
def test_turning_mirroring_and_a_thicker_border_change_no_split(walls):
    turned = [turn(walls) for turn in EIGHT] + [np.pad(walls, ((0, 2), (1, 0)), constant_values=True)]
    assert {unseen.fingerprint(form) for form in turned} == {unseen.fingerprint(walls)}
    assert {unseen.split_of(form) for form in turned} == {unseen.split_of(walls)}
    one_more = walls.copy()
    one_more[tuple(np.argwhere(~walls)[0])] = True
    assert unseen.fingerprint(one_more) != unseen.fingerprint(walls)


@given(NUMBERS)
@settings(max_examples=30, deadline=None)
def test_numbers_go_round_the_generators(number):
    for make, split in ((unseen.training_maze, "training"), (unseen.validation_maze, "validation")):
        walls, name = make(number), unseen.generator_of(number)
        np.testing.assert_array_equal(walls, make(number // len(GENERATORS), name))
        assert unseen.split_of(walls) == split


def test_every_small_size_has_mazes_of_every_split():
    """Small mazes are few: 19 of 7 x 7 cells with rooms. Larger sizes need no test."""
    sizes = set()
    for index in range(324):
        if min(unseen.training_maze(index, "rooms").shape) > 8:
            continue
        for make, name in itertools.product((unseen.training_maze, unseen.validation_maze), GENERATORS):
            sizes.add(make(index, name).shape)
    assert len(sizes) == 18**2 - 16**2


SPLITS = ("training", "validation", "test")
PLACE = st.tuples(st.sampled_from(SPLITS), NUMBERS)


@given(PLACE, PLACE)
def test_no_two_mazes_of_a_generator_share_a_seed(one, other):
    first, second = unseen.seeds_of(*one), unseen.seeds_of(*other)
    assert one == other or first.stop <= second.start or second.stop <= first.start
    assert first.start >= 0 and first.stop <= 2**63


@pytest.mark.parametrize(
    ("make", "number", "said"),
    [
        (unseen.test_maze, 1000, "test maze 1000: give a number from 0 to 999"),
        (unseen.test_maze, -1, "test maze -1"),
        (unseen.training_maze, -1, "training maze -1"),
        (unseen.validation_maze, 2**40, "validation maze 1099511627776"),
    ],
)
def test_a_number_out_of_range_is_told(make, number, said):
    with pytest.raises(UserError, match=said):
        make(number)
    with pytest.raises(UserError, match="no generator of mazes named 'spiral'"):
        unseen.training_maze(0, "spiral")


# ----------------------------------------------------------------------------------------------- starts and goals


@given(st.integers(0, 999), st.sampled_from([0.2, 0.5, 1.0, 1.9]), st.sampled_from([4.0, 12.0, 20.0, 32.0]))
@settings(max_examples=25, deadline=None)
def test_pairs_are_clear_of_walls_reachable_and_far_apart(number, clearance_m, least_way_m):
    walls = unseen.test_maze(number)
    pairs = unseen.test_pairs(number, 20, clearance_m=clearance_m, least_way_m=least_way_m)
    maze = make_maze(walls, shape=(24, 24))
    assert pairs.start_m.shape == pairs.goal_m.shape == (20, 2) and pairs.start_m.dtype == np.float32
    for points in (pairs.start_m, pairs.goal_m):
        assert (np.asarray(clearances(maze, points)) >= clearance_m).all()
    graph, cells = graph_of(walls), free_cells(walls).tolist()
    for start, goal, way in zip(pairs.start_m, pairs.goal_m, pairs.way_m, strict=True):
        a, b = (cells.index(int(y // 4) * walls.shape[1] + int(x // 4)) for x, y in (start, goal))
        assert 4 * nx.shortest_path_length(graph, a, b) == way >= least_way_m


@given(st.integers(0, 999), st.integers(1, 10), st.integers(1, 10))
@settings(max_examples=20, deadline=None)
def test_the_first_pairs_stay_the_same_when_more_are_drawn(number, few, more):
    for draw in (unseen.test_pairs, unseen.validation_pairs):
        some, many = draw(number, few), draw(number, few + more)
        for part, whole in zip(some, many, strict=True):
            np.testing.assert_array_equal(part, whole[:few])


@pytest.mark.slow
def test_every_test_maze_has_pairs_of_its_own():
    pairs = [unseen.test_pairs(number, 2) for number in range(unseen.TEST_MAZES)]
    assert len({pair.start_m.tobytes() for pair in pairs}) == unseen.TEST_MAZES


def test_pairs_that_cannot_be_are_told():
    for arguments, said in [
        ({"count": 0}, "0 pairs of test maze 3"),
        ({"count": 1, "least_way_m": 1e4}, r"test maze 3 has no way of 10000.0 m or more; its longest has \d+.0 m"),
        ({"count": 1, "clearance_m": 2.0}, "clearance 2.0 m in test maze 3: give 0 to less than 2.0 m"),
        ({"count": 1, "clearance_m": float("nan")}, "clearance nan m"),
        ({"count": 1, "least_way_m": float("nan")}, "no way of nan m"),
    ]:
        with pytest.raises(UserError, match=said):
            unseen.test_pairs(3, **arguments)


# ------------------------------------------------------------------------------------------------------- measures


@given(SMALL)
@settings(max_examples=30, deadline=None)
def test_measures_agree_with_a_graph_library(walls):
    graph, found = graph_of(walls), measure_maze(walls)
    inner = (walls.shape[0] - 2) * (walls.shape[1] - 2)
    assert found.free_share == len(graph) / inner
    assert found.cycle_rank == len(nx.cycle_basis(graph))
    assert found.dead_ends == sum(degree <= 1 for _, degree in graph.degree)
    groups, count = ndimage.label(walls, np.ones((3, 3)))
    at_border = set(groups[[0, -1]].ravel()) | set(groups[:, [0, -1]].ravel())
    assert found.islands == count_islands(walls) == count - len(at_border)
    steps = dict(nx.all_pairs_shortest_path_length(graph))
    assert found.longest_way == max(max(ways.values()) for ways in steps.values())
    table = neighbour_table(walls)
    assert {(i, int(j)) for i, row in enumerate(table) for j in row if j < len(graph)} == {
        pair for i, j in graph.edges for pair in ((i, j), (j, i))
    }


@given(st.integers(0, 2**31), st.floats(0, 1), st.floats(0.5, 1))
@settings(max_examples=20, deadline=None)
def test_traps_agree_with_their_definition_on_every_shortest_way(seed, loops, density):
    walls = random_walls(seed, height=6, width=7, loops=loops, density=density)
    graph, found, place = graph_of(walls), shortest_ways(walls), np.argwhere(~walls)
    for goal in graph:
        away = np.abs(place - place[goal]).sum(1)
        ways = {start: list(nx.all_shortest_paths(graph, start, goal)) for start in graph}
        rise = {start: min(max(away[way]) for way in ways[start]) - away[start] for start in graph}
        for start in graph:
            assert found.steps[start, goal] == len(ways[start][0]) - 1
            assert found.rise[start, goal] == rise[start]
            assert found.trap[start, goal] == min(max(rise[cell] for cell in way) for way in ways[start])


def test_traps_of_rooms_and_blind_alleys():
    room = np.pad(np.zeros((5, 6), bool), 1, constant_values=True)
    assert measure_maze(room).trap_depth == 0
    cup = mazes.parse_walls(
        """
        #########
        #.......#
        #.####..#
        #....#..#
        #.####..#
        #.......#
        #########
        """.replace(" ", "")
    )
    ways, cells = shortest_ways(cup), np.argwhere(~cup).tolist()
    start, goal = cells.index([3, 4]), cells.index([3, 7])
    assert ways.rise[start, goal] == ways.trap[start, goal] == 5  # 3 steps back, 2 aside
    assert ways.rise[goal, start] == 2  # aside, to pass the cup
    assert ways.trap[goal, start] == 3  # from beside the start to the mouth of the cup
    assert count_islands(cup) == 1


def test_regions_that_are_apart_have_no_way():
    walls = mazes.parse_walls("#######\n#..#..#\n#.##..#\n#######")
    ways = shortest_ways(walls)
    assert (ways.steps < 0).any() and (ways.trap[ways.steps < 0] == 0).all()
    assert measure_maze(walls).cycle_rank == 1 and measure_maze(walls).longest_way == 2
    assert np.isfinite(measure_maze(mazes.load_walls("antmaze-large")).free_share)


# ------------------------------------------------------------------------------------------------------- the page


@pytest.mark.slow
def test_the_page_has_the_statistics_of_the_test_mazes():
    assert "\n".join(unseen_maze.statistics_table()) in unseen_maze.PAGE.read_text("utf-8")
