"""The ant: four legs, eight motors.

    ct-jax train ant --preset demo                            # with the shipped controller
    ct-jax train ant --preset cpu                             # the controller: 88 minutes on one CPU core
    ct-jax train ant --preset cpu --controller zoo            # 10 minutes on an H200 with 16 CPU cores
    ct-jax train ant --preset published --controller zoo      # 5 minutes on an H200 with 16 CPU cores
    ct-jax train ant --preset paper --controller zoo          # wants a GPU

Success to expect in antmaze-large (seen) and antmaze-large-eval (unseen): ``cpu`` 93.7 and 89.7 %, ``published`` 0.3
and 0.0 % (three models each; ``docs/results/ant.md``). The controller walks 100 % of held-out edges
(``docs/results/controllers.md``).
"""

from dataclasses import replace

from ct_jax.configs import base
from ct_jax.controller import ControllerConfig
from ct_jax.controllers.augment import AugmentConfig
from ct_jax.controllers.edges import EdgeConfig
from ct_jax.controllers.reward import RewardConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.settings import Settings

CONTROLLER = ControllerConfig(
    sac=SacConfig(
        envs=128,
        iterations=32_000,
        updates=16,
        warmup=50,
        final_rate=0.1,
        average=0.9998,
        critic_norm=True,
        action_scale=0.4,
        greedy=0.25,
        reward_scale=0.1,
        replay=1_000_000,
    ),
    edges=EdgeConfig(
        reward=RewardConfig(arrival_bonus=100.0, tilt_m=3.0),
        episode_steps=150,
        reset_velocity_mps=0.1,
        relabel=0.5,
        chain=True,
    ),
    augment=AugmentConfig(frame="heading", mirror=True),
)


def _for_ant(settings: Settings) -> Settings:
    """The ant is half as fast as the point: longer ways, and more time before it counts as stuck."""
    settings = base.for_walker(settings, CONTROLLER, horizon=700, calm=0.2)
    recover = settings.recover
    if recover.keep == "separate":
        recover = replace(recover, stuck_steps=2 * recover.stuck_steps, patience=2 * recover.patience)
    return replace(settings, recover=recover)


# A gait is not learned in minutes: the demo is led by the controller that ships.
PRESETS = {name: _for_ant(settings) for name, settings in base.PRESETS.items()}
PRESETS["demo"] = replace(PRESETS["demo"], controller="zoo")
