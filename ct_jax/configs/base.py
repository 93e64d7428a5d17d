"""What the presets of several robots share: the method as published, and what lifts it."""

from dataclasses import replace

from ct_jax.collect import CollectConfig
from ct_jax.controller import ControllerConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.finetune import RecoverConfig
from ct_jax.fit import FitConfig, ValueConfig
from ct_jax.prm import PrmConfig
from ct_jax.settings import Settings, with_controller, with_fits
from ct_jax.transformer import ModelConfig

PAPER = Settings(
    model=ModelConfig(layers=4, heads=4, width=512, context=50, context_acting=200, acting="window"),
    fit=FitConfig(
        updates=75_000, batch=64, steps=50, learning_rate=4e-4, weight_decay=1e-3, warmup=10_000, precision="bfloat16"
    ),
)
"""The method as published, table I; wants a GPU."""

PUBLISHED = replace(
    PAPER,
    model=ModelConfig(layers=3, heads=4, width=128, context=32, context_acting=32, acting="window"),
    fit=FitConfig(updates=2400, batch=64, steps=32, learning_rate=4e-4, weight_decay=1e-3, warmup=320),
    value=ValueConfig(fit=FitConfig(updates=2000, batch=512, steps=1, learning_rate=1e-3, warmup=100, decay=True)),
)
"""The method as published in everything but size: a model, a memory and a number of updates for two CPU cores."""

_LIFTED = FitConfig(batch=24, steps=80, learning_rate=1e-3, weight_decay=1e-3, warmup=100, mirror=True)

CPU = replace(
    PUBLISHED,
    prm=PrmConfig(margin_m=0.3),
    collect=CollectConfig(trajectories=1000, guide="explorer", starts="maze", noise=0.5),
    model=replace(PUBLISHED.model, context=48, context_acting=48, acting="cache", dropout=0.0, actions=False),
    fit=replace(_LIFTED, updates=800),
    value=ValueConfig(fit=replace(PUBLISHED.value.fit, mirror=True)),
    recover=RecoverConfig(recoveries=250, keep="relabelled", takeover=0.01, patience=250),
    rounds=10,
    return_scale=0.75,
    clip_target_return=True,
    round_fit=replace(_LIFTED, updates=300, warmup=20),
    last_fit=replace(_LIFTED, updates=2500, warmup=20, decay=True),
)
"""The lifted method for two CPU cores: the teacher is a planner that sees only local maps; free starts; disturbances;
mirrored worlds, and recoveries in which the planner's action is imitated at every step."""

DEMO = replace(
    CPU,
    sac=SacConfig(iterations=400),
    collect=replace(CPU.collect, trajectories=500),
    fit=replace(_LIFTED, updates=340),
    value=ValueConfig(fit=replace(CPU.value.fit, updates=800)),
    recover=replace(CPU.recover, recoveries=200),
    rounds=3,
    round_fit=replace(_LIFTED, updates=120, warmup=20),
    last_fit=replace(_LIFTED, updates=460, warmup=20, decay=True),
)
"""The same in minutes."""

PRESETS = {"demo": DEMO, "cpu": CPU, "published": PUBLISHED, "paper": PAPER}
"""By name, for a robot in mazes that any controller can lead."""


def for_walker(settings: Settings, controller: ControllerConfig, *, horizon: int, calm: float) -> Settings:
    """A controller that has to balance, disturbances that leave it standing, fewer rounds; and for what lifts the
    method, a head that knows the heading and a longer memory."""
    collect = replace(settings.collect, horizon=horizon, noise=calm * settings.collect.noise)
    settings = with_controller(settings, controller)
    settings = replace(settings, collect=collect, rounds=min(settings.rounds, 6))
    if not settings.clip_target_return:
        return settings
    model = replace(settings.model, frame="heading", context=64, context_acting=64)
    return with_fits(replace(settings, model=model), steps=96)
