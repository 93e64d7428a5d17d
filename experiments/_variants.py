"""What the experiments share: the method's variants and the baselines, on the same data and the same pairs."""

import functools
import hashlib
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import ct_envs.quiet  # noqa: F401
from ct_envs import UserError
from ct_jax import pipeline
from ct_jax import trajectories as storage
from ct_jax.baselines.cql import Cql, CqlConfig, train_cql
from ct_jax.baselines.networks import Actor, ActorPolicy, sample_seen
from ct_jax.baselines.sac_alone import EDGES_ONLY, train_sac_alone
from ct_jax.checkpoint import load_weights, read_json, save_weights, write_json
from ct_jax.cli import guarded, prepare_jax, print_rows
from ct_jax.controllers.sac import SacConfig
from ct_jax.evaluate import GUIDED
from ct_jax.finetune import NoRecoveryError
from ct_jax.mazes import evaluated
from ct_jax.model import load_controller
from ct_jax.presets import Settings, get_preset, to_dict, with_fits
from ct_jax.progress import Metrics
from ct_jax.run import (
    Run,
    default_mazes,
    episodes_file,
    join_mazes,
    load_mazes,
    open_run,
    provenance,
    training,
)

RESULTS = Path(__file__).parent / "results"
SHARED = ("controller", "collect", "fit")  # stages that several variants may have in common
# What is tried besides ``cpu``, and the variants of F-CT; ``untuned`` is what each was before.
LIFTS = (
    "modes",
    "calm",
    "memory",
    "skill",
    "calm+memory",
    "calm+memory+skill",
    "long",
    "calm+long",
    "roam",
    "modes+roam",
    "modes+memory+roam",
)
TUNED = ("cpu", *LIFTS, "mazes")
LONGER = "long-ct"  # of one maze, and of about as many updates as F-CT in all
ALONE = 8000  # iterations of SAC alone: of the point, 500 whole episodes


@dataclass(frozen=True)
class Options:
    """What to run."""

    preset: str = "cpu"
    """demo, cpu, published or paper."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trained models."""
    variants: tuple[str, ...] = ()
    """Rows to run: published, bc, f-ct, pt-cql, sac; with preset cpu also cpu, mazes, modes, calm, memory, skill,
    calm+memory, calm+memory+skill, long and calm+long, each of them also with -ct, which is without fine-tuning; roam,
    modes+roam and modes+memory+roam, which are cpu-ct, modes-ct and modes+memory-ct before it. By default all."""
    controller: str = "own"
    """own, zoo, or a run folder."""
    out: Path | None = None
    """Folder of the runs (default: runs/ROBOT); what is finished there is not run again."""
    engine: str = "auto"
    """Physics: auto, mjx or mujoco."""


def experiment(robot: str, about: str | None) -> int:
    """Run a robot's experiment from the command line; returns the exit status."""

    def run() -> None:
        options = tyro.cli(Options, description=about)
        plan = plan_for(robot, options.preset, controller=options.controller, variants=options.variants)
        out = options.out or Path("runs") / robot
        file = RESULTS / f"{robot}-{options.preset}.json"
        run_plan(
            robot, plan, preset=options.preset, seeds=options.seeds, out=out, engine=options.engine,
            keep=lambda found: write_results(file, found),
        )  # fmt: skip
        show_results(file)

    return guarded(run)


@dataclass(frozen=True)
class Plan:
    """What an experiment runs."""

    variants: dict[str, Settings]
    baselines: dict[str, CqlConfig | SacConfig] = field(default_factory=dict)  # of those variants that are in BASELINES


def plan_for(robot: str, preset: str, *, controller: str, variants: tuple[str, ...] = ()) -> Plan:
    """The rows of a robot's table, or those of them that are named.

    The method as published, at the size of the preset (with "cpu", that of "published"), without returns (BC-CT) and
    fine-tuned (F-CT, Algorithm 4); the baselines; with "cpu" what lifts CT and F-CT; with "demo" that alone.

    Raises:
        UserError: a variant that the preset does not have.
    """
    plan = _whole_plan(robot, preset, controller=controller)
    for name in variants:
        if name not in plan.variants:
            known = ", ".join(plan.variants)
            raise UserError(f"no variant named '{name}' with preset '{preset}'; variants: {known}")
    if not variants:
        return plan
    return replace(plan, variants={name: plan.variants[name] for name in plan.variants if name in variants})


def _whole_plan(robot: str, preset: str, *, controller: str) -> Plan:
    if preset == "demo":
        return Plan({preset: replace(get_preset(preset, robot), controller=controller)})
    published, lifted = (
        replace(get_preset(name, robot), controller=controller)
        for name in ("published" if preset == "cpu" else preset, "cpu")
    )
    variants: dict[str, Settings] = {
        "published": published,
        "bc": replace(published, model=replace(published.model, returns=False)),
        "f-ct": replace(
            published,
            recover=replace(published.recover, recoveries=500, bumps=published.recover.stuck_steps // 2),
            rounds=1,
            round_fit=replace(published.fit, updates=published.fit.updates // 2, warmup=20),
        ),
    }
    frame = lifted.model.frame
    cql = CqlConfig(updates=2500, mirror=True, frame=frame)  # as tuned: 8000 make it worse
    # Alone, the maze is the task: longer ways, so a longer view, and no edges to arrange.
    sac = replace(lifted.sac, discount=0.99, iterations=ALONE, reward_scale=0.1, alive_bonus=0.0, **EDGES_ONLY)
    baselines: dict[str, CqlConfig | SacConfig] = {"pt-cql": cql, "sac": sac}
    variants |= {name: published for name in baselines}
    if preset == "cpu":  # likewise without and with fine-tuning
        assert lifted.last_fit is not None
        variants["cpu-ct"] = replace(lifted, rounds=0, fit=replace(lifted.last_fit, shift_timestep=300))
        variants["cpu"] = lifted
        variants |= _of_many_mazes(lifted)
        for name in LIFTS:
            if "skill" not in name.split("+") or not lifted.model.skill:  # which the humanoid has as it is
                variants.setdefault(untuned(name), _lift(name, robot, variants["cpu-ct"]))  # who roams has one already
                variants[name] = _lift(name, robot, lifted)
    return Plan(variants, baselines)


def untuned(name: str) -> str:
    """The variant that a fine-tuned one is before fine-tuning, which alone needs other mazes."""
    return "+".join([part for part in name.split("+") if part != "roam"] or ["cpu"]) + "-ct"


def _lift(names: str, robot: str, settings: Settings) -> Settings:
    """What is tried besides; of several, one after the other."""
    for name in names.split("+"):
        model = settings.model
        if name == "modes":  # Keeping to a mode is for those who have learned from their own mistakes, not for CT.
            settings = replace(settings, model=replace(model, modes=4, commitment=3.0 if settings.rounds else 0.0))
        elif name == "calm":  # In three quarters of its range the ant hardly falls: chosen in its training maze.
            settings = replace(settings, controller_effort=0.75)
        elif name == "memory":  # As many steps remembered, but farther apart: a step is 0.1 m of the ant's way.
            settings = replace(settings, model=replace(model, stride=4 if robot == "humanoid" else 3))
        elif name == "long":  # The last training, which of CT is the only one, takes twice the updates.
            settings = _twice_as_long(settings)
        elif name == "roam":  # CT of the one maze, which looks for its failures elsewhere.
            settings = replace(settings, recover=replace(settings.recover, random_mazes=100))
        else:
            assert name == "skill"
            settings = replace(settings, model=replace(model, skill=True))
            settings = with_fits(settings, turns=model.frame == "heading")  # of one controller one gait
    return settings


def _twice_as_long(settings: Settings) -> Settings:
    """The settings with twice the updates in the last training of the transformer."""
    name = "last_fit" if settings.rounds else "fit"
    fit = getattr(settings, name)
    return replace(settings, **{name: replace(fit, updates=2 * fit.updates)})


def _of_many_mazes(lifted: Settings) -> dict[str, Settings]:
    """What lifts the method, with data of 100 mazes more; CT and F-CT after as many updates."""
    assert lifted.last_fit is not None
    last = replace(lifted.last_fit, shift_timestep=300)
    fine_tuned = replace(
        lifted,
        random_mazes=100,
        collect=replace(lifted.collect, trajectories=2500, reset_interval=10),
        fit=replace(last, updates=600, warmup=100, decay=False),
        rounds=6,
        round_fit=replace(last, updates=200, decay=False),
        last_fit=replace(last, updates=2400),
    )
    return {
        "mazes-ct": replace(fine_tuned, rounds=0, fit=replace(last, updates=4000, warmup=100)),
        "mazes": fine_tuned,
    }


def run_plan(
    robot: str, plan: Plan, *, preset: str, seeds: tuple[int, ...], out: Path, engine: str = "auto",
    keep: Callable[[dict[str, list[dict[str, Any]]]], None] = lambda found: None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Train and evaluate everything with each seed, continuing what is there; returns all rows.

    F-CT that finds nothing to learn from is a result, too: of it there is not a row but the reason.

    The references, planner and explorer, appear once for each roadmap's margin, which they keep, too, and each effort.

    Args:
        keep: told all "rows" so far after each model, and the reasons of those "unmade".

    Raises:
        UserError: runs that cannot be finished; the others are.
    """
    prepare_jax()
    seen, unseen = default_mazes(robot)
    rows: list[dict[str, Any]] = []
    unmade: list[dict[str, Any]] = []
    results = {"rows": rows, "unmade": unmade}
    before: list[Run] = []
    failed: list[str] = []
    for seed in seeds:
        for name, settings in plan.variants.items():
            run = Run(
                folder=out / f"{name}-{seed}", robot=robot, preset=preset, settings=settings,
                mazes=load_mazes(seen), eval_mazes=load_mazes(unseen), seed=seed, engine=engine,
            )  # fmt: skip
            print(f"== {robot}: {name}, seed {seed}, in {run.folder}", file=sys.stderr)
            try:
                for other in before:
                    share(other, run)
                found = found_of(run, plan.baselines.get(name), name)
            except UserError as bad:  # the others may yet come out
                print(f"{run.folder}: {bad}", file=sys.stderr)
                if isinstance(bad, NoRecoveryError):
                    unmade.append(label(run, name, {"method": "ct", "why": str(bad)}))
                    keep(results)
                else:
                    failed.append(f"{run.folder}: {bad}")
                continue
            if reference(run) in map(reference, before):
                found = [row for row in found if row["method"] not in GUIDED]
            rows += [label(run, name, row) for row in found]
            before.append(run)
            keep(results)
    if failed:
        raise UserError("; ".join(failed))
    return rows


def found_of(run: Run, baseline: CqlConfig | SacConfig | None, name: str) -> list[dict[str, Any]]:
    """Rows of one run, trained or learned unless it is finished."""
    if baseline is not None:
        return BASELINES[name](run, baseline)
    pipeline.train(run, resume=True)
    return [row | outcomes(run.folder / "evaluate", row) for row in pipeline.results(run.folder)]


def reference(run: Run) -> dict[str, float]:
    """What tells a run's planner and explorer from those of other runs; in rooms they have a setting of their own."""
    settings = run.settings
    if settings.rooms:
        return {}
    effort = {"effort": settings.controller_effort} if settings.controller_effort != 1.0 else {}
    return {"margin_m": settings.prm.margin_m} | effort


def share(source: Run, run: Run) -> None:
    """Take over the stages that would come out alike: the planning trajectories, what was fitted to them, and how
    planner and explorer fare."""

    def made_of(run: Run, stage: str) -> tuple[Any, ...]:
        settings = run.settings
        if stage == "evaluate":  # in rooms, the references have a roadmap and a controller of their own
            found = settings.episodes, settings.pairs_seed, settings.rooms and settings.rooms.worlds
            return found if settings.rooms else (*found, settings.controller_effort, *made_of(run, "controller"))
        found = settings.prm, settings.controller, settings.sac, run.seed
        if stage == "controller":
            return found
        found += (settings.controller_effort,)
        if stage in ("collect", "fit"):
            found += settings.collect, settings.rooms, settings.random_mazes
        return (*found, settings.model, settings.fit, settings.value) if stage == "fit" else found

    alike = [stage for stage in (*SHARED, "evaluate") if made_of(source, stage) == made_of(run, stage)]
    with open_run(run, resume=True):
        for stage in SHARED:
            if stage in alike and source.done(stage) is not None and not (run.folder / stage).exists():
                shutil.copytree(source.folder / stage, run.folder / stage)
        if "evaluate" in alike and source.done("evaluate") is not None and not (run.folder / "evaluate").exists():
            (run.folder / "evaluate").mkdir()
            # Of each row the JSON file comes last: it says that the row is whole.
            for ending in ("npz", "json"):
                for file in (f for method in GUIDED for f in (source.folder / "evaluate").glob(f"*-{method}.{ending}")):
                    shutil.copy(file, run.folder / "evaluate")


def label(run: Run, variant: str, row: dict[str, Any]) -> dict[str, Any]:
    """A row with what made its model, or, where it says so itself, with what measured it later."""
    config = read_json(run.folder / "config.json")
    stages = [*sorted(run.folder.glob("*/done.json")), run.folder / "baselines" / row["method"] / "done.json"]
    walls = {done.parent.name: read_json(done)["wall_s"] for done in stages if done.is_file()}
    made = {"variant": variant, "model_seed": run.seed, "settings": digest(run.settings)}
    if row["method"] in GUIDED:
        made |= reference(run)
    if not run.settings.rooms and row["method"] != "sac":  # which nothing led
        made["controller"] = controller_digest(str(run.folder), run.robot)
    made |= {"run_wall_s": round(sum(walls.values())), "collect_wall_s": round(walls.get("collect", 0.0))}
    if row["method"] in walls:
        made["learn_wall_s"] = round(walls[row["method"]])  # of it
    return made | origin(config) | row


@functools.cache  # all rows of a run ask
def controller_digest(where: str, robot: str) -> str:
    """Some letters that tell low-level controllers apart, each of a run's folder."""
    return digest_of(load_controller(where, robot)[0])


def digest_of(tree: Any) -> str:
    """Some letters that tell trees of arrays apart."""
    return hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree))).hexdigest()[:12]


def digest(settings: Settings, baseline: CqlConfig | SacConfig | None = None) -> str:
    """Some letters that tell settings apart, with those of a baseline."""
    words = json.dumps(to_dict(settings), sort_keys=True)
    words += json.dumps(asdict(baseline), sort_keys=True) if baseline else ""
    return hashlib.sha256(words.encode()).hexdigest()[:12]


def origin(made: dict[str, Any]) -> dict[str, Any]:
    """Of what a run's ``config.json`` or ``provenance`` says, what stands in every row."""
    return {key: made[key] for key in ("command", "commit", "hardware", "created")}


def outcomes(folder: Path, row: dict[str, Any]) -> dict[str, dict[str, str]]:
    """What a row's rates count, episode by episode, as ones and zeros: methods are compared pair by pair."""
    names = {"success": "success", "collision": "collided", "fall": "fell", "frontal": "frontal", "grazing": "grazing"}
    with np.load(episodes_file(folder, row["maze"], row["method"])) as episodes:
        flags = {name: episodes[array] for name, array in names.items() if array in episodes}
    return {"outcomes": {name: "".join("01"[int(flag)] for flag in flags[name]) for name in flags}}


def claim(file: Path, of: dict[str, Any], what: str) -> dict[str, Any]:
    """Say in a file of a folder what its results are of; returns the ``origin`` of whoever said so first.

    Args:
        what: the word for what they are of.

    Raises:
        UserError: they are of something else.
    """
    of = json.loads(json.dumps(of, default=str))  # tuples as lists, as they are read back
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, {"of": of} | origin(provenance()))
    before = read_json(file)
    if before.get("of") != of:
        raise UserError(f"{file.parent}: was made with other {what}; delete it, and it is made anew")
    return origin(before)


# ------------------------------------------------------------------------------------------------------- baselines


def pt_cql(run: Run, config: CqlConfig, name: str = "pt-cql") -> list[dict[str, Any]]:
    """Rows of PT-CQL with these settings, learned from the run's planning trajectories, collected if need be."""
    with open_run(run, resume=True):
        course, metrics = pipeline.COURSES[run.spec.course](run), Metrics(run.folder)
        controller, _ = course.controller(metrics)
        metrics.close()
        pipeline.planning_trajectories(run, course, controller)

    def learn(key: jax.Array, **watch: Any) -> ActorPolicy:
        data = storage.load(run.folder / "collect" / "trajectories.npz")
        learner = Cql(config, run.settings.model.map_cell_m, run.spec, data.action.shape[-1])
        return train_cql(key, learner, data, run.stacked, **watch)

    return baseline(run, name, learn, config, config.updates, config.width)


def sac_alone(run: Run, config: SacConfig) -> list[dict[str, Any]]:
    """Rows of SAC alone in the run's maze, without its data."""

    def learn(key: jax.Array, **watch: Any) -> ActorPolicy:
        return train_sac_alone(key, run.env, next(iter(run.mazes.values())), config, **watch)

    return baseline(run, "sac", learn, config, config.iterations, config.hidden[0])


BASELINES: dict[str, Callable[[Run, Any], list[dict[str, Any]]]] = {"pt-cql": pt_cql, "sac": sac_alone}


def baseline(
    run: Run, name: str, learn: Callable, config: CqlConfig | SacConfig, total: int, width: int
) -> list[dict[str, Any]]:
    """Rows of one baseline, learned unless its weights are there."""
    frame, stage = config.frame, f"baselines/{name}"
    folder = run.folder / stage
    env = run.env(auto_reset=False)
    actor = Actor(env.action_size, width, frame)
    params = actor.init(jax.random.key(0), sample_seen(env.proprio_size))
    policy = ActorPolicy(params, env.action_size, width, frame)
    file = folder / "weights.safetensors"
    with open_run(run, resume=True):
        (run.folder / "evaluate").mkdir(exist_ok=True)  # of the pairs
        made = claim(folder / "baseline.json", asdict(config), "settings")
        if run.done(stage) is None:
            with run.stage(stage):
                metrics = Metrics(folder)
                with training(folder, name, total, metrics) as watch:
                    learned = learn(jax.random.fold_in(run.key("fit"), total), **watch)
                metrics.close()
                save_weights(file, learned.params)
        policy = policy.replace(params=jax.tree.map(jnp.asarray, load_weights(file, params)))
        mazes = join_mazes(run.mazes, run.eval_mazes).items()
        rows = [evaluated(run, env, folder, at, maze, name, policy=policy) for at, maze in mazes]
    return [made | {"settings": digest(run.settings, config)} | row | outcomes(folder, row) for row in rows]


# --------------------------------------------------------------------------------------------------------- results


def write_results(file: Path, found: dict[str, list[dict[str, Any]]]) -> None:
    """Write lists of rows. Those in the file that were not measured anew, by other commands or earlier, stay, unless
    they are of a variant that had other settings then: of those it says that they go."""

    def subject(row: dict[str, Any]) -> tuple[Any, ...]:
        model = () if row["method"] in GUIDED else (row["variant"], row["model_seed"])
        where = (row.get(name) for name in ("method", "maze", "density", "noise"))
        # Rows of earlier commits name no margin, and had none.
        return (*model, *where, row.get("margin_m") or 0.0, row.get("effort"))

    kept: dict[str, list[dict[str, Any]]] = read_json(file) if file.is_file() else {}
    now = {row["variant"]: row.get("settings") for rows in found.values() for row in rows}

    def holds(row: dict[str, Any]) -> bool:
        return row["method"] in GUIDED or row.get("settings") == now.get(row["variant"], row.get("settings"))

    for name in {**kept, **found}:
        rows = found.get(name, [])
        anew = {subject(row) for row in rows}
        before = [row for row in kept.get(name, []) if subject(row) not in anew]
        for variant, seed in dict.fromkeys((row["variant"], row["model_seed"]) for row in before if not holds(row)):
            print(f"{file}: {name} of {variant}, seed {seed}, were of other settings, and go", file=sys.stderr)
        kept[name] = [row for row in before if holds(row)] + rows
    if "unmade" in kept:  # what has rows now needs no reason any more
        made = {(row["variant"], row["model_seed"]) for row in found.get("rows", [])}
        kept["unmade"] = [row for row in kept["unmade"] if (row["variant"], row["model_seed"]) not in made]
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, kept)


def replace_rows(file: Path, rows: list[dict[str, Any]], names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Write rows into a results file in place of those that agree with one in these names; returns all of it."""
    subject = lambda row: tuple(row[name] for name in names)  # noqa: E731
    anew = set(map(subject, rows))
    before = read_json(file)["rows"] if file.is_file() else []
    together = [row for row in before if subject(row) not in anew] + rows
    write_json(file, {"rows": together})
    return together


def show_results(file: Path) -> None:
    """Print a results file's rows."""
    print_rows([row | {"method": f"{row['variant']}: {row['method']}"} for row in read_json(file)["rows"]])
    print(f"results: {file}")
