"""Files on disk are restored exactly, or give an error with the file and the reason."""

import errno
import json
import os
import pickle
import resource
import shutil
import signal
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from ct_envs import UserError
from ct_jax.runtime import checkpoint
from ct_jax.runtime.checkpoint import Checkpoints, load_weights, read_json, save_weights, write_json
from ct_jax.runtime.interrupts import Terminated, interruptible


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


def assert_same(a, b) -> None:
    def plain(leaf):
        return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf

    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype and np.shape(x) == np.shape(y)
        np.testing.assert_array_equal(plain(x), plain(y))


# ------------------------------------------------------------------------------------------------ checkpoints


def test_state_round_trip_includes_random_keys(tmp_path):
    kept = Checkpoints(tmp_path / "states")
    assert kept.restore(state()) is None
    kept.save(7, state(3))
    kept.close()
    again = Checkpoints(tmp_path / "states")
    step, found = again.restore(state())
    assert step == 7
    assert_same(found, state(3))
    np.testing.assert_array_equal(jax.random.uniform(found.key, (3,)), jax.random.uniform(state(3).key, (3,)))
    again.close()


def test_newest_state_is_restored_and_old_ones_are_deleted(tmp_path):
    kept = Checkpoints(tmp_path / "states", keep=2)
    for step in (1, 2, 5):
        kept.save(step, state(step))
    kept.save(5, state(9))  # this step exists already
    step, found = kept.restore(state())
    kept.close()
    assert step == 5
    assert_same(found, state(5))
    assert sorted(int(p.name) for p in (tmp_path / "states").iterdir() if p.name.isdigit()) == [2, 5]


def test_maybe_save_saves_at_intervals(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])
    kept = Checkpoints(tmp_path / "states", every_s=60.0)
    for step, now[0] in enumerate((10.0, 59.0, 61.0, 100.0, 122.0)):
        kept.maybe_save(step, state(step))
    monkeypatch.undo()
    assert sorted(int(p.name) for p in (tmp_path / "states").iterdir() if p.name.isdigit()) == [2, 4]
    kept.close()


def saved(folder, *steps, size=1000):
    """Checkpoints of these steps. Each state contains its step number many times."""
    kept = Checkpoints(folder)
    for step in steps:
        kept.save(step, {"a": np.full(size, step, np.float32)})
    kept.close()


def restored(folder, size=1000):
    """The newest undamaged state, as (step, its numbers)."""
    kept = Checkpoints(folder)
    found = kept.restore({"a": np.zeros(size, np.float32)})
    kept.close()
    return found and (found[0], set(np.asarray(found[1]["a"]).tolist()))


def one_bit(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


DAMAGES = {
    "one bit": one_bit,
    "half": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
    "missing": lambda file: file.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_checkpoint_falls_back_to_previous(tmp_path, damage, capsys):
    """Each file of the newest checkpoint is damaged in turn, also the manifest. One line reports it."""
    saved(tmp_path / "first", 1, 2)
    state = tmp_path / "first" / "2" / "default"
    manifest = (state / checkpoint.MANIFEST).read_text()
    files = [line.partition("  ")[2] for line in manifest.splitlines()] + [checkpoint.MANIFEST]
    assert len(files) > 3 and sum((state / file).stat().st_size for file in files) > 1000
    for number, file in enumerate(files):
        folder = Path(shutil.copytree(tmp_path / "first", tmp_path / str(number)))
        DAMAGES[damage](folder / "2" / "default" / file)
        capsys.readouterr()
        assert restored(folder) == (1, {1.0}), file
        err = capsys.readouterr().err
        assert err.startswith(f"warning: {folder / '2'}: damaged checkpoint") and err.count("\n") == 1
    saved(folder, 2)
    assert restored(folder) == (2, {2.0})


@pytest.mark.parametrize("change", ["nothing", "one line", "one file more"])
def test_manifest_must_cover_exactly_all_files(tmp_path, change):
    saved(tmp_path, 1, 2)
    state = tmp_path / "2" / "default"
    manifest = state / checkpoint.MANIFEST
    match change:
        case "nothing":
            manifest.write_text("")
        case "one line":
            manifest.write_text("".join(manifest.read_text().splitlines(keepends=True)[:-1]))
        case _:
            (state / "d" / "more").write_bytes(b"")
    assert restored(tmp_path) == (1, {1.0})


def test_training_restarts_if_all_checkpoints_are_damaged(tmp_path, capsys):
    saved(tmp_path, 1, 2)
    for step in (1, 2):
        one_bit(tmp_path / str(step) / "default" / checkpoint.MANIFEST)
    assert restored(tmp_path) is None
    assert capsys.readouterr().err.count("warning: ") == 2


def test_manifest_has_format_of_sha256sum(tmp_path):
    saved(tmp_path, 1)
    checked = subprocess.run(
        ["sha256sum", "--check", "--strict", checkpoint.MANIFEST], cwd=tmp_path / "1" / "default", capture_output=True
    )
    assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("limit", [0, 300, 10_000, 100_000])
def test_full_disk_keeps_earlier_checkpoints(tmp_path, limit):
    """A limit of the file size stands for a full disk. The system's error differs only in its number."""
    saved(tmp_path, 1)
    kept = Checkpoints(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        with pytest.raises(UserError, match=r"cannot be written \(.*--resume"):
            kept.save(2, {"a": np.random.default_rng(0).random(100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        kept.close()
    assert restored(tmp_path) == (1, {1.0})
    assert [path.name for path in tmp_path.iterdir()] == ["1"]


@pytest.mark.parametrize("failing", [errno.ENOSPC, errno.EDQUOT])
def test_error_of_full_disk_names_the_reason(tmp_path, failing, monkeypatch):
    def full(folder):
        raise OSError(failing, os.strerror(failing), str(folder))

    monkeypatch.setattr(checkpoint, "_write_manifest", full)
    with pytest.raises(UserError, match=rf"{tmp_path.name}: cannot be written \({os.strerror(failing)}\)"):
        saved(tmp_path, 1)
    monkeypatch.undo()
    assert restored(tmp_path) is None


def test_signal_is_handled_after_save(tmp_path, monkeypatch):
    write = checkpoint._write_manifest

    def signalled(folder):
        os.kill(os.getpid(), signal.SIGTERM)
        write(folder)

    monkeypatch.setattr(checkpoint, "_write_manifest", signalled)
    with pytest.raises(Terminated), interruptible():
        saved(tmp_path, 1)
    assert restored(tmp_path) == (1, {1.0})


# ---------------------------------------------------------------------------------------------------- weights

TREE = {
    "layer": {"kernel": jnp.arange(6.0).reshape(2, 3), "bias": jnp.ones(3)},
    "count": jnp.asarray(4, jnp.uint32),
}


def test_weights_round_trip_is_identity(tmp_path):
    """Also for a structure that has only shapes, for arrays that are transposed in memory, and for scalars."""
    turned = TREE | {"t": jnp.arange(6.0).reshape(2, 3).T, "n": np.arange(6, dtype=np.int32).reshape(2, 3).T}
    save_weights(tmp_path / "w.safetensors", turned)
    assert_same(load_weights(tmp_path / "w.safetensors", turned), turned)
    assert_same(load_weights(tmp_path / "w.safetensors", jax.eval_shape(lambda: turned)), turned)


def test_same_weights_give_same_file(tmp_path):
    for name in "abcdefgh":
        save_weights(tmp_path / name, TREE, of={"robot": "point"})
    assert len({file.read_bytes() for file in tmp_path.iterdir()}) == 1


def test_other_weights_are_error_with_both_shapes(tmp_path):
    file = tmp_path / "w.safetensors"
    save_weights(file, TREE)
    wider = {"layer": {"kernel": jnp.zeros((2, 5)), "bias": jnp.ones(3)}}
    with pytest.raises(UserError, match=r"w\.safetensors: 'layer/kernel' has shape \(2, 3\).*needs \(2, 5\)"):
        load_weights(file, wider)
    with pytest.raises(UserError, match=r"w\.safetensors: holds no weights 'layer/scale'"):
        load_weights(file, {"layer": {"scale": jnp.ones(3)}})


@pytest.mark.parametrize("damage", ["missing", "empty", "half", "pickle", "text", "one bit"])
def test_damaged_weights_are_error(tmp_path, damage):
    file = tmp_path / "w.safetensors"
    save_weights(file, TREE)
    whole = file.read_bytes()
    flipped = whole[:-1] + bytes([whole[-1] ^ 1])  # the last number
    content = {"empty": b"", "half": whole[: len(whole) // 2], "text": b"no weights at all", "one bit": flipped}
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
    """An object that writes a file when it is unpickled."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return self.file.write_text, ("sprung",)


# ------------------------------------------------------------------------------------------------------- JSON


def test_json_file_round_trip_is_identity(tmp_path):
    value = {"a": [1, 2.5, None, "ä"], "b": {"c": True}}
    write_json(tmp_path / "x.json", value)
    assert read_json(tmp_path / "x.json") == value
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]  # no unfinished file remains


def test_failed_write_keeps_old_file(tmp_path):
    write_json(tmp_path / "x.json", {"old": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "x.json", {"new": object()})
    assert read_json(tmp_path / "x.json") == {"old": 1}


def test_json_errors_name_file_and_line(tmp_path):
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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": NaN}', "the number NaN is not finite"),
        ('{"a": -Infinity}', "the number -Infinity is not finite"),
        ('{"a": 1e999}', "the number 1e999 is not finite"),
        ('{"a": ' + "9" * 5000 + "}", "Exceeds the limit"),
        ('{"a": ' + "[" * 100_000 + "}", "nested too deep"),
        ('{"a": ' * 100_000, "nested too deep"),
    ],
    ids=lambda text: text[:12],
)
def test_invalid_numbers_and_deep_nesting_are_error_of_one_line(tmp_path, text, words):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(UserError, match=rf"x\.json: {words}.*; mend it") as caught:
        read_json(tmp_path / "x.json", hint="mend it")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_unreadable_values_are_not_written(tmp_path):
    write_json(tmp_path / "x.json", {"old": 1})
    with pytest.raises(UserError, match=r"x\.json: cannot be written \(a number is infinite or NaN\)"):
        write_json(tmp_path / "x.json", {"new": float("nan")})
    assert read_json(tmp_path / "x.json") == {"old": 1}


def test_without_compilation(tmp_path, jit_disabled):
    kept = Checkpoints(tmp_path / "states")
    kept.save(1, state(1))
    assert_same(kept.restore(state())[1], state(1))
    kept.close()
    save_weights(tmp_path / "w.safetensors", TREE)
    assert_same(load_weights(tmp_path / "w.safetensors", TREE), TREE)
