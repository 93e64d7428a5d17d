"""The paper's experiment for the ant: train in ``antmaze-large``, evaluate there and in ``antmaze-large-eval``.

    python experiments/ant.py [--preset cpu|demo|paper] [--seeds 0 1 2] [--controller own|zoo]

With ``--preset cpu`` each row of the paper's table is trained at the CPU's size on 1000 guided trajectories: CT as
published, BC-CT, F-CT, PT-CQL and SAC alone, and what lifts it without and with fine-tuning; planner and explorer stand
beside them. All of them meet the same 100 start-goal pairs. A controller of one's own is what takes longest on two
cores; ``zoo`` takes the shipped one. Writes ``experiments/results/ant-PRESET.json``.
"""

from _variants import experiment

from ct_jax.cli import leave

if __name__ == "__main__":
    leave(experiment("ant", __doc__))
