"""What is kept on disk: Orbax for training states, safetensors for weights that are shipped. Nothing is unpickled."""

import json
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from ct_envs import UserError

Tree = TypeVar("Tree")
SAVE_EVERY_S = 60.0
_DISK_ERRORS = ("RESOURCE_EXHAUSTED", "PERMISSION_DENIED", "No space left")


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


class Checkpoints:
    """The last states of a training, in a folder of their own; a state is a pytree of arrays."""

    def __init__(self, folder: Path, *, keep: int = 2, every_s: float = SAVE_EVERY_S):
        """
        Args:
            keep: how many states stay on disk.
            every_s: ``maybe_save`` saves when the last save is older than this [s].
        """
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, create=True)
        self._folder = folder.resolve()
        self._manager = ocp.CheckpointManager(self._folder, options=options)
        self._every_s, self._last = every_s, time.monotonic()

    def save(self, step: int, state: Any) -> None:
        """Write a state and wait until it is on disk. Raises UserError if the disk is full or may not be written to."""
        if step in self._manager.all_steps():
            return
        plain = jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)
        leaves = {str(i): leaf for i, leaf in enumerate(jax.tree.leaves(plain))}
        try:
            self._manager.save(step, args=ocp.args.StandardSave(leaves))  # pyright: ignore[reportCallIssue]
            self._manager.wait_until_finished()
        except ValueError as bad:  # as tensorstore calls a full disk
            if not any(word in str(bad) for word in _DISK_ERRORS):
                raise
            reason = "no permission" if "PERMISSION" in str(bad) else "no space left"
            raise UserError(
                f"{self._folder}: cannot be written ({reason}); make room, then go on with --resume"
            ) from None
        self._last = time.monotonic()

    def maybe_save(self, step: int, state: Any) -> None:
        """Save if the last time is long enough ago."""
        if time.monotonic() - self._last >= self._every_s:
            self.save(step, state)

    def restore(self, like: Tree) -> tuple[int, Tree] | None:
        """(step, state) of the newest whole checkpoint, with the structure of ``like``; None where there is none.

        A damaged one is deleted with a warning, and the one before it is taken.
        """
        for step in sorted(self._manager.all_steps(), reverse=True):
            try:
                return step, self._read(step, like)
            except (ValueError, KeyError, OSError) as bad:
                folder = self._folder / str(step)
                reason = " ".join(str(bad).split())[:200]
                warnings.warn(f"{folder}: damaged checkpoint left out ({reason})", stacklevel=2)
                shutil.rmtree(folder, ignore_errors=True)
                self._manager.reload()
        return None

    def _read(self, step: int, like: Tree) -> Tree:
        leaves, structure = jax.tree.flatten(like)
        plain = {str(i): jax.random.key_data(leaf) if _is_key(leaf) else leaf for i, leaf in enumerate(leaves)}
        found: Any = self._manager.restore(step, args=ocp.args.StandardRestore(plain))  # pyright: ignore[reportCallIssue]
        values = [
            jax.random.wrap_key_data(found[str(i)]) if _is_key(leaf) else found[str(i)] for i, leaf in enumerate(leaves)
        ]
        return jax.tree.unflatten(structure, values)

    def close(self) -> None:
        self._manager.close()


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
    """Train a state until it has counted to ``total``: the one loop of all trainings.

    Args:
        train: takes a state and a number of steps to the state after them and what to report.
        count: how many steps a state has behind it.
        on_progress: told (steps done, report) after every ``chunk`` steps; what the report holds are floats.
        checkpoints: where to go on from, and where to save now and then and when interrupted.
    """
    if checkpoints is not None and (found := checkpoints.restore(state)) is not None:
        state = found[1]
    done = count(state)
    try:
        while done < total:
            state, report = train(state, min(chunk, total - done))
            done = count(state)
            on_progress(done, jax.tree.map(float, report))
            if checkpoints is not None:
                checkpoints.maybe_save(done, state)
    except KeyboardInterrupt:
        if checkpoints is not None:
            checkpoints.save(done, state)
        raise
    return state


def _name(path: tuple[Any, ...]) -> str:
    return "/".join(str(getattr(part, "key", getattr(part, "name", getattr(part, "idx", part)))) for part in path)


def save_weights(file: Path, tree: Any) -> None:
    """Write a pytree of arrays as safetensors, each leaf under its path; a reader never sees half of it.

    Raises:
        UserError: the disk is full or may not be written to.
    """
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    part = file.with_name(file.name + ".part")
    try:
        save_file({_name(path): np.asarray(leaf, order="C") for path, leaf in leaves}, part)
    except SafetensorError as bad:
        part.unlink(missing_ok=True)
        raise UserError(
            f"{file}: cannot be written ({_text(bad)}); free some space and continue with --resume"
        ) from None
    part.replace(file)


def load_weights(file: Path, like: Tree, *, mend: str = "train again or fetch it anew") -> Tree:
    """Read weights into the structure of ``like``.

    Args:
        mend: what the error tells a person to do about a damaged file.

    Raises:
        UserError: no safetensors file, a damaged one, or one of other weights (both shapes are shown).
    """
    try:
        found = load_file(file)
    except (OSError, SafetensorError) as bad:
        raise UserError(f"{file}: not a whole safetensors file ({_text(bad)}); {mend}") from None

    def take(path: tuple[Any, ...], leaf: Any) -> np.ndarray:
        name = _name(path)
        if name not in found:
            raise UserError(f"{file}: holds no weights '{name}'; it belongs to another model; {mend}")
        if found[name].shape != np.shape(leaf):
            shapes = f"shape {found[name].shape}, this model needs {np.shape(leaf)}"
            raise UserError(f"{file}: '{name}' has {shapes}; {mend}")
        return found[name]

    return jax.tree_util.tree_map_with_path(take, like)


def write_json(file: Path, value: Any) -> None:
    """Write JSON so that a reader never sees half of it."""
    part = file.with_name(file.name + ".part")
    part.write_text(json.dumps(value, indent=2) + "\n", "utf-8")
    part.replace(file)


def read_json(file: Path, *, mend: str = "delete it and run again") -> dict[str, Any]:
    """Read a JSON object. Raises UserError naming the file, the line and the mend."""
    try:
        found = json.loads(file.read_text("utf-8"))
    except FileNotFoundError:
        raise UserError(f"{file}: no such file") from None
    except json.JSONDecodeError as bad:
        raise UserError(f"{file}:{bad.lineno}: not JSON ({bad.msg}); {mend}") from None
    except UnicodeDecodeError:
        raise UserError(f"{file}: not UTF-8 text; {mend}") from None
    except OSError as bad:
        raise UserError(f"{file}: cannot be read ({bad.strerror})") from None
    if not isinstance(found, dict):
        raise UserError(f"{file}:1: not a JSON object; {mend}")
    return found
