"""The paper's experiment for the point robot: train in ``antmaze-large``, evaluate there and in ``antmaze-large-eval``.

    python experiments/point.py [--preset cpu|demo|paper] [--seeds 0 1 2] [--variants published cpu]

With ``--preset cpu`` each row of the paper's table is trained at the CPU's size on 1000 guided trajectories: CT as
published, BC-CT, F-CT, PT-CQL and SAC alone, and what lifts it without (``cpu-ct``) and with fine-tuning (``cpu``);
planner and explorer stand beside them. All of them meet the same 100 start-goal pairs. ``zoo:point`` is ``mazes-ct``,
with trajectories of 100 random mazes besides. Writes ``experiments/results/point-PRESET.json``.
"""

from _variants import experiment

from ct_jax.cli import leave

if __name__ == "__main__":
    leave(experiment("point", __doc__))
