"""Overrides of the presets that several robots in mazes share; each robot's file says which variants have them."""

BC = {"model.returns": False}
# Without fine-tuning: all updates of the last training at once, with timesteps shifted at random.
CT = {"rounds": 0, "fit.updates": 2500, "fit.warmup": 20, "fit.decay": True, "fit.shift_timestep": 300}
LONG_CT = CT | {"fit.updates": 5000}
LONG = {"last_fit.updates": 5000}  # twice the updates in the last training
MODES_CT = CT | {"model.modes": 4}
MODES = {"model.modes": 4, "model.commitment": 3.0}  # Commitment only for models that learned from failures.
CALM = {"controller_action_scale": 0.75}  # walkers fall less; chosen in the training maze
ROAM = {"recover.random_mazes": 100}  # CT trained in one maze; recoveries also from random mazes
# Also trajectories and recoveries from 100 random mazes. CT and F-CT have the same total number of updates.
MAZES = {
    "random_mazes": 100, "collect.trajectories": 2500, "collect.reset_interval": 10, "rounds": 6,
    "fit.updates": 600, "fit.shift_timestep": 300, "round_fit.updates": 200, "round_fit.shift_timestep": 300,
    "last_fit.updates": 2400, "last_fit.shift_timestep": 300,
}  # fmt: skip
MAZES_CT = MAZES | {"rounds": 0, "fit.updates": 4000, "fit.decay": True}
