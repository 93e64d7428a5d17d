"""Planning-guided fine-tuning: the policy's failures, and the planner's recoveries from them (paper, Algorithm 4)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from ct_envs import MazeEnv, UserError
from ct_envs.checked import Above, Checked, Count, Share, Within
from ct_envs.maze import Maze
from ct_jax.collect import CollectConfig, draw_batch, make_guide, plan_memory, run_episodes
from ct_jax.devices import joined
from ct_jax.numerics import with_own_numerics
from ct_jax.policy import TransformerPolicy
from ct_jax.prm import PrmConfig
from ct_jax.rollout import Action, Controller, Guided
from ct_jax.trajectories import OBSERVED, PER_STEP, Trajectories, arrays_of, concatenate, select


class NoRecoveryError(UserError):
    """There is nothing to fine-tune on: the planner recovers no episode, or the policy hardly ever fails."""


@dataclass(frozen=True)
class RecoverConfig(Checked):
    """Recovery-based data collection (paper, Algorithm 4). The defaults are the paper's, if the paper gives them."""

    recoveries: Count = 500  # T
    stuck_steps: Annotated[int, Within(1, 100_000)] = 40  # failure: within this many steps ...
    stuck_m: Annotated[float, Within(0, 10_000)] = 4.0  # ... the robot moved less than this [m]
    bumps: Annotated[int, Within(1, 100_000)] | None = None  # failure: the robot touched a wall in this many of the
    # last ``stuck_steps``
    patience: Annotated[int, Within(1, 1_000_000)] = 200  # failure: the goal is not reached after this many steps
    takeover: Share = 0.0  # chance at each step that the planner takes over without a failure; paper: 0
    keep: Literal["separate", "joined", "relabelled"] = "separate"  # failure and recovery as two trajectories (paper);
    # "joined": one trajectory, in which only the recovery is imitated;
    # "relabelled": one trajectory, and the planner's action is imitated at every step (DAgger)
    random_mazes: Annotated[int, Within(0, 10_000)] = 0  # number of random mazes to fail and recover in, besides the
    # run's mazes
    give_up: Annotated[float, Above(0, 1_000_000)] = 20.0  # stop after this many times T episodes


@struct.dataclass
class Watching:
    """Memory of ``TakeoverPolicy``."""

    own: Any
    guided: Any
    past: Float[Array, "W N 2"]  # positions of the last steps [m]
    touched: Float[Array, "W N"]  # collisions of the last steps
    steps: Int[Array, ""]
    rescued: Bool[Array, "N"]


@struct.dataclass
class TakeoverPolicy:
    """The transformer until f(s) detects a failure; from then on the controller guided by the planner."""

    own: TransformerPolicy
    guided: Guided
    config: RecoverConfig = struct.field(pytree_node=False)

    def init(self, state: State, own: Any, guided: Any) -> Watching:
        n = state.done.shape[0]
        past = jnp.full((self.config.stuck_steps, n, 2), jnp.inf, jnp.float32)
        touched = jnp.zeros((self.config.stuck_steps, n), jnp.float32)
        return Watching(own, guided, past, touched, jnp.zeros((), jnp.int32), jnp.zeros(n, bool))

    def act(self, memory: Watching, state: State, key: jax.Array) -> tuple[Action, Watching]:
        own_key, guided_key, chance_key = jax.random.split(key, 3)
        own, own_memory = self.own.act(memory.own, state, own_key)
        guided, guided_memory = self.guided.act(memory.guided, state, guided_key)
        position = state.info["position"]
        rescued = memory.rescued | self._failed(memory, position)
        rescued |= jax.random.bernoulli(chance_key, jnp.float32(self.config.takeover), rescued.shape)
        action = jax.tree.map(lambda g, o: jnp.where(rescued.reshape(-1, *[1] * (o.ndim - 1)), g, o), guided, own)
        if self.config.keep == "relabelled":
            action = action._replace(label=guided.label, label_mask=jnp.ones(rescued.shape, jnp.float32))
        else:
            action = action._replace(label_mask=rescued.astype(jnp.float32))
        past = jnp.concatenate([memory.past[1:], position[None]])
        touched = jnp.concatenate([memory.touched[1:], state.info["collision"][None]])
        return action, Watching(own_memory, guided_memory, past, touched, memory.steps + 1, rescued)

    def _failed(self, memory: Watching, position: jax.Array) -> Bool[Array, "N"]:
        """f(s): the robot is stuck, touches walls repeatedly, or takes too long. (A fall ends the episode.)"""
        stuck = jnp.linalg.norm(position - memory.past[0], axis=-1) < self.config.stuck_m
        if self.config.bumps is not None:
            stuck |= memory.touched.sum(0) >= self.config.bumps
        return stuck | (memory.steps >= self.config.patience)


@with_own_numerics
def recover(
    key: jax.Array,
    env: MazeEnv,
    mazes: Maze,
    policy: TransformerPolicy,
    controller: Controller,
    config: RecoverConfig,
    collecting: CollectConfig,
    prm: PrmConfig,
    *,
    on_progress: Callable[[int, int], None] = lambda recoveries, episodes: None,
) -> Trajectories:
    """Algorithm 4: failures of the policy and the planner's recoveries from them.

    Args:
        env: with maps, without auto-reset; its horizon limits failure and recovery together.
        collecting: gives starts, guide, noise, reset interval and number of environments.

    Returns:
        With ``keep="separate"`` two trajectories for each recovery, otherwise one.

    Raises:
        NoRecoveryError: no recovery within ``give_up * T`` episodes.
    """
    guide = make_guide("shortcut" if collecting.guide == "roadmap" else collecting.guide, env, prm)
    maze_key, wave_key = jax.random.split(key)
    # Each round begins at another maze, if there are many.
    first_maze = int(jax.random.randint(maze_key, (), 0, len(mazes.cell_m), jnp.int32))
    supervised = TakeoverPolicy(policy, Guided(controller, guide, collecting.noise), config)

    def wave(first: int) -> tuple[Trajectories, np.ndarray, np.ndarray]:
        batch_key, run_key = jax.random.split(jax.random.fold_in(wave_key, first))
        batch = draw_batch(
            batch_key, env, mazes, collecting, prm, first_maze=first_maze + first // collecting.reset_interval
        )
        plan = plan_memory(guide, batch.tables, batch.which, batch.state)
        memory = supervised.init(batch.state, policy.init(batch.state), supervised.guided.init(batch.state, plan))
        state, memory, steps = run_episodes(env, supervised, batch.state, memory, run_key, limit=env.horizon)
        return batch.outcome(state, steps)

    return gather_recoveries(config, collecting.envs, env.horizon, wave, on_progress)


def gather_recoveries(
    config: RecoverConfig,
    envs: int,
    horizon: int,
    wave: Callable[[int], tuple[Trajectories, np.ndarray, np.ndarray]],
    on_progress: Callable[[int, int], None],
) -> Trajectories:
    """The loop of Algorithm 4: supervised episodes, wave after wave, until T recoveries or ``give_up * T`` episodes.

    Args:
        envs: episodes in a wave, each of at most ``horizon`` steps.
        wave: a function of the index of its first episode. It returns this process's share of the episodes, which of
            them succeeded, and which broke off (see ``rollout.broke_off``).

    Raises:
        NoRecoveryError: as ``recover``.
    """
    kept: list[Trajectories] = []
    recoveries = episodes = broken = 0
    while recoveries < config.recoveries:
        if episodes >= config.give_up * config.recoveries:
            break
        data, rescued, broke = wave(episodes)
        if config.keep == "relabelled":  # also keep the transformer's own successes and falls: they are relabelled too
            data, rescued = lie_for_ever(data, broke, horizon), rescued | broke
        else:
            rescued = rescued & (data.label_mask.sum(1) > 0)
        kept += _split(select(data, rescued)) if config.keep == "separate" else [select(data, rescued)]
        recoveries, episodes = recoveries + int(joined(rescued).sum()), episodes + envs
        broken += int(joined(broke).sum())
        on_progress(recoveries, episodes)
    if not recoveries:
        why = "the robot falls before the planner takes over" if 2 * broken > episodes else "the policy hardly fails"
        raise NoRecoveryError(f"no recovery in {episodes} episodes, {broken} falls: {why}, so skip fine-tuning")
    return concatenate(kept)


def lie_for_ever(data: Trajectories, broke: Bool[Array, "N"], horizon: int) -> Trajectories:
    """Charge an episode that broke off as if the robot lay there until the horizon: a short trajectory must not look
    like a good one."""
    row, last = np.flatnonzero(broke), np.asarray(data.length)[broke] - 1
    reward = np.array(data.reward)
    reward[row, last] *= horizon - last
    return data.replace(reward=reward)


def _split(data: Trajectories) -> list[Trajectories]:
    """Split each trajectory in two: up to the failure, and the recovery from it."""
    imitated = np.asarray(data.label_mask)
    step, begin = np.arange(imitated.shape[1]), imitated.argmax(1)
    fail = data.replace(length=begin.astype(np.int32), label_mask=np.float32(step < begin[:, None]))
    later = np.minimum(step + begin[:, None], len(step) - 1)
    row = np.arange(data.n)[:, None]
    moved = {name: leaf[row, later] for name, leaf in arrays_of(data).items() if name in (*PER_STEP, *OBSERVED)}
    recovery = replace(data, **moved, length=np.asarray(data.length) - begin)
    return [select(fail, begin > 0), recovery]
