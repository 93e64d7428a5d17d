"""The task of a low-level controller: to walk the edges of a roadmap (paper, sec. III-B and III-G).

The controller sees proprioception and the vector to its goal, but no walls.
"""

from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from brax.training.agents.sac import networks as sac_networks
from brax.training.types import Transition
from jaxtyping import Array, Float

from ct_envs import Tasks, UserError
from ct_envs.checked import Above, Checked, Share, Within
from ct_envs.frames import symmetries
from ct_envs.maze import Maze
from ct_jax.controllers.augment import AugmentConfig, check_frame, controller_inputs, input_size, mirrored
from ct_jax.controllers.reward import Ramp, Reward, RewardConfig, check_ramp
from ct_jax.controllers.sac import SacConfig, make_networks
from ct_jax.prm import Roadmap
from ct_jax.rollout import Environment


@dataclass(frozen=True)
class EdgeConfig(Checked):
    """The walk along an edge."""

    reward: RewardConfig = RewardConfig()  # terms of the reward
    episode_steps: Annotated[int, Within(1, 1_000_000)] = 60  # control steps to walk an edge
    # Spread of the speed at an edge's start: on a plan, the robot arrives there moving.
    reset_velocity_mps: Annotated[float, Within(0, 100)] = 2.0
    # A change of the first heading: from facing the goal to any heading; without it, always any heading.
    turn_ramp: Ramp | None = None
    held_out: Annotated[float, Within(0, 0.9)] = 0.1  # share of the edges kept for the final test
    relabel: Share = 0.0  # share of replayed steps that get a random goal around the robot: plans turn in any direction
    relabel_m: Annotated[float, Above(0, 10_000)] = 10.0  # largest distance of those goals [m]
    chain: bool = False  # after a success, continue from there along another edge, as on a plan
    through: bool = False  # with ``chain``: an arrival does not end the return; rewards on the next edge count

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.turn_ramp is not None:
            check_ramp("EdgeConfig.turn_ramp", self.turn_ramp)
        if self.through and not self.chain:
            raise UserError("EdgeConfig.through needs chained edges; also set chain=True")


def split_edges(roadmap: Roadmap, held_out: float, seed: int) -> tuple[Tasks, Tasks]:
    """Edges in both directions, as training tasks and held-out tasks. Both directions of an edge are in the same set.

    Raises:
        UserError: the roadmap has too few edges to hold any out.
    """
    edges = np.random.default_rng(seed).permutation(roadmap.edges)
    n = int(held_out * len(edges))
    if n < 1:
        raise UserError(f"the roadmap has only {len(roadmap.edges)} edges; sample more points or connect farther")
    return edge_tasks(roadmap, edges[n:]), edge_tasks(roadmap, edges[:n])


def edge_tasks(roadmap: Roadmap, edges: np.ndarray) -> Tasks:
    """These edges of the roadmap, in both directions."""
    edges = np.concatenate([edges, edges[:, ::-1]])
    start, goal = (jnp.asarray(roadmap.points[edges[:, i]]) for i in (0, 1))
    return Tasks(start, goal, jnp.asarray(len(edges), jnp.int32))


def chain_tasks(tasks: Tasks, seed: int, choices: int = 8) -> Tasks:
    """The tasks, each with ``choices`` random tasks that begin where it ends. The way back is always a candidate."""
    rng = np.random.default_rng(seed)
    start, goal = np.asarray(tasks.start), np.asarray(tasks.goal)
    _, place = np.unique(np.concatenate([start, goal]), axis=0, return_inverse=True)
    begins, ends = place.ravel()[: len(start)], place.ravel()[len(start) :]
    order = np.argsort(begins, kind="stable")
    first, last = (np.searchsorted(begins[order], ends, side) for side in ("left", "right"))
    follow = order[rng.integers(first[:, None], last[:, None], (len(ends), choices))]
    return tasks.replace(follow=jnp.asarray(follow, jnp.int32))


@dataclass(frozen=True)
class EdgeTask:
    """Walking edges: an ``off_policy.Task``."""

    env: Environment  # with auto-reset and without maps; its robot determines the kind of reward
    edges: EdgeConfig
    augment: AugmentConfig
    discount: float

    def __post_init__(self) -> None:
        check_frame(self.augment.frame, self.env.robot)
        if self.augment.mirror:
            symmetries(self.env.robot)  # raises UserError if it has no known ones

    @property
    def reward(self) -> Reward:
        """The reward of a step: progress or distance, as suits the robot."""
        robot = self.env.robot
        return Reward(self.edges.reward, robot.controller_reward, robot.control_dt_s)

    @property
    def observation_size(self) -> int:
        """Of proprioception and goal."""
        return self.env.proprio_size + 2

    @property
    def input_size(self) -> int:
        """Of these in the controller's frame."""
        return input_size(self.env.proprio_size, self.augment.frame)

    def networks(self, config: SacConfig) -> sac_networks.SACNetworks:
        """Policy and critics."""
        return make_networks(self.input_size, self.env.action_size, config.hidden, critic_norm=config.critic_norm)

    def observe(self, state: State) -> Float[Array, "N P+2"]:
        """Proprioception and the vector to the goal."""
        return jnp.concatenate([state.obs["proprio"], state.obs["goal"]], -1)  # pyright: ignore

    def inputs(self, observation: Float[Array, "N P+2"], maze: Maze) -> Float[Array, "N I"]:
        """The same in the controller's frame."""
        del maze
        return controller_inputs(observation, self.augment.frame)

    def start(self, tasks: Tasks) -> Tasks:
        """The tasks at the beginning of the training: with ``turn_ramp`` all face their goals."""
        return tasks if self.edges.turn_ramp is None else tasks.replace(turn_rad=jnp.zeros((), jnp.float32))

    def ease(self, state: State, share: Float[Array, ""]) -> State:
        """The state with the first headings (``turn_ramp``) after this share of the training."""
        if self.edges.turn_ramp is None:
            return state
        turned = jnp.interp(share, jnp.asarray(self.edges.turn_ramp), jnp.arange(2.0))
        tasks = state.info["tasks"].replace(turn_rad=jnp.full(len(state.done), jnp.pi * turned, jnp.float32))
        return state.replace(info=state.info | {"tasks": tasks})  # pyright: ignore

    def present(self, batch: Transition, maze: Maze, key: jax.Array, share: Float[Array, ""]) -> Transition:
        """A batch from the replay, relabelled and mirrored if configured, as inputs of the networks."""
        mirror_key, goal_key = jax.random.split(key)
        if self.edges.relabel:
            batch = self.relabel(batch, goal_key)
        if self.edges.through:
            batch = batch._replace(discount=1.0 - batch.extras["state_extras"]["fall"])
        if self.augment.mirror:
            batch = mirrored(batch, self.env.robot, mirror_key)
        now, after = (self.inputs(seen, maze) for seen in (batch.observation, batch.next_observation))
        return self.reward.pay_falls(batch._replace(observation=now, next_observation=after), share, self.discount)

    def relabel(self, batch: Transition, key: jax.Array) -> Transition:
        """The batch with new goals for some of the steps, and the rewards for these goals.

        Steps that ended an episode are not changed: the goal after them belongs to the next episode.
        """
        edges, reward_of = self.edges, self.reward
        which_key, *goal_keys, next_key = jax.random.split(key, 4)
        shape = batch.reward.shape
        chosen = jax.random.bernoulli(which_key, jnp.float32(edges.relabel), shape) & (batch.discount > 0)
        goal = self._draw_goals(goal_keys, shape)
        old, old_after = batch.observation[:, -2:], batch.next_observation[:, -2:]
        after = goal - (old - old_after)
        length = lambda vectors: jnp.linalg.norm(vectors, axis=-1)  # noqa: E731
        arrived = length(after) < self.env.robot.goal_tolerance_m
        reward = batch.reward - reward_of.towards(length(old), length(old_after))
        reward = reward + edges.reward.arrival_bonus * arrived + reward_of.towards(length(goal), length(after))
        if edges.through:
            next_goal = self._draw_goals(list(jax.random.split(next_key)), shape)
            after = jnp.where(arrived[:, None], next_goal, after)

        def put(seen: jax.Array, goals: jax.Array) -> jax.Array:
            return jnp.where(chosen[:, None], jnp.concatenate([seen[:, :-2], goals], -1), seen)

        return batch._replace(
            observation=put(batch.observation, goal),
            next_observation=put(batch.next_observation, after),
            reward=jnp.where(chosen, reward, batch.reward),
            discount=jnp.where(chosen, 1.0 - arrived, batch.discount),
        )

    def _draw_goals(self, keys: list[jax.Array], shape: tuple[int, ...]) -> Float[Array, "B 2"]:
        """Goals in all directions around the robot, outside the goal tolerance [m]."""
        angle_key, far_key = keys
        angle = jax.random.uniform(angle_key, shape, jnp.float32, maxval=2 * jnp.pi)
        nearest, farthest = self.env.robot.goal_tolerance_m, self.edges.relabel_m
        distance = jax.random.uniform(far_key, shape, jnp.float32, minval=nearest, maxval=farthest)
        return distance[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
