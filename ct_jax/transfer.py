"""Transfer to another robot (paper, sec. IV-A): weights for mazes are kept, weights for the body start fresh."""

from typing import Any

import jax
import numpy as np

from ct_envs import UserError

BODY = ("embed_state", "embed_action", "predict_action", "predict_mode", "head")  # modules that depend on the robot


def transfer(source: Any, fresh: Any) -> Any:
    """Parameters of a ``ControlTransformer`` for another robot.

    The trunk, the convolutions and the embeddings of return, goal and time come from ``source``. The embeddings of
    state and action and the action head come from ``fresh``.

    Raises:
        UserError: the two models differ in layers, widths or lengths (the message shows both shapes).
    """
    old, new = source["params"], fresh["params"]
    kept = {name: leaves for name, leaves in new.items() if name not in BODY}
    if kept.keys() != {name for name in old if name not in BODY}:
        raise UserError("the two transformers have different layers; transfer between models of the same size")

    def take(path: tuple[Any, ...], leaf: Any, wanted: Any) -> Any:
        if np.shape(leaf) != np.shape(wanted):
            where = jax.tree_util.keystr(path, simple=True, separator="/")
            raise UserError(f"'{where}' has shape {np.shape(leaf)}, this robot's model needs {np.shape(wanted)}")
        return leaf

    moved = jax.tree_util.tree_map_with_path(take, {name: old[name] for name in kept}, kept)
    return fresh | {"params": new | moved}
