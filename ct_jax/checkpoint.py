"""What is kept on disk: Orbax for training states, safetensors for weights that are shipped. Nothing is unpickled."""

import json
import time
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


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


class Checkpoints:
    """The last states of a training, in a folder of their own; a state is a pytree of arrays."""

    def __init__(self, folder: Path, *, keep: int = 2, every_s: float = SAVE_EVERY_S):
        """
        Args:
            keep: how many states stay on disk.
            every_s: ``maybe_save`` saves when the last save is older than this [s].
        """
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, create=True)
        self._manager = ocp.CheckpointManager(folder.resolve(), options=options)
        self._every_s, self._last = every_s, time.monotonic()

    def save(self, step: int, state: Any) -> None:
        """Write a state and wait until it is on disk."""
        if step in self._manager.all_steps():
            return
        plain = jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)
        leaves = {str(i): leaf for i, leaf in enumerate(jax.tree.leaves(plain))}
        self._manager.save(step, args=ocp.args.StandardSave(leaves))  # pyright: ignore[reportCallIssue]
        self._manager.wait_until_finished()
        self._last = time.monotonic()

    def maybe_save(self, step: int, state: Any) -> None:
        """Save if the last time is long enough ago."""
        if time.monotonic() - self._last >= self._every_s:
            self.save(step, state)

    def restore(self, like: Tree) -> tuple[int, Tree] | None:
        """(step, state) of the newest checkpoint, with the structure of ``like``; None where there is none."""
        step = self._manager.latest_step()
        if step is None:
            return None
        leaves, structure = jax.tree.flatten(like)
        plain = {str(i): jax.random.key_data(leaf) if _is_key(leaf) else leaf for i, leaf in enumerate(leaves)}
        found: Any = self._manager.restore(step, args=ocp.args.StandardRestore(plain))  # pyright: ignore[reportCallIssue]
        values = [
            jax.random.wrap_key_data(found[str(i)]) if _is_key(leaf) else found[str(i)] for i, leaf in enumerate(leaves)
        ]
        return step, jax.tree.unflatten(structure, values)

    def close(self) -> None:
        self._manager.close()


def _name(path: tuple[Any, ...]) -> str:
    return "/".join(str(getattr(part, "key", getattr(part, "name", getattr(part, "idx", part)))) for part in path)


def save_weights(file: Path, tree: Any) -> None:
    """Write a pytree of arrays as safetensors, each leaf under its path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    save_file({_name(path): np.ascontiguousarray(leaf) for path, leaf in leaves}, file)


def load_weights(file: Path, like: Tree) -> Tree:
    """Read weights into the structure of ``like``.

    Raises:
        UserError: no safetensors file, a damaged one, or one of other weights (both shapes are shown).
    """
    try:
        found = load_file(file)
    except (OSError, SafetensorError) as bad:
        raise UserError(f"{file}: not a whole safetensors file ({bad}); train again or fetch it anew") from None

    def take(path: tuple[Any, ...], leaf: Any) -> np.ndarray:
        name = _name(path)
        if name not in found:
            raise UserError(f"{file}: holds no weights '{name}'; it belongs to another model")
        if found[name].shape != np.shape(leaf):
            raise UserError(f"{file}: '{name}' has shape {found[name].shape}, this model needs {np.shape(leaf)}")
        return found[name]

    return jax.tree_util.tree_map_with_path(take, like)


def write_json(file: Path, value: Any) -> None:
    """Write JSON so that a reader never sees half of it."""
    part = file.with_name(file.name + ".part")
    part.write_text(json.dumps(value, indent=2) + "\n", "utf-8")
    part.replace(file)


def read_json(file: Path) -> Any:
    """Read JSON. Raises UserError naming the file and the line."""
    try:
        return json.loads(file.read_text("utf-8"))
    except FileNotFoundError:
        raise UserError(f"{file}: no such file") from None
    except json.JSONDecodeError as bad:
        raise UserError(f"{file}:{bad.lineno}: not JSON ({bad.msg}); delete it and run again") from None
    except (OSError, UnicodeDecodeError) as bad:
        raise UserError(f"{file}: cannot be read ({bad})") from None
