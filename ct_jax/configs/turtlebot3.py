"""The Turtlebot3 burger, in rooms: two wheels and a lidar. Its controller is known.

    ct-jax train turtlebot3 --preset demo                     # minutes on two CPU cores
    ct-jax train turtlebot3 --preset cpu                      # 41 to 97 minutes on one CPU core
    ct-jax train turtlebot3 --preset published                # 131 minutes on one CPU core; "paper" is the same

Success to expect in the published rooms: ``cpu`` 98.9 % (three models), ``published`` 41.8 % (one;
``docs/results/turtlebot3.md``).
"""

from dataclasses import replace

from ct_envs.lidar import LIDAR_CELL_M
from ct_jax.collect import CollectConfig
from ct_jax.finetune import RecoverConfig
from ct_jax.fit import FitConfig, ValueConfig
from ct_jax.prm import PrmConfig
from ct_jax.settings import RoomConfig, Settings
from ct_jax.transformer import ModelConfig

PAPER = Settings(
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

_LIFTED = replace(PAPER.fit, batch=20, steps=40, learning_rate=1e-3, warmup=100, mirror=True, decay=True)

CPU = replace(
    PAPER,
    prm=replace(PAPER.prm, margin_m=0.08),
    collect=replace(PAPER.collect, guide="explorer", starts="maze", noise=0.3),
    model=replace(PAPER.model, context=25, context_acting=25, acting="cache", dropout=0.0, actions=False),
    value=ValueConfig(fit=replace(PAPER.value.fit, mirror=True)),
    fit=replace(_LIFTED, updates=4000),
    recover=replace(PAPER.recover, recoveries=250, keep="relabelled", takeover=0.01),
    rounds=6,
    round_fit=replace(_LIFTED, updates=500),
    last_fit=replace(_LIFTED, updates=4000),
    clip_target_return=True,
)
"""The lifted method. The teacher is a planner that sees only the lidar and keeps a margin to obstacles. The memory has
five seconds instead of one, without past actions, so that the policy does not copy them. Starts are free, actions are
disturbed, and rooms are mirrored. Six rounds relabel recoveries. A learning rate that rises and then falls halves the
number of updates."""

DEMO = replace(
    CPU,
    collect=replace(CPU.collect, trajectories=200),
    value=ValueConfig(fit=replace(CPU.value.fit, updates=800)),
    fit=replace(_LIFTED, updates=1000),
    recover=replace(CPU.recover, recoveries=100),
    rounds=2,
    round_fit=replace(_LIFTED, updates=500),
    last_fit=replace(_LIFTED, updates=1200),
    episodes=5,
    rooms=RoomConfig(worlds=10),
)
"""The same in minutes."""

PRESETS = {
    "demo": DEMO, "cpu": CPU, "published": PAPER, "paper": PAPER,
}  # fmt: skip
