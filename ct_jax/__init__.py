"""Control Transformer in JAX: robot navigation in unknown mazes, learned from roadmap-guided trajectories.

A name is imported when it is first used, so that ``import ct_jax`` alone is quick. No public name is that of a
submodule: ``ct_jax.collect`` and ``ct_jax.evaluate`` are always modules.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ct_envs.errors import UserError
    from ct_jax.agent import Agent
    from ct_jax.collect import CollectConfig
    from ct_jax.collect import collect as collect_trajectories
    from ct_jax.configs import get_preset
    from ct_jax.controllers.augment import AugmentConfig
    from ct_jax.controllers.edges import EdgeConfig
    from ct_jax.controllers.sac import SacConfig
    from ct_jax.evaluate import Episodes
    from ct_jax.evaluate import evaluate as evaluate_pairs
    from ct_jax.finetune import RecoverConfig, recover
    from ct_jax.fit import FitConfig, ValueConfig
    from ct_jax.model import load_model as load
    from ct_jax.pipeline import evaluate_model, train
    from ct_jax.policy import TransformerPolicy
    from ct_jax.prm import PrmConfig
    from ct_jax.runtime.run import Run
    from ct_jax.settings import Settings
    from ct_jax.trajectories import Trajectories
    from ct_jax.transformer import ControlTransformer, ModelConfig
    from ct_jax.types import Action, Controller, Frame, Guide, Observation, Policy, World
    from ct_jax.worlds.mazes import MazeWorld
    from ct_jax.worlds.rooms import RoomWorld

__version__ = "0.1.0"
__all__ = [
    "Action", "Agent", "AugmentConfig", "CollectConfig", "ControlTransformer", "Controller", "EdgeConfig", "Episodes",
    "FitConfig", "Frame", "Guide", "MazeWorld", "ModelConfig", "Observation", "Policy", "PrmConfig", "RecoverConfig",
    "RoomWorld", "Run", "SacConfig", "Settings", "Trajectories", "TransformerPolicy", "UserError", "ValueConfig",
    "World", "collect_trajectories", "evaluate_model", "evaluate_pairs", "get_preset", "load", "recover", "train",
]  # fmt: skip

_NAMES = {
    "ct_envs.errors": ("UserError",),
    "ct_jax.agent": ("Agent",),
    "ct_jax.collect": ("CollectConfig",),
    "ct_jax.controllers.augment": ("AugmentConfig",),
    "ct_jax.controllers.edges": ("EdgeConfig",),
    "ct_jax.controllers.sac": ("SacConfig",),
    "ct_jax.evaluate": ("Episodes",),
    "ct_jax.finetune": ("RecoverConfig", "recover"),
    "ct_jax.fit": ("FitConfig", "ValueConfig"),
    "ct_jax.pipeline": ("evaluate_model", "train"),
    "ct_jax.policy": ("TransformerPolicy",),
    "ct_jax.configs": ("get_preset",),
    "ct_jax.settings": ("Settings",),
    "ct_jax.prm": ("PrmConfig",),
    "ct_jax.runtime.run": ("Run",),
    "ct_jax.trajectories": ("Trajectories",),
    "ct_jax.transformer": ("ControlTransformer", "ModelConfig"),
    "ct_jax.types": ("Action", "Controller", "Frame", "Guide", "Observation", "Policy", "World"),
    "ct_jax.worlds.mazes": ("MazeWorld",),
    "ct_jax.worlds.rooms": ("RoomWorld",),
}
_SOURCE = {name: (module, name) for module, names in _NAMES.items() for name in names} | {
    "collect_trajectories": ("ct_jax.collect", "collect"),  # whose own names are those of submodules
    "evaluate_pairs": ("ct_jax.evaluate", "evaluate"),
    "load": ("ct_jax.model", "load_model"),
}


def __getattr__(name: str) -> Any:
    if name not in _SOURCE:
        raise AttributeError(f"module 'ct_jax' has no attribute '{name}'")
    module, own_name = _SOURCE[name]
    return getattr(import_module(module), own_name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
