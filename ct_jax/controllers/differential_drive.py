"""The known controller of a differential-drive robot (paper, sec. IV-B): it is not learned and sees only the goal."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ct_envs.turtlebot3 import as_action


@dataclass(frozen=True)
class DifferentialDrive:
    """V is proportional to the distance and omega to the angle between heading and goal; both are limited."""

    v_gain_per_s: float = 1.0  # m/s for each metre of distance
    omega_gain_per_s: float = 3.0  # rad/s for each radian between heading and goal
    # V is also multiplied by this power of the angle's cosine; it is 0 if the goal is behind. So the robot turns before
    # it drives and does not cut corners. 0 gives the paper's controller.
    turn_first: float = 2.0

    action_size: ClassVar[int] = 2

    def __call__(self, proprio: object, goal_heading: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Actions [*n, 2], in shares of the top speeds, for goals in the robot's own frame [*n, 2] (m)."""
        del proprio
        distance = np.linalg.norm(goal_heading, axis=-1)
        angle = np.arctan2(goal_heading[..., 1], goal_heading[..., 0])
        v_mps = self.v_gain_per_s * distance
        action = as_action(v_mps, self.omega_gain_per_s * angle)  # limited first, then slowed by the turn
        if self.turn_first:
            action[..., 0] *= np.maximum(np.cos(angle), 0.0) ** self.turn_first
        return action
