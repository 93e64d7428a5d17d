"""The paper's experiment for the point robot: train in ``antmaze-large``, evaluate there and in ``antmaze-large-eval``.

    python experiments/point.py [--preset cpu|demo|paper] [--seeds 0 1 2]

With ``--preset cpu`` each row of the paper's table is trained at the CPU's size on 1000 guided trajectories: CT as
published, BC-CT, F-CT, PT-CQL and SAC alone, and the preset with what lifts it, which is what ``zoo:point`` ships
(expect 100 % and 92 % of it); planner and explorer stand beside them. All of them meet the same 100 start-goal pairs.
Writes ``experiments/results/point-PRESET.json``.
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
    """demo, cpu or paper."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trained models."""
    variants: tuple[str, ...] = ()
    """Rows to run: published, bc, f-ct, cpu, baselines (which need published). By default all."""
    out: Path = Path("runs/point")
    """Folder of the runs; what is finished there is not run again."""
    engine: str = "auto"
    """Physics: auto, mjx or mujoco."""


def main(options: Options) -> None:
    """Run the experiment."""
    plan = plan_for("point", options.preset, controller="own", variants=options.variants)
    rows = run_plan("point", plan, preset=options.preset, seeds=options.seeds, out=options.out, engine=options.engine)
    write_results(RESULTS / f"point-{options.preset}.json", " ".join(["python", *sys.argv]), rows)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
