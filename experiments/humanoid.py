"""The paper's experiment for the humanoid: train in ``antmaze-large``, evaluate there, in ``antmaze-large-eval`` and in
``hall``.

    python experiments/humanoid.py [--preset cpu|demo|paper] [--seeds 0 1 2] [--controller own|zoo]

With ``--preset cpu`` each row of the paper's table is trained at the CPU's size on 1000 guided trajectories: CT as
published, BC-CT, F-CT, PT-CQL and SAC alone, and what lifts it without and with fine-tuning; planner and explorer stand
beside them. All of them meet the same 100 start-goal pairs. A controller of one's own takes hours of a core and can be
interrupted at any time; ``--controller RUN`` takes that of a run. Writes ``experiments/results/humanoid-PRESET.json``.
"""

from _variants import experiment

from ct_jax.cli import leave

if __name__ == "__main__":
    leave(experiment("humanoid", __doc__))
