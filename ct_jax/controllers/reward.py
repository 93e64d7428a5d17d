"""The reward of a robot on its way to a goal, and the cost of a fall (paper, sec. III-G)."""

from dataclasses import dataclass
from typing import Annotated

import jax.numpy as jnp
from brax.envs.base import State
from brax.training.types import Transition
from jaxtyping import Array, Float

from ct_envs import UserError
from ct_envs.checked import Above, Checked, Share, Within
from ct_envs.frames import own_frame
from ct_jax.rollout import broke_off

Metres = Annotated[float, Within(0, 1_000_000)]  # also for other terms of the reward
Ramp = tuple[Share, Share]  # begin and end of a change, in shares of the training


@dataclass(frozen=True)
class RewardConfig(Checked):
    """The terms of the reward in addition to progress or distance."""

    # For reaching the goal; without it, the entropy bonus would make it better to stay away.
    arrival_bonus: Metres = 10.0
    # Cost of a fall: the value of staying this much farther away [m], at the beginning and at the end of training. With
    # 60 m from the beginning, the ant does not learn to walk.
    fall_m: tuple[Metres, Metres] = (5.0, 20.0)
    fall_ramp: Ramp = (0.2, 0.5)  # the change of ``fall_m``
    alive_bonus: Metres = 0.0  # reward of each step without a fall (paper, humanoid); replaces the cost of a fall
    # Velocity reward: speeds towards the goal above this one get no more reward.
    speed_mps: Annotated[float, Above(0, 1000)] | None = None
    action_cost: Metres = 0.0  # cost of a step with all actuators at their limits
    tilt_m: Metres = 0.0  # cost of a torso that lies on its side: that of this distance [m]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ramp("RewardConfig.fall_ramp", self.fall_ramp)


def check_ramp(name: str, ramp: Ramp) -> None:
    """Raise UserError for a change that ends before it begins."""
    if ramp[0] > ramp[1]:
        raise UserError(f"{name} is {ramp}; give its begin first, then its end")


@dataclass(frozen=True)
class Reward:
    """Dense reward towards the goal (paper, sec. III-G): progress [m/s] or minus the distance [m], bonuses, costs."""

    config: RewardConfig
    kind: str  # "velocity" for progress, or "distance" for minus the distance
    control_dt_s: float

    def __call__(self, before: State, action: Float[Array, "N A"], after: State) -> Float[Array, "N"]:
        """The reward of a step. For a fall without an alive bonus it is always minus the distance: see ``pay_falls``.

        An episode that breaks off for another reason counts as a fall.
        """
        config = self.config
        distance = jnp.linalg.norm(before.obs["goal"], axis=-1)  # pyright: ignore
        dense = self.towards(distance, -after.reward)
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

    def towards(self, before_m: Float[Array, "N"], after_m: Float[Array, "N"]) -> Float[Array, "N"]:
        """The reward of a step that begins and ends at these distances from the goal [m]."""
        if self.kind == "distance":
            return -after_m
        return jnp.minimum((before_m - after_m) / self.control_dt_s, self.config.speed_mps or jnp.inf)

    def pay_falls(self, batch: Transition, share: Float[Array, ""], discount: float) -> Transition:
        """The batch with the cost of falls: the value of staying ``fall_m`` farther away for ever.

        Without this cost, a fall far from the goal would pay off: it ends the negative rewards. With an alive bonus the
        rewards are gains, and a fall ends them.

        Args:
            share: of the training that is done.
        """
        config, fall = self.config, batch.extras["state_extras"]["fall"]
        if config.alive_bonus:
            return batch
        farther = jnp.interp(share, jnp.asarray(config.fall_ramp), jnp.asarray(config.fall_m))
        for_ever = ((batch.reward - farther) / (1.0 - discount)).astype(jnp.float32)
        return batch._replace(reward=jnp.where(fall > 0, for_ever, batch.reward))
