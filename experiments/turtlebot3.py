"""The paper's experiment for the Turtlebot3: cluttered rooms in PyBullet, 20 random ones with 25 pairs each.

    python experiments/turtlebot3.py [--preset cpu|demo|published] [--seeds 0 1 2] [--variants ct cpu] [--no-sweeps]

With each seed: CT, BC-CT and F-CT as published on the same 1000 planning trajectories, what lifts F-CT (``cpu``) and
CT (``cpu-ct``), the latter when it asks for all of the predicted return (``cpu-ct-v``) or sees its own past actions
(``cpu-ct-actions``), both trained with noise (``noise``, ``noise-ct``), the former in rooms of many densities
(``dense``), and planner and explorer beside them.
The lifted ones of the first seed then meet rooms of 0.5 to 2 times the published density, sensors and motion of 0 to 2
times a real robot's errors, and the paper's seven pairs in one fixed room.
Everything finished is kept: the same command goes on.
Writes ``experiments/results/turtlebot3-PRESET.json``, in which rows of other seeds and variants stay, and the plots
``docs/turtlebot3-density.png`` and ``-noise.png``.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results"
DENSITIES = (0.5, 1.5, 2.0)  # besides 1, in which every variant is measured
LEVELS = (0.5, 1.0, 2.0)  # besides 0
SEVEN_LEVELS = (0.0, 1.0)
SWEEPS = ("density", "noise", "seven")
SWEPT = {  # what variants meet
    "cpu-ct": SWEEPS, "cpu": SWEEPS, "noise-ct": ("noise", "seven"), "noise": ("noise", "seven"), "dense": ("density",),
}  # fmt: skip
SWEPT_PAIRS = 10  # in each room of those


@dataclass(frozen=True)
class Options:
    """What to run."""

    preset: str = "cpu"
    """cpu (published and lifted rows), or the name of one preset alone."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trained models."""
    variants: tuple[str, ...] = ()
    """Rows to run: ct, bc-ct, f-ct, cpu-ct, cpu-ct-v, cpu-ct-actions, cpu, noise-ct, noise, dense. By default all."""
    sweeps: bool = True
    """Also other densities, levels of noise, and the seven pairs."""
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
        lifted_ct = replace(lifted, rounds=0, optimism=0.5, fit=replace(lifted.fit, shift_timestep=300))
        known = {
            "ct": ct,
            "bc-ct": replace(ct, model=replace(ct.model, returns=False)),
            "f-ct": published,
            "cpu-ct": lifted_ct,
            "cpu-ct-v": replace(lifted_ct, optimism=1.0),
            "cpu-ct-actions": replace(lifted_ct, model=replace(lifted.model, actions=True)),
            "cpu": lifted,
            "noise-ct": replace(lifted_ct, rooms=replace(lifted.rooms, noise=1.0)),
            "noise": replace(lifted, rooms=replace(lifted.rooms, noise=1.0)),
            "dense": replace(lifted, rooms=replace(lifted.rooms, density=min(DENSITIES), densest=max(DENSITIES))),
        }
    for name in chosen:
        if name not in known:
            raise UserError(f"no variant named '{name}' with preset '{preset}'; variants: {', '.join(known)}")
    return {name: settings for name, settings in known.items() if not chosen or name in chosen}


def run_all(options: Options) -> Path:
    """Train and evaluate everything with each seed, continuing what is there; returns the results file."""
    from _variants import Plan, label, run_plan, write_results

    from ct_jax.model import load_model
    from ct_jax.run import Run

    file = RESULTS / f"turtlebot3-{options.preset}.json"
    variants = variants_for(options.preset, options.variants)
    run_plan(
        "turtlebot3", Plan(variants), preset=options.preset, seeds=options.seeds, out=options.out,
        keep=lambda found: write_results(file, found),
    )  # fmt: skip
    swept = {name: SWEPT.get(name, SWEEPS) for name in variants if name in SWEPT or name == options.preset}
    for name, kinds in swept.items() if options.sweeps else ():
        folder = options.out / f"{name}-{options.seeds[0]}"
        run = Run(folder, "turtlebot3", options.preset, variants[name], {}, {}, options.seeds[0], "auto")
        model, references = load_model(str(folder)), name == next(iter(swept))
        for kind, row in _sweep(folder, model, variants[name], kinds, references=references):
            write_results(file, {kind: [label(run, name, row)]})
    return file


def _sweep(
    folder: Path, model: Any, settings: Any, kinds: tuple[str, ...], *, references: bool
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of those kinds: other densities, levels of noise, and the seven pairs."""
    from ct_jax.evaluate import GUIDED
    from ct_jax.rooms import evaluate_in_rooms, evaluate_seven_pairs

    kept, seed = folder / "sweeps", settings.pairs_seed
    kept.mkdir(exist_ok=True)
    where = {"worlds": settings.rooms.worlds, "pairs": min(SWEPT_PAIRS, settings.episodes)}
    measures: dict[str, tuple[tuple[float, ...], Callable[[str, float], dict[str, Any]]]] = {
        "density": (DENSITIES, lambda method, at: evaluate_in_rooms(model, method, seed, density=at, **where)),
        "noise": (LEVELS, lambda method, at: evaluate_in_rooms(model, method, seed, noise=at, **where)),
        "seven": (SEVEN_LEVELS, lambda method, at: evaluate_seven_pairs(model, method, noise=at)),
    }
    for method in ("ct", *(GUIDED if references else ())):
        for kind in kinds:
            points, measure = measures[kind]
            for at in points:
                yield kind, _kept(kept / f"{kind}-{at}-{method}.json", lambda m=method, a=at, f=measure: f(m, a))


def _kept(file: Path, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    from _variants import origin

    from ct_jax.checkpoint import read_json, write_json
    from ct_jax.run import provenance

    if not file.is_file():
        write_json(file, measure() | origin(provenance()))
    return read_json(file)


def draw_sweep(rows: list[dict[str, Any]], axis: str, label: str, file: Path) -> None:
    """Plot success against ``axis``, a line for each variant and reference, with 95 % intervals of all its models."""
    from matplotlib.figure import Figure
    from table import line_of, rate_of

    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    ax = figure.add_subplot()
    lines: dict[str, dict[float, list[dict[str, Any]]]] = {}
    for row in rows:
        lines.setdefault(line_of(row), {}).setdefault(row[axis], []).append(row)
    apart = 0.008 * np.ptp([row[axis] for row in rows])  # so that no interval hides another
    lowest = 100.0
    for i, (name, points) in enumerate(lines.items()):
        x = np.array(sorted(points))
        rate, low, high = np.array([rate_of(points[at], "success") for at in x]).T
        error = np.maximum([rate - low, high - rate], 0.0)
        ax.errorbar(x + apart * (i - (len(lines) - 1) / 2), rate, yerr=error, marker="o", ms=4, capsize=2, label=name)
        lowest = min(lowest, *low)
    ax.set(xlabel=label, ylabel="success [%]", ylim=(max(0.0, 10 * np.floor(lowest / 10 - 0.5)), 101))
    ax.grid(alpha=0.3)
    ax.legend()
    file.parent.mkdir(exist_ok=True)
    figure.savefig(file, dpi=150)


def main() -> int:
    """Run the experiment from the command line; returns the exit status."""
    import tyro
    from _variants import show_results
    from table import line_of

    from ct_jax.checkpoint import read_json
    from ct_jax.cli import guarded

    def run() -> None:
        options = tyro.cli(Options, description=__doc__)
        file = run_all(options)
        found = read_json(file)
        for axis, label in (("density", "density of obstacles / the published"), ("noise", "level of noise")):
            if axis in found:
                swept = {line_of(row) for row in found[axis]}
                rows = found[axis] + [row for row in found["rows"] if line_of(row) in swept]
                draw_sweep(rows, axis, label, ROOT / "docs" / f"turtlebot3-{axis}.png")
        show_results(file)

    return guarded(run)


if __name__ == "__main__":
    from ct_jax.cli import leave

    leave(main())
