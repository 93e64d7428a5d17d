"""Kinds of worlds. Only the files of this folder know a simulator.

A ``World`` runs episodes. A kind, a module of this folder, makes worlds for runs and evaluations.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from ct_envs.robots import Robot
from ct_jax.types import World


@dataclass(frozen=True)
class Trial:
    """Where all methods are evaluated, on the same pairs."""

    name: str  # of the maze, or of all rooms together
    world: World  # with local maps
    pairs: Any  # ``Pairs``
    head: dict[str, Any]  # what its rows begin with, besides robot and method
    prm: Any  # ``PrmConfig`` of the planner
    horizon: int  # control steps of an episode


class Request(Protocol):
    """The options of ``ct-jax evaluate`` for one kind of world: a dataclass of them."""

    def check(self, model: Any) -> None:
        """Raise UserError for options out of their range, or outputs that cannot be written."""
        ...

    def open(self, model: Any, seed: int) -> AbstractContextManager[Trial]:
        """The requested places and pairs. Raises UserError."""
        ...

    def show(self, trial: Trial, title: str, episodes: Any) -> None:
        """Write the requested pictures."""
        ...


class Kind(Protocol):
    """What the pipeline needs of a kind of world: the functions and names of a module."""

    Request: type[Request]
    KNOWN_CONTROLLER: Any | None  # pi_c, where it is not learned

    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Entries of a robot's proprioception and of its action."""
        ...

    def open_training(self, run: Any, *, maps: bool) -> AbstractContextManager[World]:
        """The world of a run's collection (without local maps, where they can be recomputed) and recoveries."""
        ...

    def make_env(self, run: Any, **options: Any) -> Any:
        """The ``rollout.Environment`` in which many robots learn side by side. Raises UserError if there is none."""
        ...

    def controller(self, run: Any, metrics: Any) -> tuple[Any, Any]:
        """pi_c, learned, read back or known, and its configuration."""
        ...

    def trials(self, run: Any, folder: Path) -> Iterator[Trial]:
        """The evaluation of a run, seen places first. In the folder it may keep what it has drawn."""
        ...


_KINDS = {"mujoco": "ct_jax.worlds.maze_runs", "pybullet": "ct_jax.worlds.room_runs"}


def kind_of(robot: Robot) -> Kind:
    """The kind of world that a robot drives in. Its simulator is imported only here."""
    return import_module(_KINDS[robot.simulator])  # pyright: ignore[reportReturnType]
