"""Planning-guided fine-tuning of the Turtlebot3 (paper, Algorithm 4), on a pool of simulations."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from brax.envs.base import State
from flax import struct

from ct_envs.turtlebot3_pool import Frame, Turtlebot3Pool
from ct_jax.agent import act
from ct_jax.collect import CollectConfig
from ct_jax.collect_turtlebot3 import draw_wave, make_guide
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.drive import GuidedDriver, drive, to_trajectories
from ct_jax.evaluate_turtlebot3 import as_state
from ct_jax.finetune import RecoverConfig, TakeoverPolicy, gather_recoveries
from ct_jax.numerics import with_own_numerics
from ct_jax.policy import TransformerPolicy
from ct_jax.prm import PrmConfig
from ct_jax.rollout import Action
from ct_jax.trajectories import Trajectories


@struct.dataclass
class Given:
    """A policy whose action is already computed: its memory is its action."""

    def act(self, memory: Action, state: State, key: jax.Array) -> tuple[Action, Action]:
        """The action in memory."""
        del state, key
        return memory, memory


@dataclass(frozen=True)
class SupervisedDriver:
    """The transformer until it fails, then the planner: ``TakeoverPolicy`` in the slots of a pool."""

    supervised: TakeoverPolicy  # with ``Given`` for the planner
    planner: GuidedDriver
    key: jax.Array

    def act(self, memory: tuple[Any, Any, int], frame: Frame) -> tuple[Action, tuple[Any, Any, int]]:
        """The action of the transformer or the planner. Memory: the watching, the planner's, the step."""
        watching, led, step = memory
        guided, led = self.planner.act(led, frame)
        key = jax.random.fold_in(self.key, step)
        action, watching = act(self.supervised, watching.replace(guided=guided), as_state(frame), key)
        return action, (watching, led, step + 1)


@with_own_numerics
def recover(
    key: jax.Array,
    pool: Turtlebot3Pool,
    policy: TransformerPolicy,
    config: RecoverConfig,
    collecting: CollectConfig,
    prm: PrmConfig,
    *,
    densities: tuple[float, float] = (1.0, 1.0),
    controller: DifferentialDrive = DifferentialDrive(),
    on_progress: Callable[[int, int], None] = lambda recoveries, episodes: None,
    keep: Callable[[Callable[[int], Any]], Callable[[int], Any]] = lambda wave: wave,
) -> Trajectories:
    """Algorithm 4: failures of the policy and the planner's recoveries from them; see ``finetune.recover``.

    Args:
        pool: its horizon limits failure and recovery together.
        collecting: gives starts, guide, noise, reset interval and number of episodes at a time.
        densities: of obstacles, see ``make_room``.
        keep: see ``collect_turtlebot3.keeping``.
    """
    guide = make_guide("shortcut" if collecting.guide == "roadmap" else collecting.guide, prm)
    planner = GuidedDriver(guide, controller, collecting.noise)
    draw_key, act_key = jax.random.split(key)
    supervised = TakeoverPolicy(policy, Given(), config)  # pyright: ignore[reportArgumentType]

    def wave(first: int) -> tuple[Trajectories, np.ndarray, np.ndarray]:
        drawn = draw_wave(draw_key, first, collecting, prm, n=collecting.envs, densities=densities)
        driver = SupervisedDriver(supervised, planner, jax.random.fold_in(act_key, first))

        def begin(frame: Frame) -> tuple[Any, Any, int]:
            state = as_state(frame)
            led = planner.init(guide.init(frame, drawn.episodes, drawn.rooms), frame, drawn.episodes)
            return supervised.init(state, policy.init(state), None), led, 0

        drives = drive(pool, drawn.episodes, driver, begin)
        return to_trajectories(drives), np.array([each.success for each in drives]), np.zeros(len(drives), bool)

    return gather_recoveries(config, collecting.envs, pool.config.horizon, keep(wave), on_progress)
