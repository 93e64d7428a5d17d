"""Transfer to another robot (paper, sec. IV-A): what was learned of mazes stays, what is the body's begins anew."""

from typing import Any

import jax
import numpy as np

from ct_envs import UserError

BODY = ("embed_state", "embed_action", "predict_action", "predict_mode", "head")  # modules that depend on the robot


def transfer(source: Any, fresh: Any) -> Any:
    """Parameters of a ``ControlTransformer`` for another robot: the trunk, convolutions and embeddings of return, goal
    and time of ``source``; the embeddings of state and action and the action head of ``fresh``.

    Raises:
        UserError: the two differ in more than the robot: layers, widths or lengths (both shapes are shown).
    """
    old, new = source["params"], fresh["params"]
    kept = {name: leaves for name, leaves in new.items() if name not in BODY}
    if kept.keys() != {name for name in old if name not in BODY}:
        raise UserError("the two transformers differ in their layers; transfer between models of one size")

    def take(path: tuple[Any, ...], leaf: Any, wanted: Any) -> Any:
        if np.shape(leaf) != np.shape(wanted):
            where = jax.tree_util.keystr(path, simple=True, separator="/")
            raise UserError(f"'{where}' has shape {np.shape(leaf)}, this robot's model needs {np.shape(wanted)}")
        return leaf

    moved = jax.tree_util.tree_map_with_path(take, {name: old[name] for name in kept}, kept)
    return fresh | {"params": new | moved}
