"""Maze files and nested lists: what people write is read, the rest is refused in one line, and nothing in between."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ct_envs import UserError, load_maze, make_maze, random_walls
from ct_envs.maze import draw_walls, load_walls, parse_walls
from tests.refusals import refusal

GYMNASIUM = [  # a map as Gymnasium-Robotics has it: first row on top, "r" for resets, "g" for goals
    [1, 1, 1, 1, 1, 1, 1, 1],
    [1, "r", 0, 1, 1, 0, 0, 1],
    [1, 0, 0, 1, 0, 0, "g", 1],
    [1, 1, 0, 0, 0, 1, 1, 1],
    [1, 0, 0, 1, 0, 0, 0, 1],
    [1, "g", 1, 0, 0, 1, 0, 1],
    [1, 0, 0, 0, 1, "c", 0, 1],
    [1, 1, 1, 1, 1, 1, 1, 1],
]
GRIDS = st.builds(
    lambda seed, height, width, density: random_walls(seed, height=height, width=width, density=density),
    st.integers(0, 2**31 - 1), st.integers(5, 9), st.integers(5, 9), st.floats(0, 1),
)  # fmt: skip


# --------------------------------------------------------------------------------------------------- nested lists


def test_a_nested_list_is_read_as_gymnasium_robotics_has_it():
    maze = make_maze(GYMNASIUM)
    assert int(maze.n_free) == 26
    top_down = np.asarray(maze.walls)[: len(GYMNASIUM)][::-1, : len(GYMNASIUM[0])]
    np.testing.assert_array_equal(top_down, [[cell == 1 for cell in row] for row in GYMNASIUM])


@given(GRIDS, st.data())
@settings(max_examples=30)
def test_a_drawing_is_the_same_maze_as_text_list_and_json(walls, data):
    free = data.draw(st.lists(st.sampled_from([0, "r", "g", "c"]), min_size=walls.size, max_size=walls.size))
    rows = [
        [1 if wall else free[i * walls.shape[1] + j] for j, wall in enumerate(row)] for i, row in enumerate(walls[::-1])
    ]
    marks = "\n".join("".join(map(str, row)) for row in rows)
    for indent in (None, 2):
        np.testing.assert_array_equal(parse_walls(json.dumps(rows, indent=indent)), walls)
    for text in (marks, draw_walls(walls)):
        np.testing.assert_array_equal(parse_walls(text), walls)
    for same in (rows, tuple(map(tuple, rows)), [[np.int64(c) if c in (0, 1) else c for c in row] for row in rows]):
        np.testing.assert_array_equal(make_maze(same).walls, make_maze(walls).walls)


@given(GRIDS)
@settings(max_examples=20)
def test_an_array_is_a_grid_with_row_zero_lowest(walls):
    for same in (walls.astype(np.int64), walls.astype(np.uint8), make_maze(walls, shape=walls.shape).walls):
        np.testing.assert_array_equal(make_maze(same).walls, make_maze(walls).walls)
    assert (np.asarray(make_maze(walls).walls)[: len(walls), : walls.shape[1]] == walls).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({(1, 2): 0.5}, "row 2, column 3 is 0.5"),
        ({(1, 2): 0.0}, "row 2, column 3 is 0.0"),
        ({(1, 2): 2}, "row 2, column 3 is 2"),
        ({(3, 4): "x"}, "row 4, column 5 is 'x'"),
        ({(3, 4): "1"}, "row 4, column 5 is '1'"),
        ({(3, 4): "rg"}, "row 4, column 5 is 'rg'"),
        ({(1, 1): None}, "row 2, column 2 is None"),
        ({(1, 1): True}, "row 2, column 2 is True"),
        ({(1, 1): [0]}, "row 2, column 2 is [0]"),
        ({(1, 1): "two\nlines" * 20}, "row 2, column 2 is"),
        ({(1, 0): 0}, "row 2, column 1 is free at the border"),
        ({(7, 3): "g"}, "row 8, column 4 is free at the border"),
        ({(0, 2): "r"}, "row 1, column 3 is free at the border"),
    ],
)
def test_a_nested_list_with_a_strange_entry_is_refused(tmp_path, change, said):
    rows = [[change.get((i, j), cell) for j, cell in enumerate(row)] for i, row in enumerate(GYMNASIUM)]
    assert said in refusal(lambda: make_maze(rows))
    file = tmp_path / "floor.json"
    file.write_text(json.dumps(rows))
    assert f"{file}: " in (message := refusal(lambda: load_maze(file))) and said.partition(" is ")[0] in message


@pytest.mark.parametrize(
    "walls",
    [
        [], [[]], [[], []], [1, 0, 1], [[1, 1, 1], [1, 0], [1, 1, 1]], [[1, 1, 1], 5, [1, 1, 1]], "###\n#.#\n###", 7,
        ["111", "101", "111"], [[1] * 3] * 3, [[[1] * 3] * 3] * 3, None, {1: 1}, [[1] * 2000] * 3,
        np.pad(np.zeros((3, 3)), 1, constant_values=1.0), np.full((3, 3), "1"), np.zeros((2, 5, 5), bool),
        np.array([[1, 1, 1], [1, 0, 1], [1, 1, 2]]), np.array([[1, 1, 1], [1, -1, 1], [1, 1, 1]]),
        np.array(GYMNASIUM, object), np.array(GYMNASIUM), np.array([[1, 0, 1], [1, 0, 1], [1, 1, 1]]),
        np.array([[1, 1, 1], [1, 0, 1], [1, 0, 1]], bool), np.zeros(0, bool), np.zeros((0, 3), bool),
    ],
    ids=lambda walls: " ".join(repr(walls)[:40].split()),
)  # fmt: skip
def test_grids_that_are_no_mazes_are_refused(walls):
    refusal(lambda: make_maze(walls))


@pytest.mark.parametrize("cell_m", [0.0, -4.0, float("nan"), float("inf")])
def test_cells_without_a_size_are_refused(cell_m):
    assert str(cell_m) in refusal(lambda: make_maze(GYMNASIUM, cell_m=cell_m))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[1, 1, 1],\n [1, 0 1],\n [1, 1, 1]]", ":2: not JSON"), ("[[1, 1", ":1: not JSON"), ("[" * 100_000, ": not "),
        ("[[1, NaN]]", "column 2 is nan"), ("[" + "9" * 5000 + "]", ": "), ("[]", "no free cell"), ("[[]]", "no free"),
        ('[{"a": 1}]', "row 1 is"), ("[[1, true]]", "column 2 is True"), ('[["\\ud800"]]', "column 1 is '\\ud800'"),
    ],
    ids=lambda text: text[:20],
)  # fmt: skip
def test_json_that_is_no_maze_is_refused(text, said):
    assert said in refusal(lambda: parse_walls(text, source="floor.json"))


# ------------------------------------------------------------------------------------------------------- maze text

SMALL = "#####\n#...#\n##.##\n#####"


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + SMALL, SMALL.replace("\n", " \n"), SMALL.replace("\n", "\t \r\n"), "\n" + SMALL, " \n\r\n\n" + SMALL,
        "# my floor\n" + SMALL, "\ufeff# my floor, 2nd\n\n# drawn by me\n" + SMALL + "\n\n# the end\n",
        SMALL.replace("##.##", "# a door here\n##.##"), "11111\n1r0g1\n11c11\n11111",
    ],
)  # fmt: skip
def test_what_people_write_is_read(text):
    np.testing.assert_array_equal(parse_walls(text), parse_walls(SMALL))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\n\n#####\n#.x.#\n#####", ":4: column 3 is 'x'"),
        ("# my floor\n#####\n#...#\n####", ":4: 4 cells, but line 2 has 5"),
        ("# my floor\n\n#####\n# a way\n#....\n#####", ":5: column 5 is free at the border"),
        ("\ufeff#####\n#.. #\n#####", ":2: column 4 is ' '"),
        ("#####\n\n#...#\n#####", ":2: 0 cells, but line 1 has 5"),
        ("#####\n#...#\n#   #\n#####", ":3: column 2 is ' '"),  # free cells as spaces: a row, no comment
        ("#####\n# r g\n#  r#\n#####", ":3: column 2 is ' '"),
        ("#####\n#   #\n#####", ":2: column 2 is ' '"),
        ("#####\n# S #\n#####", ":2: column 2 is ' '"),
        ("#####\n# ..#\n#####", ":2: column 2 is ' '"),
        ("#####\n#my floor\n#####", ":2: column 2 is 'm'"),
        ("# only a comment", ": empty"),
        ("11111\n1.001\n11111", ":2: column 2 is '.'"),
        ("#####\n#.0.#\n#####", ":2: column 3 is '0'"),
    ],
)
def test_errors_name_the_line_of_the_file(text, said):
    assert f"floor.txt{said}" in refusal(lambda: parse_walls(text, source="floor.txt"))


@given(GRIDS, st.text("#. ", max_size=3), st.data())
@settings(max_examples=50)
def test_a_row_drawn_with_spaces_is_never_taken_for_a_comment(walls, marks, data):
    """Such a row has a wall at each end, whatever stands between them: all or nothing of the maze is read."""
    rows = draw_walls(walls).split("\n")
    which = data.draw(st.integers(1, len(rows) - 2))
    middle = rows[which][1:-1].replace(".", " ")
    rows[which] = "#" + data.draw(st.permutations([*middle, *marks, "S"]).map("".join)) + "#"
    assert f":{which + 1}: " in refusal(lambda: parse_walls("\n".join(rows), source="floor.txt"))


# ------------------------------------------------------------------------------------------------------------ fuzz

VALID = st.one_of(
    GRIDS.map(draw_walls),
    GRIDS.map(lambda walls: draw_walls(walls).replace("#", "1").replace(".", "0")),
    GRIDS.map(lambda walls: json.dumps(walls[::-1].astype(int).tolist())),
    GRIDS.map(lambda walls: json.dumps(walls[::-1].astype(int).tolist(), indent=1)),
)
PIECES = st.sampled_from(
    ["#", ".", " ", "\n", "\r\n", "\r", "\t", "\ufeff", "# note", "[", "]", ",", "1", "0", "r", "2", "-1", "0.5", '"r"',
     '"x"', "true", "null", "NaN", "1e999", "{}", "\0", "\x85", "\u2028", "é", "\U0001f600", "", "\ud7ff"]
)  # fmt: skip


@st.composite
def mutated(draw) -> bytes:
    """Valid maze text with some spans replaced, repeated or cut."""
    text = draw(VALID)
    for _ in range(draw(st.integers(0, 4))):
        begin = draw(st.integers(0, len(text)))
        end = draw(st.integers(begin, min(len(text), begin + 12)))
        text = text[:begin] + draw(PIECES | st.just(2 * text[begin:end])) + text[end:]
    data = text.encode()
    cut = draw(st.integers(0, len(data)) | st.none())
    return data[:cut] if draw(st.booleans()) else data


FILES = st.one_of(st.binary(max_size=200), st.text("#.\n 01rgc[],", max_size=60).map(str.encode), mutated())


@given(content=FILES)
@settings(max_examples=600)
def test_any_file_is_a_maze_or_refused_in_one_line(tmp_path_factory, content):
    file = tmp_path_factory.getbasetemp() / "fuzzed-maze"
    file.write_bytes(content)
    try:
        walls = load_walls(file)
    except UserError as refused:
        assert str(file) in str(refused) and len(str(refused).splitlines()) == 1
        return
    assert walls.dtype == bool and not walls.all()
    assert walls[[0, -1]].all() and walls[:, [0, -1]].all()
    np.testing.assert_array_equal(parse_walls(draw_walls(walls)), walls)
    np.testing.assert_array_equal(make_maze(walls[::-1].astype(int).tolist()).walls, make_maze(walls).walls)


ENTRIES = st.one_of(
    st.sampled_from([0, 1, "r", "g", "c"]), st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3)
)


@given(st.lists(st.lists(ENTRIES, max_size=5), max_size=5) | st.recursive(ENTRIES, st.lists, max_leaves=12))
@settings(max_examples=300)
def test_any_nested_list_is_a_maze_or_refused_in_one_line(rows):
    try:
        maze = make_maze(rows)
    except UserError as refused:
        assert len(str(refused).splitlines()) == 1
        return
    assert int(maze.n_free) == sum(cell != 1 for row in rows for cell in row) > 0
