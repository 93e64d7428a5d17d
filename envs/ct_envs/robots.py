"""Robots as data: a model file and the few numbers that the worlds and the method need of it."""

from dataclasses import dataclass
from importlib import resources

from ct_envs.errors import UserError


@dataclass(frozen=True)
class Robot:
    """What there is to know of a robot besides its MJCF model. SI units."""

    name: str
    xml: str  # file under assets/
    radius_m: float  # of the smallest upright cylinder that the roadmap keeps clear of walls
    touch_m: float  # farthest any part reaches from the centre: the nearest walls are looked for within it
    top_speed_mps: float  # at most this fast, so that no wall is missed within a control step
    control_dt_s: float  # a control step
    horizon: int  # control steps of an episode
    goal_tolerance_m: float = 0.5
    reset_velocity_mps: float = 0.0  # standard deviation of the speed after a reset
    controller_reward: str = "velocity"  # "velocity" or "distance" (paper, sec. III-F)
    planar_symmetry: bool = False  # proprioception and action are lists of planar vectors: mirrored worlds are exact


POINT = Robot(
    name="point",
    xml="point.xml",
    radius_m=0.5,
    touch_m=0.5,
    top_speed_mps=6.0,  # both motors at once give 4 * sqrt(2)
    control_dt_s=0.1,
    horizon=1000,
    planar_symmetry=True,
)

ROBOTS = {robot.name: robot for robot in (POINT,)}


def get_robot(name: str) -> Robot:
    """The robot of that name. Raises UserError with the valid names."""
    if name not in ROBOTS:
        raise UserError(f"no robot named '{name}'; robots: {', '.join(ROBOTS)}")
    return ROBOTS[name]


def model_xml(robot: Robot) -> str:
    """Text of the robot's MJCF."""
    return (resources.files("ct_envs") / "assets" / robot.xml).read_text("utf-8")
