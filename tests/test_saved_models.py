"""The files of a model are validated: 2,000 mutations of descriptions and weights. None of them causes a traceback, is
accepted outside its range, or changes the function of a model.
"""

import copy
import json
import struct
from dataclasses import is_dataclass

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file

from ct_envs import UserError
from ct_jax.controller import ControllerConfig
from ct_jax.controllers.augment import AugmentConfig
from ct_jax.controllers.edges import EdgeConfig
from ct_jax.controllers.reward import RewardConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.fit import ValueConfig
from ct_jax.model import (
    TrainedModel,
    blank_model,
    load_controller,
    load_model,
    model_folder,
    save_controller,
    save_model,
    zoo_names,
)
from ct_jax.runtime.checkpoint import _sum_of_arrays, load_weights, save_weights
from ct_jax.settings import Settings, controller_config, from_dict, to_dict
from ct_jax.transformer import ModelConfig

pytestmark = pytest.mark.rank_promotion("allow")  # brax's running statistics

SETTINGS = Settings(
    model=ModelConfig(layers=1, heads=2, width=8, context=3, context_acting=3, max_timestep=16),
    value=ValueConfig(width=8),
    sac=SacConfig(hidden=(8, 4)),
)


def examples(n):
    """A number of examples, the same in every run."""
    return settings(
        max_examples=n, derandomize=True, database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )  # fmt: skip


# Values that no setting or only some settings accept.
NASTY = [
    None, True, False, -5, -1, 0, 1, 2, 3, 4, 99, 10**9, 2**31, 2**64, 10**400, 0.0, 0.5, 1.0, 2.0, 3.0, -0.5, 1e300,
    float("nan"), float("inf"), "", "1", "3", "x", "ab", "world", "heading", "sideways", "own", "point", "ant", "a\nb",
    "\x00", "x" * 10_000, [], [0], [1, 2], ["a"], [[[[[]]]]], {}, {"a": 1}, {"layers": 1},
]  # fmt: skip


def places(value, path=()):
    """The paths to all parts of a JSON value."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in inside:
        yield (*path, key)
        yield from places(part, (*path, key))


def at(value, path):
    for key in path:
        value = value[key]
    return value


@st.composite
def mutated(draw, value):
    """A JSON object with one to three parts replaced, removed, added, moved or wrapped."""
    value = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        found = list(places(value))
        if not found:
            break
        *parents, last = draw(st.sampled_from(found))
        parent = at(value, parents)
        match draw(st.sampled_from(["replace", "replace", "replace", "leave out", "add", "move", "wrap"])):
            case "replace":
                parent[last] = draw(st.sampled_from(NASTY))
            case "leave out":
                del parent[last]
            case "add":
                objects = [value, *(part for path in found if isinstance(part := at(value, path), dict))]
                name = draw(st.sampled_from(["colour", "layers", "heads", "rooms", "", "a" * 500]))
                draw(st.sampled_from(objects))[name] = draw(st.sampled_from(NASTY))
            case "move":
                parent[last] = copy.deepcopy(at(value, draw(st.sampled_from(found))))
            case "wrap":
                parent[last] = draw(st.sampled_from([[parent[last]], {"a": parent[last]}]))
    return value


def refused(load) -> bool:
    """Whether loading raises a UserError of one line."""
    try:
        load()
    except UserError as bad:
        assert "\n" not in str(bad) and len(str(bad)) < 1000
        return True
    return False


# ---------------------------------------------------------------------------------------------------- settings


def leaves(value):
    """The settings of a config that are not configs."""
    if is_dataclass(value):
        return [leaf for name in value.__dataclass_fields__ for leaf in leaves(getattr(value, name))]
    return [part for entry in value for part in leaves(entry)] if isinstance(value, tuple) else [value]


@given(mutated(json.loads(json.dumps(to_dict(SETTINGS)))))
@examples(500)
def test_mutated_settings_are_error_or_valid(values):
    """Accepted settings are finite and moderate, have the types of the defaults, and survive a round trip."""
    found = []
    if refused(lambda: found.append(from_dict(values))):
        return
    for leaf in leaves(found[0]):
        assert leaf is None or isinstance(leaf, bool | str) or (-1e6 <= leaf <= 2**32)
    assert from_dict(json.loads(json.dumps(to_dict(found[0])))) == found[0]
    model = found[0].model
    assert min(model.layers, model.heads, model.context_acting, model.modes, model.stride) >= 1 < model.width + 1
    assert model.width % model.heads == 0 and model.map_cell_m > 0 and found[0].return_scale > 0
    assert all(type(size) is int and size > 0 for size in found[0].sac.hidden)


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "layers": st.integers(0, 3), "heads": st.integers(0, 4), "width": st.integers(0, 9),
            "modes": st.integers(0, 3), "frame": st.sampled_from(["world", "heading", "sideways"]),
            "skill": st.booleans(), "actions": st.booleans(), "stride": st.integers(0, 2),
            "directions": st.integers(0, 2),
        },
    ),
    st.sampled_from(["point", "ant", "turtlebot3"]),
)  # fmt: skip
@examples(40)
def test_accepted_settings_build_models(changes, robot):
    values = to_dict(SETTINGS)
    values["model"] |= changes
    refused(lambda: blank_model(robot, from_dict(values)))


# ------------------------------------------------------------------------------------------------------- folders


@pytest.fixture(scope="module")
def trained():
    policy, controller = blank_model("point", SETTINGS)

    def draw(tree):
        rng = np.random.default_rng(0)
        return jax.tree.map(lambda leaf: rng.uniform(0.1, 1.0, leaf.shape).astype(leaf.dtype), tree)

    return TrainedModel("point", SETTINGS, draw(policy), draw(controller), {"command": "ct-jax train point"})


@pytest.fixture(scope="module")
def folder(trained, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    save_model(folder, trained)
    save_controller(folder / "controller", "point", controller_config(SETTINGS), trained.controller, {"seed": 0})
    return folder


def assert_same_model(found, model):
    assert (found.robot, found.settings) == (model.robot, model.settings)
    jax.tree.map(np.testing.assert_array_equal, found.policy, model.policy)
    jax.tree.map(np.testing.assert_array_equal, found.controller, model.controller)


@pytest.fixture(scope="module")
def model_json(trained, tmp_path_factory):
    """The original text; tests change the file in ``folder``."""
    folder = tmp_path_factory.mktemp("unchanged")
    save_model(folder, trained)
    return json.loads((folder / "model.json").read_text())


@given(data=st.data())
@examples(500)
def test_mutated_model_description_is_error_or_equivalent(folder, model_json, trained, data):
    (folder / "model.json").write_text(json.dumps(data.draw(mutated(model_json))))
    found = []
    if not refused(lambda: found.append(load_model(str(folder)))):
        assert_same_model(found[0], trained)


@given(data=st.data())
@examples(400)
def test_mutated_controller_description_is_error_or_equivalent(folder, trained, data):
    place = folder / "controller"
    save_controller(place, "point", controller_config(SETTINGS), trained.controller, {"seed": 0})
    described = json.loads((place / "controller.json").read_text())
    (place / "controller.json").write_text(json.dumps(data.draw(mutated(described))))
    found = []
    if not refused(lambda: found.append(load_controller(str(place), "point"))):
        controller, config = found[0]
        assert config == controller_config(SETTINGS)
        jax.tree.map(np.testing.assert_array_equal, controller, trained.controller)


@given(
    st.integers(0, 3000), st.sampled_from(["[" * 100_000, '{"a":' * 100_000, "9" * 5000, "NaN", "-Infinity", "1e999"])
)
@examples(60)
def test_unreadable_json_is_error_of_one_line(folder, trained, where, what):
    save_model(folder, trained)
    text = (folder / "model.json").read_text()
    where = text.index(":", where % (len(text) - 10)) + 1
    (folder / "model.json").write_text(text[:where] + what + "," + text[where:])
    assert refused(lambda: load_model(str(folder)))


@pytest.mark.parametrize("change", [{"heads": 1}, {"heads": 4}, {"stride": 2}, {"returns": False},
                                    {"context_acting": 4}, {"map_cell_m": 0.4}, {"commitment": 1.0}])  # fmt: skip
def test_changed_model_with_same_shapes_is_error(folder, trained, model_json, change):
    """The shapes of the weights are the same, but the function differs."""
    save_model(folder, trained)
    settings = model_json["settings"]
    for number in (1, 2):  # also if the file claims an earlier format
        changed = model_json | {"format": number, "settings": settings | {"model": settings["model"] | change}}
        (folder / "model.json").write_text(json.dumps(changed))
        with pytest.raises(UserError, match=r"weights\.safetensors: weights of another model"):
            load_model(str(folder))


def test_files_of_earlier_versions_are_read(folder, trained, model_json):
    """Their weights have no digest of the description, and their format shows it."""
    save_model(folder, trained)
    weights = folder / "weights.safetensors"
    arrays = {"transformer": trained.policy.params, "value": trained.policy.value_params}
    arrays |= {"normalizer": trained.controller.normalizer, "controller": trained.controller.policy}
    save_weights(weights, arrays)
    with pytest.raises(UserError, match="weights of another model"):
        load_model(str(folder))
    (folder / "model.json").write_text(json.dumps(model_json | {"format": 1}))
    assert_same_model(load_model(str(folder)), trained)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_controllers_that_earlier_versions_wrote_are_read(trained, tmp_path, number):
    """Their settings were one object, and were bound to the weights as they stood in the file."""
    flat = {"hidden": [8, 4], "iterations": 7, "fall_m": [1.0, 2.0], "relabel": 0.5, "mirror": True}
    flat |= {"effort": 0.5} if number < 3 else {"action_scale": 0.5}
    said = {"robot": "point", "sac": flat}
    save_weights(tmp_path / "weights.safetensors", trained.controller, of=said if number > 1 else None)
    described = said | {"proprio": 2, "actions": 2, "format": number, "made": {}}
    (tmp_path / "controller.json").write_text(json.dumps(described))
    found, config = load_controller(str(tmp_path), "point")
    assert config == ControllerConfig(
        SacConfig(hidden=(8, 4), iterations=7, action_scale=0.5),
        EdgeConfig(reward=RewardConfig(fall_m=(1.0, 2.0)), relabel=0.5),
        AugmentConfig(mirror=True),
    )
    assert found.action_scale == 0.5
    jax.tree.map(np.testing.assert_array_equal, found.policy, trained.controller.policy)
    if number > 1:
        described["sac"]["mirror"] = False
        (tmp_path / "controller.json").write_text(json.dumps(described))
        with pytest.raises(UserError, match="weights of another model"):
            load_controller(str(tmp_path), "point")


@pytest.mark.parametrize("number", [0, 5, 99, None, "2", 2.0, True])
def test_unknown_format_is_error_with_known_formats(folder, trained, model_json, number):
    save_model(folder, trained)
    (folder / "model.json").write_text(json.dumps(model_json | {"format": number}))
    with pytest.raises(UserError, match=r"model\.json: of format .*; this version of ct-jax reads 1 to 4"):
        load_model(str(folder))


@pytest.mark.parametrize("name", zoo_names())
def test_shipped_weights_belong_to_their_description(name, tmp_path):
    place = model_folder("zoo:" + name)
    for file in place.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    described = json.loads((tmp_path / "model.json").read_text())
    described["settings"]["model"]["max_timestep"] *= 2
    (tmp_path / "model.json").write_text(json.dumps(described))
    with pytest.raises(UserError, match="weights of another model"):
        load_model(str(tmp_path))


# ------------------------------------------------------------------------------------------------------- weights

TREE = {
    "a": np.linspace(-1.0, 1.0, 6, dtype=np.float32).reshape(2, 3),
    "b": {"c": np.arange(4, dtype=np.float32), "n": np.uint32([7])},
}
FLAT = {"a": TREE["a"], "b/c": TREE["b"]["c"], "b/n": TREE["b"]["n"]}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    file = tmp_path_factory.mktemp("weights") / "w.safetensors"
    save_weights(file, TREE)
    return file, file.read_bytes()


@given(data=st.data())
@examples(400)
def test_changed_bytes_are_error_or_have_no_effect(weights, data):
    file, whole = weights
    parts = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        where = data.draw(st.integers(0, max(len(parts) - 1, 0)))
        match data.draw(st.sampled_from(["flip", "set", "cut", "insert", "remove", "length"])):
            case "flip" if parts:
                parts[where] ^= 1 << data.draw(st.integers(0, 7))
            case "set" if parts:
                parts[where] = data.draw(st.sampled_from(b'\x00\xff "{}[]:,019-'))
            case "cut":
                del parts[where:]
            case "insert":
                parts[where:where] = data.draw(st.binary(max_size=9))
            case "remove":
                del parts[where : where + data.draw(st.integers(1, 9))]
            case "length":
                parts[:8] = struct.pack(
                    "<Q", data.draw(st.sampled_from([0, 1, 2**31, 2**63, len(whole), len(whole) - 8]))
                )
    file.write_bytes(bytes(parts))
    found = []
    if not refused(lambda: found.append(load_weights(file, TREE))):
        jax.tree.map(np.testing.assert_array_equal, found[0], TREE)


TYPES = [np.float64, np.float16, np.int8, np.int32, np.bool_, np.uint32, np.complex64]


@given(data=st.data())
@examples(200)
def test_wrong_arrays_with_correct_sum_are_error(weights, data):
    """Arrays of another type or shape, arrays that are not finite, missing arrays, and additional arrays."""
    file, _ = weights
    arrays = dict(FLAT)
    name = data.draw(st.sampled_from(sorted(arrays)))
    match data.draw(st.sampled_from(["type", "shape", "value", "missing", "more", "sum"])):
        case "type":
            other = data.draw(st.sampled_from([kind for kind in TYPES if kind != arrays[name].dtype]))
            arrays[name] = arrays[name].astype(other)
        case "shape":
            shapes = [arrays[name][None], arrays[name][..., None], arrays[name][:0], np.concatenate([arrays[name]] * 2)]
            arrays[name] = data.draw(st.sampled_from(shapes))
        case "value":
            name = "a"
            arrays[name] = arrays[name].copy()
            where = data.draw(st.tuples(st.integers(0, 1), st.integers(0, 2)))
            arrays[name][where] = data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
        case "missing":
            del arrays[name]
        case "more":
            arrays[data.draw(st.sampled_from(["d", "b/d", "a/b", ""]))] = np.zeros(1, np.float32)
        case "sum":
            save_file(arrays, file, metadata=data.draw(st.sampled_from([None, {}, {"sha256": ""}, {"sum": "x"}])))
            assert refused(lambda: load_weights(file, TREE))
            return
    save_file(arrays, file, metadata={"sha256": _sum_of_arrays(arrays)})
    assert refused(lambda: load_weights(file, TREE))


def test_error_of_weights_shows_found_and_needed_shape(weights):
    file, _ = weights

    def refusal(arrays, **metadata):
        save_file(arrays, file, metadata={"sha256": _sum_of_arrays(arrays)} | metadata)
        with pytest.raises(UserError, match=r"w\.safetensors: ") as caught:
            load_weights(file, TREE)
        return str(caught.value)

    assert "'a' has type float64, this model needs float32" in refusal(FLAT | {"a": np.float64(TREE["a"])})
    assert "'a' has type bool, this model needs float32" in refusal(FLAT | {"a": TREE["a"] > 0})
    assert "'a' is not finite everywhere" in refusal(FLAT | {"a": np.full((2, 3), np.nan, np.float32)})
    assert "holds weights 'd' besides" in refusal(FLAT | {"d": np.zeros(1)})
    assert "not as it was written" in refusal(FLAT, sha256="0" * 64)
    save_file(FLAT, file)
    with pytest.raises(UserError, match="without its SHA-256 sum"):
        load_weights(file, TREE)


@pytest.mark.parametrize("kind", ["F8_E4M3", "F8_E8M0"])
def test_types_unknown_to_numpy_are_error(tmp_path, kind):
    header = json.dumps({"a": {"dtype": kind, "shape": [2, 3], "data_offsets": [0, 6]}}).encode()
    (tmp_path / "w.safetensors").write_bytes(struct.pack("<Q", len(header)) + header + bytes(6))
    assert refused(lambda: load_weights(tmp_path / "w.safetensors", TREE))


def test_diverged_weights_are_error_when_saved(tmp_path):
    with pytest.raises(UserError, match="'a' has become infinite or NaN in training; try a lower learning rate"):
        save_weights(tmp_path / "w.safetensors", {"a": np.float32([1.0, np.nan])})
    assert not list(tmp_path.iterdir())
