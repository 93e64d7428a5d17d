"""Driving the Turtlebot3's simulations: the loop that steps a pool under a driver, and its records.

It does for the pool, in NumPy, what ``rollout`` does for the mazes. Lidar scans cannot be recomputed, so an episode
keeps its local maps, with eight cells in a byte.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ct_envs.turtlebot3_pool import Episode, Frame, Turtlebot3Pool
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.interrupts import raise_if_interrupted
from ct_jax.rollout import Action
from ct_jax.trajectories import Trajectories, pack_maps, pad

_NOTHING = np.zeros(0, np.uint8)


@dataclass(frozen=True)
class Drive:
    """An episode of T steps: the state before each action, and the outcome after it."""

    position: Float[np.ndarray, "T 2"]  # before the action, in the world [m]
    yaw_rad: Float[np.ndarray, "T"]
    proprio: Float[np.ndarray, "T 2"]  # cos dpsi, sin dpsi
    goal_relative: Float[np.ndarray, "T 2"]  # observed vector to the final goal [m]
    map_bits: UInt8[np.ndarray, "T 157"]
    action: Float[np.ndarray, "T 2"]  # as intended, without disturbance; in shares of the top speeds
    label: Float[np.ndarray, "T 2"]  # to be imitated
    label_mask: Float[np.ndarray, "T"]  # 1 if the target is to be imitated
    reward: Float[np.ndarray, "T"]  # after the action
    frontal: Bool[np.ndarray, "T"]
    grazing: Bool[np.ndarray, "T"]
    goal_world: Float[np.ndarray, "2"]  # final goal in the world [m]
    end_world: Float[np.ndarray, "3"]  # final pose of the robot in the world: x, y [m], yaw [rad]
    success: bool

    @property
    def length(self) -> int:
        """Number of steps."""
        return len(self.reward)

    @property
    def collision(self) -> np.ndarray:
        """Whether the robot touched anything [T]."""
        return self.frontal | self.grazing

    @property
    def path(self) -> Float[np.ndarray, "T+1 2"]:
        """Positions in the world [m], including the final one."""
        return np.concatenate([self.position, self.end_world[None, :2]])


def to_trajectories(drives: Sequence[Drive]) -> Trajectories:
    """Episodes as trajectories. They keep the observed maps and goals."""
    longest = max(each.length for each in drives)
    parts = []
    for each in drives:
        steps = {name: getattr(each, name)[None] for name in ("position", "proprio", "action", "label", "reward")}
        steps |= {"label_mask": each.label_mask[None], "collision": each.collision[None].astype(np.float32)}
        part = Trajectories(
            **steps, goal_world=each.goal_world[None], maze=np.zeros(1, np.int32),
            length=np.array([each.length], np.int32), goal_relative=each.goal_relative[None],
            map_bits=each.map_bits[None],
        )  # fmt: skip
        parts.append(pad(part, 1, longest))
    names = Trajectories.__dataclass_fields__
    return Trajectories(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


class Driver(Protocol):
    """Acts in the N slots of a pool at once, in NumPy, as ``rollout.Policy`` does in compiled programs."""

    def act(self, memory: Any, frame: Frame) -> tuple[Action, Any]:
        """Actions [N, 2] for this observation, and the next memory."""
        ...


class _Moment(NamedTuple):
    """One step of all slots."""

    before: Frame
    action: Action
    after: Frame


def drive(
    pool: Turtlebot3Pool, episodes: Sequence[Episode], driver: Driver, begin: Callable[[Frame], Any]
) -> list[Drive]:
    """Drive episodes to their ends, one in each slot.

    Args:
        begin: makes the driver's memory from the first frame.
    """
    frame = pool.reset(episodes, range(len(episodes)))
    memory = begin(frame)
    moments: list[_Moment] = []
    while not frame.done.all():
        action, memory = driver.act(memory, frame)
        action = Action(*(np.asarray(leaf) for leaf in action))
        after = pool.step(action.executed)
        moments.append(_Moment(frame._replace(map=pack_maps(frame.map)), action, after._replace(map=_NOTHING)))
        frame = after
        raise_if_interrupted()
    return [_record(moments, slot, episode) for slot, episode in enumerate(episodes)]


def _record(moments: list[_Moment], slot: int, episode: Episode) -> Drive:
    """The record of one slot until its episode ended."""
    mine = [moment for moment in moments if not moment.before.done[slot]]
    end = mine[-1].after

    def take(part: str, name: str, kind: type = np.float32) -> np.ndarray:
        return np.stack([np.asarray(getattr(getattr(moment, part), name)[slot], kind) for moment in mine])

    before, after = functools.partial(take, "before"), functools.partial(take, "after")
    return Drive(
        position=before("position"), yaw_rad=before("yaw_rad"), proprio=before("proprio"), goal_relative=before("goal"),
        map_bits=before("map", np.uint8), action=take("action", "intended"), label=take("action", "label"),
        label_mask=take("action", "label_mask"), reward=after("reward"), frontal=after("frontal", bool),
        grazing=after("grazing", bool), goal_world=np.asarray(episode.goal, np.float32),
        end_world=np.append(end.position[slot], end.yaw_rad[slot]).astype(np.float32), success=bool(end.success[slot]),
    )  # fmt: skip


# --------------------------------------------------------------------------------------------- led by a planner


class Guide(Protocol):
    """A planner of the Turtlebot3. It gives the next waypoint at every step."""

    def waypoint(self, memory: Any, frame: Frame) -> tuple[Float[np.ndarray, "N 2"], Any]:
        """Vectors to targets in the robots' own frames [m], and the guide's next memory."""
        ...


class Led(NamedTuple):
    """Memory of ``GuidedDriver`` for N robots."""

    plan: Any  # the guide's memory
    rngs: tuple[np.random.Generator, ...]  # of the disturbances
    disturbance: Float[np.ndarray, "N 2"]


@dataclass(frozen=True)
class GuidedDriver:
    """The controller guided by a planner (paper, sec. III-A), like ``rollout.Guided``."""

    guide: Guide
    controller: DifferentialDrive = DifferentialDrive()
    noise: float = 0.0  # standard deviation of a disturbance of the actions; it is not imitated
    hold: float = 0.9  # chance that the disturbance is kept for another step

    def init(self, plan: Any, frame: Frame, episodes: Sequence[Episode]) -> Led:
        """The memory before the first step; ``plan`` is the guide's memory."""
        rngs = tuple(np.random.default_rng([episode.seed, 1]) for episode in episodes)
        return Led(plan, rngs, np.zeros((len(frame.done), 2)))

    def act(self, memory: Led, frame: Frame) -> tuple[Action, Led]:
        """Actions towards each robot's waypoint, and the next memory."""
        target, plan = self.guide.waypoint(memory.plan, frame)
        meant = self.controller(target)
        disturbance = self._disturb(memory, frame.done) if self.noise else memory.disturbance
        action = Action(meant, meant + disturbance, meant, np.ones(len(meant), np.float32))  # pyright: ignore
        return action, Led(plan, memory.rngs, disturbance)

    def _disturb(self, memory: Led, done: np.ndarray) -> np.ndarray:
        disturbance = memory.disturbance.copy()
        for slot, rng in enumerate(memory.rngs):
            if not done[slot] and rng.random() >= self.hold:
                disturbance[slot] = self.noise * rng.standard_normal(2)
        return disturbance
