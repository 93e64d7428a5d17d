"""The errors of a real Turtlebot3: slipping wheels, drifting odometry, a noisy lidar, late commands. NumPy only.

One ``level`` scales all errors. Level 1 stands for a robot in good condition on a smooth floor. Each magnitude is the
standard deviation of an error; its comment gives the reason. The simulation has the true state; this file computes the
robot's estimates.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ct_envs.lidar import LIDAR_RANGE_M

LIDAR_BLIND_M = 0.12  # the LDS-01 measures nothing closer than this (its data sheet)


@dataclass(frozen=True)
class Noise:
    """Magnitudes at level 1."""

    wheel: float = 0.01  # share of a wheel's radius, constant in an episode: 0.3 mm of 33 mm, from wear and load
    slip: float = 0.03  # share of the distance that a wheel rolls in a control step: rubber on a smooth floor
    gyro_scale: float = 0.01  # share of each turn, constant in an episode: typical of an uncalibrated MEMS gyroscope
    gyro_bias_radps: float = np.radians(0.05)  # constant in an episode: the remaining bias after calibration at rest
    gyro_walk: float = np.radians(0.1)  # random walk of the yaw [rad per square root of a second]
    near_m: float = 0.010  # error of ranges below 0.5 m: the precision of the LDS-01 (data sheet)
    far: float = 0.035  # error of longer ranges, as a share of the range (data sheet)
    dropped: float = 0.02  # share of beams that do not come back: dark or slanted surfaces
    latency_s: float = 0.1  # from a scan to the wheels: half a turn of the lidar, at five turns per second


class Belief:
    """Odometry of one episode: the robot's estimate of its pose."""

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
        """Delay of a command on its way to the wheels [s]."""
        return self._level * self._noise.latency_s

    def roll(self) -> Float[np.ndarray, "2"]:
        """The true motion of the left and right wheel in the next control step, relative to their encoders."""
        self._roll = 1.0 + self._wheels + self._level * self._noise.slip * self._rng.standard_normal(2)
        return self._roll

    def move(self, rolled_m: Float[np.ndarray, "2"], turned_rad: float, dt_s: float) -> None:
        """Update the estimate after a control step, from the true roll of the wheels and the true turn."""
        walk = self._level * self._noise.gyro_walk * np.sqrt(dt_s) * self._rng.standard_normal()
        turn = turned_rad * (1.0 + self._scale) + self._bias * dt_s + walk
        middle = self.yaw_rad + turn / 2
        way = float(np.mean(rolled_m / self._roll))
        self.position = self.position + way * np.array([np.cos(middle), np.sin(middle)])
        self.yaw_rad += turn

    def scan(self, ranges: Float[np.ndarray, "360"]) -> Float[np.ndarray, "360"]:
        """A scan with the errors of the lidar. Beams that do not come back have an infinite range.

        A beam without a hit within ``LIDAR_RANGE_M`` is not changed: its true range is unknown, and a negative error
        would create an obstacle at the end of the range.
        """
        sigma = self._level * np.where(ranges < 0.5, self._noise.near_m, self._noise.far * ranges)
        seen = np.maximum(ranges + sigma * self._rng.standard_normal(ranges.shape), 1e-3)
        lost = self._rng.random(ranges.shape) < self._level * self._noise.dropped
        blind = ranges < min(self._level, 1.0) * LIDAR_BLIND_M
        return np.where(lost | blind, np.inf, np.where(ranges < LIDAR_RANGE_M, seen, ranges))
