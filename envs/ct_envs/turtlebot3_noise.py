"""What a real Turtlebot3 gets wrong: slipping wheels, drifting odometry, a noisy lidar, late commands. NumPy only.

One ``level`` scales all of it. Level 1 is meant to be a well-kept robot on a smooth floor; each magnitude is the
standard deviation of an error and has its reason beside it. The truth stays in the simulation: what is given here is
what the robot itself would believe.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ct_envs.lidar import LIDAR_RANGE_M

LIDAR_BLIND_M = 0.12  # nearer than this the LDS-01 measures nothing (its data sheet)


@dataclass(frozen=True)
class Noise:
    """Magnitudes at level 1."""

    wheel: float = 0.01  # of a wheel's radius, for the whole episode: 0.3 mm of 33 mm of wear and load
    slip: float = 0.03  # of what a wheel rolls in a control step: rubber on a smooth floor
    gyro_scale: float = 0.01  # of turns, for the whole episode: typical of an uncalibrated MEMS gyroscope
    gyro_bias_radps: float = np.radians(0.05)  # for the whole episode: what is left after calibration at rest
    gyro_walk: float = np.radians(0.1)  # random walk of the yaw [rad per square root of a second]
    near_m: float = 0.010  # of a range below 0.5 m: the LDS-01's precision (its data sheet)
    far: float = 0.035  # of a longer range, as a share of it (likewise)
    dropped: float = 0.02  # share of beams that do not come back: dark and slanting surfaces
    latency_s: float = 0.1  # between a scan and the wheels: half a turn of the lidar, which turns five times a second


class Belief:
    """Odometry of one episode: where the robot believes to be."""

    def __init__(self, level: float, position: np.ndarray, yaw_rad: float, seed: int, noise: Noise = Noise()):
        self.position, self.yaw_rad = np.array(position, np.float64), float(yaw_rad)
        self._level, self._noise = level, noise
        self._rng = np.random.default_rng([seed, 3])
        self._wheels = level * noise.wheel * self._rng.standard_normal(2)
        self._scale = level * noise.gyro_scale * self._rng.standard_normal()
        self._bias = level * noise.gyro_bias_radps * self._rng.standard_normal()
        self._roll = np.ones(2)

    @property
    def latency_s(self) -> float:
        """How late a command reaches the wheels [s]."""
        return self._level * self._noise.latency_s

    def roll(self) -> Float[np.ndarray, "2"]:
        """How far the left and right wheel roll in the next control step, in shares of what their encoders tell."""
        self._roll = 1.0 + self._wheels + self._level * self._noise.slip * self._rng.standard_normal(2)
        return self._roll

    def move(self, rolled_m: Float[np.ndarray, "2"], turned_rad: float, dt_s: float) -> None:
        """Take a control step into account: what the wheels rolled, and what the robot turned in truth."""
        walk = self._level * self._noise.gyro_walk * np.sqrt(dt_s) * self._rng.standard_normal()
        turn = turned_rad * (1.0 + self._scale) + self._bias * dt_s + walk
        middle = self.yaw_rad + turn / 2
        way = float(np.mean(rolled_m / self._roll))
        self.position = self.position + way * np.array([np.cos(middle), np.sin(middle)])
        self.yaw_rad += turn

    def scan(self, ranges: Float[np.ndarray, "360"]) -> Float[np.ndarray, "360"]:
        """A scan as the lidar would give it; infinity where nothing came back.

        A beam that met nothing within ``LIDAR_RANGE_M`` stays so: how far it went nobody knows, and an error taken off
        the limit itself would put an obstacle there.
        """
        sigma = self._level * np.where(ranges < 0.5, self._noise.near_m, self._noise.far * ranges)
        seen = np.maximum(ranges + sigma * self._rng.standard_normal(ranges.shape), 1e-3)
        lost = self._rng.random(ranges.shape) < self._level * self._noise.dropped
        blind = ranges < min(self._level, 1.0) * LIDAR_BLIND_M
        return np.where(lost | blind, np.inf, np.where(ranges < LIDAR_RANGE_M, seen, ranges))
