"""SAC alone: the controller's learner with the whole maze as its task, without planner or data (paper, sec. IV-A).

It has the transformer's observations. Starts and goals are anywhere in the maze, the reward is minus the distance to
the goal, and an episode has the robot's full horizon. The replay buffer keeps positions; local maps are recomputed from
them, exactly, when a batch is drawn.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State
from brax.training.agents.sac import networks as sac_networks
from brax.training.networks import FeedForwardNetwork
from jaxtyping import Array, Float

from ct_envs import MazeEnv, UserError
from ct_envs.maze import Maze
from ct_envs.occupancy import local_map
from ct_jax.baselines.networks import Actor, ActorPolicy, Critics, Seen, sample_seen, tanh_gaussian
from ct_jax.checkpoint import Checkpoints, run_to
from ct_jax.controllers.sac import Sac, SacConfig

# Settings of ``SacConfig`` that apply only to training on edges, and the values that they must have here.
EDGES_ONLY: dict[str, Any] = {"chain": False, "through": False, "turn_ramp": None, "mirror": False, "relabel": 0.0}


class SacAlone(Sac):
    """The learner: ``Sac`` with local maps. ``hidden[0]`` is the width of its networks."""

    kept = 4

    def __init__(self, env: MazeEnv, config: SacConfig):
        set_to = {name: value for name, value in EDGES_ONLY.items() if getattr(config, name) != value}
        if set_to:
            hint = ", ".join(f"{name}={value}" for name, value in set_to.items())
            raise UserError(f"SAC alone has no edges, so some settings of SacConfig do not apply; set {hint}")
        super().__init__(env, config)
        self.reward = "distance"

    def _make_networks(self) -> sac_networks.SACNetworks:
        size, width, frame = self.env.action_size, self.config.hidden[0], self.config.frame
        actor, critics = Actor(size, width, frame), Critics(width, frame, self.config.critic_norm)
        see = sample_seen(self.env.proprio_size)
        policy = FeedForwardNetwork(
            init=lambda key: actor.init(key, see),
            apply=lambda normalizer, params, seen: actor.apply(params, seen),
        )
        critic = FeedForwardNetwork(
            init=lambda key: critics.init(key, see, jnp.zeros((1, 1, size))),
            apply=lambda normalizer, params, seen, action: critics.apply(params, seen, action[:, None])[:, 0],  # pyright: ignore
        )
        return sac_networks.SACNetworks(policy, critic, tanh_gaussian(size))  # pyright: ignore[reportCallIssue]

    def _observe(self, state: State) -> Float[Array, "N P+4"]:
        return jnp.concatenate([super()._observe(state), state.info["position"]], -1)

    def _see(self, observation: Float[Array, "N P+4"], maze: Maze) -> Seen:
        proprio, goal, position = observation[:, :-4], observation[:, -4:-2], observation[:, -2:]
        see = jax.vmap(lambda at, to: local_map(maze, at, to, cell_m=self.env.map_cell_m))
        return Seen(see(position, position + goal), proprio, goal)

    def _watch(self, normalizer: Any, inputs: Seen) -> Any:
        return normalizer  # not used: these networks scale their inputs themselves, as the transformer does


def train_sac_alone(
    key: jax.Array,
    env_factory: Callable[..., MazeEnv],
    maze: Maze,
    config: SacConfig,
    *,
    on_progress: Callable[[int, dict[str, float]], None] = lambda iteration, metrics: None,
    checkpoints: Checkpoints | None = None,
    chunk: int = 25,
) -> ActorPolicy:
    """Learn to reach goals anywhere in a maze; ``config.episode_steps`` and ``held_out`` are not used.

    Args:
        env_factory: makes the robot's ``MazeEnv`` from keyword arguments.
        on_progress: called with (iterations done, metrics) after every ``chunk`` iterations.
        checkpoints: training continues from the last one, saves one at intervals, and saves one when interrupted.
    """
    env = env_factory(maps=False)
    sac = SacAlone(env, config)
    state = run_to(
        config.iterations, sac.create(key, maze, None), sac.train, lambda state: int(state.iteration),
        on_progress,
        checkpoints, chunk,
    )  # fmt: skip
    return ActorPolicy(jax.device_get(state.average), env.action_size, config.hidden[0], config.frame)
