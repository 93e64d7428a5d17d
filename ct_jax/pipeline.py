"""Algorithm 1, stage by stage: prm, controller, collect, fit, finetune, evaluate, report. A baseline has its own stage
in place of fit and finetune.

Each stage writes into its own folder of the run; a finished stage is read back instead of run again, and what an
interrupted one has finished is kept.
"""

import functools
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ct_envs import UserError
from ct_envs.checked import Checked, from_json
from ct_envs.robots import Robot, get_robot
from ct_jax import trajectories as storage
from ct_jax.baselines import TRANSFORMERS, baseline_of, check_method, get_baseline
from ct_jax.collect import collect, kept_in
from ct_jax.controller import ControllerConfig
from ct_jax.evaluate import GUIDED, Episodes, evaluate
from ct_jax.finetune import recover
from ct_jax.fit import Fit, FitConfig, best_trajectories, fit, init_params, transformer_loss, value_loss
from ct_jax.heads import with_skill
from ct_jax.model import TrainedModel, blank_model, load_model, save_model, sizes
from ct_jax.policy import TransformerPolicy
from ct_jax.runtime import devices
from ct_jax.runtime.checkpoint import load_weights, read_json, save_weights, write_json
from ct_jax.runtime.numerics import with_own_numerics
from ct_jax.runtime.progress import Bar, Metrics
from ct_jax.runtime.run import (
    BASELINES,
    Run,
    as_json,
    claim,
    drop_leftovers,
    is_row,
    kept_row,
    open_run,
    stored_run,
    training,
)
from ct_jax.settings import MAX_RETURN_SCALE, MAX_SEED, with_controller
from ct_jax.trajectories import Trajectories
from ct_jax.transformer import ControlTransformer
from ct_jax.types import Controller, Policy, World
from ct_jax.value import ValueNetwork
from ct_jax.worlds import Request, Trial, kind_of

_WEIGHTS = "weights.safetensors"


@with_own_numerics
def train(run: Run, *, resume: bool = False) -> Path:
    """Run all stages that are not finished; returns the report's path.

    Raises:
        UserError: bad input, or a stage that cannot succeed.
        KeyboardInterrupt: Ctrl-C; ``resume`` goes on from there.
    """
    _check_processes(run.spec)
    _check_method(run)
    from ct_jax.report import write_report  # imports matplotlib, which is slow

    with open_run(run, resume=resume):
        metrics = Metrics(run.folder)
        try:
            if run.baseline is None:
                model = _model(run, metrics)
                policy, controller = model.policy, model.controller
            else:
                policy, controller = learned_baseline(run, run.baseline, metrics)
            _evaluate(run, policy, controller)
        finally:
            metrics.close()
        return Path(devices.first(lambda: str(write_report(run.folder))))


def _check_method(run: Run) -> None:
    """Raise UserError if the run's method is unknown, or is not for its robot or its settings."""
    check_method(run.method)
    if run.method not in TRANSFORMERS:
        if jax.process_count() > 1:
            raise UserError(f"--method {run.method} trains in one process; start only one")
        assert run.baseline is not None
        get_baseline(run.method).blank(run, run.baseline)
    for name, value in TRANSFORMERS.get(run.method, {}).items():
        if getattr(run.settings.model, name) != value:
            raise UserError(f"--method {run.method} has model.{name}={value}; leave out --model.{name}")


def _model(run: Run, metrics: Metrics) -> TrainedModel:
    """The trained model, learned or, if the stages up to it are finished, read back."""
    last = "finetune" if run.settings.rounds else "fit"
    folder = run.folder / "model"
    if run.done(last) is not None and devices.first((folder / "model.json").is_file):
        return load_model(str(run.folder))
    controller, config = kind_of(run.spec).controller(run, metrics)
    data = planning_trajectories(run, controller)
    policy = _fit(run, controller, config, data, metrics)
    if run.settings.rounds:
        policy = _finetune(run, policy, controller, data, metrics)
    model = TrainedModel(run.robot, with_controller(run.settings, config), policy, controller, run.made)
    devices.first(lambda: save_model(folder, model))
    return model


# -------------------------------------------------------------------------------------------- data and transformer


def planning_trajectories(run: Run, controller: Any) -> Trajectories:
    """The trajectories of Algorithm 3, collected or read back."""
    file, settings = run.folder / "collect" / "trajectories.npz", run.settings
    if run.done("collect") is not None:
        return _read_trajectories(run, file)
    with (
        run.stage("collect") as (_, info),
        kind_of(run.spec).open_training(run, maps=False) as world,
        Bar("collect", settings.collect.trajectories) as bar,
    ):
        data = collect(
            run.key("collect"), world, controller, settings.collect, settings.prm,
            on_progress=lambda successes, episodes: bar.update(successes, f"of {episodes} episodes"),
            keep=kept_in(file.parent / "waves", hint=run.hint("collect")),
        )  # fmt: skip
        storage.save(data, file)
        info |= describe(data)
    return data


def _read_trajectories(run: Run, file: Path) -> Trajectories:
    """What ``storage.save`` wrote in the run. Raises UserError if it is damaged, or another run's."""
    try:
        data = storage.load(file)
    except UserError as bad:
        raise UserError(f"{bad}: {run.hint(file.parent.name)}") from None
    mazes = len(run.mazes) + max(run.settings.random_mazes, run.settings.recover.random_mazes)
    fits = (data.proprio.shape[-1], data.action.shape[-1]) == sizes(run.robot)
    if not fits or (data.map_bits is None) != bool(run.mazes) or np.max(data.maze, initial=0) >= max(mazes, 1):
        raise UserError(f"{file}: trajectories of another run; {run.hint(file.parent.name)}")
    return data


def describe(data: Trajectories) -> dict[str, Any]:
    """Size of a dataset in words and numbers."""
    length, sizes = devices.joined(np.asarray(data.length)), devices.joined(np.array([data.nbytes]))
    counts = {"trajectories": len(length), "steps": int(length.sum()), "bytes": int(sizes.sum())}
    return counts | {"mean_length": float(length.mean())}


def _fit(
    run: Run, controller: Any, config: ControllerConfig, data: Trajectories, metrics: Metrics
) -> TransformerPolicy:
    """Train value network and transformer from scratch. A head that is the low-level controller is not trained."""
    policy, _ = blank_model(run.robot, with_controller(run.settings, config))
    if run.settings.model.skill:
        policy = replace(policy, params=with_skill(policy.params, controller))
    if run.done("fit") is not None:
        return _fit_both(run, "fit", 0, policy, data, metrics)
    with run.stage("fit") as (_, info):
        policy = _fit_both(run, "fit", 0, policy, data, metrics)
        info |= {"parameters": sum(leaf.size for leaf in jax.tree.leaves(policy.params))}
    return policy


def _fit_both(
    run: Run, stage: str, number: int, policy: TransformerPolicy, data: Trajectories, metrics: Metrics
) -> TransformerPolicy:
    """Train the transformer from scratch (round 0) or on (later rounds), and at both ends the value network anew."""
    settings = run.settings
    last = number == settings.rounds
    suffix = f"-{number}" if number else ""
    keys = run.round_keys(stage, number)
    value, model = ValueNetwork(settings.value.width), policy.model

    def train_one(name: str, learner: Fit, params: Any, data: Trajectories, key: jax.Array) -> Any:
        return _fit_network(run, stage, name + suffix, learner, params, data, metrics, key)

    value_params = policy.value_params
    if number == 0 or last:
        learner = make_learner(value, settings.value.fit, settings.model.map_cell_m, run.spec)  # pyright: ignore[reportArgumentType]
        best = best_trajectories(data, settings.value, run.spec.goal_tolerance_m)
        value_params = train_one("value", learner, init_params(keys[0], value, data), best, keys[1])
    config = settings.fit
    if number:
        config = (settings.last_fit if last else None) or settings.round_fit or settings.fit
    params = policy.params if number else init_params(keys[2], model, data, policy.params)
    learner = make_learner(model, config, settings.model.map_cell_m, run.spec)  # pyright: ignore[reportArgumentType]
    params = train_one("fit", learner, params, data, keys[3])
    return replace(policy, params=params, value_params=value_params)


@functools.cache
def make_learner(model: ControlTransformer | ValueNetwork, config: FitConfig, map_cell_m: float, robot: Robot) -> Fit:
    """One learner, and so one compilation, for all rounds that train alike."""
    if isinstance(model, ValueNetwork):
        return Fit(value_loss(model), config, map_cell_m, robot)
    loss = transformer_loss(model.clone(dtype=None if config.precision == "float32" else config.precision))
    return Fit(loss, config, map_cell_m, robot, stride=model.config.stride)


def _fit_network(
    run: Run, stage: str, name: str, learner: Fit, params: Any, data: Trajectories, metrics: Metrics, key: jax.Array
) -> Any:  # fmt: skip
    """Fit one network with a bar, metrics and checkpoints; its weights, once there, are read back."""
    folder = run.folder / stage
    file = folder / f"{name}.safetensors"
    if devices.first(file.is_file):
        return jax.tree.map(jnp.asarray, load_weights(file, params, hint=run.hint(stage)))
    with training(folder, name, learner.config.updates, metrics) as watch:
        params = fit(key, learner, params, data, run.stacked, **watch)
    devices.first(lambda: save_weights(file, params))
    return params


# ------------------------------------------------------------------------------------------------------- baselines


def learned_baseline(run: Run, config: Checked, metrics: Metrics, name: str = "") -> tuple[Policy, Controller | None]:
    """What a baseline learned in a run, learned now or read back; and the controller of its data, if it needs any.

    Args:
        config: a ``Config`` of the baseline.
        name: of the folder in ``baselines`` (default: the baseline's name).

    Raises:
        UserError: the settings are not for the robot, or the folder was made with other settings.
    """
    baseline = baseline_of(config)
    name = name or baseline.NAME
    stage = f"{BASELINES}/{name}"
    folder, controller, data = run.folder / stage, None, None
    policy = baseline.blank(run, config)
    if baseline.TRAJECTORIES:
        controller, _ = kind_of(run.spec).controller(run, metrics)
        data = planning_trajectories(run, controller)
    claim(folder / "baseline.json", as_json(config), "settings")
    if run.done(stage) is None:
        total = config.total  # pyright: ignore[reportAttributeAccessIssue]
        with run.stage(stage):
            with training(folder, name, total, metrics) as watch:
                learned = baseline.learn(jax.random.fold_in(run.key("fit"), total), run, config, data, **watch)
            devices.first(lambda: save_weights(folder / _WEIGHTS, learned.params))  # pyright: ignore[reportAttributeAccessIssue]
    return _with_weights(run, policy, stage), controller


def _with_weights(run: Run, policy: Any, stage: str) -> Any:
    """A blank policy with the weights that a stage learned."""
    params = load_weights(run.folder / stage / _WEIGHTS, policy.params, hint=run.hint(stage))
    return replace(policy, params=jax.tree.map(jnp.asarray, params))


def _load_baseline(folder: Path, method: str) -> TrainedModel:
    """What a baseline learned in a run folder, as ``learned_baseline`` left it. Raises UserError."""
    baseline, stage = get_baseline(method), f"{BASELINES}/{method}"
    run = stored_run(folder)
    if run.done(stage) is None:
        raise UserError(f"{folder}: has no trained {method}; train it with: ct-jax train {run.robot} --method {method}")
    file = folder / stage / "baseline.json"
    config = from_json(baseline.Config, read_json(file, hint=run.hint(stage)).get("of"), f"{file}: of")
    policy = _with_weights(run, baseline.blank(run, config), stage)
    return TrainedModel(run.robot, run.settings, policy, None, run.made)


# ----------------------------------------------------------------------------------------------------- fine-tuning


def _finetune(
    run: Run, policy: TransformerPolicy, controller: Any, data: Trajectories, metrics: Metrics
) -> TransformerPolicy:
    """Algorithm 4, ``rounds`` times: recoveries join the data, and training goes on."""
    with run.stage("finetune") as (folder, info), kind_of(run.spec).open_training(run, maps=True) as world:
        for number in range(1, run.settings.rounds + 1):
            data = storage.concatenate([data, _recoveries(run, world, number, policy, controller)])
            policy = _fit_both(run, "finetune", number, policy, data, metrics)
            devices.first(lambda: drop_leftovers(folder))
        info |= {"rounds": run.settings.rounds} | describe(data)
    return policy


def _recoveries(run: Run, world: World, number: int, policy: TransformerPolicy, controller: Any) -> Trajectories:
    """Failures and recoveries of a round."""
    file, settings = run.folder / "finetune" / f"trajectories-{number}.npz", run.settings
    if storage.is_saved(file):
        return _read_trajectories(run, file)
    with Bar(f"recover-{number}", settings.recover.recoveries) as bar:
        found = recover(
            run.round_keys("finetune", number)[4], world, policy, controller, settings.recover, settings.collect,
            settings.prm, on_progress=lambda recoveries, episodes: bar.update(recoveries, f"of {episodes} episodes"),
            keep=kept_in(file.parent / f"waves-{number}", hint=run.hint("finetune")),
        )  # fmt: skip
    storage.save(found, file)
    return found


# ------------------------------------------------------------------------------------------------------ evaluation


def _evaluate(run: Run, policy: Policy, controller: Controller | None) -> None:
    """The run's method everywhere, and with a controller the planners; each row is kept as soon as it is there."""
    if run.done("evaluate") is not None:
        return
    with run.stage("evaluate") as (folder, _):
        rows = [
            evaluated(run, folder, trial, method, policy=policy, controller=controller)
            for trial in kind_of(run.spec).trials(run, folder)
            for method in (run.method, *(GUIDED if controller is not None else ()))
        ]
        write_json(folder / "results.json", {"rows": rows})


def evaluated(
    run: Run, folder: Path, trial: Trial, method: str, *, policy: Policy, controller: Controller | None = None
) -> dict[str, Any]:
    """A method's row of the table for one trial; see ``kept_row``."""
    head = {"robot": run.robot, "method": method} | trial.head
    measure = lambda: measured(trial, method, policy=policy, controller=controller)  # noqa: E731
    return kept_row(folder, trial.name, method, head, measure)


def measured(trial: Trial, method: str, *, policy: Policy, controller: Controller | None = None) -> Episodes:
    """Run a method on a trial, with a bar."""
    with Bar(f"{method} in {trial.name}", len(trial.pairs.start)) as bar:
        return evaluate(
            trial.world, trial.pairs, method, policy=policy, controller=controller, prm=trial.prm,
            horizon=trial.horizon, on_progress=bar.update,
        )  # fmt: skip


def results(folder: Path) -> list[dict[str, Any]]:
    """The rows of a run's table. Raises UserError if they are damaged."""
    file = folder / "evaluate" / "results.json"
    hint = f"delete {file.parent} and continue with --resume"
    rows = read_json(file, hint=hint).get("rows")
    if not isinstance(rows, list) or not all(map(is_row, rows)):
        raise UserError(f"{file}: not the rows of a table; {hint}")
    return rows


@with_own_numerics
def evaluate_model(
    run: str, *, method: str, seed: int, return_scale: float | None = None,
    keep: Callable[[dict[str, Any]], None] = lambda row: None, **options: Any
) -> dict[str, Any]:  # fmt: skip
    """Evaluate one method of a run folder or zoo model; returns its row of the table.

    Args:
        keep: called with the row as soon as it is complete, before pictures are drawn.
        return_scale: k, in place of the model's own.
        options: of the ``Request`` of the robot's kind of world.

    Raises:
        UserError: unknown model, method or maze, an option that is not for this robot, or one out of its range.
    """
    check_seed(seed)
    check_method(method, *GUIDED)
    model = _load(run, method)
    robot = get_robot(model.robot)
    _check_processes(robot)
    kind = kind_of(robot)
    known = [option.name for option in fields(kind.Request)]  # pyright: ignore[reportArgumentType]
    for name in options:
        if name not in known:
            raise UserError(f"--{name} is not for the {model.robot}; its options: --{', --'.join(known)}")
    asked = {}
    if return_scale is not None:
        model, asked = _asking(model, method, return_scale), {"return_scale": return_scale}
    return answer(kind.Request(**options), model, method, seed, lambda row: keep(row | asked)) | asked


def _load(where: str, method: str) -> TrainedModel:
    """What an evaluation of a method needs of a run folder or model. Raises UserError if it is not there."""
    folder = Path(where)
    if method not in (*TRANSFORMERS, *GUIDED):
        return _load_baseline(folder, method)
    run = None
    if not (folder / "model" / "model.json").is_file() and (folder / "config.json").is_file():
        run = stored_run(folder)
    if run is None or run.baseline is None or method in TRANSFORMERS:
        model = load_model(where)
        for name, value in TRANSFORMERS.get(method, {}).items():
            if getattr(model.settings.model, name) != value:
                raise UserError(f"{where}: its transformer has not model.{name}={value}; give --method ct")
        return model
    if not get_baseline(run.method).TRAJECTORIES:
        raise UserError(f"{where}: {run.method} has no low-level controller; give --method {run.method}")
    if kind_of(run.spec).KNOWN_CONTROLLER is None and run.done("controller") is None:
        raise UserError(f"{where}: has no trained controller yet; continue it with --resume")
    controller, config = kind_of(run.spec).controller(run, None)
    return TrainedModel(run.robot, with_controller(run.settings, config), None, controller, run.made)


def answer(
    request: Request, model: TrainedModel, method: str, seed: int,
    keep: Callable[[dict[str, Any]], None] = lambda row: None,
) -> dict[str, Any]:  # fmt: skip
    """The row of one method of a model; ``keep`` as in ``evaluate_model``. Raises UserError."""
    request.check(model)
    with request.open(model, seed) as trial:
        episodes = measured(trial, method, policy=model.policy, controller=model.controller)
        row = {"robot": model.robot, "method": method} | trial.head | episodes.summary()
        keep(row)
        request.show(trial, f"{model.robot}, {method} in {trial.name}", episodes)
    return row


def _asking(model: TrainedModel, method: str, return_scale: float) -> TrainedModel:
    """The model asking for k times the predicted return. Raises UserError for a k that means nothing."""
    if not 0.0 < return_scale <= MAX_RETURN_SCALE:
        raise UserError(f"--return-scale {return_scale}: give a factor above 0, at most {MAX_RETURN_SCALE:g}")
    if method != "ct" or not model.settings.model.returns:
        raise UserError("--return-scale needs a transformer with returns as inputs (--method ct); leave it out")
    return replace(model, policy=model.policy.replace(return_scale=return_scale))


def _check_processes(robot: Robot) -> None:
    if robot.simulator == "pybullet" and jax.process_count() > 1:
        raise UserError(f"the {robot.name} drives in PyBullet, which is one process's; start only one")


def check_seed(seed: int) -> None:
    """Raise UserError unless random keys can be made of the seed."""
    if not 0 <= seed <= MAX_SEED:
        raise UserError(f"--seed {seed}: give a number from 0 to {MAX_SEED}")
