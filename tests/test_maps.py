"""Maps made by others: each format is read as its makers mean it, and bad files are refused in one line."""

import io
import json
import math
import re
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ct_envs import UserError, load_maze, random_walls
from ct_envs.maps import MAX_MAP_SIDE, Map, converted, in_words, png_of, read_map, small_picture
from ct_envs.maze import draw_walls, load_walls
from ct_jax.cli import main
from tests.refusals import refusal

GRIDS = st.builds(
    lambda seed, height, width, density: random_walls(seed, height=height, width=width, density=density),
    st.integers(0, 2**31 - 1), st.integers(5, 9), st.integers(5, 9), st.floats(0, 1),
)  # fmt: skip
PLAIN = {
    "image": "floor.pgm", "resolution": "0.05", "origin": "[0, 0, 0]", "negate": "0", "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}  # fmt: skip


def pgm(grey: np.ndarray) -> bytes:
    """A binary PGM, first row on top, of 8 or 16 bits."""
    wide = grey.dtype == np.uint16
    head = f"P5\n# by a test\n{grey.shape[1]} {grey.shape[0]}\n{65535 if wide else 255}\n".encode()
    return head + (grey.astype(">u2") if wide else grey).tobytes()


def picture(array: np.ndarray, format: str = "PNG") -> bytes:
    written = io.BytesIO()
    Image.fromarray(array).save(written, format)
    return written.getvalue()


def write_map(folder, content: bytes, **changes):
    """A map_server map: its YAML file."""
    lines = PLAIN | changes
    (folder / lines["image"]).write_bytes(content)
    file = folder / "floor.yaml"
    file.write_text("".join(f"{name}: {value}\n" for name, value in lines.items() if value is not None))
    return file


def grey_of(walls: np.ndarray) -> np.ndarray:
    """A picture of a wall grid, first row on top."""
    return np.where(walls[::-1], 0, 254).astype(np.uint8)


# ------------------------------------------------------------------------------- the rules of map_server's map_io


def by_map_io(pixel: tuple[int, ...], largest: int, mode: str, negate: int, occupied: float, free: float) -> int:
    """The occupancy that map_io gives a pixel: grey, grey and alpha, red green blue, or with alpha. Written down from
    its documentation, pixel by pixel."""
    *colour, alpha = pixel if len(pixel) in (2, 4) else (*pixel, None)
    colour = colour * 3 if len(colour) == 1 else colour
    averaged = [*colour, alpha] if alpha is not None and mode == "trinary" else colour
    brightness = sum(averaged) / len(averaged) / largest
    if mode == "raw":
        level = math.floor(brightness * 255 + 0.5)
        return level if 0 <= level <= 100 else -1
    if mode == "scale" and alpha is not None and alpha != largest:
        return -1
    darkness = brightness if negate else 1.0 - brightness
    if darkness > occupied:
        return 100
    if darkness < free:
        return 0
    return -1 if mode == "trinary" else round((darkness - free) / (occupied - free) * 100.0)


def drawn_case(rng: np.random.Generator):
    """A picture file of some depth, its pixels [H, W, C], the value of full brightness, and map_server's settings."""
    depth = rng.choice(["L", "LA", "RGB", "RGBA", "L16", "PGM", "PGM16", "P2", "BMP"])
    channels = {"LA": 2, "RGB": 3, "RGBA": 4}.get(depth, 1)
    largest = 65535 if depth.endswith("16") else 255
    shape = (*rng.integers(1, 5, 2), channels)
    pixels = rng.integers(0, largest + 1, shape)
    ends = rng.random(shape) < 0.3
    pixels[ends] = rng.choice([0, largest, 205 * largest // 255, 204 * largest // 255], ends.sum())
    flat = pixels.astype(np.uint16 if largest > 255 else np.uint8)
    flat = flat[..., 0] if channels == 1 else flat
    if depth.startswith("PGM"):
        content = pgm(flat)
    elif depth == "P2":
        content = f"P2 {shape[1]} {shape[0]} 255\n{' '.join(map(str, flat.ravel()))}\n".encode()
    else:
        content = picture(flat, "BMP" if depth == "BMP" else "PNG")
    low, high = sorted(rng.choice(1001, 2, replace=False) / 1000)
    low, high = (0.196, 0.65) if rng.random() < 0.2 else (low, high)
    mode, negate = rng.choice(["trinary", "scale", "raw"]), int(rng.integers(2))
    return content, pixels, largest, str(mode), negate, float(high), float(low)


@pytest.mark.parametrize("cases", [500, pytest.param(10_000, marks=pytest.mark.slow)])
def test_map_server_maps_are_read_by_the_rules_of_map_io(tmp_path, cases):
    rng = np.random.default_rng(cases)
    for _ in range(cases):
        content, pixels, *rules = drawn_case(rng)
        _largest, mode, negate, high, low = rules
        how = {"mode": mode, "negate": negate, "occupied_thresh": high, "free_thresh": low}
        found = read_map(write_map(tmp_path, content, **how))
        expected = [[by_map_io(tuple(map(int, pixel)), *rules) for pixel in row] for row in pixels[::-1]]
        np.testing.assert_array_equal(found.occupancy, expected, str((rules, pixels.tolist())))
        assert found.occupancy.dtype == np.int8
        np.testing.assert_array_equal(found.walls, (found.occupancy < 0) | (found.occupancy >= 50))


def test_thresholds_are_strict(tmp_path):
    """Black is not above 1, and white not below 0: both are unknown, and so wall."""
    ends = np.array([[0, 255]], np.uint8)
    found = read_map(write_map(tmp_path, pgm(ends), occupied_thresh="1.0", free_thresh="0.0"))
    np.testing.assert_array_equal(found.occupancy, [[-1, -1]])
    assert found.walls.all()


@pytest.mark.parametrize(("thresh", "noted"), [("0.196", False), ("0.25", True)])
def test_grey_of_unknown_space_that_reads_as_free_is_told_in_one_line(tmp_path, thresh, noted):
    file = write_map(tmp_path, pgm(np.array([[0, 205, 254]], np.uint8)), free_thresh=thresh)
    found = read_map(file)
    assert found.occupancy[0, 1] == (0 if noted else -1)
    assert len(found.notes) == noted
    for note in found.notes:
        assert str(file) in note and "0.196" in note and note.splitlines() == [note]


def test_row_zero_is_lowest_and_the_origin_turns(tmp_path):
    """The origin is where the lower left pixel's corner lies; the yaw turns the map about it."""
    grey = np.full((2, 3), 254, np.uint8)
    grey[1, 0] = 0  # first row on top: the lower left pixel
    found = read_map(write_map(tmp_path, pgm(grey), resolution="0.5", origin=f"[-10.0, 4, {math.pi / 2}]"))
    np.testing.assert_array_equal(found.walls, [[True, False, False], [False, False, False]])
    assert found.cell_m == 0.5 and found.origin == (-10.0, 4.0, math.pi / 2)
    np.testing.assert_allclose(
        found.to_world(np.array([[0.0, 0.0], [1.5, 0.0], [0.0, 1.0]])), [[-10, 4], [-10, 5.5], [-11, 4]]
    )


@pytest.mark.parametrize(
    ("line", "value"), [("resolution", "5e-2"), ("negate", "false"), ("mode", "trinary"), ("origin", "[-1, 2, 3e-1]")]
)
def test_what_map_server_accepts_is_accepted(tmp_path, line, value):
    assert read_map(write_map(tmp_path, pgm(np.array([[0, 254]], np.uint8)), **{line: value})).cell_m == 0.05


# ------------------------------------------------------------------------------------------------- other formats


@given(GRIDS)
@settings(max_examples=30)
def test_one_floor_is_the_same_in_all_formats(tmp_path_factory, walls):
    folder = tmp_path_factory.mktemp("floor")
    marks = draw_walls(walls)
    moving_ai = f"type octile\r\nheight {walls.shape[0]}\r\nwidth {walls.shape[1]}\r\nmap\r\n"
    files = {
        "a.txt": marks.encode(),
        "b.txt": f"# mine\ncell_m: 0.5\norigin: 1 2 0\n\n{marks}\n".encode(),
        "c.json": json.dumps(walls[::-1].astype(int).tolist()).encode(),
        "d.map": (moving_ai + marks.replace("#", "@").replace("\n", "\r\n")).encode(),
        "e": (moving_ai + marks.replace("#", "T")).encode(),
        "f.png": picture(grey_of(walls)),
        "g": pgm(grey_of(walls)),
        "h.jpg": picture(grey_of(walls).repeat(16, 0).repeat(16, 1), "JPEG"),
    }  # fmt: skip
    for name, content in files.items():
        (folder / name).write_bytes(content)
        sized = {} if name == "b.txt" else {"cell_m": 0.5 / 16 if name == "h.jpg" else 0.5}
        found = read_map(folder / name, **sized).with_cells(0.5)
        np.testing.assert_array_equal(found.walls, walls, name)
        assert found.cell_m == 0.5 and found.origin == ((1, 2, 0) if name == "b.txt" else (0, 0, 0))
    found = read_map(write_map(folder, pgm(grey_of(walls)), resolution="0.5"))
    np.testing.assert_array_equal(found.walls, walls)


def test_transparent_parts_of_a_floor_plan_are_unknown(tmp_path):
    file = tmp_path / "plan.png"
    file.write_bytes(picture(np.array([[[255, 255, 255, 255], [255, 255, 255, 0], [0, 0, 0, 255]]], np.uint8)))
    np.testing.assert_array_equal(read_map(file, cell_m=0.1).occupancy, [[0, -1, 100]])


@pytest.mark.parametrize("mode", ["1", "P", "CMYK"])
def test_pictures_of_any_colours_are_read(tmp_path, mode):
    walls = random_walls(3)
    file = tmp_path / "plan"
    Image.fromarray(grey_of(walls)).convert(mode).save(file, "JPEG" if mode == "CMYK" else "PNG", quality=100)
    np.testing.assert_array_equal(read_map(file, cell_m=0.1).walls, walls)


@given(GRIDS, st.floats(0.02, 10), st.tuples(*[st.floats(-1e3, 1e3)] * 3))
@settings(max_examples=30)
def test_converting_keeps_the_map(tmp_path_factory, walls, cell_m, origin):
    """Walls, cell size and origin; a map_server map also keeps what is unknown."""
    folder = tmp_path_factory.mktemp("converted")
    occupancy = np.where(walls, 100, 0).astype(np.int8)
    occupancy[0] = -1
    found = Map(occupancy, cell_m, origin)
    for name in ("again.txt", "again.yaml"):
        for file, content in converted(found, folder / name).items():
            file.write_bytes(content)
        again = read_map(folder / name)
        assert (again.cell_m, again.origin, again.notes) == (cell_m, origin, ())
        np.testing.assert_array_equal(again.walls, walls)
    np.testing.assert_array_equal(again.occupancy, occupancy)


def test_an_open_map_is_closed_where_a_maze_is_made_of_it(tmp_path):
    """With one more ring of walls; each point of the world keeps its place."""
    file = write_map(tmp_path, pgm(np.full((3, 4), 254, np.uint8)), resolution="4.0", origin="[1.0, 2.0, 0.5]")
    walls = load_walls(file)
    np.testing.assert_array_equal(walls, np.pad(np.zeros((3, 4), bool), 1, constant_values=True))
    found = read_map(file)
    np.testing.assert_allclose(found.closed().to_world(np.array([4.0, 4.0])), found.to_world(np.zeros(2)), atol=1e-12)
    assert found.closed().closed().shape == (5, 6)


# --------------------------------------------------------------------------------------------------- other cells


@given(GRIDS, st.sampled_from([0.05, 0.3, 1.0, 4.0, 7.0]), st.sampled_from([0.1, 0.25, 1.0, 4.0, 10.0]))
@settings(max_examples=60)
def test_no_wall_is_lost_in_cells_of_another_size(walls, from_m, to_m):
    """A cell is free exactly if all of it is free; the ground stays where it is."""
    found = Map(np.where(walls, 100, 0).astype(np.int8), from_m).with_cells(to_m)
    assert found.cell_m == to_m
    height, width = (side * from_m for side in walls.shape)
    assert found.shape == (math.ceil(height / to_m - 1e-6), math.ceil(width / to_m - 1e-6))
    for row, column in np.ndindex(found.shape):
        inside = [np.arange(i * to_m + 1e-4, (i + 1) * to_m - 1e-4, min(from_m, to_m) / 3) for i in (row, column)]
        inside = [np.append(each, (i + 1) * to_m - 1e-4) for each, i in zip(inside, (row, column), strict=True)]
        at = [np.floor(each / from_m).astype(int) for each in inside]
        beyond = at[0].max() >= walls.shape[0] or at[1].max() >= walls.shape[1]
        assert found.walls[row, column] == (beyond or walls[np.ix_(*at)].any())


@pytest.mark.parametrize("fraction", [1, 2, 80])
def test_a_maze_drawn_finely_is_the_same_maze(tmp_path, fraction):
    """Cells of 4 m as 4, 2 or 0.05 m each."""
    walls = load_walls("antmaze-large")
    fine = walls.repeat(fraction, 0).repeat(fraction, 1)
    file = write_map(tmp_path, pgm(grey_of(fine)), resolution=repr(4.0 / fraction))
    np.testing.assert_array_equal(load_walls(file), walls)
    for leaf, same in zip(load_maze(file).__dict__.values(), load_maze("antmaze-large").__dict__.values(), strict=True):
        np.testing.assert_array_equal(leaf, same)


@pytest.mark.parametrize("width_m", [0.3, 1.0, 3.0])
def test_a_map_too_narrow_for_robots_is_refused_with_a_command_that_mends_it(tmp_path, capsys, width_m):
    grey = np.zeros((120, 120), np.uint8)
    cells = round(width_m / 0.05)
    grey[40 : 40 + cells, 10:110] = grey[10:110, 50 : 50 + cells] = 254
    file = write_map(tmp_path, pgm(grey))
    message = refusal(lambda: load_walls(file))
    assert str(file) in message and "no free cell of 4 m" in message
    command = re.search(r"ct-jax (maps convert .*)", message)[1].replace("OUT.txt", str(tmp_path / "out.txt"))
    assert main(command.split()) == 0
    assert "written: " in capsys.readouterr().out
    assert not load_walls(tmp_path / "out.txt").all()


# ------------------------------------------------------------------------------------------------------ bad input


def png_claiming(width: int, height: int) -> bytes:
    """A PNG of a few bytes that unpacks to a picture of that size, all black."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    packer = zlib.compressobj(9)
    rows = packer.compress(bytes(min(width * height, 10_000_000))) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


GREY = pgm(np.array([[0, 254]], np.uint8))
REST = "".join(f"{name}: {value}\n" for name, value in PLAIN.items() if name != "image")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"image": None}, ["names no image", "image: "]),
        ({"image": "''"}, ["names no image"]),
        ({"resolution": ".nan"}, ["resolution of nan m", "metres from"]),
        ({"resolution": "-0.05"}, ["resolution of -0.05 m"]),
        ({"resolution": "0"}, ["resolution of 0 m"]),
        ({"resolution": "fine"}, ["resolution of fine m"]),
        ({"resolution": None}, ["'resolution' is missing", "resolution: 0.05"]),
        ({"origin": "[1, 2]"}, ["origin is 2 numbers", "give three"]),
        ({"origin": "[1, 2, .nan]"}, ["origin is [1, 2, nan]"]),
        ({"origin": "here"}, ["origin is 'here'"]),
        ({"origin": None}, ["'origin' is missing"]),
        ({"mode": "binary"}, ["mode is 'binary'", "trinary, scale, raw"]),
        ({"negate": "2"}, ["negate is 2", "0 or 1"]),
        ({"occupied_thresh": "65"}, ["occupied_thresh is 65", "0 to 1"]),
        ({"free_thresh": "0.7"}, ["free_thresh 0.7 is not below"]),
        ({"free_thresh": None}, ["'free_thresh' is missing"]),
    ],
    ids=str,
)  # fmt: skip
def test_settings_that_are_wrong_are_named_with_the_mend(tmp_path, changes, said):
    (tmp_path / "floor.pgm").write_bytes(GREY)
    lines = {name: value for name, value in (PLAIN | changes).items() if value is not None}
    file = tmp_path / "floor.yaml"
    file.write_text("".join(f"{name}: {value}\n" for name, value in lines.items()))
    message = refusal(lambda: read_map(file))
    assert message.startswith(f"{file}: ") and not [word for word in said if word not in message], message


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no settings"), ("- 1\n- 2\n", "holds no settings"), ("image: [\n", ":2: not the YAML"),
        ("image: *floor\n", ":1: not the YAML"), ("image: !!python/object/apply:os.getcwd []\n", ":1: not the YAML"),
        ("a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\nimage: floor.pgm\n", ":2: not the YAML"),
        ("image: " + "[" * 20_000, "not the YAML"), ("image: floor.pgm\n" + "#" * 70_000, "too large"),
        (f"image: no.pgm\n{REST}", "no.pgm is not there"), (f"image: .\n{REST}", "is not there"),
    ],
    ids=lambda text: " ".join(text[:24].split()),
)  # fmt: skip
def test_yaml_that_is_no_map_is_refused(tmp_path, text, said):
    file = tmp_path / "floor.yaml"
    file.write_text(text)
    assert said in (message := refusal(lambda: read_map(file))) and message.startswith(str(file))


def test_a_bomb_of_aliases_is_refused_before_it_grows(tmp_path):
    """Each line has ten times the line above it: the last would be ten thousand million words."""
    lines = ["a0: &a0 [x]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 11)]
    file = tmp_path / "floor.yaml"
    file.write_text("\n".join([*lines, "image: *a10"]))
    assert "alias" in refusal(lambda: read_map(file))


@pytest.mark.parametrize("size", [(30_000, 30_000), (MAX_MAP_SIDE + 1, 1), (1, MAX_MAP_SIDE + 1), (2**31 - 1,) * 2])
def test_a_picture_that_unpacks_to_too_much_is_refused_before_it_does(tmp_path, size):
    file = write_map(tmp_path, png_claiming(*size))
    message = refusal(lambda: read_map(file))
    assert str(tmp_path / "floor.pgm") in message and f"at most {MAX_MAP_SIDE} x {MAX_MAP_SIDE}" in message


BROKEN = {
    "text": b"###\n#.#\n###\n",
    "nothing": b"",
    "half": picture(np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8).astype(np.uint8))[:2000],
    "jpeg": b"\xff\xd8\xff\xe0 not a picture",
    "pgm": b"P5\n9 9\n255\n123",
    "pgm-size": b"P5\n-1 9\n255\n123",
    "bmp": b"BM not a picture at all",
    "svg": b"<svg/>",
}


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN)
def test_an_image_that_is_none_is_refused(tmp_path, content):
    file = write_map(tmp_path, content)
    message = refusal(lambda: read_map(file))
    assert str(tmp_path / "floor.pgm") in message and "cannot be read as a picture" in message and "PGM" in message


def test_colours_of_16_bits_are_refused(tmp_path):
    """The library reads only their upper 8 bits, which would not be the map."""
    content = bytearray(picture(np.zeros((1, 1, 3), np.uint8)))
    content[24] = 16
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    assert "16 bits" in refusal(lambda: read_map(write_map(tmp_path, bytes(content))))


def test_a_picture_needs_a_scale(tmp_path):
    alone, beside = tmp_path / "alone.pgm", tmp_path / "floor.pgm"
    alone.write_bytes(GREY)
    file = write_map(tmp_path, GREY)
    assert "--resolution 0.05" in refusal(lambda: read_map(alone))
    assert str(file) in refusal(lambda: load_maze(beside))
    assert read_map(alone, cell_m=0.1).cell_m == 0.1
    assert "0.05 m, not 0.1 m" in refusal(lambda: read_map(file, cell_m=0.1))


MOVING_AI = "type octile\nheight 2\nwidth 3\nmap\n"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("floor.map", "height 2\n", "begin it with 'type octile'"),
        ("floor.map", MOVING_AI.replace("2", "two") + "...\n...\n", "begin it with"),
        ("floor.map", MOVING_AI.replace("2", "90000") + "...\n...\n", "8192 x 8192"),
        ("floor.map", MOVING_AI + "...\n", "1 rows, but its height is 2"),
        ("floor.map", MOVING_AI + "...\n...\n...\n", "3 rows, but its height is 2"),
        ("floor.map", MOVING_AI + "...\n..\n", ":6: 2 cells, but the width is 3"),
        ("floor.map", MOVING_AI + "...\n.x.\n", ":6: column 2 is 'x'"),
        ("floor.txt", "cell_m: wide\n###\n#.#\n###", ":1: cell_m of wide m"),
        ("floor.txt", "cell_m: nan\n###\n#.#\n###", ":1: cell_m of nan m"),
        ("floor.txt", "cell_m: 1 2\n###\n#.#\n###", ":1: cell_m of 1 2 m"),
        ("floor.txt", "\ncell_m: 1\norigin: 1 2\n###\n#.#\n###", ":3: origin is 2 numbers"),
        ("floor.txt", "cell_m: 1\n###\n#.#\n#x#", ":4: column 2 is 'x'"),
        ("floor.txt", "cell_m: 1\n" + "#" * 9000, "8192 x 8192"),
    ],
)
def test_text_that_is_no_map_is_refused(tmp_path, name, text, said):
    file = tmp_path / name
    file.write_text(text)
    assert said in (message := refusal(lambda: read_map(file))) and message.startswith(str(file)), message


def test_a_map_without_free_space_is_refused(tmp_path):
    file = write_map(tmp_path, pgm(np.full((9, 9), 205, np.uint8)))
    assert "no free cell" in refusal(lambda: load_walls(file))
    assert "no free cell" in refusal(lambda: converted(read_map(file), tmp_path / "out.txt"))


@given(GRIDS, st.floats(0.05, 3))
@settings(max_examples=30)
def test_room_is_the_distance_to_the_nearest_wall(walls, cell_m):
    """From centre to centre of cells; the outside is wall. A robot that needs more is refused."""
    found = Map(np.where(walls, 100, 0).astype(np.int8), cell_m)
    outside = np.argwhere(np.pad(walls, 1, constant_values=True)) - 1
    apart = [np.hypot(*(outside - (row, column)).T).min() for row, column in np.ndindex(walls.shape)]
    np.testing.assert_allclose(found.room().ravel(), np.array(apart) * cell_m, rtol=1e-9)
    widest = max(apart) * cell_m
    found.check_room(0.99 * widest)
    assert f"radius {1.01 * widest:g} m" in refusal(lambda: found.check_room(1.01 * widest))


ENDINGS = st.sampled_from(["", ".txt", ".json", ".map", ".yaml", ".png", ".pgm"])
STARTS = st.sampled_from(
    [b"", b"cell_m: 0.5\n", b"image: floor.pgm\n", b"type octile\nheight 2\nwidth 2\nmap\n", b"P5\n2 2\n255\n",
     b"P2 1 1 255", b"[[", b"\x89PNG\r\n\x1a\n", b"BM", b"\xff\xd8\xff", GREY, MOVING_AI.encode() + b"...\n.@.\n"]
)  # fmt: skip


@given(ENDINGS, STARTS, st.binary(max_size=60) | st.text("#.@0\n: 5[],", max_size=60).map(str.encode))
@settings(max_examples=400)
def test_any_file_is_a_map_or_refused_in_one_line(tmp_path_factory, ending, start, rest):
    file = tmp_path_factory.getbasetemp() / f"fuzzed-map{ending}"
    file.write_bytes(start + rest)
    try:
        found = read_map(file)
    except UserError as refused:
        assert str(file) in str(refused) and len(str(refused).splitlines()) == 1
        return
    assert found.occupancy.dtype == np.int8 and found.occupancy.size and found.occupancy.min() >= -1
    assert found.occupancy.max() <= 100 and (found.cell_m is None or found.cell_m > 0)


# ---------------------------------------------------------------------------------------------- the command line


def told(capsys, *arguments, status=0):
    """What ``ct-jax maps`` prints, on stdout and stderr."""
    capsys.readouterr()
    assert main(["maps", *map(str, arguments)]) == status
    return capsys.readouterr()


def test_show_tells_size_area_regions_and_draws(tmp_path, capsys):
    grey = np.zeros((40, 60), np.uint8)
    grey[10:30, 5:25] = grey[10:30, 35:55] = 254
    file = write_map(tmp_path, pgm(grey), origin="[-1, 2, 0]")
    drawn = tmp_path / "floor.png"
    out = told(capsys, "show", file, "--picture", drawn).out
    for words in ("60 x 40 cells of 0.05 m, 3 x 2 m", "(-1, 2) m", "2.0 m²", "33.3 % free", "regions: 2", "0.50 m"):
        assert words in out, out
    rows = [line for line in out.splitlines() if line and set(line) <= set("#+.")]
    assert len({len(row) for row in rows}) == 1 and any("." in row and "#" in row[1:-1] for row in rows)
    shown = np.asarray(Image.open(drawn))
    times = shown.shape[0] // 40
    np.testing.assert_array_equal(shown[::times, ::times] > 128, grey > 128)
    assert told(capsys, "show", file, "--radius-m", "0.4").out == out
    assert "no free space for a robot of radius 0.6 m" in told(capsys, "show", file, "--radius-m", "0.6", status=2).err


def test_show_tells_of_a_map_without_a_scale(tmp_path, capsys):
    file = tmp_path / "floor.map"
    file.write_text(MOVING_AI + "...\n.@.\n")
    assert "cell size: not said" in told(capsys, "show", file).out
    assert "of 2 m, 6 x 4 m" in told(capsys, "show", file, "--resolution", "2").out


def test_convert_writes_what_read_map_reads(tmp_path, capsys):
    file = write_map(tmp_path, pgm(grey_of(random_walls(1).repeat(10, 0).repeat(10, 1))))
    out = tmp_path / "out.txt"
    assert str(out) in told(capsys, "convert", file, out, "--cell-m", "0.5", "--scale", "8").out
    assert out.read_text().startswith("cell_m: 4.0\n")
    np.testing.assert_array_equal(load_walls(out), random_walls(1))
    again = tmp_path / "again.yaml"
    told(capsys, "convert", out, again)
    np.testing.assert_array_equal(load_walls(again), random_walls(1))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["show", "nowhere.yaml"], "nowhere.yaml: no such file"),
        (["convert", "floor.yaml"], "give OUT"),
        (["show", "floor.yaml", "out.txt"], "give OUT"),
        (["show", "floor.yaml", "--picture", "out.gif"], "give a .png file"),
        (["convert", "floor.yaml", "out.gif"], "ends in .txt"),
        (["convert", "floor.yaml", "no/such/out.txt"], "folder that exists"),
        (["convert", "floor.map", "out.txt"], "--resolution"),
        (["show", "floor.map", "--scale", "2"], "--resolution"),
        (["show", "floor.yaml", "--scale", "nan"], "scale nan"),
        (["show", "floor.yaml", "--scale", "1e9"], "metres from"),
        (["show", "floor.yaml", "--cell-m", "-1"], "cells of -1.0 m"),
        (["show", "floor.yaml", "--radius-m", "0"], "above 0"),
        (["draw", "floor.yaml"], "show"),
    ],
    ids=lambda each: " ".join(each) if isinstance(each, list) else "",
)
def test_bad_commands_are_refused_in_one_line(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    write_map(tmp_path, GREY)
    (tmp_path / "floor.map").write_text(MOVING_AI + "...\n.@.\n")
    out, err = told(capsys, *arguments, status=2)
    assert out == "" and err.count("\n") == 1 and err.startswith("error: ") and said in err, err
    assert not list(tmp_path.glob("out*"))


def test_pictures_and_words_take_any_map():
    """A single cell, all wall, and a long corridor."""
    for walls in (np.ones((1, 1), bool), np.zeros((1, 1), bool), np.zeros((3, 500), bool), np.zeros((500, 3), bool)):
        found = Map(np.where(walls, 100, 0).astype(np.int8), 0.05)
        rows = small_picture(found).split("\n")
        assert len({len(row) for row in rows}) == 1 and len(rows[0]) <= 72 and len(rows) <= 72
        assert in_words(found) and Image.open(io.BytesIO(png_of(found))).size[0] % walls.shape[1] == 0
