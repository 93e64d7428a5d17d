"""Starts and goals of an evaluation, and the shortest ways between them."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int

from ct_envs import Maze
from ct_envs.robots import Robot
from ct_jax.prm import PrmConfig, Space, build_roadmap, extend_by_pairs


@dataclass(frozen=True)
class Pairs:
    """Starts and goals, drawn once from a seed, so that all methods get the same ones."""

    start: Float[np.ndarray, "n 2"]  # [m]
    goal: Float[np.ndarray, "n 2"]  # [m]
    shortest_m: Float[np.ndarray, "n"]  # on a dense roadmap; where it has no path, the straight line
    seed: int
    place: Int[np.ndarray, "n"] = None  # pyright: ignore  # index of the maze or room of each; by default the first
    straight: int = 0  # number of pairs for which only the straight line is known: a lower bound

    def __post_init__(self) -> None:
        if self.place is None:
            object.__setattr__(self, "place", np.zeros(len(self.start), int))

    @property
    def ends(self) -> Float[np.ndarray, "n 2 2"]:
        """Starts and goals together [m]."""
        return np.stack([self.start, self.goal], 1)


def shortest_ways(
    key: jax.Array, space: Maze | Space, ends: Float[np.ndarray, "n 2 2"], *, radius_m: float, config: PrmConfig
) -> tuple[Float[np.ndarray, "n"], int]:
    """Lengths (m) of the shortest ways between starts and goals (m), and how many of them are only straight lines.

    The roadmap grows until it joins them. Where it cannot, the length is that of the straight line: a lower bound, for
    a strict SPL.
    """
    grown, nodes = extend_by_pairs(build_roadmap(key, space, radius_m=radius_m, config=config, ends=ends), ends)
    shortest = grown.distances(nodes)
    unknown = ~np.isfinite(shortest)
    straight = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    return np.where(unknown, straight, shortest), int(unknown.sum())


def horizon_for(robot: Robot, pairs: Pairs) -> int:
    """Control steps of an episode: the robot's own horizon, or more in proportion to the longest way of the pairs."""
    return int(np.ceil(robot.horizon * max(1.0, float(pairs.shortest_m.max()) / robot.way_m)))


def beyond_horizon(robot: Robot, pairs: Pairs, horizon: int) -> int:
    """Number of pairs that are farther apart than the robot goes in so many control steps."""
    return int((pairs.shortest_m > robot.cruise_mps * robot.control_dt_s * horizon).sum())
