"""Trajectories: from recorded episodes to training windows without loss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ct_envs import POINT, ROBOTS, UserError, load_maze, make_maze, random_walls, stack_mazes
from ct_envs.frames import symmetries
from ct_envs.occupancy import local_map
from ct_jax.trajectories import (
    Trajectories,
    concatenate,
    load,
    mirror_windows,
    pack_maps,
    pad,
    sample_windows,
    save,
    select,
    unpack_maps,
)

MAZES = stack_mazes([load_maze("antmaze-umaze"), make_maze(random_walls(1)), make_maze(random_walls(2, height=12))])
LENGTHS = [3, 17, 40]
CELL = 0.8
draw = jax.jit(sample_windows, static_argnames=("batch", "steps", "map_cell_m", "shift_timestep", "stride"))
GROUP = symmetries(POINT)


def fields(data):
    leaves = {name: getattr(data, name) for name in data.__dataclass_fields__}
    return {name: np.asarray(leaf) for name, leaf in leaves.items() if leaf is not None}


def assert_same(a, b) -> None:
    for name, leaf in fields(a).items():
        np.testing.assert_array_equal(leaf, getattr(b, name), err_msg=name)
        assert leaf.dtype == np.asarray(getattr(b, name)).dtype, name


# ----------------------------------------------------------------------------------------------- return-to-go


@given(st.integers(0, 2**31 - 1), st.lists(st.integers(0, 9), min_size=3, max_size=3))
@settings(max_examples=20)
def test_return_to_go_is_sum_of_future_rewards(toy_data, seed, lengths):
    data = toy_data(lengths, seed=seed, steps=9)
    rtg = np.asarray(data.rtg)
    for i, length in enumerate(lengths):
        expected = [data.reward[i, t:length].astype(np.float64).sum() for t in range(9)]
        np.testing.assert_allclose(rtg[i], expected, rtol=1e-5, atol=1e-4)


def test_padding_does_not_affect_return(toy_data):
    data = toy_data(LENGTHS)
    padding = np.arange(data.reward.shape[1]) >= data.length[:, None]
    other = data.replace(reward=np.where(padding, np.nan, data.reward))
    np.testing.assert_array_equal(data.rtg, other.rtg)


# ---------------------------------------------------------------------------------------------------- windows


def windows(data: Trajectories, seed: int = 0, **options):
    return draw(jax.random.key(seed), data, data.rtg, MAZES, **{"batch": 64, "steps": 5, "map_cell_m": CELL} | options)


def which_step(window, data: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Trajectory and step [B, S] of windows. After the end of a short trajectory, it is the last step."""
    i = np.asarray(window.proprio)[:, :1, 0].astype(int)
    return np.broadcast_to(i, window.valid.shape), np.asarray(window.proprio)[..., 1].astype(int)


def test_maps_match_positions(toy_data):
    data = toy_data(LENGTHS, mazes=3)
    window = windows(data, steps=12)
    i, t = which_step(window, data)
    assert set(data.maze[i.ravel()]) == set(data.maze)
    mazes = jax.tree.map(lambda leaf: leaf[data.maze[i.ravel()]], MAZES)
    positions, goals = data.position[i, t].reshape(-1, 2), data.goal_world[i.ravel()]
    expected = jax.vmap(lambda m, p, g: local_map(m, p, g, cell_m=CELL))(mazes, positions, goals)
    np.testing.assert_array_equal(window.map.reshape(expected.shape), expected)
    np.testing.assert_array_equal(window.goal_relative.reshape(-1, 2), goals - positions)


@pytest.mark.parametrize("stride", [1, 3])
def test_window_is_part_of_trajectory(toy_data, stride):
    data = toy_data(LENGTHS)
    data = data.replace(label_mask=(np.random.default_rng(0).random(data.label_mask.shape) < 0.5).astype(np.float32))
    window = windows(data, steps=5, stride=stride)
    i, t = which_step(window, data)
    inside = np.asarray(window.timestep) < data.length[i]
    np.testing.assert_array_equal(window.valid, inside)
    np.testing.assert_array_equal(np.diff(t, axis=1)[inside[:, 1:]], stride)
    np.testing.assert_array_equal(window.timestep[inside], (t[:, :1] + stride * np.arange(5))[inside])
    for name in ("action", "label", "label_mask"):
        np.testing.assert_array_equal(getattr(window, name)[inside], getattr(data, name)[i, t][inside], err_msg=name)
    np.testing.assert_array_equal(np.asarray(window.rtg)[inside], np.asarray(data.rtg)[i, t][inside])
    assert not np.asarray(window.label_mask)[~inside].any()
    assert (~inside).any() and not (~inside)[np.asarray(data.length)[i] >= 5 * stride].any()  # only short ones


def test_single_steps_are_drawn_uniformly(toy_data):
    """A chi-square test over all steps of the data, with a fixed seed. Padding is never drawn."""
    data = toy_data([3, 0, 17, 40])
    counts = np.zeros(data.reward.shape)
    for seed in range(3):
        window = windows(data, seed, steps=1, batch=2000)
        np.add.at(counts, which_step(window, data), 1)
    inside = np.arange(40) < data.length[:, None]
    assert not counts[~inside].any()
    expected = counts.sum() / inside.sum()
    chi2 = ((counts[inside] - expected) ** 2 / expected).sum()
    assert chi2 < 2 * inside.sum(), (chi2, inside.sum())


@pytest.mark.parametrize("stride", [1, 3])
def test_all_steps_occur_in_windows(toy_data, stride):
    data = toy_data(LENGTHS)
    window = windows(data, steps=8, batch=2000, stride=stride)
    i, t = which_step(window, data)
    seen = np.zeros(data.reward.shape, bool)
    valid = np.asarray(window.valid) > 0
    seen[i[valid], t[valid]] = True
    np.testing.assert_array_equal(seen, np.arange(40) < data.length[:, None])
    share = np.bincount(i[:, 0], minlength=3) / len(i)
    np.testing.assert_allclose(share, data.length / data.length.sum(), atol=0.04)


@pytest.mark.parametrize(("stride", "steps"), [(1, 8), (3, 4)])
def test_all_steps_are_equally_likely(toy_data, stride, steps):
    data = toy_data([40])
    window = windows(data, steps=steps, batch=4000, stride=stride)
    counts = np.bincount(which_step(window, data)[1].ravel(), minlength=40)
    middle = counts[stride * steps : -stride * steps]
    assert counts[[0, -1]].min() > 0.9 * middle.mean() and window.valid.all()


def test_shifted_timesteps_keep_their_differences(toy_data):
    data = toy_data([30])
    plain, shifted = windows(data), windows(data, shift_timestep=9)
    shift = np.asarray(shifted.timestep - plain.timestep)
    assert (shift == shift[:, :1]).all()
    assert set(shift[:, 0]) == set(range(10))
    assert_same(shifted.replace(timestep=plain.timestep), plain)


# ------------------------------------------------------------------------------------------------- symmetries


def test_eight_symmetries_are_a_group(toy_data):
    one = jax.tree.map(lambda leaf: leaf[:1], windows(toy_data([30], seed=3)))
    images = [mirror_windows(jnp.array([s]), GROUP, one) for s in range(8)]
    names = ("map", "proprio", "goal_relative", "action", "label")

    def index(window) -> int:
        """The index of the symmetry that gives a window."""
        equal = [all(np.array_equal(getattr(window, n), getattr(image, n)) for n in names) for image in images]
        assert sum(equal) == 1
        return equal.index(True)

    assert [index(image) for image in images] == list(range(8))  # all are different
    table = np.array([[index(mirror_windows(jnp.array([s]), GROUP, image)) for image in images] for s in range(8)])
    for line in (*table, *table.T):
        assert sorted(line) == list(range(8))  # closed, with inverses
    assert (table[0] == np.arange(8)).all()
    assert (table != table.T).any()  # rotations and reflections do not commute


def element(bits: int) -> int:
    """Index in the group for: swap x and y (bit 0), then flip x (bit 1), then flip y (bit 2)."""
    world = np.diag([1.0 - (bits & 2), 1.0 - (bits >> 1 & 2)]) @ (np.eye(2)[::-1] if bits & 1 else np.eye(2))
    return int(np.flatnonzero((GROUP.world == world).all((1, 2)))[0])


def turn_world(symmetry: int, mazes, data: Trajectories):
    """The same episodes in a mirrored world, computed from the definition of the bits."""
    side = mazes.shape[0] * 4.0
    walls, centre = np.asarray(mazes.walls), np.float32(side / 2)
    points = {"position": np.asarray(data.position) - centre, "goal_world": np.asarray(data.goal_world) - centre}
    vectors = points | {name: np.asarray(getattr(data, name)) for name in ("proprio", "action", "label")}
    if symmetry & 1:
        walls, vectors = walls.swapaxes(1, 2), {name: v[..., ::-1] for name, v in vectors.items()}
    if symmetry & 2:
        walls, vectors = walls[:, :, ::-1], {name: v * np.float32([-1, 1]) for name, v in vectors.items()}
    if symmetry & 4:
        walls, vectors = walls[:, ::-1], {name: v * np.float32([1, -1]) for name, v in vectors.items()}
    for name in points:
        vectors[name] = vectors[name] + centre
    return stack_mazes([make_maze(w) for w in walls]), data.replace(**vectors)


@pytest.mark.parametrize("symmetry", range(8))
def test_mirrored_window_equals_window_of_mirrored_world(toy_data, symmetry):
    """Positions on a grid of 1/64 m and map cells of 3/4 m make all sums exact, so that windows can be equal."""
    mazes = stack_mazes([make_maze(random_walls(seed, height=12, width=12, density=0.7)) for seed in range(3)])
    data = toy_data([20, 9], mazes=3, side_m=48.0, seed=symmetry)
    data = data.replace(
        position=np.round(data.position * 64) / 64 + 1 / 128, goal_world=np.round(data.goal_world * 64) / 64 + 1 / 128
    )
    turned_mazes, turned = turn_world(symmetry, mazes, data)
    options = {"batch": 16, "steps": 4, "map_cell_m": 0.75}
    window = draw(jax.random.key(0), data, data.rtg, mazes, **options)
    other = draw(jax.random.key(0), turned, turned.rtg, turned_mazes, **options)
    assert window.map[:, :, 1].any() and window.map[:, :, 0].any()
    assert_same(mirror_windows(jnp.full(16, element(symmetry)), GROUP, window), other)


def test_mirroring_samples_all_symmetries(toy_data):
    data = toy_data([30])
    plain, mirrored = windows(data), windows(data, symmetries=GROUP)
    found = {
        s
        for s in range(8)
        for i in range(64)
        if np.array_equal(mirror_windows(jnp.full(64, s), GROUP, plain).action[i], mirrored.action[i])
    }
    assert found == set(range(8))


# -------------------------------------------------------------------------------------------- kept and joined


def test_saving_and_loading_is_the_identity(toy_data, tmp_path):
    data = toy_data(LENGTHS, mazes=3)
    save(data, tmp_path / "data.npz")
    assert_same(load(tmp_path / "data.npz"), data)


@pytest.mark.parametrize("damage", ["missing", "empty", "text", "half", "one byte", "other arrays", "pickle"])
def test_damaged_file_is_error(toy_data, tmp_path, damage):
    file = tmp_path / "data.npz"
    save(toy_data(LENGTHS), file)
    whole = file.read_bytes()
    middle = len(whole) // 3
    match damage:
        case "missing":
            file.unlink()
        case "other arrays":
            np.savez(file, position=np.zeros(3))
        case "pickle":
            np.savez(file, **fields(toy_data(LENGTHS)) | {"goal_world": np.array([{"a": 1}], dtype=object)})
        case _:
            content = {"empty": b"", "text": b"no arrays", "half": whole[: len(whole) // 2]}
            broken = whole[:middle] + bytes([whole[middle] ^ 0xFF]) + whole[middle + 1 :]
            file.write_bytes(content.get(damage, broken))
    with pytest.raises(UserError, match=r"data\.npz"):
        load(file)


def damaged(arrays, draw):
    """Arrays of trajectories; one of them has an invalid value."""
    name = draw(st.sampled_from(sorted(arrays)))
    array = arrays[name]
    match draw(st.sampled_from(["missing", "type", "axis", "cut", "value"])):
        case "missing":
            return {other: arrays[other] for other in arrays if other != name}
        case "type":
            kinds = [np.bool_, np.complex64, np.str_, np.float32 if array.dtype.kind in "iu" else np.int8]
            return arrays | {name: array.astype(draw(st.sampled_from(kinds)))}
        case "axis":
            return arrays | {name: draw(st.sampled_from([array[None], array[..., None], array[0]]))}
        case "cut":
            return arrays | {name: array[:-1], draw(st.sampled_from(["more", ""])): array}
        case _:
            name = draw(st.sampled_from([name for name in sorted(arrays) if name not in ("map_bits",)]))
            bad = [-1, 10**6] if name == "length" else [-1] if name == "maze" else [np.nan, np.inf]
            changed = arrays[name].copy()
            changed[(0,) * changed.ndim] = draw(st.sampled_from(bad))
            return arrays | {name: changed}


@given(data=st.data())
@settings(max_examples=200, derandomize=True, database=None)
def test_invalid_arrays_are_error(toy_data, tmp_path_factory, data):
    good = toy_data(LENGTHS)
    if data.draw(st.booleans()):
        maps = np.zeros((*good.reward.shape, 2, 25, 25), np.uint8)
        good = good.replace(goal_relative=good.proprio, map_bits=pack_maps(maps))
    file = tmp_path_factory.getbasetemp() / "bad.npz"
    np.savez(file, **damaged(fields(good), data.draw))
    with pytest.raises(UserError, match=r"bad\.npz: not a trajectory file \(.*\); collect again"):
        load(file)


@given(st.data())
@settings(max_examples=200, derandomize=True, database=None)
def test_changed_bytes_are_error_or_have_no_effect(toy_data, tmp_path_factory, data):
    good, file = toy_data([2, 3]), tmp_path_factory.getbasetemp() / "changed.npz"
    save(good, file)
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(content)
    try:
        found = load(file)
    except UserError as bad:
        assert "\n" not in str(bad)
    else:
        assert_same(found, good)


def test_padding_in_file_is_ignored(toy_data, tmp_path):
    good = toy_data([2, 5])
    reward = good.reward.copy()
    reward[0, 2:] = np.nan
    save(good.replace(reward=reward), tmp_path / "data.npz")
    assert_same(load(tmp_path / "data.npz"), good.replace(reward=reward))


@pytest.mark.parametrize("steps", [(2, 40, 300), (64, 65, 2), (7, 7, 7)])
def test_joining_keeps_everything(toy_data, steps):
    """For any padding of the parts. Padding may be cut, but steps are not."""
    parts = [toy_data([1, n // 2, n], seed=n, steps=n + extra) for n, extra in zip(steps, (0, 9, 400), strict=True)]
    whole = concatenate(parts)
    assert whole.n == 9
    single = [(part, i) for part in parts for i in range(part.n)]
    for k, (part, i) in enumerate(single):
        length = part.length[i]
        for name, leaf in fields(part).items():
            per_step = name not in ("goal_world", "maze", "length")
            one, joined = leaf[i], np.asarray(getattr(whole, name))[k]
            np.testing.assert_array_equal(joined[:length] if per_step else joined, one[:length] if per_step else one)
    assert whole.position.shape[1] < max(steps) + 64


def test_selection_by_integers_and_bools(toy_data):
    data = toy_data(LENGTHS)
    assert_same(select(data, np.array([2, 0])), concatenate_exact(data, [2, 0]))
    assert_same(select(data, np.array([True, False, True])), concatenate_exact(data, [0, 2]))


def concatenate_exact(data: Trajectories, index: list[int]) -> Trajectories:
    return Trajectories(**{name: np.stack([leaf[i] for i in index]) for name, leaf in fields(data).items()})


def test_memory_of_a_thousand_trajectories(toy_data):
    data = toy_data([128] * 1000)
    assert data.nbytes == sum(leaf.nbytes for leaf in fields(data).values())
    assert data.nbytes < 32e6


def test_window_is_the_same_without_jit(toy_data):
    data = toy_data(LENGTHS, mazes=3)
    compiled = windows(data, batch=2, steps=2)
    with jax.disable_jit():
        plain = windows(data, batch=2, steps=2)
    np.testing.assert_array_equal(plain.map, compiled.map)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), plain, compiled)


# --------------------------------------------------------------------------------------------- maps that are kept


@pytest.fixture
def kept(toy_data):
    """Make trajectories with stored maps and goals, which contain the index of the step."""

    def make(lengths):
        data = toy_data(lengths)
        maps = np.random.default_rng(1).integers(0, 2, (*data.reward.shape, 2, 25, 25), dtype=np.uint8)
        return data.replace(goal_relative=data.proprio + np.float32(0.5), map_bits=pack_maps(maps)), maps

    return make


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=5)
def test_packing_of_maps_is_lossless(seed):
    maps = np.random.default_rng(seed).integers(0, 2, (3, 4, 2, 25, 25), dtype=np.uint8)
    np.testing.assert_array_equal(unpack_maps(pack_maps(maps)), maps)


def test_stored_maps_and_goals_need_no_maze(kept):
    data, maps = kept(LENGTHS)
    window = draw(jax.random.key(0), data, data.rtg, None, batch=64, steps=5, map_cell_m=CELL)
    i, t = which_step(window, data)
    np.testing.assert_array_equal(window.map, maps[i, t])
    np.testing.assert_array_equal(window.goal_relative, np.stack([i, t], -1) + np.float32(0.5))


def test_stored_maps_survive_saving_padding_and_joining(kept, tmp_path):
    data, _ = kept(LENGTHS)
    save(data, tmp_path / "data.npz")
    assert_same(data, load(tmp_path / "data.npz"))
    assert_same(select(pad(data, 5, 64), np.arange(3)), concatenate([data]))
    joined = concatenate([select(data, np.array([0])), select(data, np.array([1, 2]))])
    assert_same(joined, concatenate([data]))


def test_mirrored_turtlebot3_swaps_left_and_right(kept):
    """In its own frame, rows of the map run to the left, so they are reversed. Only sideways components change."""
    data, _ = kept([30])
    group = symmetries(ROBOTS["turtlebot3"])
    assert len(group.world) == 2
    window = draw(jax.random.key(0), data, data.rtg, None, batch=8, steps=5, map_cell_m=CELL)
    mirrored = mirror_windows(jnp.ones(8, jnp.int32), group, window)
    np.testing.assert_array_equal(mirrored.map, window.map[..., ::-1, :])
    for name in ("proprio", "goal_relative", "action", "label"):
        np.testing.assert_array_equal(getattr(mirrored, name), np.asarray(getattr(window, name)) * np.float32([1, -1]))
    assert_same(mirror_windows(jnp.ones(8, jnp.int32), group, mirrored), window)
