"""Planning-guided fine-tuning: the policy's failures, and the planner's recoveries from them (paper, Algorithm 4)."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from ct_envs import UserError
from ct_envs.checked import Above, Checked, Count, Share, Within
from ct_jax.collect import CollectConfig, RunWave, Wave, as_wave
from ct_jax.guided import Guided
from ct_jax.prm import PrmConfig
from ct_jax.runtime.devices import joined
from ct_jax.runtime.numerics import with_own_numerics
from ct_jax.trajectories import OBSERVED, PER_STEP, Trajectories, arrays_of, concatenate, select
from ct_jax.types import Action, Controller, Frame, Guide, Policy, World


class NoRecoveryError(UserError):
    """There is nothing to fine-tune on: the planner recovers no episode, or the policy hardly ever fails."""


@dataclass(frozen=True)
class RecoverConfig(Checked):
    """Recovery-based data collection (paper, Algorithm 4). The defaults are the paper's, if the paper gives them."""

    recoveries: Count = 500  # T
    stuck_steps: Annotated[int, Within(1, 100_000)] = 40  # failure: in this many steps, it moved less than ``stuck_m``
    stuck_m: Annotated[float, Within(0, 10_000)] = 4.0  # see ``stuck_steps`` [m]
    # Failure: the robot touched a wall in this many of the last ``stuck_steps``.
    bumps: Annotated[int, Within(1, 100_000)] | None = None
    patience: Annotated[int, Within(1, 1_000_000)] = 200  # failure: the goal is not reached after this many steps
    takeover: Share = 0.0  # chance at each step that the planner takes over without a failure; paper: 0
    # Failure and recovery as two trajectories (paper); "joined": one trajectory, in which only the recovery is
    # imitated; "relabelled": one trajectory, and the planner's action is imitated at every step (DAgger).
    keep: Literal["separate", "joined", "relabelled"] = "separate"
    # Number of random mazes to fail and recover in, besides the run's mazes.
    random_mazes: Annotated[int, Within(0, 10_000)] = 0
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

    own: Policy
    guided: Guided
    config: RecoverConfig = struct.field(pytree_node=False)

    def init(self, frame: Frame, tasks: Any) -> Watching:
        """The memory before the first step."""
        n = frame.done.shape[0]
        past = jnp.full((self.config.stuck_steps, n, 2), jnp.inf, jnp.float32)
        touched = jnp.zeros((self.config.stuck_steps, n), jnp.float32)
        own, guided = self.own.init(frame, tasks), self.guided.init(frame, tasks)
        return Watching(own, guided, past, touched, jnp.zeros((), jnp.int32), jnp.zeros(n, bool))

    def act(self, memory: Watching, frame: Frame, key: jax.Array) -> tuple[Action, Watching]:
        """The action of the transformer or of the planner, and the next memory."""
        own_key, guided_key, chance_key = jax.random.split(key, 3)
        own, own_memory = self.own.act(memory.own, frame, own_key)
        guided, guided_memory = self.guided.act(memory.guided, frame, guided_key)
        at = frame.privileged
        action, watched = _choose(self.config, _watched(memory), own, guided, at.position, at.collision, chance_key)
        return action, Watching(own_memory, guided_memory, *watched)


def _watched(memory: Watching) -> tuple[jax.Array, ...]:
    return memory.past, memory.touched, memory.steps, memory.rescued


@functools.partial(jax.jit, static_argnums=0)
def _choose(
    config: RecoverConfig, watched: tuple[jax.Array, ...], own: Action, guided: Action, position: Float[Array, "N 2"],
    collision: Float[Array, "N"], key: jax.Array,
) -> tuple[Action, tuple[jax.Array, ...]]:  # fmt: skip
    """Whose action is executed and which is imitated; what ``Watching`` holds next."""
    past, touched, steps, rescued = watched
    rescued |= _failed(config, past, touched, steps, position)
    rescued |= jax.random.bernoulli(key, jnp.float32(config.takeover), rescued.shape)
    intended, executed, label = (
        jnp.where(rescued[:, None], theirs, mine) for theirs, mine in zip(guided[:3], own[:3], strict=True)
    )
    if config.keep == "relabelled":
        label, mask = guided.label, jnp.ones(rescued.shape, jnp.float32)
    else:
        mask = rescued.astype(jnp.float32)
    past = jnp.concatenate([past[1:], position[None]])
    touched = jnp.concatenate([touched[1:], collision[None]])
    return Action(intended, executed, label, mask, own.target_return), (past, touched, steps + 1, rescued)


def _failed(
    config: RecoverConfig, past: Float[Array, "W N 2"], touched: Float[Array, "W N"], steps: Int[Array, ""],
    position: Float[Array, "N 2"],
) -> Bool[Array, "N"]:  # fmt: skip
    """f(s): the robot is stuck, touches walls repeatedly, or takes too long. (A fall ends the episode.)"""
    stuck = jnp.linalg.norm(position - past[0], axis=-1) < config.stuck_m
    if config.bumps is not None:
        stuck |= touched.sum(0) >= config.bumps
    return stuck | (steps >= config.patience)


@with_own_numerics
def recover(
    key: jax.Array,
    world: World,
    policy: Policy,
    controller: Controller,
    config: RecoverConfig,
    collecting: CollectConfig,
    prm: PrmConfig,
    *,
    guide: Guide | None = None,
    on_progress: Callable[[int, int], None] = lambda recoveries, episodes: None,
    keep: Callable[[RunWave], RunWave] = lambda wave: wave,
) -> Trajectories:
    """Algorithm 4: failures of the policy and the planner's recoveries from them.

    Args:
        world: with local maps.
        collecting: gives starts, guide, noise, reset interval, number of episodes at a time, and the horizon of a
            recovery; the failure before it has ``config.patience`` steps more.
        guide: your own planner; by default that of the collection, with "shortcut" in place of "roadmap", because it
            recovers from any position.
        keep: see ``collect.kept_in``.

    Returns:
        With ``keep="separate"`` two trajectories for each recovery, otherwise one.

    Raises:
        NoRecoveryError: no recovery within ``give_up * T`` episodes.
    """
    guide = guide or world.guide("shortcut" if collecting.guide == "roadmap" else collecting.guide, prm)
    place_key, wave_key = jax.random.split(key)
    # Each round begins at another place, if there are many.
    offset = int(jax.random.randint(place_key, (), 0, world.places, jnp.int32))
    takeover = TakeoverPolicy(policy, Guided(controller, guide, collecting.noise), config)
    horizon = config.patience + collecting.horizon

    def run(first: int) -> Wave:
        tasks = world.sample_tasks(wave_key, collecting, prm, first=first, offset=offset)
        return as_wave(world.rollout(takeover, tasks, horizon=horizon))

    return gather_recoveries(config, collecting.envs, horizon, keep(run), on_progress)


def gather_recoveries(
    config: RecoverConfig,
    envs: int,
    horizon: int,
    wave: RunWave,
    on_progress: Callable[[int, int], None],
) -> Trajectories:
    """The loop of Algorithm 4: episodes, wave after wave, until T recoveries or ``give_up * T`` episodes.

    Args:
        envs: episodes in a wave, each of at most ``horizon`` steps.

    Raises:
        NoRecoveryError: as ``recover``.
    """
    kept: list[Trajectories] = []
    recoveries = episodes = broken = 0
    while recoveries < config.recoveries:
        if episodes >= config.give_up * config.recoveries:
            break
        found = wave(episodes)
        data, rescued, broke = found.data, found.success, found.broke_off
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
