"""PT-CQL: conservative Q-learning on the planner-guided trajectories (paper, sec. IV-A; Kumar et al., 2020).

The data are the transformer's trajectories, with the same final goals and reward -||g||, as single steps (s, a, r, s').
An episode ends only at its goal. The method is CQL(H): it lowers the critics' values of actions that are not in the
data. The soft maximum over all actions is estimated from uniform samples and from samples of the policy, each weighted
by its density.

Settings. Learning rate, batch, discount, number of sampled actions, importance weights, ``alpha=5``, the adaptive
temperature, and targets without entropy are the defaults of the implementation that the paper used (github.com/
young-geng/cql). It expects rewards of order one; ours are tens of metres a step, so ``reward_scale=0.1``. The target
entropy, -1 for each action, is SAC's. ``alpha`` and a target rate for thousands of updates instead of a million were
chosen by ``experiments/cql.py`` in the point's training maze; with none of them did the ant reach a goal.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ct_envs import Robot, UserError
from ct_envs.checked import Above, Checked, Count, Share, Within
from ct_envs.frames import FrameName, symmetries
from ct_envs.maze import Maze
from ct_jax.baselines.networks import Actor, ActorPolicy, Critics, blank_policy, sample_observation, tanh_gaussian
from ct_jax.learner import Info
from ct_jax.learner import learn as learn_in_chunks
from ct_jax.runtime.checkpoint import Checkpoints
from ct_jax.runtime.devices import data_mesh, place, replicated, sharded
from ct_jax.settings import Settings
from ct_jax.trajectories import Trajectories, Window, at_goal, sample_windows
from ct_jax.types import Observation

NAME = "pt-cql"
TRAJECTORIES = True


@dataclass(frozen=True)
class CqlConfig(Checked):
    """Conservative Q-learning."""

    updates: Count = 20_000  # gradient updates
    batch: Annotated[int, Within(1, 1_000_000)] = 256  # number of single steps in a batch
    learning_rate: Annotated[float, Above(0, 1)] = 3e-4  # of policy, critics and temperature
    width: Annotated[int, Within(1, 16_384)] = 128  # of all layers
    discount: Share = 0.99  # of the return, for each step
    reward_scale: Annotated[float, Above(0, 1_000_000)] = 0.1  # of the reward [m] in the critics' units
    alpha: Annotated[float, Within(0, 1_000_000)] = 5.0  # weight of the conservative penalty against the squared error
    # For the penalty: number of actions of each kind (uniform, policy at s, policy at s').
    samples: Annotated[int, Within(1, 10_000)] = 10
    target_rate: Annotated[float, Above(0, 1)] = 0.05  # share of the new critics in the target critics at each update
    temperature: Annotated[float, Within(0, 1000)] = 1.0  # initial weight of the policy's entropy; 0: no entropy term
    # Target entropy for each action dimension [nats]. The temperature adapts to it.
    entropy: Annotated[float, Within(-1000, 1000)] = -1.0
    soft_target: bool = False  # include the entropy in the critics' targets
    # Number of first updates in which the policy imitates the data, until the critics are useful.
    imitation: Annotated[int, Within(0, 10**9)] = 0
    mirror: bool = False  # turn and reflect steps by a random symmetry of the robot
    frame: FrameName = "world"  # "heading": proprioception and actions are in the robot's own frame

    @property
    def total(self) -> int:
        """Updates of the training."""
        return self.updates


Config = CqlConfig


def config_for(settings: Settings, robot: Robot) -> CqlConfig:
    """The settings that ``experiments/cql.py`` chose, in the controller's frame, and with the robot's symmetries."""
    try:
        symmetries(robot)
    except UserError:
        return CqlConfig(updates=2500, frame=settings.augment.frame)
    return CqlConfig(updates=2500, mirror=True, frame=settings.augment.frame)


def blank(run: Any, config: CqlConfig) -> ActorPolicy:
    """A policy of the right sizes. Raises UserError for a frame or symmetries that the robot does not have."""
    if config.mirror:
        symmetries(run.spec)
    return blank_policy(run.spec, config.width, config.frame)


def learn(key: jax.Array, run: Any, config: CqlConfig, data: Trajectories | None, **watch: Any) -> ActorPolicy:
    """Train on the run's trajectories."""
    assert data is not None
    learner = Cql(config, run.settings.model.map_cell_m, run.spec, data.action.shape[-1])
    return train_cql(key, learner, data, run.stacked, **watch)


@struct.dataclass
class Learned:
    """The parameters that are learned by gradient descent."""

    actor: Any
    critics: Any
    log_temperature: jax.Array


@struct.dataclass
class Transitions:
    """Single steps of trajectories, with the observations before and after."""

    now: Observation
    action: Float[Array, "B A"]
    reward: Float[Array, "B"]  # [m]
    after: Observation
    arrived: Float[Array, "B"]  # 1 if the step reached the goal, where the episode ends
    known: Float[Array, "B"]  # 0 if the trajectory was cut off here, so the next observation is unknown


def transitions(window: Window, goal_tolerance_m: float) -> Transitions:
    """Windows of two steps as transitions. The second step may lie beyond the trajectory's end; then it is not used.

    The reward of the last step shows whether it arrived or was cut off.
    """
    see = lambda i: Observation(window.map[:, i], window.proprio[:, i], window.goal_relative[:, i])  # noqa: E731
    reward, last = window.reward[:, 0], 1.0 - window.valid[:, 1]
    arrived = last * at_goal(reward, goal_tolerance_m)
    known = window.valid[:, 0] * (1.0 - last + arrived)
    return Transitions(see(0), window.action[:, 0], reward, see(1), arrived, known)


@struct.dataclass
class Cql:
    """The learner: its settings, and after ``create`` the complete state of training."""

    config: CqlConfig = struct.field(pytree_node=False)
    map_cell_m: float = struct.field(pytree_node=False)
    robot: Robot = struct.field(pytree_node=False)
    action_size: int = struct.field(pytree_node=False)
    params: Learned | None = None
    target: Any = None  # target critics: a moving average of the critics
    optimizer: Any = None
    key: Any = None
    step: Any = None  # updates so far

    def create(self, key: jax.Array, data: Trajectories) -> "Cql":
        """The learner before training on data of these sizes, replicated over the devices."""
        actor_key, critic_key, key = jax.random.split(key, 3)
        see = sample_observation(data.proprio.shape[-1])
        actor = jax.jit(self.actor.init)(actor_key, see)
        critics = jax.jit(self.critics.init)(critic_key, see, jnp.zeros((1, 1, self.action_size)))
        params = Learned(actor, critics, jnp.log(jnp.asarray(self.config.temperature, jnp.float32)))
        fresh = self.replace(
            params=params, target=critics, optimizer=self._adam.init(params), key=key, step=jnp.zeros((), jnp.int32)
        )
        return place(jax.tree.map(jnp.array, fresh), replicated(self.mesh))

    def update(self, data: Trajectories, mazes: Maze | None) -> tuple["Cql", Info]:
        """One update on a batch of single steps."""
        draw, noise = jax.random.split(jax.random.fold_in(self.key, self.step))
        window = sample_windows(
            draw, data, data.reward, mazes, batch=self.config.batch, steps=2, overhang=1, map_cell_m=self.map_cell_m,
            symmetries=symmetries(self.robot) if self.config.mirror else None,
        )  # fmt: skip
        window = jax.lax.with_sharding_constraint(window, sharded(self.mesh))
        batch = transitions(window, self.robot.goal_tolerance_m)
        gradient, info = jax.grad(self.loss, has_aux=True)(self.params, batch, noise)
        change, optimizer = self._adam.update(gradient, self.optimizer, self.params)
        params: Any = optax.apply_updates(self.params, change)
        target = optax.incremental_update(params.critics, self.target, self.config.target_rate)
        return self.replace(params=params, target=target, optimizer=optimizer, step=self.step + 1), info

    @property
    def _adam(self) -> optax.GradientTransformation:
        return optax.adam(self.config.learning_rate)

    @property
    def mesh(self) -> Mesh:
        """The devices that share a batch."""
        return data_mesh(self.config.batch)

    @property
    def actor(self) -> Actor:
        """The policy's network."""
        return Actor(self.action_size, self.config.width, self.config.frame)

    @property
    def critics(self) -> Critics:
        """The critics' network."""
        return Critics(self.config.width, self.config.frame)

    @property
    def policy(self) -> ActorPolicy:
        """What is learned so far."""
        assert self.params is not None
        return ActorPolicy(self.params.actor, self.action_size, self.config.width, self.config.frame)

    def loss(self, params: Learned, batch: Transitions, key: jax.Array) -> tuple[jax.Array, Info]:
        """The sum of the losses. The gradient of each changes only its own parameters."""
        critic_key, actor_key = jax.random.split(key)
        mean = lambda values: jnp.sum(values * batch.known) / jnp.maximum(jnp.sum(batch.known), 1.0)  # noqa: E731
        error, gap, q = self._critic_losses(params, self.target, batch, critic_key)
        actor, entropy = self._actor_loss(params, self.step, batch, actor_key)
        surplus = jax.lax.stop_gradient(entropy) - self.config.entropy * self.action_size
        losses = {"error": mean(error), "gap": mean(gap), "actor_loss": mean(actor)}
        loss = losses["error"] + self.config.alpha * losses["gap"] + losses["actor_loss"]
        loss += jnp.exp(params.log_temperature) * mean(surplus)
        return loss, losses | {"q": mean(q), "entropy": mean(entropy), "temperature": jnp.exp(params.log_temperature)}

    def _critic_losses(
        self, params: Learned, target: Any, batch: Transitions, key: jax.Array
    ) -> tuple[Float[Array, "B"], Float[Array, "B"], Float[Array, "B"]]:
        """For each step: squared error to the target, conservative penalty, and Q of the action in the data."""
        config = self.config
        next_key, uniform_key, here_key, there_key = jax.random.split(key, 4)
        here, there = (
            jax.lax.stop_gradient(self.actor.apply(params.actor, where)) for where in (batch.now, batch.after)
        )
        action, log_density = self._draw(next_key, there, 1)
        after = self.critics.apply(target, batch.after, action).min(-1)  # pyright: ignore
        if config.soft_target:
            after -= jnp.exp(params.log_temperature) * log_density
        after = jnp.where(batch.arrived > 0, 0.0, after[:, 0])
        aim = jax.lax.stop_gradient(config.reward_scale * batch.reward + config.discount * after)

        shape = (len(aim), config.samples, self.action_size)
        uniform = jax.random.uniform(uniform_key, shape, minval=-1.0, maxval=1.0)
        flat = jnp.full(shape[:2], -self.action_size * jnp.log(2.0))
        drawn_here, drawn_there = (self._draw(k, p, config.samples) for k, p in ((here_key, here), (there_key, there)))
        actions, densities = zip((uniform, flat), drawn_here, drawn_there, strict=True)
        actions = jnp.concatenate([batch.action[:, None], *actions], 1)
        q: Any = self.critics.apply(params.critics, batch.now, actions)  # [B, 1 + 3 samples, 2]
        error = ((q[:, 0] - aim[:, None]) ** 2).sum(-1)
        weighted = q[:, 1:] - jnp.concatenate(densities, 1)[..., None]
        soft_maximum = jax.nn.logsumexp(weighted, axis=1) - jnp.log(3.0 * config.samples)
        return error, (soft_maximum - q[:, 0]).sum(-1), q[:, 0].min(-1)

    def _actor_loss(
        self, params: Learned, update: jax.Array, batch: Transitions, key: jax.Array
    ) -> tuple[Float[Array, "B"], Float[Array, "B"]]:
        """The policy's loss and entropy for each step. It maximises Q or, in the first updates, imitates the data."""
        temperature, critics = jax.lax.stop_gradient((jnp.exp(params.log_temperature), params.critics))
        logits: Any = self.actor.apply(params.actor, batch.now)
        action, log_density = self._draw(key, logits, 1)
        value = self.critics.apply(critics, batch.now, action).min(-1)[:, 0]  # pyright: ignore
        if self.config.imitation:
            # The inverse of tanh is infinite at the bounds, so clip the actions.
            distribution = tanh_gaussian(self.action_size)
            done = distribution.inverse_postprocess(jnp.clip(batch.action, -0.999, 0.999))
            value = jnp.where(update < self.config.imitation, distribution.log_prob(logits, done), value)
        return temperature * log_density[:, 0] - value, -log_density[:, 0]

    def _draw(
        self, key: jax.Array, logits: Float[Array, "B 2A"], n: int
    ) -> tuple[Float[Array, "B n A"], Float[Array, "B n"]]:
        """n actions of the policy, and their log-densities."""
        distribution, logits = tanh_gaussian(self.action_size), jnp.repeat(logits[:, None], n, 1)
        raw = distribution.sample_no_postprocessing(logits, key)
        return distribution.postprocess(raw), distribution.log_prob(logits, raw)


def train_cql(
    key: jax.Array,
    learner: Cql,
    data: Trajectories,
    mazes: Maze | None,
    *,
    on_progress: Callable[[int, dict[str, float]], None] = lambda update, metrics: None,
    checkpoints: Checkpoints | None = None,
    chunk: int = 20,
) -> ActorPolicy:
    """Train for the configured number of updates.

    Args:
        data: rewards are -||g|| to the final goal. The last step of a trajectory that did not arrive is not used.
        mazes: stacked; ``data.maze`` is an index into it. None if the trajectories keep their maps.
        on_progress: called with (updates done, metrics) after every ``chunk``.
        checkpoints: training continues from the last one, saves one at intervals, and saves one when interrupted.
    """
    learner = learner.create(key, data)
    data, mazes = place((data, mazes), replicated(learner.mesh))
    learner = learn_in_chunks(
        learner, learner.config.updates, data, mazes, on_progress=on_progress, checkpoints=checkpoints, chunk=chunk
    )
    return jax.device_get(learner.policy)
