"""Train and evaluate the variants of a robot with each seed. A variant is a preset with overrides.

A finished run is not repeated, and an interrupted run is continued. Runs share stages with the same inputs. The inputs
are compared by their digests.
"""

import functools
import hashlib
import importlib
import json
import shutil
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np
import tyro
from rows import CT, RESULTS, Results, Row, Unmade, add_results, origin_of

from ct_envs import UserError
from ct_envs.checked import Checked
from ct_envs.robots import get_robot
from ct_jax import pipeline
from ct_jax.baselines import baseline_of, get_baseline
from ct_jax.cli import guarded, leave, prepare_jax, print_rows
from ct_jax.configs import get_preset
from ct_jax.evaluate import GUIDED
from ct_jax.finetune import NoRecoveryError
from ct_jax.model import PARTS, load_controller
from ct_jax.runtime.checkpoint import read_json, write_json
from ct_jax.runtime.files import prepare_outputs
from ct_jax.runtime.progress import Metrics
from ct_jax.runtime.run import (
    Run,
    as_json,
    default_mazes,
    episodes_file,
    identity,
    load_mazes,
    open_run,
    provenance,
)
from ct_jax.runtime.terminal import printable
from ct_jax.settings import Settings, to_dict
from ct_jax.worlds import kind_of

# -------------------------------------------------------------------------------------------------------- variants


@dataclass(frozen=True)
class Variant:
    """A row of a robot's table: a preset and its overrides."""

    preset: str
    """"published" (at the size of --preset) or "cpu"."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Overrides by dotted name, such as "model.modes"; a value can be a function of the preset."""
    label: str = ""
    """Name in tables (default: CT or F-CT with the variant's name)."""
    tuned_from: str | None = None
    """For a fine-tuned variant: the variant before fine-tuning."""
    baseline: Checked | None = None
    """Baseline to train instead of a transformer: CQL on the run's data, or SAC without data."""
    sweeps: tuple[str, ...] = ()
    """Turtlebot3: further evaluations: "density", "noise", "seven"."""

    def settings(self, robot: str, preset: str = "cpu") -> Settings:
        """The settings of the variant's runs with ``--preset preset``."""
        size = "published" if preset == "cpu" else preset
        base = get_preset(size if self.preset == "published" else self.preset, robot)
        settings = base
        for name, value in self.changes.items():
            settings = _set(settings, name.split("."), value(base) if callable(value) else value)
        return settings


def _set(config: Any, path: list[str], value: Any) -> Any:
    """A copy of a frozen dataclass with another value at a path of field names."""
    name, *below = path
    return replace(config, **{name: _set(getattr(config, name), below, value) if below else value})


def half_the_updates(published: Settings) -> Any:
    """Training in a round of fine-tuning as published. The paper gives no length; ours is half of the first."""
    return replace(published.fit, updates=published.fit.updates // 2, warmup=20)


def baseline_config(name: str, robot: str) -> Any:
    """The settings of a baseline for the preset "cpu"."""
    return get_baseline(name).config_for(get_preset("cpu", robot), get_robot(robot))


def load_variants(robot: str) -> dict[str, Variant]:
    """The variants in a robot's file. Raises UserError for a robot without a file."""
    if robot not in ROBOTS:
        raise UserError(f"no experiment for robot '{robot}'; robots: {', '.join(ROBOTS)}")
    return importlib.import_module(robot).VARIANTS


ROBOTS = ("point", "ant", "humanoid", "turtlebot3")


def choose(variants: Mapping[str, Variant], preset: str, names: tuple[str, ...] = ()) -> dict[str, Variant]:
    """The variants of a preset, or only those with the given names, in the order of the robot's file.

    "cpu" has all variants. "published" and "paper" have the published variants, at their size. "demo" has one variant.

    Raises:
        UserError: the preset has no variant with a given name.
    """
    known = dict(variants)
    if preset == "demo":
        known = {preset: Variant(preset)}
    elif preset != "cpu":
        known = {name: variant for name, variant in variants.items() if variant.preset == "published"}
    for name in names:
        if name not in known:
            raise UserError(f"no variant named '{name}' with preset '{preset}'; variants: {', '.join(known)}")
    return {name: variant for name, variant in known.items() if not names or name in names}


# ---------------------------------------------------------------------------------------------------- command line


@dataclass(frozen=True)
class Options:
    """What to run."""

    preset: str = "cpu"
    """demo, cpu, published or paper."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trained models."""
    variants: tuple[str, ...] = ()
    """Variants to run (default: all of the preset)."""
    out: Path | None = None
    """Folder of the runs (default: runs/ROBOT). Finished runs are not repeated."""


@dataclass(frozen=True)
class MazeOptions(Options):
    """What to run in mazes."""

    controller: str = "own"
    """Low-level controller: own, zoo, or a run folder."""
    engine: str = "auto"
    """Physics: auto, mjx or mujoco."""


def about(docstring: str | None, variants: Mapping[str, Variant]) -> str:
    """The --help text of an experiment."""
    return f"{docstring}\nvariants: {', '.join(variants)}"


def main(robot: str, variants: Mapping[str, Variant], docstring: str | None) -> NoReturn:
    """The command line of a maze robot's experiment."""

    def run() -> None:
        options = tyro.cli(MazeOptions, description=about(docstring, variants))
        file = RESULTS / f"{robot}-{options.preset}.json"
        prepare_outputs(file)
        study = Study(
            robot=robot, preset=options.preset, out=options.out or Path("runs") / robot, engine=options.engine,
            controller=options.controller,
        )  # fmt: skip
        study.run(
            choose(variants, options.preset, options.variants), options.seeds, lambda found: add_results(file, found)
        )
        show_results(file)

    leave(guarded(run))


def show_results(file: Path) -> None:
    """Print the rows of a results file."""
    print_rows([row.values() | {"method": f"{row.variant}: {row.method}"} for row in Results.read(file).rows])
    print(f"results: {file}\npages:   python experiments/pages.py writes them to docs/results")


# ----------------------------------------------------------------------------------------------------------- study


@dataclass(frozen=True)
class Study:
    """Runs of one robot in one folder."""

    robot: str
    preset: str
    out: Path
    engine: str = "auto"
    controller: str = "own"

    def make_run(self, name: str, variant: Variant, seed: int) -> Run:
        """The run of a variant and a seed."""
        seen, unseen = default_mazes(self.robot)
        settings = replace(variant.settings(self.robot, self.preset), controller=self.controller)
        return Run(
            folder=self.out / f"{name}-{seed}", robot=self.robot, preset=self.preset, settings=settings,
            mazes=load_mazes(seen), eval_mazes=load_mazes(unseen), seed=seed, engine=self.engine,
        )  # fmt: skip

    def run(self, variants: Mapping[str, Variant], seeds: tuple[int, ...], keep: Callable[[Results], None]) -> Results:
        """Train and evaluate all variants with each seed. If a run fails, the others still run.

        If F-CT finds no recoveries to learn from, the reason is stored instead of a row. Planner and explorer have one
        row for each roadmap margin and each action scale.

        Args:
            keep: called after each model with all results so far.

        Raises:
            UserError: at the end, with the names of the failed runs.
        """
        prepare_jax()
        found, failed = Results(), []
        runs: list[Run] = []
        for seed in seeds:
            for name, variant in variants.items():
                run = self.make_run(name, variant, seed)
                print(printable(f"== {self.robot}: {name}, seed {seed}, in {run.folder}"), file=sys.stderr)
                try:
                    share(runs, run)
                    rows = measure(run, name, variant)
                except NoRecoveryError as none:
                    print(printable(f"{run.folder}: {none}"), file=sys.stderr)
                    found.unmade.append(Unmade(**made_of(run, name, CT), why=str(none)))
                    keep(found)
                    continue
                except UserError as bad:  # the other runs can still succeed
                    print(printable(f"{run.folder}: {bad}"), file=sys.stderr)
                    failed.append(f"{run.folder}: {bad}")
                    continue
                if reference(run) in map(reference, runs):
                    rows = [row for row in rows if row.method not in GUIDED]
                found.rows += rows
                runs.append(run)
                keep(found)
        if failed:
            raise UserError("; ".join(failed))
        return found


def measure(run: Run, name: str, variant: Variant) -> list[Row]:
    """The rows of a run. The run is trained first unless it is finished."""
    if variant.baseline is not None:
        found = baseline_rows(run, variant.baseline)
    else:
        pipeline.train(run, resume=True)
        found = [row | outcomes(run.folder / "evaluate", row) for row in pipeline.results(run.folder)]
    return [label(run, name, values) for values in found]


def reference(run: Run) -> dict[str, float]:
    """The settings that affect planner and explorer; in rooms there are none."""
    settings = run.settings
    if settings.rooms:
        return {}
    action_scale = {"action_scale": settings.controller_action_scale} if settings.controller_action_scale != 1.0 else {}
    return {"margin_m": settings.prm.margin_m} | action_scale


# ---------------------------------------------------------------------------------------------------------- stages

# The settings that a stage depends on, in addition to those of the stage before it.
STAGES = {
    "controller": ("prm", "controller", *PARTS),
    "collect": ("controller_action_scale", "collect", "rooms", "random_mazes"),
    "fit": ("model", "fit", "value"),
}
_REFERENCES = ("episodes", "pairs_seed", "controller_action_scale")


def stage_digests(run: Run) -> dict[str, str]:
    """Digests of the inputs of each stage that runs can share. "evaluate" covers planner and explorer only."""
    found = identity(run)
    settings: dict[str, Any] = found["settings"]
    where = {name: found[name] for name in ("robot", "mazes", "eval_mazes", "engine")}
    inputs: dict[str, Any] = {"seed": run.seed, "where": where}
    digests: dict[str, str] = {}
    for stage, names in STAGES.items():
        inputs |= {name: settings.get(name) for name in names}
        digests[stage] = digest_words(inputs)
    asked = {name: settings.get(name) for name in _REFERENCES}
    if run.settings.rooms:  # in rooms, planner and explorer have their own roadmap and controller
        asked = {name: asked[name] for name in ("episodes", "pairs_seed")} | {"worlds": run.settings.rooms.worlds}
    else:
        asked["controller"] = digests["controller"]
    digests["evaluate"] = digest_words(asked | where)
    return digests


def share(runs: list[Run], run: Run) -> None:
    """Copy finished stages with the same inputs from other runs, and the episodes of planner and explorer."""
    wanted = stage_digests(run)
    with open_run(run, resume=True):
        for source in runs:
            have = stage_digests(source)
            for stage in (stage for stage in wanted if have[stage] == wanted[stage]):
                if source.done(stage) is None or (run.folder / stage).exists():
                    continue
                if stage == "evaluate":
                    _copy_references(source.folder / stage, run.folder / stage)
                else:
                    shutil.copytree(source.folder / stage, run.folder / stage)


def _copy_references(source: Path, folder: Path) -> None:
    folder.mkdir()
    for ending in ("npz", "json"):  # the JSON file is copied last: it marks the row as complete
        for method in GUIDED:
            for file in source.glob(f"*-{method}.{ending}"):
                shutil.copy(file, folder)


# ------------------------------------------------------------------------------------------------------------ rows


def label(run: Run, variant: str, values: dict[str, Any]) -> Row:
    """A row of results. Its origin is that of the model, unless ``values`` has an origin."""
    made = made_of(run, variant, values["method"])
    return Row.read(made | (reference(run) if values["method"] in GUIDED else {}) | values)


def made_of(run: Run, variant: str, method: str) -> dict[str, Any]:
    """The fields of ``rows.Made``."""
    config = read_json(run.folder / "config.json")
    stages = [*sorted(run.folder.glob("*/done.json")), run.folder / "baselines" / method / "done.json"]
    walls = {done.parent.name: read_json(done)["wall_s"] for done in stages if done.is_file()}
    made = {"variant": variant, "model_seed": run.seed, "method": method, "settings": digest(run.settings)}
    if not run.settings.rooms and method != "sac":  # SAC alone has no low-level controller
        made["controller"] = controller_digest(str(run.folder), run.robot)
    made |= {"run_wall_s": round(sum(walls.values())), "collect_wall_s": round(walls.get("collect", 0.0))}
    if method in walls:
        made["learn_wall_s"] = round(walls[method])
    return made | origin_of(config)


@functools.cache  # all rows of a run use the same digest
def controller_digest(where: str, robot: str) -> str:
    """A digest of the low-level controller in a run's folder."""
    return digest_arrays(load_controller(where, robot)[0])


def digest_arrays(tree: Any) -> str:
    """A digest of a tree of arrays."""
    return hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree))).hexdigest()[:12]


def digest_words(*values: Any) -> str:
    """A digest of JSON values."""
    words = "".join(json.dumps(value, sort_keys=True) for value in values)
    return hashlib.sha256(words.encode()).hexdigest()[:12]


def digest(settings: Settings, baseline: Checked | None = None) -> str:
    """A digest of settings, and of those of a baseline."""
    return digest_words(to_dict(settings), *([as_json(baseline)] if baseline else []))


def outcomes(folder: Path, row: dict[str, Any]) -> dict[str, dict[str, str]]:
    """The outcome of each episode as ones and zeros, so that methods can be compared on each start-goal pair."""
    names = {"success": "success", "collision": "collided", "fall": "fell", "frontal": "frontal", "grazing": "grazing"}
    with np.load(episodes_file(folder, row["maze"], row["method"])) as episodes:
        found = {name: episodes[array] for name, array in names.items() if array in episodes}
    return {"outcomes": {name: as_digits(flags) for name, flags in found.items()}}


def as_digits(flags: np.ndarray) -> str:
    """Booleans as ones and zeros."""
    return "".join("01"[int(flag)] for flag in flags)


def keep_once(file: Path, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The contents of a JSON file. If the file does not exist, measure its values and write them with their origin."""
    if not file.is_file():
        write_json(file, measure() | origin_of(provenance()))
    return read_json(file)


# ------------------------------------------------------------------------------------------------------- baselines


def baseline_rows(run: Run, config: Checked, name: str = "") -> list[dict[str, Any]]:
    """Rows of one baseline. It is trained first unless it is finished.

    Args:
        name: of its folder in the run, and of its rows (default: the baseline's name).
    """
    name = name or baseline_of(config).NAME
    folder = run.folder / "baselines" / name
    with open_run(run, resume=True):
        (run.folder / "evaluate").mkdir(exist_ok=True)  # for the pairs
        with closing(Metrics(run.folder)) as metrics:
            policy, _ = pipeline.learned_baseline(run, config, metrics, name)
        made = origin_of(read_json(folder / "baseline.json"))
        trials = kind_of(run.spec).trials(run, run.folder / "evaluate")
        rows = [pipeline.evaluated(run, folder, trial, name, policy=policy) for trial in trials]
    return [made | {"settings": digest(run.settings, config)} | row | outcomes(folder, row) for row in rows]
