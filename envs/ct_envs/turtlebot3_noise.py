"""The errors of a real Turtlebot3: slipping wheels, drifting odometry, a noisy lidar, late commands. NumPy only.

One ``level`` scales all of them. Level 1 stands for a well-kept robot on a smooth floor. Each magnitude is the standard
deviation of an error, with its reason beside it. The simulation keeps the true state; this file gives the robot's
estimates.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ct_envs.lidar import LIDAR_RANGE_M

LIDAR_BLIND_M = 0.12  # the LDS-01 measures nothing closer than this (its data sheet)


@dataclass(frozen=True)
class Noise:
    """Magnitudes at level 1."""

    wheel: float = 0.01  # share of a wheel's radius, for the whole episode: 0.3 mm of 33 mm, from wear and load
    slip: float = 0.03  # share of what a wheel rolls in a control step: rubber on a smooth floor
    gyro_scale: float = 0.01  # share of each turn, for the whole episode: typical of an uncalibrated MEMS gyroscope
    gyro_bias_radps: float = np.radians(0.05)  # for the whole episode: the rest after calibration at standstill
    gyro_walk: float = np.radians(0.1)  # random walk of the yaw [rad per square root of a second]
    near_m: float = 0.010  # of a range below 0.5 m: the LDS-01's precision (its data sheet)
    far: float = 0.035  # of a longer range, as a share of it (likewise)
    dropped: float = 0.02  # share of beams that do not come back: dark and slanting surfaces
    latency_s: float = 0.1  # from a scan to the wheels: half a turn of the lidar, which turns five times a second


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
        """How far the left and right wheel really roll in the next control step, relative to their encoders."""
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
        """A scan with the lidar's errors; infinity if a beam did not come back.

        A beam without a hit within ``LIDAR_RANGE_M`` is not changed: its true range is unknown, and an error subtracted
        from the limit would create an obstacle.
        """
        sigma = self._level * np.where(ranges < 0.5, self._noise.near_m, self._noise.far * ranges)
        seen = np.maximum(ranges + sigma * self._rng.standard_normal(ranges.shape), 1e-3)
        lost = self._rng.random(ranges.shape) < self._level * self._noise.dropped
        blind = ranges < min(self._level, 1.0) * LIDAR_BLIND_M
        return np.where(lost | blind, np.inf, np.where(ranges < LIDAR_RANGE_M, seen, ranges))
