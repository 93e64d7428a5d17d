"""The humanoid: two legs, seventeen motors.

    ct-jax train humanoid --preset demo                       # with the shipped controller
    ct-jax train humanoid --preset cpu                        # the controller: 92 minutes on one CPU core
    ct-jax train humanoid --preset cpu --controller zoo       # 55 to 71 minutes on one CPU core
    ct-jax train humanoid --preset published --controller zoo
    ct-jax train humanoid --preset paper                      # wants a GPU

Success to expect in antmaze-large (seen), antmaze-large-eval and hall (unseen): ``cpu`` 89.0, 79.3 and 94.0 %,
``published`` 0 %, for it falls (three models each; ``docs/results/humanoid.md``). The controller walks 99.5 % of
held-out edges (``docs/results/controllers.md``).
"""

from dataclasses import replace

from ct_jax.configs import base
from ct_jax.controller import ControllerConfig
from ct_jax.controllers.augment import AugmentConfig
from ct_jax.controllers.edges import EdgeConfig
from ct_jax.controllers.reward import RewardConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.settings import Settings, with_fits

CONTROLLER = ControllerConfig(
    sac=SacConfig(
        envs=64,
        iterations=40_000,
        updates=8,
        warmup=60,
        final_rate=0.1,
        average=0.9995,
        critic_norm=True,
        hidden=(256, 256),  # paper: 512, of which a core makes a quarter of the updates
        discount=0.98,
        target_rate=0.01,
        greedy=0.25,
        reward_scale=0.1,
        replay=500_000,
    ),
    edges=EdgeConfig(
        reward=RewardConfig(alive_bonus=1.0, speed_mps=2.0, action_cost=0.2),
        episode_steps=400,
        reset_velocity_mps=0.05,
        relabel=0.25,
        chain=True,
        through=True,
        turn_ramp=(0.1, 0.3),
    ),
    augment=AugmentConfig(frame="heading", mirror=True),
)

SAC_GPU = replace(CONTROLLER.sac, envs=512, iterations=22_000, batch=2048, replay=1_500_000, hidden=(512, 512))
"""The paper's width, eight times the environments and eight times the batch, for a GPU."""


def _for_humanoid(settings: Settings) -> Settings:
    """Three of its control steps are one of the ant's, and it is brought down more easily."""
    settings = base.for_walker(settings, CONTROLLER, horizon=1600, calm=0.1)
    recover = settings.recover
    recover = replace(
        recover,
        stuck_steps=3 * recover.stuck_steps,
        patience=3 * recover.patience,
        takeover=recover.takeover / 3,
    )
    model = replace(settings.model, max_timestep=2048)
    settings = replace(settings, recover=recover, model=model)
    if not settings.clip_target_return:
        return settings
    # The controller's actions change fast with the body's attitude: a head that learned them from examples fell.
    # Mirrored, they are off by half of their variance.
    return with_fits(replace(settings, model=replace(model, skill=True)), turns=True)


# A gait is not learned in minutes: the demo is led by the controller that ships.
PRESETS = {name: _for_humanoid(settings) for name, settings in base.PRESETS.items()}
PRESETS["demo"] = replace(PRESETS["demo"], controller="zoo")
PRESETS["paper"] = replace(PRESETS["paper"], sac=SAC_GPU)
