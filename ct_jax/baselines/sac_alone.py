"""SAC alone: the controller's learner with the whole maze as its task, without planner or data (paper, sec. IV-A).

It has the transformer's observations. Starts and goals are anywhere in the maze, the reward is minus the distance to
the goal, and an episode has the robot's full horizon. The replay buffer keeps positions; local maps are recomputed from
them, exactly, when a batch is drawn.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State
from brax.training.agents.sac import networks as sac_networks
from brax.training.networks import FeedForwardNetwork
from brax.training.types import Transition
from jaxtyping import Array, Float

from ct_envs.checked import Checked
from ct_envs.frames import FrameName
from ct_envs.maze import Maze
from ct_envs.occupancy import local_map
from ct_envs.robots import Robot
from ct_jax.baselines.networks import Actor, ActorPolicy, Critics, blank_policy, sample_observation, tanh_gaussian
from ct_jax.controllers.augment import check_frame
from ct_jax.controllers.off_policy import OffPolicy
from ct_jax.controllers.reward import Reward, RewardConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.rollout import Environment
from ct_jax.runtime.checkpoint import Checkpoints, run_to
from ct_jax.settings import Settings
from ct_jax.trajectories import Trajectories
from ct_jax.types import Observation
from ct_jax.worlds import kind_of

NAME = "sac"
TRAJECTORIES = False
ITERATIONS = 8000  # 500 episodes of the point


@dataclass(frozen=True)
class SacAloneConfig(Checked):
    """Settings of SAC alone."""

    sac: SacConfig = SacConfig()  # ``hidden[0]`` is the width of its networks
    reward: RewardConfig = RewardConfig()  # terms of the reward
    frame: FrameName = "world"  # "heading": proprioception and actions are in the robot's own frame

    @property
    def total(self) -> int:
        """Iterations of the training."""
        return self.sac.iterations


Config = SacAloneConfig


def config_for(settings: Settings, robot: Robot) -> SacAloneConfig:
    """The controller's learner in the whole maze. Longer paths need a larger discount factor."""
    del robot
    sac = replace(settings.sac, discount=0.99, iterations=ITERATIONS, reward_scale=0.1)
    return SacAloneConfig(sac, replace(settings.edges.reward, alive_bonus=0.0), settings.augment.frame)


def blank(run: Any, config: SacAloneConfig) -> ActorPolicy:
    """A policy of the right sizes.

    Raises:
        UserError: the robot has no such frame, or does not drive in mazes.
    """
    kind_of(run.spec).make_env(run, maps=False)
    return blank_policy(run.spec, config.sac.hidden[0], config.frame)


def learn(key: jax.Array, run: Any, config: SacAloneConfig, data: Trajectories | None, **watch: Any) -> ActorPolicy:
    """Train in the run's first maze, without data."""
    del data
    env_factory = functools.partial(kind_of(run.spec).make_env, run)
    return train_sac_alone(key, env_factory, next(iter(run.mazes.values())), config, **watch)


@functools.cache  # learners with the same networks share their compiled programs
def _make_networks(
    proprio_size: int, action_size: int, width: int, frame: FrameName, critic_norm: bool
) -> sac_networks.SACNetworks:
    actor, critics = Actor(action_size, width, frame), Critics(width, frame, critic_norm)
    policy = FeedForwardNetwork(
        init=lambda key: actor.init(key, sample_observation(proprio_size)),
        apply=lambda normalizer, params, seen: actor.apply(params, seen),
    )
    critic = FeedForwardNetwork(
        init=lambda key: critics.init(key, sample_observation(proprio_size), jnp.zeros((1, 1, action_size))),
        apply=lambda normalizer, params, seen, action: critics.apply(params, seen, action[:, None])[:, 0],  # pyright: ignore
    )
    return sac_networks.SACNetworks(policy, critic, tanh_gaussian(action_size))  # pyright: ignore[reportCallIssue]


@dataclass(frozen=True)
class MazeTask:
    """Crossing the maze: an ``off_policy.Task``."""

    env: Environment  # with auto-reset and without maps
    reward_config: RewardConfig
    frame: FrameName
    discount: float

    def __post_init__(self) -> None:
        check_frame(self.frame, self.env.robot)

    @property
    def reward(self) -> Reward:
        """Minus the distance to the goal, with bonuses and costs."""
        return Reward(self.reward_config, "distance", self.env.robot.control_dt_s)

    @property
    def observation_size(self) -> int:
        """Of proprioception, goal and position."""
        return self.env.proprio_size + 4

    @property
    def input_size(self) -> None:
        """These networks scale their inputs themselves, as the transformer does."""
        return None

    def networks(self, config: SacConfig) -> sac_networks.SACNetworks:
        """The baselines' actor and critics."""
        sizes = self.env.proprio_size, self.env.action_size
        return _make_networks(*sizes, config.hidden[0], self.frame, config.critic_norm)

    def observe(self, state: State) -> Float[Array, "N P+4"]:
        """Proprioception, the vector to the goal, and the position."""
        return jnp.concatenate([state.obs["proprio"], state.obs["goal"], state.info["position"]], -1)  # pyright: ignore

    def inputs(self, observation: Float[Array, "N P+4"], maze: Maze) -> Observation:
        """The same with the local map for the position."""
        proprio, goal, position = observation[:, :-4], observation[:, -4:-2], observation[:, -2:]
        see = jax.vmap(lambda at, to: local_map(maze, at, to, cell_m=self.env.map_cell_m))
        return Observation(see(position, position + goal), proprio, goal)

    def ease(self, state: State, share: Float[Array, ""]) -> State:
        """The state as it is: starts are as hard from the first."""
        del share
        return state

    def present(self, batch: Transition, maze: Maze, key: jax.Array, share: Float[Array, ""]) -> Transition:
        """A batch from the replay, as inputs of the networks, with the cost of falls."""
        del key
        now, after = (self.inputs(seen, maze) for seen in (batch.observation, batch.next_observation))
        return self.reward.pay_falls(batch._replace(observation=now, next_observation=after), share, self.discount)


def start_training(key: jax.Array, env: Environment, maze: Maze, config: SacAloneConfig) -> OffPolicy:
    """The training before its first iteration. ``env`` must have auto-reset, and no maps."""
    task = MazeTask(env, config.reward, config.frame, config.sac.discount)
    return OffPolicy(config.sac, task).create(key, maze, None)


def train_sac_alone(
    key: jax.Array,
    env_factory: Callable[..., Environment],
    maze: Maze,
    config: SacAloneConfig,
    *,
    on_progress: Callable[[int, dict[str, float]], None] = lambda iteration, metrics: None,
    checkpoints: Checkpoints | None = None,
    chunk: int = 25,
) -> ActorPolicy:
    """Learn to reach goals anywhere in a maze.

    Args:
        env_factory: makes the robot's ``MazeEnv`` from keyword arguments.
        on_progress: called with (iterations done, metrics) after every ``chunk`` iterations.
        checkpoints: training continues from the last one, saves one at intervals, and saves one when interrupted.
    """
    env, sac = env_factory(maps=False), config.sac
    state = run_to(
        sac.iterations, start_training(key, env, maze, config), OffPolicy.train, lambda state: int(state.iteration),
        on_progress, checkpoints, chunk,
    )  # fmt: skip
    return ActorPolicy(jax.device_get(state.learner.average), env.action_size, sac.hidden[0], config.frame)
