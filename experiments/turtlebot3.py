"""The paper's experiment for the Turtlebot3: 20 random cluttered rooms in PyBullet, with 25 pairs in each.

    python experiments/turtlebot3.py [--preset cpu|demo|published] [--seeds 0 1 2] [--variants ct cpu] [--no-sweeps]

The variants, with each seed: CT, BC-CT and F-CT as published (``ct``, ``bc-ct``, ``f-ct``), on the same 1000 planning
trajectories; the lifted method without and with fine-tuning (``cpu-ct``, ``cpu``); ``cpu-ct`` conditioned on V itself
(``cpu-ct-v``), or with past actions as inputs (``cpu-ct-actions``); both trained with noise (``noise-ct``, ``noise``);
``cpu`` trained in rooms of many densities (``dense``). Planner and explorer are evaluated too.

Some variants of the first seed are also evaluated in rooms with 0.5 to 2 times the published density, with 0 to 2 times
the errors of a real robot, and on the paper's seven pairs in one fixed room.

The same command continues an interrupted run. Writes ``experiments/results/turtlebot3-PRESET.json``, and keeps the rows
of other seeds and variants.
"""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from rows import CT, LISTS, RESULTS, Results, Row, add_results
from study import Options, Study, Variant, about, choose, keep_once, label, show_results

from ct_jax.cli import guarded, leave
from ct_jax.evaluate import GUIDED
from ct_jax.model import TrainedModel, load_model
from ct_jax.pipeline import answer, measured
from ct_jax.runtime.files import make_folder, prepare_outputs
from ct_jax.runtime.run import Run
from ct_jax.worlds.room_runs import Request, SevenPairs, grades

DENSITIES = (0.5, 1.5, 2.0)  # in addition to 1, which all variants have
LEVELS = (0.5, 1.0, 2.0)  # in addition to 0, which all variants have
SEVEN_LEVELS = (0.0, 1.0)
SWEEPS = LISTS[1:]
SWEPT_PAIRS = 10  # in each room of a sweep

# No fine-tuning. The target return is half of V, and timesteps are shifted at random.
LIFTED_CT = {"rounds": 0, "return_scale": 0.5, "fit.shift_timestep": 300}
NOISE = {"rooms.noise": 1.0}  # the errors of a real robot, in training
DENSE = {"rooms.density": min(DENSITIES), "rooms.densest": max(DENSITIES)}

SHIPPED = "cpu"  # the variant of zoo:turtlebot3

VARIANTS = {
    "ct": Variant("published", {"rounds": 0}),
    "bc-ct": Variant("published", {"rounds": 0, "model.returns": False}),
    "f-ct": Variant("published", tuned_from="ct"),
    "cpu-ct": Variant("cpu", LIFTED_CT, sweeps=SWEEPS),
    "cpu-ct-v": Variant("cpu", LIFTED_CT | {"return_scale": 1.0}),
    "cpu-ct-actions": Variant("cpu", LIFTED_CT | {"model.actions": True}),
    "cpu": Variant("cpu", tuned_from="cpu-ct", sweeps=SWEEPS),
    "noise-ct": Variant("cpu", LIFTED_CT | NOISE, sweeps=("noise", "seven")),
    "noise": Variant("cpu", NOISE, tuned_from="noise-ct", sweeps=("noise", "seven")),
    "dense": Variant("cpu", DENSE, tuned_from="cpu-ct", sweeps=("density",)),
}


@dataclass(frozen=True)
class RoomOptions(Options):
    """What to run in rooms."""

    out: Path = Path("runs/turtlebot3")
    """Folder of the runs. Finished runs are not repeated."""
    sweeps: bool = True
    """Also evaluate at other densities, at other levels of noise, and on the seven pairs."""


def run_all(options: RoomOptions) -> Path:
    """Train and evaluate everything with each seed, and continue unfinished runs; returns the results file."""
    file = RESULTS / f"turtlebot3-{options.preset}.json"
    prepare_outputs(file)
    chosen = choose(VARIANTS, options.preset, options.variants)
    study = Study(robot="turtlebot3", preset=options.preset, out=options.out)
    study.run(chosen, options.seeds, lambda found: add_results(file, found))
    swept = {name: variant for name, variant in chosen.items() if variant.sweeps} if options.sweeps else {}
    for name, variant in swept.items():
        run = study.make_run(name, variant, options.seeds[0])
        for kind, row in sweep(run, name, variant.sweeps, references=name == next(iter(swept))):
            add_results(file, replace(Results(), **{kind: [row]}))
    return file


def sweep(run: Run, name: str, kinds: tuple[str, ...], *, references: bool) -> Iterator[tuple[str, Row]]:
    """Rows of the given kinds: other densities, levels of noise, and the seven pairs."""
    model, settings = load_model(str(run.folder)), run.settings
    kept, seed = run.folder / "sweeps", settings.pairs_seed
    make_folder(kept)
    assert settings.rooms is not None
    where = {"worlds": settings.rooms.worlds, "pairs": min(SWEPT_PAIRS, settings.episodes)}
    for method in (CT, *(GUIDED if references else ())):
        for kind in kinds:
            points, measure = _MEASURES[kind]
            for at in points:
                file = kept / f"{kind}-{at}-{method}.json"
                values = keep_once(file, functools.partial(measure, model, method, seed, at, where))
                yield kind, label(run, name, values)


def seven_pairs(model: TrainedModel, method: str, noise: float) -> dict[str, Any]:
    """The paper's protocol on the real robot, counted as the paper counts."""
    with SevenPairs(noise).open(model) as trial:
        episodes = measured(trial, method, policy=model.policy, controller=model.controller)
        head = {"robot": model.robot, "method": method} | trial.head
    return head | grades(episodes) | episodes.summary()


Measure = Callable[[TrainedModel, str, int, float, dict[str, int]], dict[str, Any]]
_MEASURES: dict[str, tuple[tuple[float, ...], Measure]] = {
    "density": (
        DENSITIES, lambda model, method, seed, at, where: answer(Request(density=at, **where), model, method, seed),
    ),
    "noise": (
        LEVELS, lambda model, method, seed, at, where: answer(Request(noise=at, **where), model, method, seed),
    ),
    "seven": (SEVEN_LEVELS, lambda model, method, seed, at, where: seven_pairs(model, method, at)),
}  # fmt: skip


def run() -> None:
    """Run the experiment from the command line."""
    show_results(run_all(tyro.cli(RoomOptions, description=about(__doc__, VARIANTS))))


if __name__ == "__main__":
    leave(guarded(run))
