"""Overrides that the variants of several robots share. The robots' files list the variants."""

BC = {"model.returns": False}
# No fine-tuning. One training with all updates, and randomly shifted timesteps.
CT = {"rounds": 0, "fit.updates": 2500, "fit.warmup": 20, "fit.decay": True, "fit.shift_timestep": 300}
LONG_CT = CT | {"fit.updates": 5000}
LONG = {"last_fit.updates": 5000}  # twice the updates in the last training
MODES_CT = CT | {"model.modes": 4}
MODES = {"model.modes": 4, "model.commitment": 3.0}  # commitment only for models that are trained on recoveries
CALM = {"controller_action_scale": 0.75}  # ant and humanoid fall less often; chosen in the training maze
ROAM = {"recover.random_mazes": 100}  # trajectories from one maze; recoveries also from random mazes
# Trajectories and recoveries also come from 100 random mazes. CT and F-CT have the same total number of updates.
MAZES = {
    "random_mazes": 100, "collect.trajectories": 2500, "collect.reset_interval": 10, "rounds": 6,
    "fit.updates": 600, "fit.shift_timestep": 300, "round_fit.updates": 200, "round_fit.shift_timestep": 300,
    "last_fit.updates": 2400, "last_fit.shift_timestep": 300,
}  # fmt: skip
MAZES_CT = MAZES | {"rounds": 0, "fit.updates": 4000, "fit.decay": True}
