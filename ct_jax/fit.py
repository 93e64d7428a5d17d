"""Supervised training of the value network and the transformer on trajectories (paper, Algorithm 1 and sec. III-D).

The data are arrays in device memory. A compiled step draws windows from them, recomputes their maps and updates the
parameters; the host only reports progress. Trajectories and batches are sharded over the devices of ``data_mesh``: all
devices draw the same windows, each sends the steps that it holds, and each computes its share of the batch.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ct_envs import Robot, UserError
from ct_envs.checked import Above, Checked, Count, Within
from ct_envs.frames import Symmetries, symmetries, turns
from ct_envs.maze import Maze
from ct_jax.learner import Info, learn
from ct_jax.runtime.checkpoint import Checkpoints
from ct_jax.runtime.devices import data_mesh, feed, joined, largest, place, replicated, sharded
from ct_jax.trajectories import Trajectories, Window, at_goal, pad, sample_windows, select
from ct_jax.transformer import RETURN_DIVISOR, ControlTransformer, Modes, sample_inputs
from ct_jax.value import ValueNetwork

# Expected squared error within one mode. It is larger than the error of a single-mode model (point 0.03, ant 0.014):
# otherwise modes become phases of a gait. It is smaller than the squared difference between two routes' actions.
MODE_SPREAD = 0.05


@dataclass(frozen=True)
class FitConfig(Checked):
    """One supervised training (paper, table I)."""

    updates: Count = 75_000  # gradient updates
    batch: Annotated[int, Within(1, 1_000_000)] = 64  # windows in a batch
    # Steps in a window, ``ModelConfig.stride`` apart; with more than K, a window trains several predictions with a full
    # past.
    steps: Annotated[int, Within(1, 100_000)] = 50
    learning_rate: Annotated[float, Above(0, 10)] = 4e-4  # after the warm-up
    weight_decay: Annotated[float, Within(0, 100)] = 1e-3  # of AdamW
    warmup: Count = 10_000  # updates of linear warm-up
    decay: bool = False  # cosine decay to zero after the warm-up; the paper keeps the rate
    clip: Annotated[float, Above(0, 1_000_000)] = 1.0  # largest norm of a gradient
    mirror: bool = False  # turn and reflect each window by a random symmetry of the robot
    # With ``mirror``: only rotate the world with the robot in it. The gait of a controller may not be symmetric; then a
    # model that also learns the mirrored gait learns the mean of the two.
    turns: bool = False
    shift_timestep: Annotated[int, Within(0, 1_000_000)] = 0  # add a random number up to this to a window's timesteps
    # Precision of the transformer's computations: "bfloat16" for accelerators. Parameters stay float32.
    precision: Literal["float32", "bfloat16"] = "float32"


@dataclass(frozen=True)
class ValueConfig(Checked):
    """Training of the value network, and the selection of its trajectories (paper, sec. III-D)."""

    # The training of the network.
    fit: FitConfig = FitConfig(updates=3000, batch=512, steps=1, learning_rate=1e-3, warmup=100, decay=True)
    # Use only this best share X of the trajectories, ranked by return divided by the squared straight distance.
    top: Annotated[float, Above(0, 1)] = 1.0
    collision_free: bool = False  # only trajectories without a collision
    width: Annotated[int, Within(1, 16_384)] = 128  # of all layers


Loss = Callable[[Any, Window, jax.Array], tuple[jax.Array, Info]]


@struct.dataclass
class Fit:
    """A learner by gradient descent on windows of trajectories: its settings, and after ``create`` its arrays."""

    loss: Loss = struct.field(pytree_node=False)
    config: FitConfig = struct.field(pytree_node=False)
    map_cell_m: float = struct.field(pytree_node=False)
    robot: Robot = struct.field(pytree_node=False)
    stride: int = struct.field(pytree_node=False, default=1)  # control steps from one step of a window to the next
    params: Any = None
    optimizer: Any = None
    key: Any = None
    step: Any = None  # updates so far

    def create(self, key: jax.Array, params: Any) -> "Fit":
        """The learner before training, replicated over the devices."""
        fresh = self.replace(params=params, optimizer=self.descent.init(params), key=key, step=jnp.zeros((), jnp.int32))
        return place(jax.tree.map(jnp.array, fresh), replicated(self.mesh))

    def update(self, data: Trajectories, rtg: Float[Array, "N T"], mazes: Maze | None) -> tuple["Fit", Info]:
        """One update on a batch of windows."""
        draw, drop = jax.random.split(jax.random.fold_in(self.key, self.step))
        window = sample_windows(
            draw,
            data,
            rtg,
            mazes,
            batch=self.config.batch,
            steps=self.config.steps,
            map_cell_m=self.map_cell_m,
            symmetries=self._symmetries(),
            shift_timestep=self.config.shift_timestep,
            stride=self.stride,
        )
        window = jax.lax.with_sharding_constraint(window, sharded(self.mesh))
        gradient, info = jax.grad(self.loss, has_aux=True)(self.params, window, drop)
        change, optimizer = self.descent.update(gradient, self.optimizer, self.params)
        params = optax.apply_updates(self.params, change)
        return self.replace(params=params, optimizer=optimizer, step=self.step + 1), info

    @property
    def mesh(self) -> Mesh:
        """The devices that share a batch."""
        return data_mesh(self.config.batch)

    @property
    def descent(self) -> optax.GradientTransformation:
        """AdamW with clipped gradients and a rate that warms up."""
        config = self.config
        if config.decay:
            rate = optax.warmup_cosine_decay_schedule(
                0.0, config.learning_rate, config.warmup, max(config.updates, config.warmup + 1)
            )
        else:
            rate = optax.linear_schedule(0.0, config.learning_rate, config.warmup)
        return optax.chain(
            optax.clip_by_global_norm(config.clip),
            optax.adamw(rate, weight_decay=config.weight_decay, mask=_matrices),
        )

    def _symmetries(self) -> Symmetries | None:
        """Those by which windows are transformed. Raises UserError if the robot has no known ones."""
        if not self.config.mirror:
            return None
        found = symmetries(self.robot)
        return turns(found) if self.config.turns else found


def _matrices(params: Any) -> Any:
    """Which leaves have weight decay: matrices and kernels; not biases and norms, and not the fixed skill."""
    decays = jax.tree.map(lambda leaf: leaf.ndim > 1, params)
    return decays | {"skill": jax.tree.map(lambda leaf: False, params["skill"])} if "skill" in params else decays


def transformer_loss(model: ControlTransformer) -> Loss:
    """Mean squared error of the predicted actions over the steps to imitate (paper, sec. III-D).

    With several modes it is the negative log-likelihood of a mixture of Gaussians around them. The scale is such that
    with one mode it equals the squared error.
    """

    def loss(params: Any, window: Window, key: jax.Array) -> tuple[jax.Array, Info]:
        predicted: Modes = model.apply(
            params, window.map, window.proprio, window.goal_relative, window.action, window.rtg, window.timestep,
            window.valid, deterministic=False, rngs={"dropout": key}, method="propose",
        )  # fmt: skip # pyright: ignore
        error = jnp.mean((predicted.action - window.label[..., None, :]) ** 2, -1)
        likelihood = jax.nn.log_softmax(predicted.logit) - error / MODE_SPREAD
        error = -MODE_SPREAD * jax.nn.logsumexp(likelihood, -1)
        mean = jnp.sum(error * window.label_mask) / jnp.maximum(jnp.sum(window.label_mask), 1.0)
        return mean, {"loss": mean}

    return loss


def value_loss(model: ValueNetwork) -> Loss:
    """Mean squared error of the predicted return-to-go, in units of ``RETURN_DIVISOR`` (paper, sec. III-D)."""

    def loss(params: Any, window: Window, key: jax.Array) -> tuple[jax.Array, Info]:
        del key
        value = model.apply(params, window.map, window.proprio, window.goal_relative)
        error = ((value - window.rtg) / RETURN_DIVISOR) ** 2  # pyright: ignore
        mean = jnp.sum(error * window.valid) / jnp.maximum(jnp.sum(window.valid), 1.0)
        return mean, {"loss": mean}

    return loss


def init_params(key: jax.Array, model: ControlTransformer | ValueNetwork, data: Trajectories, given: Any = None) -> Any:
    """Fresh parameters for data of these sizes.

    Args:
        given: parameters whose fixed part, a skill, is kept.
    """
    inputs = sample_inputs(data.proprio.shape[-1], data.action.shape[-1])
    fresh = jax.jit(model.init)(key, *(inputs[:3] if isinstance(model, ValueNetwork) else inputs))
    return fresh if given is None else given | {"params": fresh["params"]}


def best_trajectories(data: Trajectories, config: ValueConfig, goal_tolerance_m: float) -> Trajectories:
    """The trajectories for the value network: those that arrive at the goal and, depending on ``config``, the top X %
    and those without collision. The return of a failure says nothing about the path length, so failures are left out.

    Raises:
        UserError: no trajectory is left.
    """
    last = np.maximum(np.asarray(data.length) - 1, 0)
    keep = np.asarray(at_goal(np.asarray(data.reward)[np.arange(data.n), last], goal_tolerance_m))
    if not joined(keep).any():
        raise UserError("no trajectory arrives at its goal; collect again")
    if config.collision_free:
        inside = np.arange(data.collision.shape[1]) < np.asarray(data.length)[:, None]
        keep &= ~((np.asarray(data.collision) > 0) & inside).any(1)
        if not joined(keep).any():
            raise UserError("every trajectory has a collision; raise prm.margin_m or set value.collision_free=False")
    if config.top < 1.0:
        straight = np.linalg.norm(np.asarray(data.goal_world) - np.asarray(data.position)[:, 0], axis=1)
        score = np.asarray(data.rtg)[:, 0] / np.maximum(straight, 1.0) ** 2
        keep &= score >= np.quantile(joined(score[keep]), 1.0 - config.top)
    return select(data, keep)


def spread(data: Trajectories, mesh: Mesh) -> tuple[Trajectories, Float[Array, "N T"]]:
    """The trajectories of all processes as one data set, sharded over their devices, and their returns-to-go.

    The lengths are replicated: windows are drawn from them, so devices exchange only the steps that were drawn.
    """
    # Sizes are rounded up, so a data set that grows from round to round seldom needs a new compilation.
    rows = math.lcm(1024, len(mesh.local_devices))
    data = pad(data, -(-largest(data.n) // rows) * rows, -(-largest(data.position.shape[1]) // 256) * 256)
    data = feed(data, mesh)
    rtg = jax.jit(lambda d: d.rtg)(data)
    everywhere = jax.jit(lambda lengths: lengths, out_shardings=replicated(mesh))
    return data.replace(length=everywhere(data.length)), rtg


def fit(
    key: jax.Array,
    learner: Fit,
    params: Any,
    data: Trajectories,
    mazes: Maze | None,
    *,
    on_progress: Callable[[int, float], None] = lambda update, loss: None,
    checkpoints: Checkpoints | None = None,
    chunk: int = 20,
    updates: int | None = None,
) -> Any:
    """Train for the configured number of updates; returns the parameters, on the host.

    Args:
        data: this process's own trajectories; the trajectories of all processes form one data set.
        updates: stop earlier, after this many updates; with ``checkpoints`` training can continue from there.
        on_progress: called with (updates done, mean loss since the last call) after every ``chunk``.
        checkpoints: training continues from the last one, saves one at intervals, and saves one when interrupted.
    """
    learner = learner.create(key, params)
    data, rtg = spread(data, learner.mesh)
    mazes = place(mazes, replicated(learner.mesh))
    learner = learn(
        learner, updates or learner.config.updates, data, rtg, mazes, checkpoints=checkpoints, chunk=chunk,
        on_progress=lambda update, info: on_progress(update, info["loss"]),
    )  # fmt: skip
    return jax.device_get(learner.params)
