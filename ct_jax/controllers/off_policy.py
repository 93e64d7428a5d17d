"""Learning from experience: environments are stepped, a replay buffer keeps the steps, and ``Sac`` learns from them.

The loop is ours, because brax's own trainer can neither draw fresh goals at a reset nor resume. What is walked, seen
and rewarded is a ``Task``.
"""

import functools
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from brax.envs.base import State
from brax.training import replay_buffers
from brax.training.agents.sac import networks as sac_networks
from brax.training.types import Transition
from flax import struct
from jaxtyping import Array, Float

from ct_envs import Tasks
from ct_envs.maze import Maze
from ct_jax.controllers.sac import Sac, SacConfig
from ct_jax.learner import Info
from ct_jax.rollout import Environment, broke_off


class Task(Protocol):
    """What is learned: a hashable description."""

    @property
    def env(self) -> Environment:
        """With auto-reset and without maps."""
        ...

    @property
    def observation_size(self) -> int:
        """Length of ``observe``."""
        ...

    @property
    def input_size(self) -> int | None:
        """Length of the networks' inputs if running statistics normalise them."""
        ...

    def networks(self, config: SacConfig) -> sac_networks.SACNetworks:
        """Policy and critics."""
        ...

    def observe(self, state: State) -> Float[Array, "N O"]:
        """The part of a state that the replay stores."""
        ...

    def inputs(self, observation: Float[Array, "N O"], maze: Maze) -> Any:
        """The networks' inputs, from observations in this maze."""
        ...

    def reward(self, before: State, action: Float[Array, "N A"], after: State) -> Float[Array, "N"]:
        """The reward of a step, before what ``present`` adds."""
        ...

    def ease(self, state: State, share: Float[Array, ""]) -> State:
        """The state with the difficulty of the next starts after this share of the training."""
        ...

    def present(self, batch: Transition, maze: Maze, key: jax.Array, share: Float[Array, ""]) -> Transition:
        """A batch from the replay, as the learner gets it after this share of the training."""
        ...


class Replay(replay_buffers.UniformSamplingQueue):
    """brax's queue as a ring buffer. Samples are the same to the bit.

    Once it is full, brax's queue moves all its rows at each insertion. Here positions only grow, and rows are stored at
    the position modulo the size, where brax looks them up.
    """

    def insert_internal(
        self, buffer_state: replay_buffers.ReplayBufferState, samples: Transition
    ) -> replay_buffers.ReplayBufferState:
        rows, size = self._flatten_fn(samples), len(buffer_state.data)
        where = (buffer_state.insert_position + jnp.arange(len(rows))) % size
        end = buffer_state.insert_position + len(rows)
        return buffer_state.replace(
            data=buffer_state.data.at[where].set(rows, unique_indices=True),
            insert_position=end,
            sample_position=jnp.maximum(buffer_state.sample_position, end - size),
        )


@struct.dataclass
class OffPolicy:
    """A task and its learner, and after ``create`` the complete state of training."""

    config: SacConfig = struct.field(pytree_node=False)
    task: Task = struct.field(pytree_node=False)
    learner: Any = None  # Sac
    replay: Any = None  # brax's ReplayBufferState
    env: Any = None  # State of the environments
    key: Any = None
    iteration: Any = None

    def create(self, key: jax.Array, maze: Maze, tasks: Tasks | None) -> "OffPolicy":
        """The state before training, in one maze with the given tasks."""
        keys = jax.random.split(key, 5)
        buffer_key, env_key, key = keys[2:]
        learner = Sac(self.config, self.task.networks(self.config), self.task.env.action_size)
        resets = jax.vmap(self.task.env.reset, in_axes=(0, None, None))
        return self.replace(
            learner=learner.create(keys[:2], self.task.input_size),
            replay=self.buffer.init(buffer_key),
            env=resets(jax.random.split(env_key, self.config.envs), maze, tasks),
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    @property
    def buffer(self) -> Replay:
        """The replay buffer. Its state is ``replay``."""
        return _buffer(self.config, self.task.observation_size, self.task.env.action_size)

    def train(self, iterations: int) -> tuple["OffPolicy", Info]:
        """Run ``iterations`` iterations; returns the state and mean metrics."""
        return _iterations(self, iterations=iterations)

    def update(self) -> tuple["OffPolicy", Info]:
        """One iteration: one step of all environments, then the updates."""
        state, collected = self.replace(env=self.task.ease(self.env, self.share)).collect()
        state, losses = jax.lax.cond(
            state.iteration >= self.config.warmup,
            OffPolicy.learn,
            lambda s: (s, jax.tree.map(jnp.zeros_like, jax.eval_shape(OffPolicy.learn, s)[1])),
            state,
        )
        return state.replace(iteration=state.iteration + 1), collected | losses

    @property
    def share(self) -> Float[Array, ""]:
        """The share of the training that is done."""
        return self.iteration / self.config.iterations

    @property
    def maze(self) -> Maze:
        """The maze that all environments share."""
        return jax.tree.map(lambda leaf: leaf[0], self.env.info["maze"])

    def collect(self) -> tuple["OffPolicy", Info]:
        """One step of all environments, which the replay keeps."""
        key, act_key, random_key = jax.random.split(self.key, 3)
        observation = self.task.observe(self.env)
        inputs = self.task.inputs(observation, self.maze)
        action = self.learner.act(inputs, act_key)
        random = jax.random.uniform(random_key, action.shape, jnp.float32, minval=-1.0, maxval=1.0)
        action = jnp.where(self.iteration < self.config.warmup, random, action)
        after = jax.vmap(self.task.env.step)(self.env, self.config.action_scale * action)
        reward = self.task.reward(self.env, action, after)
        over = after.done
        transition = Transition(
            observation=observation,
            action=action,
            reward=reward,
            discount=1.0 - over,
            next_observation=self.task.observe(after),
            extras={"state_extras": {"truncation": after.info["truncation"], "fall": over * broke_off(after.info)}},
        )
        state = self.replace(
            key=key,
            env=after,
            learner=self.learner.watch(inputs),
            replay=self.buffer.insert_internal(self.replay, transition),
        )
        count = lambda name: (over * after.info[name]).sum()  # noqa: E731
        return state, {
            "reward": reward.mean(), "episodes": over.sum(), "successes": count("success"), "falls": count("fall"),
        }  # fmt: skip

    def learn(self) -> tuple["OffPolicy", Info]:
        """The updates of an iteration. All batches are drawn at once, because nothing is added in between."""
        key, present_key, update_key = jax.random.split(self.key, 3)
        replay, drawn = self.buffer.sample_internal(self.replay)
        drawn = self.task.present(drawn, self.maze, present_key, self.share)
        count = self.config.updates
        batches = jax.tree.map(lambda leaf: leaf.reshape(count, -1, *leaf.shape[1:]), drawn)
        # With "rbg" keys, noise is one operation on a CPU; with other keys it is a loop of many.
        keys = jax.random.wrap_key_data(jax.random.bits(update_key, (count, 2, 4), jnp.uint32), impl="rbg")
        learner, info = jax.lax.scan(lambda learner, drawn: learner.update(*drawn), self.learner, (batches, keys))
        return self.replace(learner=learner, replay=replay, key=key), jax.tree.map(jnp.mean, info)


@functools.cache
def _buffer(config: SacConfig, observation_size: int, action_size: int) -> Replay:
    with jax.ensure_compile_time_eval():
        number = jnp.zeros((), jnp.float32)
        observation, action = (jnp.zeros(size, jnp.float32) for size in (observation_size, action_size))
        extras = {"state_extras": {"truncation": number, "fall": number}}
        example = Transition(observation, action, number, number, observation, extras)
        return Replay(config.replay, example, config.updates * config.batch)


@functools.partial(jax.jit, static_argnames="iterations")
def _iterations(state: OffPolicy, *, iterations: int) -> tuple[OffPolicy, Info]:
    state, metrics = jax.lax.scan(lambda state, _: state.update(), state, length=iterations)
    ends = jnp.maximum(metrics["episodes"].sum(), 1.0)
    means = jax.tree.map(jnp.mean, metrics)
    rates = {"success": metrics["successes"].sum() / ends, "fall": metrics["falls"].sum() / ends}
    return state, means | rates
