"""The paper's experiment for the Turtlebot3: cluttered rooms in PyBullet, 20 random ones with 25 pairs each.

    python experiments/turtlebot3.py [--preset cpu|demo|published] [--seeds 0 1 2] [--variants ct bc-ct f-ct cpu noise]

With each seed: CT, BC-CT and F-CT as published on the same 1000 planning trajectories, what lifts them (``cpu``), the
same trained with noise, and planner and explorer beside them. F-CT and its lifted forms then meet rooms of 0.5 to 2
times the density of training, sensors and motion of 0 to 2 times a real robot's errors, and the paper's seven pairs in
one fixed room. Everything finished is kept: the same command goes on. Writes
``experiments/results/turtlebot3-PRESET.json`` and the plots ``docs/turtlebot3-density.png`` and ``-noise.png``.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results"
DENSITIES = (0.5, 1.0, 1.5, 2.0)
LEVELS = (0.0, 0.5, 1.0, 1.5, 2.0)
SEVEN_LEVELS = (0.0, 1.0)
SWEPT = ("ct", "f-ct", "cpu", "noise")  # variants that meet other densities and levels of noise
REFERENCES = ("planner", "explorer")


@dataclass(frozen=True)
class Options:
    """What to run."""

    preset: str = "cpu"
    """cpu (published and lifted rows), or the name of one preset alone."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trained models."""
    variants: tuple[str, ...] = ()
    """Rows to run: ct, bc-ct, f-ct, cpu, noise. By default all."""
    out: Path = Path("runs/turtlebot3")
    """Folder of the runs; what is finished there is not run again."""


def variants_for(preset: str, chosen: tuple[str, ...] = ()) -> dict[str, Any]:
    """The rows of the table: settings by name, each after those whose stages it shares.

    Raises:
        UserError: a variant that the preset does not have.
    """
    from ct_envs import UserError
    from ct_jax.presets import get_preset

    lifted = get_preset(preset, "turtlebot3")
    assert lifted.rooms is not None
    known = {preset: lifted}
    if preset == "cpu":
        published = get_preset("published", "turtlebot3")
        ct = replace(published, rounds=0)
        known = {
            "ct": ct,
            "bc-ct": replace(ct, model=replace(ct.model, returns=False)),
            "f-ct": published,
            "cpu": lifted,
            "noise": replace(lifted, rooms=replace(lifted.rooms, noise=1.0)),
        }
    for name in chosen:
        if name not in known:
            raise UserError(f"no variant named '{name}' with preset '{preset}'; variants: {', '.join(known)}")
    return {name: settings for name, settings in known.items() if not chosen or name in chosen}


def run_all(options: Options) -> dict[str, Any]:
    """Train and evaluate everything with each seed, continuing what is there; returns what the results file holds."""
    from _variants import label, outcomes, share

    from ct_jax import pipeline
    from ct_jax.model import load_model
    from ct_jax.run import Run

    rows: list[dict[str, Any]] = []
    sweeps: dict[str, list[dict[str, Any]]] = {"density": [], "noise": [], "seven": []}
    for seed in options.seeds:
        before: list[Run] = []
        for name, settings in variants_for(options.preset, options.variants).items():
            folder = options.out / f"{name}-{seed}"
            run = Run(folder, "turtlebot3", options.preset, settings, {}, {}, seed, "auto")
            print(f"== turtlebot3: {name}, seed {seed}, in {folder}", file=sys.stderr)
            for other in before:
                share(other, run)
            pipeline.train(run, resume=True)
            before.append(run)
            first = len(before) == 1 and seed == options.seeds[0]
            found = [row for row in pipeline.results(folder) if first or row["method"] not in REFERENCES]
            rows += [label(run, name, row | outcomes(folder / "evaluate", row)) for row in found]
            if name in SWEPT or name == options.preset:
                model = load_model(str(folder))
                for kind, found in _sweep(folder, model, settings, references=first).items():
                    sweeps[kind] += [label(run, name, row) for row in found]
    return {"rows": rows, **sweeps}


def _sweep(folder: Path, model: Any, settings: Any, *, references: bool) -> dict[str, list[dict[str, Any]]]:
    """Other densities, levels of noise, and the seven pairs."""
    from ct_jax.rooms import evaluate_in_rooms, evaluate_seven_pairs

    where = {"worlds": settings.rooms.worlds, "pairs": settings.episodes}
    seed = settings.pairs_seed
    methods = ("ct", *REFERENCES) if references else ("ct",)
    kept = folder / "sweeps"
    kept.mkdir(exist_ok=True)
    found: dict[str, list[dict[str, Any]]] = {"density": [], "noise": [], "seven": []}
    for method in methods:
        for density in DENSITIES:
            row = _kept(
                kept / f"density-{density}-{method}.json",
                lambda m=method, d=density: evaluate_in_rooms(model, m, seed, density=d, **where),
            )
            found["density"].append(row)
        for level in LEVELS:
            row = _kept(
                kept / f"noise-{level}-{method}.json",
                lambda m=method, f=level: evaluate_in_rooms(model, m, seed, noise=f, **where),
            )
            found["noise"].append(row)
        for level in SEVEN_LEVELS:
            row = _kept(
                kept / f"seven-{level}-{method}.json", lambda m=method, f=level: evaluate_seven_pairs(model, m, noise=f)
            )
            found["seven"].append(row)
    return found


def _kept(file: Path, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    from ct_jax.checkpoint import read_json, write_json

    if not file.is_file():
        write_json(file, measure())
    return read_json(file)


def draw_sweep(rows: list[dict[str, Any]], axis: str, label: str, file: Path) -> None:
    """Plot success against ``axis``, a line for each variant and reference, with 95 % intervals of all its models."""
    from matplotlib.figure import Figure

    from ct_jax.evaluate import wilson_of

    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    ax = figure.add_subplot()
    lines: dict[str, dict[float, list[tuple[int, int]]]] = {}
    for row in rows:
        name = row["variant"] if row["method"] == "ct" else row["method"]
        counts = round(row["success_rate"] * row["episodes"]), row["episodes"]
        lines.setdefault(name, {}).setdefault(row[axis], []).append(counts)
    for name, points in lines.items():
        x = sorted(points)
        won, of = (([sum(count[i] for count in points[at]) for at in x]) for i in (0, 1))
        rate = [100 * w / n for w, n in zip(won, of, strict=True)]
        ends = [wilson_of(w, n) for w, n in zip(won, of, strict=True)]
        error = [[max(r - 100 * low, 0) for r, (low, _) in zip(rate, ends, strict=True)],
                 [max(100 * high - r, 0) for r, (_, high) in zip(rate, ends, strict=True)]]  # fmt: skip
        ax.errorbar(x, rate, yerr=error, marker="o", capsize=3, label=name)
    ax.set(xlabel=label, ylabel="success [%]", ylim=(0, 102))
    ax.grid(alpha=0.3)
    ax.legend()
    file.parent.mkdir(exist_ok=True)
    figure.savefig(file, dpi=150)


def main() -> int:
    """Run the experiment from the command line; returns the exit status."""
    import tyro

    from ct_jax.checkpoint import write_json
    from ct_jax.cli import guarded, prepare_jax, print_rows
    from ct_jax.run import provenance

    def run() -> None:
        options = tyro.cli(Options, description=__doc__)
        prepare_jax()
        found = run_all(options)
        file = RESULTS / f"turtlebot3-{options.preset}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, {"command": provenance()["command"], **found})
        for axis, label in (("density", "density of obstacles / that of training"), ("noise", "level of noise")):
            draw_sweep(found[axis], axis, label, ROOT / "docs" / f"turtlebot3-{axis}.png")
        print_rows([row | {"method": f"{row['variant']}: {row['method']}"} for row in found["rows"]])
        print(f"results: {file}")

    return guarded(run)


if __name__ == "__main__":
    from ct_jax.cli import leave

    leave(main())
