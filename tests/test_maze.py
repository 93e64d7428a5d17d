"""Mazes: reading, making, and the geometric queries against plain NumPy."""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from ct_envs import UserError, load_maze, make_maze, maze_names, random_walls, stack_mazes
from ct_envs import maze as mazes

SHAPE = (12, 12)  # all small mazes are padded to it, so that one compiled program serves them
SIDES = st.integers(5, 12)
FRACTIONS = st.floats(0, 1)
SEEDS = st.integers(0, 2**31 - 1)
GRIDS = st.builds(
    lambda seed, height, width, density, loops: random_walls(
        seed, height=height, width=width, density=density, loops=loops
    ),
    SEEDS, SIDES, SIDES, FRACTIONS, FRACTIONS,
)  # fmt: skip
GOLDEN = ["#########", "#.......#", "#.#.#.#.#", "#...#.#.#", "#...#.#.#", "#.#...#.#", "#########"]
TWO_REGIONS = "#######\n#..#..#\n#.##..#\n#######"

clearances = jax.jit(jax.vmap(mazes.clearance, (None, 0)))
segments_free = jax.jit(
    jax.vmap(lambda maze, a, b, radius: mazes.segment_free(maze, a, b, radius=radius, reach=3), (None, 0, 0, None))
)


@functools.partial(jax.jit, static_argnames="reach")
def within_reach(maze, a, b, radius, reach):
    ask = functools.partial(mazes.segment_free, maze, radius=radius, reach=reach)
    return jax.vmap(ask)(a, b)


in_sight = jax.jit(
    jax.vmap(lambda maze, a, b, radius: mazes.in_sight(maze, a, b, radius=radius, reach=3), (None, 0, 0, None))
)
sample_many = jax.jit(jax.vmap(lambda key, maze, radius: mazes.sample_free(key, maze, radius=radius), (0, None, None)))
sample_from = jax.jit(
    jax.vmap(
        lambda key, maze, index, radius: mazes.sample_free(key, maze, radius=radius, index=index),
        (0, None, 0, None),
    )
)


def draw_points(seed: int, walls: np.ndarray, n: int, cell_m: float = 4.0) -> np.ndarray:
    """Points anywhere over the maze and a little beyond."""
    height, width = walls.shape
    unit = np.random.default_rng(seed).random((n, 2)) * 1.1 - 0.05
    return np.float32(unit * [width * cell_m, height * cell_m])


def draw_segments(seed: int, walls: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Segments of up to 14 m; every fourth is parallel to an axis, and some are points."""
    rng = np.random.default_rng(seed)
    a = draw_points(seed, walls, n)
    angle, length = rng.uniform(0, 2 * np.pi, n), rng.uniform(0, 14, n)
    angle[::4] = rng.integers(0, 4, n)[::4] * np.pi / 2
    length[::16] = 0
    return a, np.float32(a + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1))


def regions(walls: np.ndarray) -> int:
    return ndimage.label(~walls)[1]


# ---------------------------------------------------------------------------------------------- named layouts


@pytest.mark.parametrize("name", maze_names())
def test_named_layouts_are_closed_and_connected(name):
    walls = mazes.load_walls(name)
    assert walls[[0, -1]].all() and walls[:, [0, -1]].all()
    assert regions(walls) == 1
    maze = load_maze(name)
    assert int(maze.n_free) == (~walls).sum()
    np.testing.assert_array_equal(mazes.unpadded(maze), walls)


def test_the_mazes_of_the_paper_are_there():
    names = {"antmaze-umaze", "antmaze-medium", "antmaze-large", "antmaze-large-eval", "unseen-spiral"}
    assert names <= set(maze_names())


def test_row_zero_of_a_layout_is_its_last_line():
    walls = mazes.parse_walls("####\n#..#\n##.#\n####")
    assert walls[1].tolist() == [True, True, False, True]
    assert walls[2].tolist() == [True, False, False, True]


# ----------------------------------------------------------------------------------------------- random mazes


@given(GRIDS)
def test_random_mazes_are_closed_with_one_free_region(walls):
    assert walls[[0, -1]].all() and walls[:, [0, -1]].all()
    assert regions(walls) == 1


@given(SEEDS, SIDES, SIDES, FRACTIONS, FRACTIONS)
def test_a_seed_gives_one_random_maze(seed, height, width, density, loops):
    again = [random_walls(seed, height=height, width=width, density=density, loops=loops) for _ in range(2)]
    assert again[0].shape == (height, width)
    np.testing.assert_array_equal(*again)


def test_a_seed_gives_the_same_random_maze_on_every_machine():
    assert mazes.draw_walls(random_walls(7, height=7, width=9, loops=0.3)).split() == GOLDEN


def test_seeds_give_different_random_mazes():
    assert len({random_walls(seed).tobytes() for seed in range(20)}) > 15


@given(SEEDS, SIDES, SIDES)
def test_without_loops_a_random_maze_is_a_tree(seed, height, width):
    free = ~random_walls(seed, height=height, width=width, loops=0.0)
    passages = (free[1:] & free[:-1]).sum() + (free[:, 1:] & free[:, :-1]).sum()
    assert passages == free.sum() - 1


@given(SEEDS, SIDES, SIDES, FRACTIONS, FRACTIONS, FRACTIONS)
def test_less_density_and_more_loops_only_open_walls(seed, height, width, x, y, other):
    low, high = sorted([x, y])
    size = {"height": height, "width": width}
    sparse, dense = (random_walls(seed, **size, density=d, loops=other) for d in (low, high))
    assert not (sparse & ~dense).any()
    tree, loopy = (random_walls(seed, **size, density=other, loops=fraction) for fraction in (low, high))
    assert not (loopy & ~tree).any()


def test_density_and_loops_at_their_ends():
    room = random_walls(3, height=9, width=12, density=0.0)
    assert not room[1:-1, 1:-1].any()
    tree, all_loops = (random_walls(3, density=1.0, loops=loops) for loops in (0.0, 1.0))
    assert tree.sum() > all_loops.sum() > room.sum()


@pytest.mark.parametrize(
    "options",
    [{"height": 4}, {"width": 5000}, {"density": 1.5}, {"density": float("nan")}, {"loops": -0.1}],
    ids=str,
)
def test_random_mazes_refuse_what_is_out_of_range(options):
    assert_one_line(lambda: random_walls(0, **options))


# ---------------------------------------------------------------------------------------------- text and back


@given(GRIDS)
def test_drawing_and_parsing_is_the_identity(walls):
    text = mazes.draw_walls(walls)
    np.testing.assert_array_equal(mazes.parse_walls(text), walls)


@given(GRIDS, st.sampled_from(["", "\n", "\r\n", "\n\n \n", "\r\n\r\n"]))
def test_windows_line_ends_and_trailing_blank_lines_are_read(walls, tail):
    text = mazes.draw_walls(walls)
    for variant in (text + tail, text.replace("\n", "\r\n") + tail):
        np.testing.assert_array_equal(mazes.parse_walls(variant), walls)


def assert_one_line(call, *parts: str) -> None:
    """The call is refused with a single line that holds all the parts."""
    with pytest.raises(UserError) as refusal:
        call()
    message = str(refusal.value)
    assert message and "\n" not in message and "\r" not in message
    assert not [part for part in parts if part not in message], message


@pytest.mark.parametrize(
    ("content", "line", "hint"),
    [
        (b"####\n#.#\n####\n", ":2", "make all lines equal"),
        (b"####\n#..#\n#####\n", ":3", "make all lines equal"),
        (b"####\n#.o#\n####\n", ":2: column 3 is 'o'", "use '#' (wall) or '.' (free)"),
        (b"####\n#.\t#\n####\n", ":2: column 3 is '\\t'", "use '#' (wall) or '.' (free)"),
        (b"####\n#.\r#\n####\n", ":2: column 3 is '\\r'", "use '#' (wall) or '.' (free)"),
        (b"", "", "a maze is lines of '#' (wall) and '.' (free)"),
        (b" \r\n\n", "", "a maze is lines of '#' (wall) and '.' (free)"),
        (b"###\n###\n###\n", "", "draw free cells as '.'"),
        (b"####\n#...\n####\n", ":2: column 4", "close the maze with '#'"),
        (b"#.##\n#..#\n####\n", ":1: column 2", "close the maze with '#'"),
        (b"####\n#..#\n#.##\n", ":3: column 2", "close the maze with '#'"),
        (b"..", ":1: column 1", "close the maze with '#'"),
        (b"####\n#\xff.#\n####\n", ":2", "save the maze as plain text"),
        (b"\xff\xfe#\x00#\x00", ":1", "save the maze as plain text"),
        (b"#" * 2000, "", "at most 1024 x 1024"),
        (b"#\n" * 2000, "", "at most 1024 x 1024"),
    ],
)
def test_files_that_are_no_mazes_are_named_with_line_and_mend(tmp_path, content, line, hint):
    file = tmp_path / "floor.txt"
    file.write_bytes(content)
    assert_one_line(lambda: load_maze(file), f"{file}{line}", hint)


def test_a_giant_file_is_refused_at_once(tmp_path):
    file = tmp_path / "giant.txt"
    with file.open("wb") as out:
        out.truncate(10_000 * 10_001)  # sparse: nothing is written, and nothing should be read
    begun = time.perf_counter()
    assert_one_line(lambda: load_maze(file), str(file), "at most 1024 x 1024")
    assert_one_line(lambda: mazes.parse_walls(("#" * 10_000 + "\n") * 10_000), "10000 x 10000")
    assert time.perf_counter() - begun < 5.0  # to read its hundred million cells takes longer


def test_the_largest_maze_is_read(tmp_path):
    walls = np.ones((1024, 1024), bool)
    walls[1:-1, 1] = False
    file = tmp_path / "large.txt"
    file.write_bytes(mazes.draw_walls(walls).replace("\n", "\r\n").encode())
    np.testing.assert_array_equal(mazes.load_walls(file), walls)


@pytest.mark.parametrize("name", ["antmaze-huge", "", "no/such/file.txt", ".", "nul\0"])
def test_an_unknown_name_gets_the_known_ones(name):
    assert_one_line(lambda: load_maze(name), *maze_names())


@pytest.mark.parametrize("walls", [np.ones((5, 5)), np.ones((0, 0)), np.zeros((12, 12)), np.zeros(5)])
def test_grids_that_are_no_mazes_are_refused(walls):
    assert_one_line(lambda: make_maze(walls))


def test_a_maze_that_outgrows_its_shape_is_refused():
    assert_one_line(lambda: make_maze(random_walls(0, height=13), shape=(12, 12)), "(13, 12)", "(12, 12)")


# ---------------------------------------------------------------------------------------- padding and regions


@given(GRIDS, SEEDS)
@settings(max_examples=20)
def test_padding_changes_no_answer(walls, seed):
    small, large = make_maze(walls, shape=SHAPE), make_maze(walls, shape=(24, 12))
    points = draw_points(seed, walls, 64)
    a, b = draw_segments(seed, walls, 64)
    np.testing.assert_array_equal(clearances(small, points), clearances(large, points))
    np.testing.assert_array_equal(segments_free(small, a, b, 0.5), segments_free(large, a, b, 0.5))
    keys = jax.random.split(jax.random.key(seed), 8)
    for one, other in zip(sample_many(keys, small, 0.5), sample_many(keys, large, 0.5), strict=True):
        np.testing.assert_array_equal(one, other)


@given(GRIDS)
def test_free_cells_are_listed_once_and_centred_in_free_cells(walls):
    maze = make_maze(walls, shape=SHAPE)
    flat = np.asarray(maze.free_cells)[: int(maze.n_free)]
    padded = np.asarray(maze.walls)
    assert sorted(flat) == np.flatnonzero(~padded).tolist()
    assert (np.asarray(maze.region_lo)[: len(flat)] == 0).all()
    assert (np.asarray(maze.region_hi)[: len(flat)] == len(flat)).all()


def test_regions_of_a_maze_with_two():
    walls = mazes.parse_walls(TWO_REGIONS)
    maze = make_maze(walls)
    labels, count = ndimage.label(~np.asarray(maze.walls))
    label = labels.ravel()[np.asarray(maze.free_cells)[: int(maze.n_free)]]
    assert count == 2
    for i, own in enumerate(label):
        members = np.arange(int(maze.region_lo[i]), int(maze.region_hi[i]))
        np.testing.assert_array_equal(members, np.flatnonzero(label == own))


def test_a_stack_holds_each_maze_unchanged():
    singles = [load_maze("antmaze-umaze"), load_maze("antmaze-large", cell_m=3.0), load_maze("hall")]
    stack = stack_mazes(singles)
    assert stack.shape == (12, 24)
    for i, single in enumerate(singles):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], stack)
        np.testing.assert_array_equal(mazes.unpadded(one), mazes.unpadded(single))
        assert float(one.cell_m) == float(single.cell_m)
        assert int(one.n_free) == int(single.n_free)


# --------------------------------------------------------------------------------------------------- geometry


@given(GRIDS, SEEDS, st.sampled_from([1.0, 4.0]))
@settings(max_examples=40)
def test_clearance_is_the_distance_to_the_nearest_wall(wall_distance, walls, seed, cell_m):
    maze = make_maze(walls, shape=SHAPE, cell_m=cell_m)
    points = draw_points(seed, walls, 64, cell_m)
    expected = np.minimum(wall_distance(maze.walls, points, cell_m), cell_m)
    np.testing.assert_allclose(clearances(maze, points), expected, atol=1e-5 * cell_m)


@given(GRIDS, SEEDS, st.floats(0.0, 1.5))
@settings(max_examples=25)
def test_segment_free_is_what_dense_sampling_says(wall_distance, walls, seed, radius):
    maze = make_maze(walls, shape=SHAPE)
    a, b = draw_segments(seed, walls, 64)
    share = np.linspace(0, 1, 401)[:, None, None]  # every 3.5 cm, so at most 1.75 cm beside the nearest point
    nearest = wall_distance(maze.walls, a + share * (b - a)).min(0)
    free = np.asarray(segments_free(maze, a, b, np.float32(radius)))
    assert free[nearest > radius + 0.02].all()
    assert not free[nearest < max(radius - 1e-4, 1e-9)].any()


def test_segment_free_is_exact_around_a_corner():
    maze = make_maze(mazes.parse_walls("#####\n#...#\n#.#.#\n#...#\n#####"), shape=SHAPE)
    corner = np.float32([8.0, 8.0])  # lower left one of the pillar; the way past it makes 45 degrees
    for radius in (0.3, 0.5, 1.0):
        for gap, free in ((radius + 1e-3, True), (radius - 1e-3, False)):
            nearest = corner - gap * np.sqrt(0.5)
            a, b = (np.float32(nearest + d * np.array([1, -1]))[None] for d in (1.5, -1.5))
            assert bool(segments_free(maze, a, b, np.float32(radius))[0]) is free


@given(GRIDS, SEEDS, st.floats(0.1, 1.5))
@settings(max_examples=25)
def test_in_sight_is_free_for_a_disc_that_fits_both_ends(wall_distance, walls, seed, radius):
    maze = make_maze(walls, shape=SHAPE)
    a, b = draw_segments(seed, walls, 64)
    share = np.linspace(0, 1, 401)[:, None, None]
    nearest = wall_distance(maze.walls, a + share * (b - a))
    disc = np.minimum(radius, 0.98 * np.minimum(nearest[0], nearest[-1]))
    seen = np.asarray(in_sight(maze, a, b, np.float32(radius)))
    assert seen[(disc > 0) & (nearest.min(0) > disc + 0.02)].all()
    assert not seen[nearest.min(0) < np.maximum(disc - 1e-4, 1e-9)].any()
    assert seen[np.asarray(segments_free(maze, a, b, np.float32(radius + 1e-4)))].all()


@given(SEEDS)
@settings(max_examples=10)
def test_reach_is_large_enough(seed):
    """``segment_reach`` cells give the same answer as all cells do, at lengths up to the promised one."""
    rng = np.random.default_rng(seed)
    walls = random_walls(seed, height=12, width=12, density=0.3)
    maze = make_maze(walls)
    max_length, radius = rng.choice([2.9, 7.0, 7.9]), rng.choice([0.5, 0.6, 1.0])
    a = draw_points(seed, walls, 256)
    angle = rng.uniform(0, 2 * np.pi, 256)
    b = np.float32(a + max_length * 0.999 * np.stack([np.cos(angle), np.sin(angle)], -1))
    reach = mazes.segment_reach(float(max_length), float(radius))
    np.testing.assert_array_equal(*(within_reach(maze, a, b, radius, n) for n in (reach, reach + 3)))


@given(GRIDS, SEEDS, st.floats(0.1, 1.5), st.booleans(), st.booleans(), st.booleans())
@settings(max_examples=25)
def test_segment_free_is_symmetric(wall_distance, walls, seed, radius, flip_x, flip_y, transpose):
    """In its ends, and under the symmetries of the square."""
    a, b = draw_segments(seed, walls, 64)
    share = np.linspace(0, 1, 201)[:, None, None]
    graze = np.abs(wall_distance(walls, a + share * (b - a)).min(0) - radius) < 0.04
    radius = np.float32(radius)
    free = np.asarray(segments_free(make_maze(walls, shape=SHAPE), a, b, radius))
    back = np.asarray(segments_free(make_maze(walls, shape=SHAPE), b, a, radius))
    assert (free == back)[~graze].all()

    size = np.float32(np.array(walls.shape[::-1]) * 4.0)
    flip = np.array([flip_x, flip_y])
    a, b = (np.where(flip, size - end, end) for end in (a, b))
    image = walls[:: -1 if flip_y else 1, :: -1 if flip_x else 1]
    if transpose:
        a, b, image = a[:, ::-1], b[:, ::-1], image.T
    mirrored = np.asarray(segments_free(make_maze(image, shape=SHAPE), a, b, radius))
    assert (free == mirrored)[~graze].all()


@given(GRIDS, SEEDS, st.floats(0.0, 1.9))
@settings(max_examples=25)
def test_samples_are_clear_of_walls(wall_distance, walls, seed, radius):
    maze = make_maze(walls, shape=SHAPE)
    keys = jax.random.split(jax.random.key(seed), 64)
    points, index = sample_many(keys, maze, np.float32(radius))
    assert (wall_distance(maze.walls, points) >= radius).all()
    assert (np.asarray(index) < int(maze.n_free)).all()
    cells = np.floor(np.asarray(points)[:, ::-1] / 4.0).astype(int)
    assert ((cells @ [SHAPE[1], 1]) == np.asarray(maze.free_cells)[np.asarray(index)]).all()


def test_samples_reach_every_free_cell_and_stay_in_their_region():
    maze = make_maze(mazes.parse_walls(TWO_REGIONS))
    _, index = sample_many(jax.random.split(jax.random.key(0), 256), maze, 0.5)
    assert set(np.asarray(index).tolist()) == set(range(int(maze.n_free)))
    _, other = sample_from(jax.random.split(jax.random.key(1), 256), maze, index, 0.5)
    np.testing.assert_array_equal(maze.region_lo[index], maze.region_lo[other])
    for lo in set(np.asarray(maze.region_lo)[: int(maze.n_free)].tolist()):
        here = np.asarray(maze.region_lo)[np.asarray(index)] == lo
        assert set(np.asarray(other)[here].tolist()) == set(range(lo, int(maze.region_hi[lo])))


def test_cells_and_centres_agree():
    maze = make_maze(mazes.parse_walls(TWO_REGIONS), cell_m=2.0)
    for flat in np.asarray(maze.free_cells)[: int(maze.n_free)]:
        centre = mazes.cell_centre(maze, jnp.asarray(flat))
        assert tuple(np.asarray(mazes.cell_of(maze, centre))) == divmod(int(flat), maze.shape[1])


def test_everything_outside_is_wall():
    maze = load_maze("antmaze-umaze")
    cells = jnp.array([[-1, 1], [1, -1], [maze.shape[0], 1], [1, maze.shape[1]], [-(2**31), 2**31 - 1]])
    assert np.asarray(mazes.is_wall(maze, cells)).all()
    assert not bool(mazes.is_wall(maze, jnp.array([1, 1])))
