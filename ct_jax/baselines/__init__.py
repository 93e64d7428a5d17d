"""The methods that the transformer is compared with: offline and online reinforcement learning (paper, sec. IV-A).

A new baseline is one new file in this folder, with the names of ``Baseline``. Then ``ct-jax train ROBOT --method NAME``
trains it, and ``ct-jax evaluate RUN --method NAME`` evaluates it. Files without a ``NAME`` are parts of baselines.
"""

import importlib
import pkgutil
from types import MappingProxyType
from typing import Any, Protocol

import jax

from ct_envs.checked import Checked
from ct_envs.errors import UserError
from ct_envs.robots import Robot
from ct_jax.settings import Settings
from ct_jax.trajectories import Trajectories
from ct_jax.types import Policy

# The methods that are a transformer, and what they set in its ``ModelConfig``.
TRANSFORMERS = MappingProxyType({"ct": {}, "bc-ct": {"returns": False}})


class Baseline(Protocol):
    """What the file of a baseline contains: the functions and names of a module."""

    NAME: str  # of the method, on the command line and in tables
    Config: type[Checked]  # its settings; the attribute ``total`` is the number of steps that ``learn`` counts
    TRAJECTORIES: bool  # whether it learns from the planner-guided trajectories; they need the low-level controller

    def config_for(self, settings: Settings, robot: Robot) -> Any:
        """The default ``Config`` for a run with these settings."""
        ...

    def blank(self, run: Any, config: Any) -> Policy:
        """A policy of the right sizes: a dataclass. Its field ``params`` has the shapes of the weights.

        Raises:
            UserError: the settings are not for the run's robot. (It is called before the run's folder is made.)
        """
        ...

    def learn(self, key: jax.Array, run: Any, config: Any, data: Trajectories | None, **watch: Any) -> Policy:
        """The trained policy.

        Args:
            run: a ``Run``: its robot, mazes and settings.
            data: this process's trajectories; None without ``TRAJECTORIES``.
            watch: ``on_progress`` and ``checkpoints``, see ``run_to``.
        """
        ...


def baseline_names() -> list[str]:
    """The names of all baselines."""
    return sorted(_all())


def get_baseline(name: str) -> Baseline:
    """The baseline of that name. Raises UserError with the valid names."""
    found = _all()
    if name not in found:
        raise UserError(f"no baseline named '{name}'; baselines: {', '.join(sorted(found))}")
    return found[name]


def baseline_of(config: Checked) -> Baseline:
    """The baseline that these are the settings of."""
    return next(baseline for baseline in _all().values() if type(config) is baseline.Config)


def check_method(method: str, *others: str) -> None:
    """Raise UserError unless the name is that of a transformer, a baseline, or one of ``others``."""
    if method not in (*TRANSFORMERS, *others) and method not in baseline_names():
        known = (*TRANSFORMERS, *baseline_names(), *others)
        raise UserError(f"no method named '{method}'; methods: {', '.join(known)}")


def _all() -> dict[str, Any]:
    """The baselines with a file in this folder, by name."""
    files = sorted(found.name for found in pkgutil.iter_modules(__path__))
    modules = [importlib.import_module(f"{__name__}.{name}") for name in files]
    return {module.NAME: module for module in modules if hasattr(module, "NAME")}
