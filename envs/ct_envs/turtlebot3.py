"""The Turtlebot3 burger in a cluttered room: one PyBullet simulation, on the CPU (paper, sec. IV-B).

Observations contain only what the robot itself can measure, in its own frame (x ahead, y to the left): the direction of
the goal [cos dpsi, sin dpsi], where dpsi is the angle from the heading to the goal; the vector to the goal (dx, dy);
and the lidar within 1 m as a 2 x 25 x 25 map with cells of 0.08 m. The paper does not give the frame, the control step,
the horizon, the goal tolerance and the penalty. In the robot's frame, the lidar map needs no estimate of the yaw,
errors of the yaw do not move obstacles, and a rotation of the world changes nothing. The other choices are the defaults
of ``Turtlebot3Config``.

PyBullet is imported when the first simulation starts. Everything else works without it.
"""

import os
import sys
import xml.etree.ElementTree as xml
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ct_envs.checked import Above, Checked, Within
from ct_envs.errors import UserError
from ct_envs.lidar import LIDAR_BEAMS, LIDAR_RANGE_M, lidar_map
from ct_envs.robots import TURTLEBOT3
from ct_envs.turtlebot3_noise import Belief
from ct_envs.turtlebot3_world import World

WHEEL_RADIUS_M = 0.033  # r
WHEEL_SEPARATION_M = 0.160  # b
RADIUS_M = TURTLEBOT3.radius_m
TOP_SPEED_MPS = TURTLEBOT3.top_speed_mps
TOP_TURN_RADPS = 2.84
PROPRIO_SIZE = 2  # cos dpsi, sin dpsi
ACTION_SIZE = 2  # v, omega
MAX_NOISE = 2.0  # at this level the delay is one control step; longer delays are not simulated

_STOP_M = 0.1  # with noise, the robot stops at this estimated distance; half of the tolerance remains for drift
_LIDAR_M = 0.18  # height of the beams: above the body, below the top of every obstacle
_HEIGHT_M = 0.5  # of walls and obstacles
_TORQUE_NM = 0.03  # torque limit of a motor: 1.8 m/s^2, so that the robot does not tip over
_SETTLE = 12  # physics steps until a robot is at rest after it was placed
_FRONTAL = np.cos(np.pi / 4)  # a contact within 45 degrees of the direction of motion is frontal
_RENDERER = "tinyRendererPlugin"
_WHEELS = ("wheel_left_joint", "wheel_right_joint")
# Collision groups: body with obstacles, wheels with the floor, and rays (PyBullet uses group 1) with obstacles.
_RAY, _ROLLING, _BODY, _OBSTACLE, _FLOOR = 1, 2, 4, 8, 16


@dataclass(frozen=True)
class Turtlebot3Config(Checked):
    """The simulation and the task."""

    control_dt_s: Annotated[float, Above(0, 10)] = TURTLEBOT3.control_dt_s  # duration of a control step
    physics_dt_s: Annotated[float, Above(0, 10)] = 1 / 240  # duration of a step of PyBullet
    horizon: Annotated[int, Within(1, 1_000_000)] = TURTLEBOT3.horizon  # control steps of an episode
    goal_tolerance_m: Annotated[float, Above(0, 100)] = TURTLEBOT3.goal_tolerance_m
    # Subtracted from the reward of a step in which the robot touches something.
    collision_penalty: Annotated[float, Within(0, 1_000_000)] = 1.0
    urdf: str | None = None  # a URDF file to use instead of ours
    # Level of the errors of sensors and motion, see ``turtlebot3_noise``. 1 stands for a real robot.
    noise: Annotated[float, Within(0, MAX_NOISE)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.physics_dt_s > self.control_dt_s:
            raise UserError(f"Turtlebot3Config.physics_dt_s is {self.physics_dt_s}; give at most control_dt_s")

    @property
    def substeps(self) -> int:
        """Physics steps per control step."""
        return round(self.control_dt_s / self.physics_dt_s)


class Pose(NamedTuple):
    """Pose of the middle of the robot's axle in the world frame. May have leading batch axes."""

    position: np.ndarray  # float64 [*b, 2], [m]
    yaw_rad: Any  # float [*b]


class Touch(NamedTuple):
    """The contacts of a control step."""

    frontal: bool  # in the direction of motion
    grazing: bool  # at the side or behind


class Step(NamedTuple):
    """The result of a control step."""

    obs: dict[str, np.ndarray]
    reward: float
    done: bool
    info: dict[str, Any]


def wheel_speeds(v_mps: Any, omega_radps: Any) -> Any:
    """Speeds of the left and right wheel [..., 2] (rad/s) for linear speed v and angular speed omega (sec. IV-B)."""
    v_mps, omega_radps = np.asarray(v_mps, np.float64), np.asarray(omega_radps, np.float64)
    left = (v_mps - omega_radps * (WHEEL_SEPARATION_M / 2)) / WHEEL_RADIUS_M
    right = (v_mps + omega_radps * (WHEEL_SEPARATION_M / 2)) / WHEEL_RADIUS_M
    return np.stack([left, right], -1)


def speeds(action: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """(v, omega) [m/s, rad/s] of an action. The action is in shares of the top speeds, and is clipped to [-1, 1]."""
    return np.clip(action, -1.0, 1.0) * np.array([TOP_SPEED_MPS, TOP_TURN_RADPS])


def as_action(v_mps: Any, omega_radps: Any) -> np.ndarray:
    """The action of (v, omega), clipped: the inverse of ``speeds``."""
    return np.clip(np.stack([v_mps / TOP_SPEED_MPS, omega_radps / TOP_TURN_RADPS], -1), -1.0, 1.0)


def to_heading(vector: Float[np.ndarray, "*n 2"], yaw_rad: Any) -> Float[np.ndarray, "*n 2"]:
    """Transform a vector from the world frame to the frame of a robot with this yaw."""
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x], -1)


def observe(
    pose: Pose, goal: Float[np.ndarray, "*b 2"], ranges: Float[np.ndarray, "*b 360"], *, missing_ok: bool = False
) -> dict[str, np.ndarray]:
    """The observation: ``map`` [*b, 2, 25, 25] uint8, ``proprio`` [cos dpsi, sin dpsi] and ``goal`` [*b, 2] (m).

    Args:
        pose: the robot's estimate of its pose; positions [*b, 2] (m), yaws [*b].
        goal: in the world frame [m].
        ranges: of the lidar [m]; see ``lidar_map``, also for ``missing_ok``.
    """
    ahead = to_heading(goal - pose.position, np.asarray(pose.yaw_rad))
    distance = np.linalg.norm(ahead, axis=-1, keepdims=True)
    direction = np.where(distance > 1e-9, ahead / np.maximum(distance, 1e-9), [1.0, 0.0])
    picture = lidar_map(ranges, ahead, missing_ok=missing_ok)
    return {"map": picture, "proprio": direction.astype(np.float32), "goal": ahead.astype(np.float32)}


class Turtlebot3Env:
    """Reach the goal. The reward is minus the distance to the goal after the step [m], minus a penalty for contacts.

    Action: [-1, 1]^2, shares of 0.22 m/s and 2.84 rad/s. Observation: see ``observe``. An episode ends with a success
    (within the goal tolerance), or at the horizon (truncation). A collision does not end it. ``info`` holds
    ``success``, ``collision``, ``frontal``, ``grazing``, ``truncation``, ``episode_steps``, ``position``, ``yaw_rad``,
    ``ranges``, the estimated pose ``believed``, and ``believed_reward``, the estimated reward without the penalty. With
    ``noise``, the observation and the last three contain the robot's errors; all other entries are exact. The episode
    then ends when the robot estimates that it has reached the goal. It is a success if the true position is within the
    goal tolerance. The same world, start, goal, seed and actions give exactly the same episode, in any order of
    episodes.
    """

    def __init__(self, config: Turtlebot3Config = Turtlebot3Config()):
        """Raises UserError if PyBullet or the URDF is missing, or if the URDF is damaged."""
        self.config = config
        self._urdf = _urdf_file(config.urdf)
        self._bullet = load_pybullet()
        self._client = self._bullet.connect(self._bullet.DIRECT)
        self._drop_renderer()
        self._world: World | None = None
        self._done = True

    def close(self) -> None:
        """End the simulation."""
        if self._client >= 0:
            self._bullet.disconnect(self._client)
            self._client = -1

    def __enter__(self) -> "Turtlebot3Env":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(
        self, world: World, start: Any, goal: Any, *, seed: int = 0, yaw_rad: float | None = None
    ) -> dict[str, np.ndarray]:
        """The first observation of an episode from ``start`` to ``goal`` [2] (m).

        Args:
            seed: random seed of the noise, and of the yaw if none is given.

        Raises:
            UserError: a start or goal in an obstacle or too close to it, or a goal that the robot cannot reach.
        """
        start, goal = (np.asarray(point, np.float64) for point in (start, goal))
        check_task(world, start, goal)
        if yaw_rad is None:
            yaw_rad = float(np.random.default_rng(seed).uniform(-np.pi, np.pi))
        self._world, self._goal, self._steps, self._done = world, goal, 0, False
        self._build(world, start, yaw_rad)
        self._asked = np.zeros(2)
        self._belief = Belief(self.config.noise, *self.pose, seed)
        obs, self._sight = self._see()
        return obs

    def step(self, action: Any) -> Step:
        """One control step. Raises UserError if the action is not two finite numbers, or if the episode is over."""
        action = np.asarray(action, np.float64)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise UserError(f"the action {action.tolist()} is not two finite numbers; give shares of (v, omega)")
        if self._done:
            raise UserError("the Turtlebot3's episode is over, or none has begun; call reset first")
        touch = self._drive(*speeds(action))
        self._steps += 1
        pose = self.pose
        obs, self._sight = self._see()
        distance = float(np.linalg.norm(self._goal - pose.position))
        collision = touch.frontal or touch.grazing
        close, believed = distance < self.config.goal_tolerance_m, float(np.linalg.norm(obs["goal"]))
        stopped = believed < _STOP_M if self.config.noise else close
        success, truncation = stopped and close, not stopped and self._steps >= self.config.horizon
        self._done = stopped or truncation
        info = {
            "success": success, "collision": collision, "frontal": touch.frontal, "grazing": touch.grazing,
            "truncation": truncation, "episode_steps": self._steps, "position": pose.position,
            "yaw_rad": pose.yaw_rad, "believed_reward": -believed, **self._sight,
        }  # fmt: skip
        return Step(obs, -distance - self.config.collision_penalty * collision, self._done, info)

    def _see(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The observation, and the ranges and the pose from which it was computed."""
        if not self.config.noise:
            pose, ranges = self.pose, self.lidar()
        else:
            pose = Pose(self._belief.position, self._belief.yaw_rad)
            ranges = self._belief.scan(self.lidar())
        obs = observe(pose, self._goal, ranges, missing_ok=bool(self.config.noise))
        return obs, {"ranges": ranges, "believed": pose}

    def sight(self) -> dict[str, Any]:
        """The entries of ``info`` that exist before the first step."""
        pose = self.pose
        return {"position": pose.position, "yaw_rad": pose.yaw_rad, **self._sight}

    @property
    def pose(self) -> Pose:
        """The true pose of the robot."""
        position, quat = self._bullet.getBasePositionAndOrientation(self._robot, physicsClientId=self._client)
        x, y, z, w = quat
        return Pose(np.array(position[:2]), float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))

    def lidar(self) -> np.ndarray:
        """Ranges [360] (m). Beam i points i degrees to the left of the heading. No hit gives ``LIDAR_RANGE_M``."""
        position, yaw = self.pose
        angle = yaw + np.arange(LIDAR_BEAMS) * (2 * np.pi / LIDAR_BEAMS)
        begin = np.tile(np.append(position, _LIDAR_M), (LIDAR_BEAMS, 1))
        end = begin + LIDAR_RANGE_M * np.stack([np.cos(angle), np.sin(angle), np.zeros(LIDAR_BEAMS)], -1)
        hits = self._bullet.rayTestBatch(begin.tolist(), end.tolist(), physicsClientId=self._client)
        return LIDAR_RANGE_M * np.array([hit[2] for hit in hits])

    def _drop_renderer(self) -> None:
        """Unload the renderer. We do not use it, and its images take a quarter of the memory of a simulation."""
        # If the renderer is loaded, ``loadPlugin`` returns its number.
        if (renderer := self._bullet.loadPlugin(_RENDERER, physicsClientId=self._client)) >= 0:
            self._bullet.unloadPlugin(renderer, physicsClientId=self._client)

    def _build(self, world: World, start: np.ndarray, yaw_rad: float) -> None:
        """Build the whole simulation again. Old caches would make an episode depend on the episode before it."""
        p, client = self._bullet, {"physicsClientId": self._client}
        p.resetSimulation(**client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=self.config.physics_dt_s, deterministicOverlappingPairs=1, **client
        )  # fmt: skip
        p.setGravity(0.0, 0.0, -9.81, **client)
        floor = p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE, **client), **client)
        p.changeDynamics(floor, -1, lateralFriction=1.0, **client)
        p.setCollisionFilterGroupMask(floor, -1, _FLOOR, _ROLLING, **client)
        for x, y, half_x, half_y, yaw in [*_walls(world.side_m), *world.boxes.tolist()]:
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[half_x, half_y, _HEIGHT_M / 2], **client)
            self._put(shape, x, y, yaw)
        for x, y, radius in world.cylinders.tolist():
            self._put(p.createCollisionShape(p.GEOM_CYLINDER, radius=radius, height=_HEIGHT_M, **client), x, y, 0.0)
        self._load_robot(start, yaw_rad)
        for _ in range(_SETTLE):
            p.stepSimulation(**client)

    def _put(self, shape: int, x: float, y: float, yaw: float) -> None:
        """Add a fixed obstacle."""
        p, client = self._bullet, {"physicsClientId": self._client}
        quat = p.getQuaternionFromEuler([0.0, 0.0, yaw])
        body = p.createMultiBody(0, shape, -1, [x, y, _HEIGHT_M / 2], quat, **client)
        p.changeDynamics(body, -1, lateralFriction=0.5, restitution=0.0, **client)
        p.setCollisionFilterGroupMask(body, -1, _OBSTACLE, _BODY | _RAY, **client)

    def _load_robot(self, start: np.ndarray, yaw_rad: float) -> None:
        p, client = self._bullet, {"physicsClientId": self._client}
        place = [*start.tolist(), WHEEL_RADIUS_M], p.getQuaternionFromEuler([0.0, 0.0, yaw_rad])
        try:
            with _quiet():
                self._robot = p.loadURDF(str(self._urdf), *place, flags=p.URDF_USE_IMPLICIT_CYLINDER, **client)
        except p.error:
            raise UserError(f"{self._urdf}: PyBullet cannot load it; compare it with ours") from None
        joints = [p.getJointInfo(self._robot, i, **client) for i in range(p.getNumJoints(self._robot, **client))]
        number = {info[1].decode(): info[0] for info in joints}
        self._wheels = [number[name] for name in _WHEELS]
        for link in range(-1, len(joints)):
            rolls = link in self._wheels
            friction = 1.0 if rolls else 0.2 if link == -1 else 0.0
            p.changeDynamics(
                self._robot, link, lateralFriction=friction, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0,
                **client,
            )  # fmt: skip
            group = (_BODY, _OBSTACLE) if link == -1 else (_ROLLING, _FLOOR)
            p.setCollisionFilterGroupMask(self._robot, link, *group, **client)
        self._command(0.0, 0.0)

    def _command(self, v_mps: float, omega_radps: float, roll: Any = 1.0) -> None:
        """Set the speeds of the wheels. ``roll`` scales the speed of each wheel: it is the error of its motion."""
        p = self._bullet
        speeds = (wheel_speeds(v_mps, omega_radps) * roll).tolist()
        p.setJointMotorControlArray(
            self._robot, self._wheels, p.VELOCITY_CONTROL, targetVelocities=speeds, forces=[_TORQUE_NM] * 2,
            physicsClientId=self._client,
        )  # fmt: skip

    def _drive(self, v_mps: float, omega_radps: float) -> Touch:
        """Drive for one control step with constant speeds; returns the contacts."""
        assert self._world is not None
        before, asked = self._odometry(), np.array([v_mps, omega_radps])
        roll = self._belief.roll() if self.config.noise else np.ones(2)
        late = round(min(self._belief.latency_s, self.config.control_dt_s) / self.config.physics_dt_s)
        self._command(*(self._asked if late else asked), roll=roll)
        # The distance that the robot can reach in this step. Contacts are only computed if an obstacle is closer.
        reach = RADIUS_M + 1.5 * TOP_SPEED_MPS * self.config.control_dt_s + 0.02
        near = float(self._world.clearance(self.pose.position)) < reach
        frontal = grazing = False
        for substep in range(self.config.substeps):
            if substep == late and late:
                self._command(*asked, roll=roll)
            self._bullet.stepSimulation(physicsClientId=self._client)
            if near:
                now = self._touching(np.sign(v_mps) or 1.0)
                frontal, grazing = frontal or now.frontal, grazing or now.grazing
        self._asked = asked
        if self.config.noise:
            rolled, yaw = (after - here for after, here in zip(self._odometry(), before, strict=True))
            self._belief.move(rolled, float(np.angle(np.exp(1j * yaw))), self.config.control_dt_s)
        return Touch(frontal, grazing)

    def _odometry(self) -> tuple[np.ndarray, float]:
        """The distances that the wheels have rolled [2] (m), and the yaw [rad]."""
        states = self._bullet.getJointStates(self._robot, self._wheels, physicsClientId=self._client)
        return WHEEL_RADIUS_M * np.array([state[0] for state in states]), self.pose.yaw_rad

    def _touching(self, direction: float) -> Touch:
        """The current contacts of the body, classified by their normals. ``direction`` is -1 when driving backwards."""
        contacts = self._bullet.getContactPoints(bodyA=self._robot, linkIndexA=-1, physicsClientId=self._client)
        pressed = [contact[7] for contact in contacts if contact[9] > 0.0]
        if not pressed:
            return Touch(False, False)
        yaw = self.pose.yaw_rad
        way = direction * np.array([np.cos(yaw), np.sin(yaw)])
        frontal = -np.array(pressed)[:, :2] @ way > _FRONTAL  # the normals point at the robot
        return Touch(bool(frontal.any()), bool((~frontal).any()))


def check_task(world: World, start: np.ndarray, goal: np.ndarray) -> None:
    """Raise UserError if start or goal [2] (m) is too close to an obstacle, or if the robot cannot reach the goal."""
    for name, point in (("start", start), ("goal", goal)):
        if point.shape != (2,) or not np.isfinite(point).all():
            raise UserError(f"the {name} {point.tolist()} is not a point; give x and y in metres")
        if float(world.clearance(point)) < RADIUS_M:
            x, y = point
            raise UserError(f"the {name} ({x:.2f}, {y:.2f}) is in an obstacle or wall, or too near to one; move it")
    if not world.reachable(start, goal, RADIUS_M):
        x, y = goal
        raise UserError(f"the goal ({x:.2f}, {y:.2f}) is out of the robot's reach from this start; move one of them")


def load_pybullet() -> ModuleType:
    """Import PyBullet. Raises UserError if it is not installed."""
    try:
        with _quiet():
            import pybullet
    except ImportError:
        raise UserError(
            "the Turtlebot3 needs PyBullet, which is not installed and has no wheel past Python 3.11; "
            "use Python 3.11 and pip install 'control-transformer-jax[turtlebot3]' (all other robots work without)"
        ) from None
    return pybullet


@contextmanager
def _quiet() -> Iterator[None]:
    """A context that hides the output of C code: PyBullet prints a greeting and needless warnings."""
    streams = sys.stdout, sys.stderr
    for stream in streams:
        stream.flush()
    saved = os.dup(1), os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        yield
    finally:
        for stream in streams:
            stream.flush()
        for number, copy in enumerate(saved, 1):
            os.dup2(copy, number)
            os.close(copy)
        os.close(sink)


def _urdf_file(name: str | None) -> Path:
    """The path of the URDF. Raises UserError if the file is missing, is not XML, or has no joints for the wheels."""
    path = Path(name or str(resources.files("ct_envs") / "assets" / TURTLEBOT3.xml))
    if not path.is_file():
        raise UserError(f"no URDF file '{path}'; leave urdf out to use the Turtlebot3's own")
    try:
        robot = xml.fromstring(path.read_bytes())
    except xml.ParseError as bad:
        raise UserError(f"{path}:{bad.position[0]}: not XML ({bad.msg.split(':')[0]}); correct this line") from None
    joints = {joint.get("name") for joint in robot.iter("joint")}
    missing = [name for name in _WHEELS if name not in joints]
    if missing:
        raise UserError(f"{path}: has no joint {' and no '.join(missing)}; give the joints of the wheels these names")
    return path


def _walls(side_m: float) -> list[tuple[float, float, float, float, float]]:
    """The room's four walls as boxes, outside the room."""
    thick, middle = 0.1, side_m / 2
    low, high, half = -thick, side_m + thick, middle + 2 * thick
    return [
        (middle, low, half, thick, 0.0), (middle, high, half, thick, 0.0),
        (low, middle, thick, half, 0.0), (high, middle, thick, half, 0.0),
    ]  # fmt: skip
