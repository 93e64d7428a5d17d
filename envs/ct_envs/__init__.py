"""Worlds for Control Transformer: mazes as data, robots, physics engines and ``MazeEnv``. Knows nothing of learning.

A name is imported when it is first used: who only wants to look at a maze does not wait for a physics engine.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ct_envs.errors import UserError
    from ct_envs.fine import fit_maze, load_fitted
    from ct_envs.maps import Map, read_map
    from ct_envs.maze import Maze, load_maze, make_maze, maze_names, random_walls, stack_mazes
    from ct_envs.maze_env import FlatObservation, MazeEnv, Tasks, check_tasks
    from ct_envs.robots import ANT, HUMANOID, POINT, ROBOTS, Robot

__all__ = [
    "ANT", "HUMANOID", "POINT", "ROBOTS", "FlatObservation", "Map", "Maze", "MazeEnv", "Robot", "Tasks",
    "UserError", "check_tasks", "fit_maze", "load_fitted", "load_maze", "make_maze", "maze_names", "random_walls",
    "read_map", "stack_mazes",
]  # fmt: skip

_NAMES = {
    "errors": ("UserError",),
    "fine": ("fit_maze", "load_fitted"),
    "maps": ("Map", "read_map"),
    "maze": ("Maze", "load_maze", "make_maze", "maze_names", "random_walls", "stack_mazes"),
    "maze_env": ("FlatObservation", "MazeEnv", "Tasks", "check_tasks"),
    "robots": ("ANT", "HUMANOID", "POINT", "ROBOTS", "Robot"),
}
_MODULE = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module 'ct_envs' has no attribute '{name}'")
    if _MODULE[name] in ("fine", "maze_env"):  # which import MJX
        import_module("ct_envs.quiet")
    return getattr(import_module(f"ct_envs.{_MODULE[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
