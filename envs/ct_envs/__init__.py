"""Worlds for Control Transformer: mazes as data, robots, physics engines and ``MazeEnv``. Knows nothing of learning."""

from ct_envs.errors import UserError
from ct_envs.maze import Maze, load_maze, make_maze, maze_names, random_walls, stack_mazes
from ct_envs.maze_env import MazeEnv, Tasks
from ct_envs.robots import POINT, ROBOTS, Robot

__all__ = [
    "POINT", "ROBOTS", "Maze", "MazeEnv", "Robot", "Tasks", "UserError",
    "load_maze", "make_maze", "maze_names", "random_walls", "stack_mazes",
]
