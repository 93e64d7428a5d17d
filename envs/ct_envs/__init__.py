"""Worlds for Control Transformer: mazes as data, robots, physics engines and ``MazeEnv``. No learning code.

Each name is imported at its first use, so that code that only needs mazes does not load a physics engine.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ct_envs.errors import UserError
    from ct_envs.fine import fit_maze, load_fitted
    from ct_envs.generators import GENERATORS, generate_walls
    from ct_envs.maps import Map, read_map
    from ct_envs.maze import Maze, load_maze, make_maze, maze_names, random_walls, stack_mazes
    from ct_envs.maze_env import FlatObservation, MazeEnv, Tasks, check_tasks
    from ct_envs.maze_statistics import measure_maze
    from ct_envs.robots import ANT, HUMANOID, POINT, ROBOTS, Robot
    from ct_envs.unseen import test_maze, test_pairs, training_maze, validation_maze, validation_pairs

__all__ = [
    "ANT", "GENERATORS", "HUMANOID", "POINT", "ROBOTS", "FlatObservation", "Map", "Maze", "MazeEnv", "Robot", "Tasks",
    "UserError", "check_tasks", "fit_maze", "generate_walls", "load_fitted", "load_maze", "make_maze", "maze_names",
    "measure_maze", "random_walls", "read_map", "stack_mazes", "test_maze", "test_pairs", "training_maze",
    "validation_maze", "validation_pairs",
]  # fmt: skip

_NAMES = {
    "errors": ("UserError",),
    "fine": ("fit_maze", "load_fitted"),
    "generators": ("GENERATORS", "generate_walls"),
    "maps": ("Map", "read_map"),
    "maze": ("Maze", "load_maze", "make_maze", "maze_names", "random_walls", "stack_mazes"),
    "maze_env": ("FlatObservation", "MazeEnv", "Tasks", "check_tasks"),
    "maze_statistics": ("measure_maze",),
    "robots": ("ANT", "HUMANOID", "POINT", "ROBOTS", "Robot"),
    "unseen": ("test_maze", "test_pairs", "training_maze", "validation_maze", "validation_pairs"),
}
_MODULE = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module 'ct_envs' has no attribute '{name}'")
    if _MODULE[name] in ("fine", "maze_env"):  # they import MJX
        import_module("ct_envs.quiet")
    return getattr(import_module(f"ct_envs.{_MODULE[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
