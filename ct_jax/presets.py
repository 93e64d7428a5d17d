"""The presets: settings for each robot."""

from collections.abc import Callable
from dataclasses import replace

from ct_envs import UserError
from ct_envs.lidar import LIDAR_CELL_M
from ct_envs.robots import get_robot
from ct_jax.collect import CollectConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.finetune import RecoverConfig
from ct_jax.fit import FitConfig, ValueConfig
from ct_jax.prm import PrmConfig
from ct_jax.settings import RoomConfig, Settings, with_fits
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
"""What lifts the method on two CPU cores: a teacher that knows no more than its pupil, free starts, disturbances,
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


_ANT_SAC = SacConfig(
    envs=128,
    iterations=32_000,
    updates=16,
    warmup=50,
    final_rate=0.1,
    average=0.9998,
    critic_norm=True,
    arrival_bonus=100.0,
    tilt_m=3.0,
    action_scale=0.4,
    greedy=0.25,
    reward_scale=0.1,
    replay=1_000_000,
    episode_steps=150,
    reset_velocity_mps=0.1,
    frame="heading",
    mirror=True,
    relabel=0.5,
    chain=True,
)


_HUMANOID_SAC = SacConfig(
    envs=64,
    iterations=40_000,
    updates=8,
    warmup=60,
    final_rate=0.1,
    average=0.9995,
    critic_norm=True,
    hidden=(256, 256),  # paper: 512, of which a core makes a quarter of the updates
    discount=0.98,
    alive_bonus=1.0,
    speed_mps=2.0,
    action_cost=0.2,
    target_rate=0.01,
    greedy=0.25,
    reward_scale=0.1,
    replay=500_000,
    episode_steps=400,
    reset_velocity_mps=0.05,
    frame="heading",
    mirror=True,
    relabel=0.25,
    chain=True,
    through=True,
    turn_ramp=(0.1, 0.3),
)

_HUMANOID_SAC_GPU = replace(_HUMANOID_SAC, envs=512, iterations=22_000, batch=2048, replay=1_500_000, hidden=(512, 512))
"""The paper's width, eight times the environments and eight times the batch, for a GPU."""


def _for_ant(settings: Settings) -> Settings:
    """The ant is half as fast as the point: longer ways, and more time before it counts as stuck."""
    settings = _for_walker(settings, _ANT_SAC, horizon=700, calm=0.2)
    recover = settings.recover
    if recover.keep == "separate":
        recover = replace(recover, stuck_steps=2 * recover.stuck_steps, patience=2 * recover.patience)
    return replace(settings, recover=recover)


def _for_humanoid(settings: Settings) -> Settings:
    """Three of its control steps are one of the ant's, and it is brought down more easily."""
    settings = _for_walker(settings, _HUMANOID_SAC, horizon=1600, calm=0.1)
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


def _for_walker(settings: Settings, sac: SacConfig, *, horizon: int, calm: float) -> Settings:
    """A controller that has to balance, disturbances that leave it standing, fewer rounds; and for what lifts the
    method, a head that knows the heading and a longer memory."""
    collect = replace(settings.collect, horizon=horizon, noise=calm * settings.collect.noise)
    settings = replace(settings, sac=sac, collect=collect, rounds=min(settings.rounds, 6))
    if not settings.clip_target_return:
        return settings
    model = replace(settings.model, frame="heading", context=64, context_acting=64)
    return with_fits(replace(settings, model=model), steps=96)


TURTLEBOT3_PAPER = Settings(
    prm=PrmConfig(samples=150, connect_m=2.0, most_samples=2400),
    collect=CollectConfig(trajectories=1000, reset_interval=25, envs=50, horizon=400),
    model=ModelConfig(
        layers=4, heads=4, width=128, context=5, context_acting=5, acting="window", map_cell_m=LIDAR_CELL_M
    ),
    fit=FitConfig(updates=15_000, batch=128, steps=5, learning_rate=1e-4, weight_decay=1e-4, warmup=10_000),
    value=ValueConfig(fit=FitConfig(updates=3000, batch=512, steps=1, learning_rate=1e-3, warmup=100, decay=True)),
    recover=RecoverConfig(recoveries=500, stuck_steps=25, stuck_m=0.15, bumps=2, patience=300),
    rounds=1,
    round_fit=FitConfig(updates=7500, batch=128, steps=5, learning_rate=1e-4, weight_decay=1e-4, warmup=100),
    episodes=25,
    rooms=RoomConfig(),
)
"""The Turtlebot3 as published, table I: F-CT."""

_TURTLEBOT3_LIFTED = replace(
    TURTLEBOT3_PAPER.fit, batch=20, steps=40, learning_rate=1e-3, warmup=100, mirror=True, decay=True
)

TURTLEBOT3_CPU = replace(
    TURTLEBOT3_PAPER,
    prm=replace(TURTLEBOT3_PAPER.prm, margin_m=0.08),
    collect=replace(TURTLEBOT3_PAPER.collect, guide="explorer", starts="maze", noise=0.3),
    model=replace(TURTLEBOT3_PAPER.model, context=25, context_acting=25, acting="cache", dropout=0.0, actions=False),
    value=ValueConfig(fit=replace(TURTLEBOT3_PAPER.value.fit, mirror=True)),
    fit=replace(_TURTLEBOT3_LIFTED, updates=4000),
    recover=replace(TURTLEBOT3_PAPER.recover, recoveries=250, keep="relabelled", takeover=0.01),
    rounds=6,
    round_fit=replace(_TURTLEBOT3_LIFTED, updates=500),
    last_fit=replace(_TURTLEBOT3_LIFTED, updates=4000),
    clip_target_return=True,
)
"""What lifts it: a teacher that knows no more than its pupil, and passes obstacles with room to spare; five seconds of
memory instead of one, in which it does not see, and so does not repeat, what it did itself; free starts, disturbances,
mirrored rooms, relabelled recoveries in six rounds; and with its rate raised and then lowered, training takes half the
updates."""

TURTLEBOT3_DEMO = replace(
    TURTLEBOT3_CPU,
    collect=replace(TURTLEBOT3_CPU.collect, trajectories=200),
    value=ValueConfig(fit=replace(TURTLEBOT3_CPU.value.fit, updates=800)),
    fit=replace(_TURTLEBOT3_LIFTED, updates=1000),
    recover=replace(TURTLEBOT3_CPU.recover, recoveries=100),
    rounds=2,
    round_fit=replace(_TURTLEBOT3_LIFTED, updates=500),
    last_fit=replace(_TURTLEBOT3_LIFTED, updates=1200),
    episodes=5,
    rooms=RoomConfig(worlds=10),
)
"""The same in minutes."""

TURTLEBOT3_PRESETS = {
    "demo": TURTLEBOT3_DEMO, "cpu": TURTLEBOT3_CPU, "published": TURTLEBOT3_PAPER, "paper": TURTLEBOT3_PAPER,
}  # fmt: skip

_OF_ROBOT: dict[str, Callable[[], dict[str, Settings]]] = {
    "point": lambda: PRESETS,
    # A gait is not learned in minutes: their demos are led by the controller that ships.
    "ant": lambda: (
        {name: _for_ant(settings) for name, settings in PRESETS.items()}
        | {"demo": replace(_for_ant(DEMO), controller="zoo")}
    ),
    "humanoid": lambda: (
        {name: _for_humanoid(settings) for name, settings in PRESETS.items()}
        | {"demo": replace(_for_humanoid(DEMO), controller="zoo")}
        | {"paper": replace(_for_humanoid(PAPER), sac=_HUMANOID_SAC_GPU)}
    ),
    "turtlebot3": lambda: TURTLEBOT3_PRESETS,
}


def get_preset(name: str, robot: str = "point") -> Settings:
    """The preset of that name for a robot. Raises UserError with the valid names."""
    presets = _OF_ROBOT[get_robot(robot).name]()
    if name not in presets:
        raise UserError(f"no preset named '{name}'; presets: {', '.join(sorted(presets))}")
    return presets[name]
