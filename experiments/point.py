"""The paper's experiment for the point robot: train in ``antmaze-large``, evaluate there and in ``antmaze-large-eval``.

    python experiments/point.py [--preset cpu|demo|paper] [--seeds 0]

With ``--preset cpu`` (two cores, 50 minutes) each row of ``VARIANTS`` is trained: the method as published at the CPU's
size, and the preset itself, which is what ``zoo:point`` ships; expect 100 % and 92 % of it. All of them meet the same
100 start-goal pairs. Writes ``experiments/results/point-PRESET.json``.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from _variants import RESULTS, run_variants, write_results

from ct_jax.cli import guarded
from ct_jax.presets import CPU, PUBLISHED, Settings, get_preset

VARIANTS: dict[str, Settings] = {
    "published": PUBLISHED,
    "cpu": CPU,
}


@dataclass(frozen=True)
class Options:
    """What to run."""

    preset: str = "cpu"
    """demo, cpu or paper."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trained models."""
    out: Path = Path("runs/point")
    """Folder of the runs; what is finished there is not run again."""
    engine: str = "auto"
    """Physics: auto, mjx or mujoco."""


def main(options: Options) -> None:
    """Run the experiment."""
    settings = get_preset(options.preset)
    variants = VARIANTS if options.preset == "cpu" else {options.preset: settings}
    rows = run_variants(
        "point", variants, preset=options.preset, seeds=options.seeds, out=options.out, engine=options.engine
    )
    write_results(RESULTS / f"point-{options.preset}.json", " ".join(["python", *sys.argv]), rows)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
