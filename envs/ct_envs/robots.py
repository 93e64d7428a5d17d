"""Robots as data: a model file, and the numbers that the worlds and the method need."""

from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

from ct_envs.checked import shown
from ct_envs.errors import UserError


@dataclass(frozen=True)
class Robot:
    """The data of a robot besides its model file. SI units."""

    name: str
    xml: str  # file in assets/, or the absolute path of another
    radius_m: float  # radius of an upright cylinder around the robot, for the clearance of roadmaps
    touch_m: float  # maximum distance of any part from the centre, for the search of the nearest walls
    top_speed_mps: float  # upper limit of the speed, so that no wall is missed in a control step
    control_dt_s: float  # duration of a control step
    horizon: int  # control steps of an episode
    way_m: float  # length of the longest path for this horizon; longer paths get a longer horizon in proportion
    cruise_mps: float  # mean speed along shortest paths, guided by the planner (measured in antmaze-large-eval)
    goal_tolerance_m: float = 0.5
    reset_velocity_mps: float = 0.0  # standard deviation of the speed after a reset
    reset_joints_rad: float = 0.0  # maximum deviation of the joints from the standing pose after a reset
    upright_min: float | None = None  # the robot has fallen if the cosine of the torso's tilt is below this
    height_min_m: float | None = None  # the robot has fallen if the torso is lower than this
    controller_reward: Literal["velocity", "distance"] = "velocity"  # "velocity" or "distance" (paper, sec. III-G)
    has_heading: bool = False  # the torso has a free joint, so the robot has a heading, which is random after a reset
    simulator: Literal["mujoco", "pybullet"] = "mujoco"  # and so its world: mazes, or cluttered rooms in PyBullet

    @property
    def reach_m(self) -> float:
        """How far from its centre it can touch something within a control step [m]."""
        return self.touch_m + self.top_speed_mps * self.control_dt_s


POINT = Robot(
    name="point",
    xml="point.xml",
    radius_m=0.5,
    touch_m=0.5,
    top_speed_mps=6.0,  # both motors at once give 4 * sqrt(2)
    control_dt_s=0.1,
    horizon=1000,
    way_m=80.0,
    cruise_mps=3.28,
)

ANT = Robot(
    name="ant",
    xml="ant.xml",
    radius_m=1.0,  # the feet of the standing ant are 0.95 m from its centre
    touch_m=1.25,
    top_speed_mps=7.0,
    control_dt_s=0.1,
    horizon=1000,
    way_m=80.0,
    cruise_mps=1.45,
    reset_velocity_mps=0.1,
    reset_joints_rad=0.1,
    upright_min=0.0,
    has_heading=True,
    controller_reward="distance",
)

HUMANOID = Robot(
    name="humanoid",
    xml="humanoid.xml",
    radius_m=1.0,  # a stretched arm reaches 0.8 m
    touch_m=1.3,
    top_speed_mps=7.0,
    control_dt_s=0.03,
    horizon=2000,
    way_m=80.0,
    cruise_mps=1.98,
    reset_velocity_mps=0.05,
    reset_joints_rad=0.05,
    height_min_m=1.0,  # it stands at 1.28 m; of Humanoid-v5
    has_heading=True,
)

TURTLEBOT3 = Robot(
    name="turtlebot3",
    xml="turtlebot3_burger.urdf",
    radius_m=0.105,
    touch_m=0.105,
    top_speed_mps=0.22,
    control_dt_s=0.2,
    horizon=400,  # 80 s, in which the robot drives 17 m
    way_m=9.0,
    cruise_mps=0.2,
    goal_tolerance_m=0.2,
    simulator="pybullet",
)

ROBOTS = {robot.name: robot for robot in (POINT, ANT, HUMANOID, TURTLEBOT3)}


def get_robot(name: str, simulator: str | None = None) -> Robot:
    """The robot with this name. Raises UserError with the valid names (of a ``simulator``, if given)."""
    known = [robot.name for robot in ROBOTS.values() if simulator in (None, robot.simulator)]
    if name not in known:
        where = f" in {simulator}" if simulator else ""
        raise UserError(f"no robot named {shown(name)}{where}; robots: {', '.join(known)}")
    return ROBOTS[name]


def register(robot: Robot) -> Robot:
    """Register your own robot under its name, and return it. Raises UserError if another robot has that name."""
    if ROBOTS.setdefault(robot.name, robot) != robot:
        raise UserError(f"there is another robot named {shown(robot.name)}; give yours a name of its own")
    return robot


def model_xml(robot: Robot) -> str:
    """Text of the robot's MJCF. Raises UserError if the file of a registered robot cannot be read."""
    file = Path(str(resources.files("ct_envs"))) / "assets" / robot.xml  # an absolute path stays what it is
    try:
        return file.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as bad:
        raise UserError(f"{file}: not the MJCF of robot '{robot.name}' ({bad})") from None
