"""The paper's experiment for the ant: train in ``antmaze-large``, evaluate there and in ``antmaze-large-eval``.

    python experiments/ant.py [--preset cpu|demo|paper] [--seeds 0 1 2] [--controller own|zoo]

With ``--preset cpu`` each row of the paper's table is trained at the CPU's size on 1000 guided trajectories: CT as
published, BC-CT, F-CT, PT-CQL and SAC alone, and the preset with what lifts it; planner and explorer stand beside them.
All of them meet the same 100 start-goal pairs. A controller of one's own takes half an hour on two cores; ``zoo`` takes
the shipped one. Writes ``experiments/results/ant-PRESET.json``.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from _variants import RESULTS, plan_for, run_plan, write_results

from ct_jax.cli import guarded


@dataclass(frozen=True)
class Options:
    """What to run."""

    preset: str = "cpu"
    """demo, cpu, published or paper."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trained models."""
    variants: tuple[str, ...] = ()
    """Rows to run: published, bc, f-ct, cpu, baselines (which need published). By default all."""
    controller: str = "own"
    """own, zoo, or a run folder."""
    out: Path = Path("runs/ant")
    """Folder of the runs; what is finished there is not run again."""
    engine: str = "auto"
    """Physics: auto, mjx or mujoco."""


def main(options: Options) -> None:
    """Run the experiment."""
    plan = plan_for("ant", options.preset, controller=options.controller, variants=options.variants)
    rows = run_plan("ant", plan, preset=options.preset, seeds=options.seeds, out=options.out, engine=options.engine)
    write_results(RESULTS / f"ant-{options.preset}.json", " ".join(["python", *sys.argv]), rows)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
