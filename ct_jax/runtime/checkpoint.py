"""Files on disk: Orbax checkpoints of training states, and safetensors files of weights. Nothing is unpickled.

Both have SHA-256 sums, which are checked before the files are used.
"""

import hashlib
import json
import math
import shutil
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ct_envs import UserError
from ct_envs.checked import shown
from ct_jax.runtime import devices
from ct_jax.runtime.files import check_folders, make_folder, whole, write_text
from ct_jax.runtime.interrupts import rescued_by, uninterrupted
from ct_jax.runtime.terminal import printable

Tree = TypeVar("Tree")
SAVE_EVERY_S = 60.0
MANIFEST = "SHA256SUMS"  # in the format of ``sha256sum -c``
_COMMITTED = "commit_success.txt"  # Orbax writes it last; it contains no state
_DISK_ERRORS = {  # by a part of tensorstore's message
    "RESOURCE_EXHAUSTED": "no space left", "No space left": "no space left", "PERMISSION_DENIED": "no permission",
    "Error writing": "writing fails",
}  # fmt: skip


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _disk_error(error: ValueError) -> str:
    """The kind of disk error; empty for other errors. tensorstore raises the same exception for all errors."""
    return next((words for sign, words in _DISK_ERRORS.items() if sign in str(error)), "")


def _write_manifest(folder: Path) -> None:
    """Write the sums of all files in a folder into a file in that folder."""
    lines = [f"{_sum(file)}  {name}\n" for name, file in _files(folder)]
    write_text(folder / MANIFEST, "".join(lines))


def _check_manifest(folder: Path) -> None:
    """Check the files of a folder against its manifest.

    Raises:
        ValueError: a file is changed, missing, or not in the manifest.
        OSError: a file cannot be read.
    """
    lines = (folder / MANIFEST).read_text("utf-8").splitlines()
    written = {name: wanted for wanted, _, name in (line.partition("  ") for line in lines)}
    found = {name: _sum(file) for name, file in _files(folder)}
    for name in sorted(written.keys() | found.keys()):
        if written.get(name) != found.get(name):
            raise ValueError(f"{name} is not as it was written")


def _files(folder: Path) -> list[tuple[str, Path]]:
    """The names and paths of the files that belong in the manifest: without those that are written after it."""
    later = (folder / MANIFEST, folder / _COMMITTED)
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file not in later)
    return [(file.relative_to(folder).as_posix(), file) for file in files]


def _sum(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


class _Handler(ocp.StandardCheckpointHandler):
    """Orbax's handler, with a manifest. It is written before the checkpoint gets its final name."""

    def finalize(self, directory: Any) -> None:
        super().finalize(directory)
        _write_manifest(Path(directory))


@ocp.args.register_with_handler(_Handler, for_save=True)
class _Save(ocp.args.StandardSave):
    pass


@ocp.args.register_with_handler(_Handler, for_restore=True)
class _Restore(ocp.args.StandardRestore):
    pass


class Checkpoints:
    """The last states of a training, in their own folder. A state is a pytree of arrays."""

    def __init__(self, folder: Path, *, keep: int = 2, every_s: float | None = None):
        """
        Args:
            keep: number of states that are kept.
            every_s: ``maybe_save`` saves if the last save is older than this [s]. The default is ``SAVE_EVERY_S``.

        Raises:
            UserError: the folder cannot be made; or the folder, or a folder in it, is a link.
        """
        devices.first(lambda: _make_folder(folder))
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, create=True, enable_async_checkpointing=False)
        self._folder = folder.resolve()
        self._manager = ocp.CheckpointManager(self._folder, options=options, item_handlers=_Handler())
        self._every_s, self._last = SAVE_EVERY_S if every_s is None else every_s, time.monotonic()
        self._lock = threading.Lock()  # another thread may save, see ``rescued_by``

    def save(self, step: int, state: Any) -> None:
        """Write a state, and wait until it is on disk. Signals are handled after that.

        Raises:
            UserError: the state cannot be written. Earlier states are kept.
        """
        plain = jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)
        leaves = {str(i): leaf for i, leaf in enumerate(jax.tree.leaves(plain))}
        with self._lock, uninterrupted():
            if devices.first(lambda: step in self._manager.all_steps()):
                return
            try:
                self._manager.save(step, args=_Save(leaves))  # pyright: ignore[reportCallIssue]
            except (ValueError, OSError) as bad:
                for half in self._folder.glob("*.orbax-checkpoint-tmp"):
                    shutil.rmtree(half, ignore_errors=True)
                reason = bad.strerror if isinstance(bad, OSError) else _disk_error(bad)
                if not reason:
                    raise
                raise UserError(
                    f"{self._folder}: cannot be written ({reason}); make room, then go on with --resume"
                ) from None
            self._last = time.monotonic()

    def maybe_save(self, step: int, state: Any) -> None:
        """Save if the last save is old enough."""
        if devices.largest(time.monotonic() - self._last >= self._every_s):
            self.save(step, state)

    def restore(self, like: Tree) -> tuple[int, Tree] | None:
        """(step, state) of the newest undamaged checkpoint; None if there is none.

        The state has the structure and the devices of ``like``. It may have been saved on a different number of
        devices. A damaged checkpoint is renamed, with a warning on stderr, and the previous one is used.
        """
        for step in devices.first(lambda: sorted(self._manager.all_steps(), reverse=True)):
            folder = self._folder / str(step)
            try:
                devices.first(lambda folder=folder: _check_manifest(folder / "default"))  # Orbax's name for the item
                return step, self._read(step, like)
            except (ValueError, KeyError, OSError) as bad:
                devices.first(lambda folder=folder, bad=bad: _put_aside(folder, bad))
                self._manager.reload()
        return None

    def _read(self, step: int, like: Tree) -> Tree:
        leaves, structure = jax.tree.flatten(like)
        plain = {str(i): jax.random.key_data(leaf) if _is_key(leaf) else leaf for i, leaf in enumerate(leaves)}
        found: Any = self._manager.restore(step, args=_Restore(plain))  # pyright: ignore[reportCallIssue]
        values = [
            jax.random.wrap_key_data(found[str(i)]) if _is_key(leaf) else found[str(i)] for i, leaf in enumerate(leaves)
        ]
        return jax.tree.unflatten(structure, values)

    def close(self) -> None:
        self._manager.close()


def _make_folder(folder: Path) -> None:
    make_folder(folder, parents=True)
    check_folders(folder)


def _put_aside(folder: Path, bad: Exception) -> None:
    reason = " ".join(str(bad).split())[:200]
    print(printable(f"warning: {folder}: damaged checkpoint, going on without it ({reason})"), file=sys.stderr)
    with suppress(FileNotFoundError):  # another process of the same training has renamed it
        folder.rename(folder.with_name(f"damaged-{folder.name}-{time.time_ns()}"))


def _text(error: Exception) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else str(error)


def run_to(
    total: int,
    state: Tree,
    train: Callable[[Tree, int], tuple[Tree, Any]],
    count: Callable[[Tree], int],
    on_progress: Callable[[int, Any], None],
    checkpoints: Checkpoints | None,
    chunk: int,
) -> Tree:
    """Train a state up to ``total`` steps. All trainings use this loop.

    Args:
        train: maps a state and a number of steps to the state after these steps, and a report.
        count: the number of steps that a state has been trained for.
        on_progress: called with (steps done, report) after each ``chunk`` of steps. The report contains floats.
        checkpoints: the training continues from the last checkpoint. It saves at intervals, and when interrupted.
    """
    if checkpoints is not None and (found := checkpoints.restore(state)) is not None:
        state = found[1]
    done = count(state)

    def save() -> None:
        if checkpoints is not None:
            checkpoints.save(count(state), state)

    with rescued_by(save):
        try:
            while done < total:
                after, report = train(state, min(chunk, total - done))
                report = jax.tree.map(float, report)  # waits for the devices, so that ``state`` can always be saved
                state, done = after, count(after)
                on_progress(done, report)
                if checkpoints is not None:
                    checkpoints.maybe_save(done, state)
        except KeyboardInterrupt:
            save()
            raise
    return state


def _name(path: tuple[Any, ...]) -> str:
    return "/".join(str(getattr(part, "key", getattr(part, "name", getattr(part, "idx", part)))) for part in path)


def save_weights(file: Path, tree: Any, *, of: Any = None) -> None:
    """Write a pytree of arrays as a safetensors file, each leaf under its path. The file appears only when complete.

    Args:
        of: description of the model in JSON values. Its digest is stored with the weights, because the shapes of the
            weights do not determine the model: they do not depend on the number of heads, for example.

    Raises:
        UserError: a number is not finite, or the file cannot be written.
    """
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    arrays = {_name(path): np.asarray(leaf, order="C") for path, leaf in leaves}
    for name, array in arrays.items():
        if not _is_finite(array):
            raise UserError(f"{file}: '{name}' has become infinite or NaN in training; try a lower learning rate")
    # The metadata has one entry, because safetensors writes several entries in random order. Files are reproducible.
    sums = [_sum_of_arrays(arrays)] + ([] if of is None else [_digest(of)])
    content = save(arrays, metadata={"sha256": " ".join(sums)})  # ``save_file`` would ignore the umask
    with whole(file) as opened:
        opened.write(content)


def _sum_of_arrays(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype} {array.shape}\n".encode() + array.tobytes())
    return digest.hexdigest()


def _digest(of: Any) -> str:
    """SHA-256 of JSON values; independent of the order of keys."""
    return hashlib.sha256(json.dumps(of, sort_keys=True).encode()).hexdigest()


def _is_finite(array: np.ndarray) -> bool:
    return not np.issubdtype(array.dtype, np.inexact) or bool(np.isfinite(array).all())


def load_weights(file: Path, like: Tree, *, hint: str = "train again or fetch it anew") -> Tree:
    """Read weights into the structure of ``like``.

    Args:
        hint: the remedy in the error for a damaged file.

    Raises:
        UserError: see ``read_weights`` and ``arrange_weights``.
    """
    return arrange_weights(file, read_weights(file, hint=hint), like, hint=hint)


def read_weights(file: Path, *, of: Any = None, bound: bool = True, hint: str) -> dict[str, np.ndarray]:
    """The arrays of a file written by ``save_weights``, by name.

    Args:
        of: the description of the model that was given to ``save_weights``, if any.
        bound: the file must contain the digest of ``of``. Files of earlier versions do not.

    Raises:
        UserError: not a safetensors file, a damaged file, or the weights of another model.
    """
    try:
        with safe_open(file, framework="np") as opened:
            found, said = {name: opened.get_tensor(name) for name in opened.keys()}, opened.metadata() or {}  # noqa: SIM118
    # NumPy lacks some types of safetensors (AttributeError), and allows fewer dimensions (ValueError).
    except (OSError, SafetensorError, AttributeError, TypeError, ValueError) as bad:
        raise UserError(f"{file}: not a whole safetensors file ({_text(bad)}); {hint}") from None
    if "sha256" not in said:
        raise UserError(f"{file}: without its SHA-256 sum; {hint}")
    whole, _, described = said["sha256"].partition(" ")
    if whole != _sum_of_arrays(found):
        raise UserError(f"{file}: not as it was written (SHA-256); {hint}")
    if of is not None and (bound or described) and described != _digest(of):
        raise UserError(f"{file}: weights of another model than the one described beside it; {hint}")
    return found


def arrange_weights(file: Path, found: dict[str, np.ndarray], like: Tree, *, hint: str) -> Tree:
    """The arrays of a file in the structure of ``like``.

    Raises:
        UserError: an array is missing, unexpected, not finite, or has another shape or type.
    """
    wanted = {_name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(like)}
    for name, leaf in wanted.items():
        if name not in found:
            raise UserError(f"{file}: holds no weights '{name}'; it belongs to another model; {hint}")
        for what, is_, needed in (
            ("shape", found[name].shape, np.shape(leaf)), ("type", found[name].dtype, leaf.dtype),
        ):  # fmt: skip
            if is_ != needed:
                raise UserError(f"{file}: '{name}' has {what} {is_}, this model needs {needed}; {hint}")
        if not _is_finite(found[name]):
            raise UserError(f"{file}: '{name}' is not finite everywhere; {hint}")
    for name in found:
        if name not in wanted:
            raise UserError(f"{file}: holds weights {shown(name)} besides; it belongs to another model; {hint}")
    return jax.tree_util.tree_map_with_path(lambda path, leaf: found[_name(path)], like)


def write_json(file: Path, value: Any) -> None:
    """Write a JSON file. It appears only when complete. Raises UserError, also for infinite numbers and NaN."""
    try:
        text = json.dumps(value, indent=2, allow_nan=False)
    except ValueError:
        raise UserError(f"{file}: cannot be written (a number is infinite or NaN)") from None
    write_text(file, text + "\n")


def read_json(file: Path, *, hint: str = "delete it and run again") -> dict[str, Any]:
    """Read a JSON object. Raises UserError with the file, the line and the remedy."""
    try:
        found = json.loads(file.read_text("utf-8"), parse_constant=_finite, parse_float=_finite)
    except FileNotFoundError:
        raise UserError(f"{file}: no such file") from None
    except json.JSONDecodeError as bad:
        raise UserError(f"{file}:{bad.lineno}: not JSON ({bad.msg}); {hint}") from None
    except UnicodeDecodeError:
        raise UserError(f"{file}: not UTF-8 text; {hint}") from None
    except RecursionError:
        raise UserError(f"{file}: nested too deep to be read; {hint}") from None
    except ValueError as bad:  # an integer with thousands of digits, or an error of ``_finite``
        raise UserError(f"{file}: {str(bad).partition(';')[0]}; {hint}") from None
    except OSError as bad:
        raise UserError(f"{file}: cannot be read ({bad.strerror})") from None
    if not isinstance(found, dict):
        raise UserError(f"{file}:1: not a JSON object; {hint}")
    return found


def _finite(text: str) -> float:
    """Convert a text to a finite number. Raises ValueError otherwise: JSON has no NaN and no infinity."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"the number {text[:20]} is not finite")
    return number
