"""Training the low-level controller with Soft Actor-Critic on the edges of a roadmap (paper, Algorithm 2).

The networks, losses, replay buffer and running statistics are brax's. The loop is ours, because brax's own trainer can
neither draw fresh goals at a reset nor resume. The controller sees proprioception and the vector to its goal, but no
walls.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import State
from brax.training import gradients, replay_buffers
from brax.training.acme import running_statistics, specs
from brax.training.agents.sac import losses as sac_losses
from brax.training.agents.sac import networks as sac_networks
from brax.training.types import Transition
from flax import struct
from jaxtyping import Array, Float

from ct_envs import MazeEnv, Tasks, UserError
from ct_envs.checked import Above, Checked, Count, Share, Within
from ct_envs.frames import FrameName, own_frame, symmetries, transform, turn
from ct_envs.maze import Maze
from ct_envs.maze_env import broke_off
from ct_jax.checkpoint import Checkpoints, run_to
from ct_jax.devices import alike
from ct_jax.prm import Roadmap
from ct_jax.types import Action, Controller, Frame, act_as_intended
from ct_jax.worlds.mazes import run as rollout

Metres = Annotated[float, Within(0, 1_000_000)]  # also for other terms of the reward


@dataclass(frozen=True)
class SacConfig(Checked):
    """Soft Actor-Critic. Values marked "paper" are from sec. III-G; the others are usual values."""

    envs: Annotated[int, Within(1, 100_000)] = 64  # environments stepped together
    iterations: Count = 500  # in each: one step of all environments, then the updates
    updates: Annotated[int, Within(1, 10_000)] = 8  # gradient updates in an iteration
    warmup: Annotated[int, Within(0, 10**9)] = 20  # first iterations, with random actions and no updates
    batch: Annotated[int, Within(1, 1_000_000)] = 256  # paper
    learning_rate: Annotated[float, Above(0, 1)] = 3e-4  # paper
    final_rate: Share = 1.0  # final learning rate, as a share of the first; it falls linearly
    average: Share = 0.0  # the controller is a mean of policies with this decay at each update; 0: the last policy
    critic_norm: bool = False  # layer norm in the critics
    hidden: Annotated[tuple[Annotated[int, Within(1, 16_384)], ...], Within(1, 16)] = (256, 256)  # paper
    discount: Share = 0.97
    initial_temperature: Annotated[float, Above(0, 1000)] = 0.1
    arrival_bonus: Metres = 10.0  # reward for reaching the goal; without it, staying away would earn entropy for ever
    fall_m: tuple[Metres, Metres] = (5.0, 20.0)  # a fall costs as much as lying for ever this much farther away [m]:
    # at first, while every attempt to walk ends in a fall, and later; with 60 m the ant stood still
    fall_ramp: tuple[Share, Share] = (0.2, 0.5)  # begin and end of the change of ``fall_m``, in shares of the training
    alive_bonus: Metres = 0.0  # reward of each step without a fall (paper, for the humanoid); then a fall has no other
    # cost
    speed_mps: Annotated[float, Above(0, 1000)] | None = None  # velocity reward: a higher speed towards the goal earns
    # no more than this one
    action_cost: Metres = 0.0  # cost of a step with all actuators at their limits
    tilt_m: Metres = 0.0  # a torso on its side costs as much as being this much farther away [m]
    action_scale: Annotated[float, Above(0, 1)] = 1.0  # share of the actuators' range that the controller uses
    greedy: Share = 0.0  # share of the environments with deterministic actions, as in later use: they visit states in
    # which only random actions would make progress
    target_rate: Annotated[float, Above(0, 1)] = 0.005  # share of the new critic in the target critic at each update
    replay: Count = 200_000  # transitions in the replay buffer
    turn_ramp: tuple[Share, Share] | None = None  # begin and end, in shares of the training, of a change of the first
    # heading: from facing the goal to any heading; without it, always any heading
    episode_steps: Annotated[int, Within(1, 1_000_000)] = 60  # control steps to walk an edge
    reset_velocity_mps: Annotated[float, Within(0, 100)] = 2.0  # spread of the speed at an edge's start: on a plan, the
    # robot arrives there moving
    held_out: Annotated[float, Within(0, 0.9)] = 0.1  # share of the edges kept for the final test
    frame: FrameName = "world"  # frame of the networks' inputs: the "world"'s, or the robot's own "heading"
    mirror: bool = False  # transform each replayed transition by a random symmetry of the robot
    relabel: Share = 0.0  # share of replayed steps that get a random goal around the robot: plans turn in any direction
    relabel_m: Annotated[float, Above(0, 10_000)] = 10.0  # largest distance of those goals [m]
    chain: bool = False  # after a success, continue from there along another edge, as on a plan
    through: bool = False  # with ``chain``: an arrival does not end the return; rewards on the next edge count
    reward_scale: Annotated[float, Above(0, 1_000_000)] = 1.0  # factor of the reward in the losses

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, ramp in (("fall_ramp", self.fall_ramp), ("turn_ramp", self.turn_ramp)):
            if ramp is not None and ramp[0] > ramp[1]:
                raise UserError(f"SacConfig.{name} is {ramp}; give its begin first, then its end")
        if self.through and not self.chain:
            raise UserError("SacConfig.through needs chained edges; also set chain=True")
        if self.replay < self.envs:
            raise UserError(f"SacConfig.replay is {self.replay}; give at least the number of envs, {self.envs}")


@struct.dataclass
class SacState:
    """The complete state of training, from which it can continue."""

    policy: Any
    average: Any  # moving average of the policies
    critic: Any
    target_critic: Any
    log_alpha: jax.Array
    policy_optimizer: Any
    critic_optimizer: Any
    alpha_optimizer: Any
    normalizer: running_statistics.RunningStatisticsState
    replay: replay_buffers.ReplayBufferState
    env: State
    key: jax.Array
    iteration: jax.Array


TESTS = 20  # number of tests of the controller on held-out edges during its training


def controller_inputs(observation: Float[Array, "*b P+2"], frame: str) -> Float[Array, "*b I"]:
    """The networks' inputs: proprioception and the vector to the goal [m], in the given frame."""
    if frame == "world":
        return observation
    proprio, goal = observation[..., :-2], observation[..., -2:]
    heading, own = own_frame(proprio)
    return jnp.concatenate([own, turn(heading, goal)], -1)


def input_size(proprio_size: int, frame: str) -> int:
    """Length of ``controller_inputs``."""
    whole = jax.ShapeDtypeStruct((proprio_size + 2,), jnp.float32)
    return jax.eval_shape(functools.partial(controller_inputs, frame=frame), whole).shape[0]


def controller_networks(
    observation_size: int, action_size: int, hidden: tuple[int, ...], *, critic_norm: bool = False
) -> sac_networks.SACNetworks:
    """Policy and critics for a controller of these sizes."""
    return sac_networks.make_sac_networks(
        observation_size,
        action_size,
        preprocess_observations_fn=running_statistics.normalize,
        hidden_layer_sizes=hidden,
        q_network_layer_norm=critic_norm,
    )


@struct.dataclass
class SacController:
    """The trained pi_c, deterministic."""

    normalizer: Any
    policy: Any
    action_size: int = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)
    frame: str = struct.field(pytree_node=False, default="world")
    action_scale: float = struct.field(pytree_node=False, default=1.0)

    def __call__(self, proprio: Float[Array, "N P"], goal: Float[Array, "N 2"]) -> Float[Array, "N A"]:
        inputs = controller_inputs(jnp.concatenate([proprio, goal], -1), self.frame)
        networks = controller_networks(inputs.shape[-1], self.action_size, self.hidden)
        logits = networks.policy_network.apply(self.normalizer, self.policy, inputs)
        return self.action_scale * networks.parametric_action_distribution.mode(logits)


def blank_statistics(size: int) -> running_statistics.RunningStatisticsState:
    """brax's running statistics of inputs of this size, of none so far; in 32 bits, also where JAX has 64."""
    blank = running_statistics.init_state(specs.Array((size,), jnp.dtype("float32")))
    names = ("mean", "summed_variance", "std", "std_eps")
    return blank.replace(**{name: jnp.asarray(getattr(blank, name), jnp.float32) for name in names})


def blank_controller(key: jax.Array, proprio_size: int, action_size: int, config: SacConfig) -> SacController:
    """An untrained controller of these sizes."""
    size = input_size(proprio_size, config.frame)
    return SacController(
        normalizer=blank_statistics(size),
        policy=controller_networks(size, action_size, config.hidden).policy_network.init(key),
        action_size=action_size,
        hidden=config.hidden,
        frame=config.frame,
        action_scale=config.action_scale,
    )


def split_edges(roadmap: Roadmap, held_out: float, seed: int) -> tuple[Tasks, Tasks]:
    """Edges in both directions, as training tasks and held-out tasks. Both directions of an edge are in the same set.

    Raises:
        UserError: the roadmap has too few edges to hold any out.
    """
    edges = np.random.default_rng(seed).permutation(roadmap.edges)
    n = int(held_out * len(edges))
    if n < 1:
        raise UserError(f"the roadmap has only {len(roadmap.edges)} edges; sample more points or connect farther")
    return _tasks(roadmap, edges[n:]), _tasks(roadmap, edges[:n])


def _tasks(roadmap: Roadmap, edges: np.ndarray) -> Tasks:
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


class Sac:
    """The learner: ``create`` and ``train`` on states, both pure.

    Subclasses can replace what the replay stores of a state, the networks' inputs, and the networks: these are methods.
    """

    kept = 2  # how many numbers the replay stores of a state besides proprioception

    def __init__(self, env: MazeEnv, config: SacConfig):
        """
        Args:
            env: with auto-reset and without maps; its robot determines the reward.
        """
        if config.frame == "heading" and not env.robot.has_heading:
            raise UserError(f"robot '{env.robot.name}' has no heading; use frame='world'")
        self.env, self.config = env, config
        self._symmetries = symmetries(env.robot) if config.mirror else None
        self._input_size = input_size(env.proprio_size, config.frame)
        self.networks = self._make_networks()
        self.reward = env.robot.controller_reward
        updates = config.iterations * config.updates
        rate = optax.linear_schedule(config.learning_rate, config.final_rate * config.learning_rate, updates)
        self._optimizer = optax.adam(rate)
        alpha_loss, critic_loss, actor_loss = sac_losses.make_losses(
            self.networks, reward_scaling=config.reward_scale, discounting=config.discount, action_size=env.action_size
        )
        update = functools.partial(gradients.gradient_update_fn, pmap_axis_name=None)
        self._alpha_update = update(alpha_loss, self._optimizer)
        self._critic_update = update(critic_loss, self._optimizer)
        self._actor_update = update(actor_loss, self._optimizer)
        observation, number = (jnp.zeros(shape, jnp.float32) for shape in (env.proprio_size + self.kept, ()))
        example = Transition(
            observation=observation,
            action=jnp.zeros(env.action_size, jnp.float32),
            reward=number,
            discount=number,
            next_observation=observation,
            extras={"state_extras": {"truncation": number, "fall": number}},
        )
        self._buffer = Replay(config.replay, example, config.updates * config.batch)
        self.train = jax.jit(self._train, static_argnames="iterations")

    def _make_networks(self) -> sac_networks.SACNetworks:
        config = self.config
        return controller_networks(
            self._input_size, self.env.action_size, config.hidden, critic_norm=config.critic_norm
        )

    def _observe(self, state: State) -> Float[Array, "N P+kept"]:
        """The part of a state that the replay stores."""
        return jnp.concatenate([state.obs["proprio"], state.obs["goal"]], -1)  # pyright: ignore

    def _see(self, observation: Float[Array, "N P+kept"], maze: Maze) -> Any:
        """The networks' inputs, from observations in this maze."""
        del maze
        return controller_inputs(observation, self.config.frame)

    def _watch(self, normalizer: Any, inputs: Any) -> Any:
        """The running statistics after these inputs."""
        return running_statistics.update(normalizer, inputs)

    def create(self, key: jax.Array, maze: Maze, tasks: Tasks | None) -> SacState:
        """The state before training, in one maze with the given edges."""
        policy_key, critic_key, buffer_key, env_key, key = jax.random.split(key, 5)
        policy = self.networks.policy_network.init(policy_key)
        critic = self.networks.q_network.init(critic_key)
        log_alpha = jnp.log(jnp.asarray(self.config.initial_temperature, jnp.float32))
        resets = jax.vmap(self.env.reset, in_axes=(0, None, None))
        if self.config.turn_ramp is not None and tasks is not None:
            tasks = tasks.replace(turn_rad=jnp.zeros((), jnp.float32))
        return SacState(
            policy=policy,
            average=policy,
            critic=critic,
            target_critic=critic,
            log_alpha=log_alpha,
            policy_optimizer=self._optimizer.init(policy),
            critic_optimizer=self._optimizer.init(critic),
            alpha_optimizer=self._optimizer.init(log_alpha),
            normalizer=blank_statistics(self._input_size),
            replay=self._buffer.init(buffer_key),
            env=resets(jax.random.split(env_key, self.config.envs), maze, tasks),
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def _train(self, state: SacState, iterations: int) -> tuple[SacState, dict[str, jax.Array]]:
        """Run ``iterations`` iterations (static); returns the state and mean metrics."""

        def iterate(state: SacState, _) -> tuple[SacState, dict[str, jax.Array]]:
            state, collected = self._collect(self._ease(state))
            state, losses = jax.lax.cond(
                state.iteration >= self.config.warmup,
                self._updates,
                lambda s: (s, jax.tree.map(jnp.zeros_like, jax.eval_shape(self._updates, s)[1])),
                state,
            )
            return state.replace(iteration=state.iteration + 1), collected | losses

        state, metrics = jax.lax.scan(iterate, state, length=iterations)
        ends = jnp.maximum(metrics["episodes"].sum(), 1.0)
        means = jax.tree.map(jnp.mean, metrics)
        rates = {"success": metrics["successes"].sum() / ends, "fall": metrics["falls"].sum() / ends}
        return state, means | rates

    def _ease(self, state: SacState) -> SacState:
        """The state with the difficulty of starts (``turn_ramp``) for this iteration."""
        if self.config.turn_ramp is None:
            return state
        share = jnp.interp(
            state.iteration / self.config.iterations, jnp.asarray(self.config.turn_ramp), jnp.arange(2.0)
        )
        tasks = state.env.info["tasks"].replace(turn_rad=jnp.full(self.config.envs, jnp.pi * share, jnp.float32))
        return state.replace(env=state.env.replace(info=state.env.info | {"tasks": tasks}))

    def _collect(self, state: SacState) -> tuple[SacState, dict[str, jax.Array]]:
        key, act_key, random_key = jax.random.split(state.key, 3)
        observation = self._observe(state.env)
        inputs = self._see(observation, _one_maze(state))
        logits = self.networks.policy_network.apply(state.normalizer, state.policy, inputs)
        distribution = self.networks.parametric_action_distribution
        action = distribution.sample(logits, act_key).astype(jnp.float32)
        if self.config.greedy:
            without = jnp.arange(len(action)) < self.config.greedy * len(action)
            action = jnp.where(without[:, None], distribution.mode(logits), action)
        random = jax.random.uniform(random_key, action.shape, jnp.float32, minval=-1.0, maxval=1.0)
        action = jnp.where(state.iteration < self.config.warmup, random, action)
        after = jax.vmap(self.env.step)(state.env, self.config.action_scale * action)
        reward = self._reward(state.env, action, after)
        over = after.done
        truncation = after.info["truncation"]
        transition = Transition(
            observation=observation,
            action=action,
            reward=reward,
            discount=1.0 - over,
            next_observation=self._observe(after),
            extras={"state_extras": {"truncation": truncation, "fall": over * broke_off(after.info)}},
        )
        state = state.replace(
            key=key,
            env=after,
            normalizer=self._watch(state.normalizer, inputs),
            replay=self._buffer.insert_internal(state.replay, transition),
        )
        count = lambda name: (over * after.info[name]).sum()  # noqa: E731
        return state, {
            "reward": reward.mean(), "episodes": over.sum(), "successes": count("success"), "falls": count("fall"),
        }  # fmt: skip

    def _reward(self, before: State, action: jax.Array, after: State) -> jax.Array:
        """Dense reward towards the goal (paper, sec. III-G): progress [m/s] or minus the distance [m]; bonuses.

        For a fall without an alive bonus it is always minus the distance; see ``_pay_falls``.
        An episode that breaks off for another reason counts as a fall.
        """
        config = self.config
        distance = jnp.linalg.norm(before.obs["goal"], axis=-1)  # pyright: ignore
        dense = self._towards(distance, -after.reward)
        if config.tilt_m:
            up = own_frame(after.obs["proprio"])[1][..., 3]  # pyright: ignore
            dense -= config.tilt_m * (1.0 - up)
        if config.action_cost:
            dense -= config.action_cost * jnp.mean(action**2, -1)
        dense += config.arrival_bonus * after.done * after.info["success"]
        fall = after.done * broke_off(after.info)
        if config.alive_bonus:
            return dense + config.alive_bonus * (1.0 - fall)
        return jnp.where(fall > 0, after.reward, dense)

    def _towards(self, before_m: jax.Array, after_m: jax.Array) -> jax.Array:
        """The reward of a step that begins and ends at these distances from the goal [m]."""
        if self.reward == "distance":
            return -after_m
        return jnp.minimum((before_m - after_m) / self.env.robot.control_dt_s, self.config.speed_mps or jnp.inf)

    def _relabel(self, batch: Transition, key: jax.Array) -> Transition:
        """The batch with new goals for some of the steps, and the rewards for these goals.

        Steps that ended an episode are not changed: the goal after them belongs to the next episode.
        """
        config, tolerance = self.config, self.env.robot.goal_tolerance_m
        which_key, *goal_keys, next_key = jax.random.split(key, 4)
        shape = batch.reward.shape
        chosen = jax.random.bernoulli(which_key, jnp.float32(config.relabel), shape) & (batch.discount > 0)
        goal = self._draw_goals(goal_keys, shape)
        old, old_after = batch.observation[:, -2:], batch.next_observation[:, -2:]
        after = goal - (old - old_after)
        length = lambda vectors: jnp.linalg.norm(vectors, axis=-1)  # noqa: E731
        arrived = length(after) < tolerance
        reward = batch.reward - self._towards(length(old), length(old_after)) + config.arrival_bonus * arrived
        reward += self._towards(length(goal), length(after))
        if config.through:
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

    def _draw_goals(self, keys: list[jax.Array], shape: tuple[int, ...]) -> jax.Array:
        """Goals in all directions around the robot, outside the goal tolerance [m]."""
        angle_key, far_key = keys
        angle = jax.random.uniform(angle_key, shape, jnp.float32, maxval=2 * jnp.pi)
        nearest, farthest = self.env.robot.goal_tolerance_m, self.config.relabel_m
        distance = jax.random.uniform(far_key, shape, jnp.float32, minval=nearest, maxval=farthest)
        return distance[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)

    def _pay_falls(self, batch: Transition, iteration: jax.Array) -> Transition:
        """The batch with the cost of falls: as much as lying for ever, ``fall_m`` (at this iteration) farther away.

        Without this cost, a fall far from the goal would pay off: it ends the negative rewards. With an alive bonus the
        rewards are gains, and a fall ends them.
        """
        if self.config.alive_bonus:
            return batch
        config, fall = self.config, batch.extras["state_extras"]["fall"]
        share = iteration / config.iterations
        farther = jnp.interp(share, jnp.asarray(config.fall_ramp), jnp.asarray(config.fall_m))
        for_ever = ((batch.reward - farther) / (1.0 - config.discount)).astype(jnp.float32)
        return batch._replace(reward=jnp.where(fall > 0, for_ever, batch.reward))

    def _updates(self, state: SacState) -> tuple[SacState, dict[str, jax.Array]]:
        """The updates of an iteration. All batches are drawn at once, because nothing is added in between."""
        key, present_key, update_key = jax.random.split(state.key, 3)
        replay, drawn = self._buffer.sample_internal(state.replay)
        drawn = self._pay_falls(self._present(drawn, _one_maze(state), present_key), state.iteration)
        count = self.config.updates
        batches = jax.tree.map(lambda leaf: leaf.reshape(count, -1, *leaf.shape[1:]), drawn)
        state = state.replace(replay=replay, key=key)
        # With "rbg" keys, noise is one operation on a CPU; with other keys it is a loop of many.
        keys = jax.random.wrap_key_data(jax.random.bits(update_key, (count, 2, 4), jnp.uint32), impl="rbg")
        state, losses = jax.lax.scan(self._update, state, (batches, keys))
        return state, jax.tree.map(jnp.mean, losses)

    def _present(self, batch: Transition, maze: Maze, key: jax.Array) -> Transition:
        """A batch from the replay, relabelled and mirrored if configured, as inputs of the networks."""
        mirror_key, goal_key = jax.random.split(key)
        if self.config.relabel:
            batch = self._relabel(batch, goal_key)
        if self.config.through:
            batch = batch._replace(discount=1.0 - batch.extras["state_extras"]["fall"])
        now, action, after = batch.observation, batch.action, batch.next_observation
        if self._symmetries is not None:
            pick = jax.random.randint(mirror_key, (len(action),), 0, len(self._symmetries.world), jnp.int32)
            world, proprio, joints = (jnp.asarray(matrices)[pick] for matrices in self._symmetries)
            halves = lambda o: (transform(proprio, o[:, :-2]), transform(world, o[:, -2:]))  # noqa: E731
            now, after = (jnp.concatenate(halves(o), -1) for o in (now, after))
            action = transform(joints, action)
        return batch._replace(observation=self._see(now, maze), action=action, next_observation=self._see(after, maze))

    def _update(self, state: SacState, drawn: tuple[Transition, jax.Array]) -> tuple[SacState, dict[str, jax.Array]]:
        batch, (policy_key, critic_key) = drawn
        # The losses of temperature and policy use the same key, so the same actions, which are computed once.
        alpha_loss, log_alpha, alpha_optimizer = self._alpha_update(
            state.log_alpha, state.policy, state.normalizer, batch, policy_key, optimizer_state=state.alpha_optimizer
        )
        alpha = jnp.exp(state.log_alpha)
        critic_loss, critic, critic_optimizer = self._critic_update(
            state.critic, state.policy, state.normalizer, state.target_critic, alpha, batch, critic_key,
            optimizer_state=state.critic_optimizer,
        )  # fmt: skip
        actor_loss, policy, policy_optimizer = self._actor_update(
            state.policy, state.normalizer, state.critic, alpha, batch, policy_key,
            optimizer_state=state.policy_optimizer,
        )  # fmt: skip
        average = optax.incremental_update(policy, state.average, 1.0 - self.config.average)
        target = optax.incremental_update(critic, state.target_critic, self.config.target_rate)
        state = state.replace(
            policy=policy, average=average, critic=critic, target_critic=target, log_alpha=log_alpha,
            policy_optimizer=policy_optimizer, critic_optimizer=critic_optimizer, alpha_optimizer=alpha_optimizer,
        )  # fmt: skip
        losses = {"alpha_loss": alpha_loss, "critic_loss": critic_loss, "actor_loss": actor_loss, "alpha": alpha}
        return state, losses


def _one_maze(state: SacState) -> Maze:
    """The maze that all environments share."""
    return jax.tree.map(lambda leaf: leaf[0], state.env.info["maze"])


@struct.dataclass
class Steered:
    """The controller with the environment's goal as its target, for tests on edges."""

    controller: Controller

    def init(self, frame: Frame, tasks: Any = None) -> tuple[()]:
        """There is nothing to remember."""
        del frame, tasks
        return ()

    def act(self, memory: tuple[()], frame: Frame, key: jax.Array) -> tuple[Action, tuple[()]]:
        """The controller's actions."""
        del key
        return act_as_intended(self.controller(frame.obs.proprio, frame.obs.goal_relative)), memory


def edge_success(env: MazeEnv, act: Controller, maze: Maze, tasks: Tasks, key: jax.Array) -> float:
    """Share of the given edges that the controller walks in time, from rest. ``env`` must be without auto-reset."""
    n = tasks.start.shape[0]
    keys = jax.random.split(key, n + 1)
    one_each = Tasks(tasks.start[:, None], tasks.goal[:, None], jnp.ones(n, jnp.int32))
    state = jax.jit(jax.vmap(env.reset, in_axes=(0, None, 0)))(keys[:n], maze, one_each)
    state, _, _ = rollout(env, Steered(act), state, (), keys[n], env.horizon)
    return float(state.info["success"].mean())


def edges_in_a_row(
    env: MazeEnv, act: Controller, maze: Maze, tasks: Tasks, key: jax.Array, *, edges: int = 20, walkers: int = 100
) -> float:
    """Share of the walkers that, from rest, walk ``edges`` edges in a row, each in time and without a fall.

    ``env`` must have auto-reset, and the tasks must be chained (``chain_tasks``).
    """
    keys = jax.random.split(key, walkers + edges)
    state = jax.jit(jax.vmap(env.reset, in_axes=(0, None, None)))(keys[:walkers], maze, tasks)
    walked, unbroken = np.zeros(walkers, int), np.ones(walkers, bool)
    for i in range(edges):  # each rollout is one full horizon, the time limit of an edge
        state, _, steps = rollout(env, Steered(act), state, (), keys[walkers + i], env.horizon)
        ended = 1.0 - np.concatenate([np.asarray(steps.alive)[1:], 1.0 - np.asarray(state.done)[None]])
        won = np.asarray(steps.success) > 0
        whole = unbroken & (np.cumsum((ended > 0) & ~won, 0) == 0)
        walked, unbroken = walked + (whole & won).sum(0), whole[-1]
    return float((walked >= edges).mean())


def train_controller(
    key: jax.Array,
    env_factory: Callable[..., MazeEnv],
    maze: Maze,
    roadmap: Roadmap,
    config: SacConfig,
    *,
    on_progress: Callable[[int, dict[str, float]], None] = lambda iteration, metrics: None,
    checkpoints: Checkpoints | None = None,
    chunk: int = 25,
) -> tuple[SacController, dict[str, float]]:
    """Algorithm 2: learn pi_c on the roadmap's edges.

    Args:
        env_factory: makes the robot's ``MazeEnv`` from keyword arguments.
        on_progress: called with (iterations done, metrics) after every ``chunk`` iterations.
        checkpoints: training continues from the last one, saves one at intervals, and saves one when interrupted.

    Returns:
        The controller; its success on held-out edges, and on twenty edges in a row.
    """
    train_key, test_key, split_key, row_key = jax.random.split(key, 4)
    seed = int(jax.random.randint(split_key, (), 0, 2**31 - 1, jnp.int32))
    train_tasks, test_tasks = split_edges(roadmap, config.held_out, seed)
    if config.chain:
        train_tasks = chain_tasks(train_tasks, seed)
    env = env_factory(maps=False, horizon=config.episode_steps, reset_velocity_mps=config.reset_velocity_mps)
    sac = Sac(env, config)
    state = alike(sac.create(train_key, maze, train_tasks))
    alone, in_a_row = (
        env_factory(maps=False, horizon=config.episode_steps, auto_reset=again) for again in (False, True)
    )

    def learned(state: SacState) -> SacController:
        normalizer, average = jax.tree.map(jnp.asarray, jax.device_get((state.normalizer, state.average)))
        return SacController(normalizer, average, env.action_size, config.hidden, config.frame, config.action_scale)

    def train(state: SacState, n: int) -> tuple[SacState, dict[str, Any]]:
        after, metrics = sac.train(state, n)
        before, now = (int(s.iteration) * TESTS // config.iterations for s in (state, after))
        if now > before:
            metrics |= {"held_out": edge_success(alone, learned(after), maze, test_tasks, test_key)}
        return after, metrics

    state = run_to(config.iterations, state, train, lambda state: int(state.iteration), on_progress, checkpoints, chunk)
    act = learned(state)
    every_edge = chain_tasks(_tasks(roadmap, roadmap.edges), seed)
    return act, {
        "held_out_success": edge_success(alone, act, maze, test_tasks, test_key),
        "twenty_in_a_row": edges_in_a_row(in_a_row, act, maze, every_edge, row_key),
    }
