"""What is kept on disk comes back as it was, or with an error that says which file and why."""

import json
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from ct_envs import UserError
from ct_jax import checkpoint
from ct_jax.checkpoint import Checkpoints, load_weights, read_json, save_weights, write_json


@struct.dataclass
class State:
    weights: dict
    key: jax.Array
    keys: jax.Array
    step: jax.Array


def state(seed: int = 0) -> State:
    key = jax.random.key(seed)
    weights = {"a": jax.random.normal(key, (2, 3)), "b": [jnp.asarray(1.5 + seed), jnp.arange(4) % 3 == 0]}
    return State(weights, key, jax.random.split(key, 3), jnp.asarray(seed, jnp.int32))


def same(a, b) -> None:
    def plain(leaf):
        return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf

    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype and np.shape(x) == np.shape(y)
        np.testing.assert_array_equal(plain(x), plain(y))


# ------------------------------------------------------------------------------------------------ checkpoints


def test_a_state_comes_back_with_its_keys(tmp_path):
    kept = Checkpoints(tmp_path / "states")
    assert kept.restore(state()) is None
    kept.save(7, state(3))
    kept.close()
    again = Checkpoints(tmp_path / "states")
    step, found = again.restore(state())
    assert step == 7
    same(found, state(3))
    np.testing.assert_array_equal(jax.random.uniform(found.key, (3,)), jax.random.uniform(state(3).key, (3,)))
    again.close()


def test_the_newest_comes_back_and_few_are_kept(tmp_path):
    kept = Checkpoints(tmp_path / "states", keep=2)
    for step in (1, 2, 5):
        kept.save(step, state(step))
    kept.save(5, state(9))  # is there already
    step, found = kept.restore(state())
    kept.close()
    assert step == 5
    same(found, state(5))
    assert sorted(int(p.name) for p in (tmp_path / "states").iterdir() if p.name.isdigit()) == [2, 5]


def test_it_saves_now_and_then(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])
    kept = Checkpoints(tmp_path / "states", every_s=60.0)
    for step, now[0] in enumerate((10.0, 59.0, 61.0, 100.0, 122.0)):
        kept.maybe_save(step, state(step))
    monkeypatch.undo()
    assert sorted(int(p.name) for p in (tmp_path / "states").iterdir() if p.name.isdigit()) == [2, 4]
    kept.close()


# ---------------------------------------------------------------------------------------------------- weights

TREE = {
    "layer": {"kernel": jnp.arange(6.0).reshape(2, 3), "bias": jnp.ones(3)},
    "count": jnp.asarray(4, jnp.uint32),
}


def test_weights_come_back_as_they_were(tmp_path):
    """Also in a structure of shapes only, transposed in memory, and single numbers."""
    turned = TREE | {"t": jnp.arange(6.0).reshape(2, 3).T, "n": np.arange(6).reshape(2, 3).T}
    save_weights(tmp_path / "w.safetensors", turned)
    same(load_weights(tmp_path / "w.safetensors", turned), turned)
    same(load_weights(tmp_path / "w.safetensors", jax.eval_shape(lambda: turned)), turned)


def test_other_weights_are_refused_with_both_shapes(tmp_path):
    file = tmp_path / "w.safetensors"
    save_weights(file, TREE)
    wider = {"layer": {"kernel": jnp.zeros((2, 5)), "bias": jnp.ones(3)}}
    with pytest.raises(UserError, match=r"w\.safetensors: 'layer/kernel' has shape \(2, 3\).*needs \(2, 5\)"):
        load_weights(file, wider)
    with pytest.raises(UserError, match=r"w\.safetensors: holds no weights 'layer/scale'"):
        load_weights(file, {"layer": {"scale": jnp.ones(3)}})


@pytest.mark.parametrize("damage", ["missing", "empty", "half", "pickle", "text"])
def test_damaged_weights_are_refused(tmp_path, damage):
    file = tmp_path / "w.safetensors"
    save_weights(file, TREE)
    whole = file.read_bytes()
    content = {"empty": b"", "half": whole[: len(whole) // 2], "text": b"no weights at all"}
    if damage == "missing":
        file.unlink()
    elif damage == "pickle":
        file.write_bytes(pickle.dumps(Trap(tmp_path / "sprung")))
    else:
        file.write_bytes(content[damage])
    with pytest.raises(UserError, match=r"w\.safetensors"):
        load_weights(file, TREE)
    assert not (tmp_path / "sprung").exists()


class Trap:
    """Writes a file when it is unpickled."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return self.file.write_text, ("sprung",)


# ------------------------------------------------------------------------------------------------------- JSON


def test_json_comes_back(tmp_path):
    value = {"a": [1, 2.5, None, "ä"], "b": {"c": True}}
    write_json(tmp_path / "x.json", value)
    assert read_json(tmp_path / "x.json") == value
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]  # nothing half-written is left


def test_a_failed_write_leaves_the_old_file(tmp_path):
    write_json(tmp_path / "x.json", {"old": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "x.json", {"new": object()})
    assert read_json(tmp_path / "x.json") == {"old": 1}


def test_json_errors_name_the_file_and_the_line(tmp_path):
    file = tmp_path / "x.json"
    file.write_text(json.dumps({"a": 1, "b": 2}, indent=2).replace("2", "two"))
    with pytest.raises(UserError, match=r"x\.json:3: not JSON"):
        read_json(file)
    file.write_bytes(b"\xff\xfe{}")
    with pytest.raises(UserError, match=r"x\.json"):
        read_json(file)
    with pytest.raises(UserError, match=r"gone\.json: no such file"):
        read_json(tmp_path / "gone.json")
    with pytest.raises(UserError, match=tmp_path.name):
        read_json(tmp_path)


def test_without_compilation(tmp_path, jit_disabled):
    kept = Checkpoints(tmp_path / "states")
    kept.save(1, state(1))
    same(kept.restore(state())[1], state(1))
    kept.close()
    save_weights(tmp_path / "w.safetensors", TREE)
    same(load_weights(tmp_path / "w.safetensors", TREE), TREE)
