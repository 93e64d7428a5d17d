"""The interfaces of the method: read this file first.

A ``World`` draws tasks and runs a policy on them; nothing else knows a simulator. A ``Policy`` acts on observations:
the transformer, a controller that a planner guides, the takeover of fine-tuning, a baseline. A ``Guide`` is a planner:
it gives waypoints. Collection, recovery, fine-tuning and evaluation use only these.

Arrays have a leading axis N, the episodes that run side by side, all of them at the same step. Some worlds run under
``jax.jit``, others in NumPy: policies and guides for several worlds use operations that both know.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ct_envs.robots import Robot

AnyArray = jax.Array | np.ndarray


class Observation(NamedTuple):
    """All that a policy may use."""

    map: (
        UInt8[AnyArray, "N 2 k k"] | None
    )  # local map: obstacles and the direction of the goal; None if nobody needs it
    proprio: Float[AnyArray, "N P"]
    goal_relative: Float[AnyArray, "N 2"]  # from the robot to its goal [m]


class Privileged(NamedTuple):
    """What only planners, failure detectors and records may use."""

    position: Float[AnyArray, "N 2"]  # in the world [m]
    goal_world: Float[AnyArray, "N 2"]  # [m]
    collision: Float[AnyArray, "N"]  # 1 if the robot touches something now
    scene: Any  # what guides of this world need besides: in mazes the maze of each episode, in rooms the lidar and pose


class Frame(NamedTuple):
    """N episodes at one control step."""

    obs: Observation
    reward: Float[AnyArray, "N"]  # since the last action, as the robot can tell: minus the distance to the goal [m]
    done: Bool[AnyArray, "N"]
    privileged: Privileged


class Action(NamedTuple):
    """What a policy decides in N episodes. Actions are shares of the actuators' range, in [-1, 1]."""

    intended: Float[AnyArray, "N A"]
    executed: Float[AnyArray, "N A"]  # with a disturbance, if there is one
    label: Float[AnyArray, "N A"]  # the action to imitate
    label_mask: Float[AnyArray, "N"]  # 1 if the label is to be imitated, else 0
    target_return: Float[AnyArray, "N"] | None = None  # the return-to-go that the policy is conditioned on, if it is


def act_as_intended(action: Float[AnyArray, "N A"], target_return: Float[AnyArray, "N"] | None = None) -> Action:
    """An action that is executed without disturbance and imitated as it is."""
    return Action(action, action, action, jnp.ones(action.shape[:1], jnp.float32), target_return)


@dataclass(frozen=True)
class Tasks:
    """Episodes to run. All that is random in them is drawn: the same tasks and policy give the same episodes.

    Each world has its own kind with more fields, such as the roadmaps that planners follow.
    """

    start: Float[np.ndarray, "N 2"]  # [m]
    goal: Float[np.ndarray, "N 2"]  # [m]
    place: Int[np.ndarray, "N"]  # index of the maze or room
    key: jax.Array  # of all that a policy draws


class Policy(Protocol):
    """Acts in N episodes. The policy and its memory of the episodes are two pytrees."""

    def init(self, frame: Frame, tasks: Any) -> Any:
        """The memory before the first step. Only planners may use the tasks."""
        ...

    def act(self, memory: Any, frame: Frame, key: jax.Array) -> tuple[Action, Any]:
        """Actions for N episodes, and the next memory."""
        ...


class Guide(Protocol):
    """A planner: it gives the next waypoint at every step."""

    def init(self, frame: Frame, tasks: Any) -> Any:
        """The memory at the robots' present positions, such as their plans."""
        ...

    def waypoint(self, memory: Any, frame: Frame) -> tuple[Float[AnyArray, "N 2"], Any]:
        """Vectors to the waypoints [m], in the frame of ``Observation.goal_relative``, and the next memory."""
        ...


class Controller(Protocol):
    """The low-level controller pi_c. It is a pytree, so its parameters are arguments of compiled programs."""

    action_size: int

    def __call__(
        self, proprio: Float[AnyArray, "N P"], goal_relative: Float[AnyArray, "N 2"]
    ) -> Float[AnyArray, "N A"]:
        """Actions from proprioception and the vector to a nearby goal [m]."""
        ...


class Steps(NamedTuple):
    """The record of N episodes, time first: the state before each action, and what followed it."""

    position: Float[np.ndarray, "T N 2"]  # before the action [m]
    proprio: Float[np.ndarray, "T N P"]
    action: Float[np.ndarray, "T N A"]  # as intended, without disturbance; 0 where it is not finite
    label: Float[np.ndarray, "T N A"]  # 0 where it is not finite
    label_mask: Float[np.ndarray, "T N"]  # 1 where the label is finite and is to be imitated
    reward: Float[np.ndarray, "T N"]  # after the action
    alive: Float[np.ndarray, "T N"]  # 1 where the episode was still running before the action
    collision: Float[np.ndarray, "T N"]  # 1 where the robot touched something after the action
    success: Float[np.ndarray, "T N"]  # 1 where the robot was at its goal after the action
    target_return: Float[np.ndarray, "T N"] | None = None
    # Of worlds in which local maps cannot be recomputed from positions:
    goal_relative: Float[np.ndarray, "T N 2"] | None = None  # observed [m]
    map_bits: UInt8[np.ndarray, "T N 157"] | None = None  # see ``trajectories.pack_maps``
    # Of worlds that tell two kinds of collision apart:
    frontal: Float[np.ndarray, "T N"] | None = None
    grazing: Float[np.ndarray, "T N"] | None = None


class End(NamedTuple):
    """How N episodes ended."""

    position: Float[np.ndarray, "N 2"]  # [m]
    reward: Float[np.ndarray, "N"]  # the last one
    success: Bool[np.ndarray, "N"]
    fell: Bool[np.ndarray, "N"]
    diverged: Bool[np.ndarray, "N"] | None  # a state or action was not finite; None where that raises an error

    @property
    def broke_off(self) -> Bool[np.ndarray, "N"]:
        """Whether an episode ended by a fall or because something was not finite.

        Both end the losses of a robot that has not arrived. Where returns are compared, such an episode is charged as
        if the robot stayed where it is until the horizon.
        """
        return self.fell if self.diverged is None else self.fell | self.diverged


@dataclass(frozen=True)
class Rollout:
    """What happened to this process's share of the tasks, in NumPy."""

    steps: Steps
    end: End
    goal_world: Float[np.ndarray, "N 2"]  # [m]
    place: Int[np.ndarray, "N"]
    counted: Bool[np.ndarray, "N"]  # false for copies, which make the number even for all devices
    horizon: int  # control steps of an episode


OnProgress = Callable[[int, str], None]  # called with the number of finished episodes, and a note


class World(Protocol):
    """Where robots drive."""

    robot: Robot
    horizon: int  # default number of control steps of an episode
    places: int  # number of mazes that tasks are drawn in, one after the other; 1 if each room is new

    def sample_tasks(self, key: jax.Array, config: Any, prm: Any, *, first: int = 0, offset: int = 0) -> Tasks:
        """Episodes ``first`` to ``first + config.envs - 1`` of a collection, with roadmaps that join starts and goals.

        Args:
            config: a ``CollectConfig``.
            prm: a ``PrmConfig``.
            offset: the place of episode 0.
        """
        ...

    def draw_pairs(self, seed: int, n: int) -> Any:
        """``Pairs`` of an evaluation: n in each place."""
        ...

    def tasks_of(self, pairs: Any, prm: Any | None) -> tuple[Tasks, int | None]:
        """The pairs as tasks; with a ``PrmConfig`` also roadmaps to plan on, and how many pairs they do not join.

        Raises:
            UserError: the pairs are not of this world.
        """
        ...

    def guide(self, name: str, prm: Any) -> Guide:
        """The planner "roadmap", "shortcut" or "explorer" in this world."""
        ...

    def rollout(
        self, policy: Policy, tasks: Any, *, horizon: int, on_progress: OnProgress = lambda over, note: None
    ) -> Rollout:
        """Run all tasks to their ends, at most ``horizon`` control steps each."""
        ...

    def close(self) -> None:
        """Give back processes and memory."""
        ...
