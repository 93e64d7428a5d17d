"""The presets: one plain file a robot, with its ``PRESETS`` by name.

A new robot needs its MJCF and a file here that bears its name. The file may register the robot itself:

    ROBOT = register(replace(POINT, name="heavy", xml="/path/of/heavy.xml"))
    PRESETS = {"published": base.PUBLISHED}
"""

import importlib
import pkgutil
from typing import TYPE_CHECKING

from ct_envs.errors import UserError
from ct_envs.robots import ROBOTS, Robot, get_robot

if TYPE_CHECKING:
    from ct_jax.settings import Settings

_SHARED = "base"  # a file that is no robot's


def find_robot(name: str) -> Robot:
    """The robot of that name, be it one that its file here registers. Raises UserError with the valid names."""
    if name not in ROBOTS and name in _files():  # its file may register it
        importlib.import_module(f"{__name__}.{name}")
    return get_robot(name)


def get_preset(name: str, robot: str = "point") -> "Settings":
    """The preset of that name for a robot. Raises UserError with the valid names."""
    robot = find_robot(robot).name
    if robot not in _files():
        raise UserError(f"no presets for robot '{robot}'; add a file {robot}.py to ct_jax/configs")
    presets = importlib.import_module(f"{__name__}.{robot}").PRESETS
    if name not in presets:
        raise UserError(f"no preset named '{name}'; presets: {', '.join(sorted(presets))}")
    return presets[name]


def _files() -> list[str]:
    """The robots with a file in this folder."""
    return sorted(found.name for found in pkgutil.iter_modules(__path__) if found.name != _SHARED)
