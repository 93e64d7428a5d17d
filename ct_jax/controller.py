"""The low-level controller pi_c, and its training on the edges of a roadmap (paper, sec. III-B and Algorithm 2)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from ct_envs import Tasks
from ct_envs.checked import Checked
from ct_envs.frames import FrameName
from ct_envs.maze import Maze
from ct_jax.controllers.augment import AugmentConfig, controller_inputs, input_size
from ct_jax.controllers.edges import EdgeConfig, EdgeTask, chain_tasks, edge_tasks, split_edges
from ct_jax.controllers.off_policy import OffPolicy
from ct_jax.controllers.sac import SacConfig, blank_statistics, make_networks
from ct_jax.prm import Roadmap
from ct_jax.rollout import Environment, run
from ct_jax.runtime.checkpoint import Checkpoints, run_to
from ct_jax.runtime.devices import alike
from ct_jax.types import Action, Controller, Frame, act_as_intended

TESTS = 20  # number of tests of the controller on held-out edges during its training


@dataclass(frozen=True)
class ControllerConfig(Checked):
    """All settings of a controller: of its learner, of what it learns, and of what it sees."""

    sac: SacConfig = SacConfig()  # the learner
    edges: EdgeConfig = EdgeConfig()  # the task
    augment: AugmentConfig = AugmentConfig()  # frame and symmetries

    def scaled(self, factor: float) -> "ControllerConfig":
        """The same with actions smaller by this factor."""
        return replace(self, sac=replace(self.sac, action_scale=factor * self.sac.action_scale))


@struct.dataclass
class SacController:
    """The trained pi_c, deterministic."""

    normalizer: Any
    policy: Any
    action_size: int = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)
    frame: FrameName = struct.field(pytree_node=False, default="world")
    action_scale: float = struct.field(pytree_node=False, default=1.0)

    def __call__(self, proprio: Float[Array, "N P"], goal: Float[Array, "N 2"]) -> Float[Array, "N A"]:
        inputs = controller_inputs(jnp.concatenate([proprio, goal], -1), self.frame)
        networks = make_networks(inputs.shape[-1], self.action_size, self.hidden)
        logits = networks.policy_network.apply(self.normalizer, self.policy, inputs)
        return self.action_scale * networks.parametric_action_distribution.mode(logits)


def make_controller(normalizer: Any, policy: Any, action_size: int, config: ControllerConfig) -> SacController:
    """The controller with these statistics and parameters."""
    sac = config.sac
    return SacController(normalizer, policy, action_size, sac.hidden, config.augment.frame, sac.action_scale)


def blank_controller(key: jax.Array, proprio_size: int, action_size: int, config: ControllerConfig) -> SacController:
    """An untrained controller of these sizes."""
    size = input_size(proprio_size, config.augment.frame)
    policy = make_networks(size, action_size, config.sac.hidden).policy_network.init(key)
    return make_controller(blank_statistics(size), policy, action_size, config)


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


def edge_success(env: Environment, act: Controller, maze: Maze, tasks: Tasks, key: jax.Array) -> float:
    """Share of the given edges that the controller walks in time, from rest. ``env`` must be without auto-reset."""
    n = tasks.start.shape[0]
    keys = jax.random.split(key, n + 1)
    one_each = Tasks(tasks.start[:, None], tasks.goal[:, None], jnp.ones(n, jnp.int32))
    state = jax.jit(jax.vmap(env.reset, in_axes=(0, None, 0)))(keys[:n], maze, one_each)
    state, _, _ = run(env, Steered(act), state, (), keys[n], env.horizon)
    return float(state.info["success"].mean())


def edges_in_a_row(
    env: Environment, act: Controller, maze: Maze, tasks: Tasks, key: jax.Array, *, edges: int = 20, walkers: int = 100
) -> float:
    """Share of the walkers that, from rest, walk ``edges`` edges in a row, each in time and without a fall.

    ``env`` must have auto-reset, and the tasks must be chained (``chain_tasks``).
    """
    keys = jax.random.split(key, walkers + edges)
    state = jax.jit(jax.vmap(env.reset, in_axes=(0, None, None)))(keys[:walkers], maze, tasks)
    walked, unbroken = np.zeros(walkers, int), np.ones(walkers, bool)
    for i in range(edges):  # each rollout is one full horizon, the time limit of an edge
        state, _, steps = run(env, Steered(act), state, (), keys[walkers + i], env.horizon)
        ended = 1.0 - np.concatenate([np.asarray(steps.alive)[1:], 1.0 - np.asarray(state.done)[None]])
        won = np.asarray(steps.success) > 0
        whole = unbroken & (np.cumsum((ended > 0) & ~won, 0) == 0)
        walked, unbroken = walked + (whole & won).sum(0), whole[-1]
    return float((walked >= edges).mean())


def train_controller(
    key: jax.Array,
    env_factory: Callable[..., Environment],
    maze: Maze,
    roadmap: Roadmap,
    config: ControllerConfig,
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
    sac, edges = config.sac, config.edges
    train_key, test_key, split_key, row_key = jax.random.split(key, 4)
    seed = int(jax.random.randint(split_key, (), 0, 2**31 - 1, jnp.int32))
    train_tasks, test_tasks = split_edges(roadmap, edges.held_out, seed)
    if edges.chain:
        train_tasks = chain_tasks(train_tasks, seed)
    env = env_factory(maps=False, horizon=edges.episode_steps, reset_velocity_mps=edges.reset_velocity_mps)
    state = alike(start_training(train_key, env, maze, train_tasks, config))
    alone, in_a_row = (
        env_factory(maps=False, horizon=edges.episode_steps, auto_reset=again) for again in (False, True)
    )

    def train(state: OffPolicy, n: int) -> tuple[OffPolicy, dict[str, Any]]:
        after, metrics = state.train(n)
        before, now = (int(s.iteration) * TESTS // sac.iterations for s in (state, after))
        if now > before:
            metrics |= {"held_out": edge_success(alone, learned(after, config), maze, test_tasks, test_key)}
        return after, metrics

    state = run_to(sac.iterations, state, train, lambda state: int(state.iteration), on_progress, checkpoints, chunk)
    act = learned(state, config)
    every_edge = chain_tasks(edge_tasks(roadmap, roadmap.edges), seed)
    return act, {
        "held_out_success": edge_success(alone, act, maze, test_tasks, test_key),
        "twenty_in_a_row": edges_in_a_row(in_a_row, act, maze, every_edge, row_key),
    }


def start_training(key: jax.Array, env: Environment, maze: Maze, tasks: Tasks, config: ControllerConfig) -> OffPolicy:
    """The training on these edges before its first iteration. ``env`` must have auto-reset, and no maps."""
    task = EdgeTask(env, config.edges, config.augment, config.sac.discount)
    return OffPolicy(config.sac, task).create(key, maze, task.start(tasks))


def learned(state: OffPolicy, config: ControllerConfig) -> SacController:
    """The controller that is learned so far."""
    found = jax.device_get((state.learner.normalizer, state.learner.average))
    normalizer, policy = jax.tree.map(jnp.asarray, found)
    return make_controller(normalizer, policy, state.task.env.action_size, config)
