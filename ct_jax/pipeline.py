"""Algorithm 1, stage by stage: prm, controller, collect, fit, finetune, evaluate, report.

Each stage writes into its own folder of the run; a finished stage is read back instead of run again, and what an
interrupted one has finished is kept.
"""

import functools
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ct_envs import Maze, MazeEnv, UserError, load_maze
from ct_envs.robots import Robot
from ct_jax import trajectories as storage
from ct_jax.checkpoint import Checkpoints, load_weights, read_json, save_weights, write_json
from ct_jax.collect import collect
from ct_jax.controllers.sac import SacConfig, SacController, train_controller
from ct_jax.evaluate import METHODS, Episodes, Learned, Pairs, draw_pairs, evaluate
from ct_jax.finetune import recover
from ct_jax.fit import Fit, FitConfig, best_trajectories, fit, init_params, transformer_loss, value_loss
from ct_jax.model import TrainedModel, blank_model, load_controller, load_model, save_controller, save_model
from ct_jax.policy import TransformerPolicy
from ct_jax.prm import PrmConfig, Roadmap, build_roadmap
from ct_jax.progress import Bar, Metrics
from ct_jax.run import Run, join_mazes, open_run, slug
from ct_jax.trajectories import Trajectories
from ct_jax.transformer import ControlTransformer
from ct_jax.value import ValueNetwork

MAX_EPISODES = 100_000
MAX_SEED = 2**32 - 1
PAIR_ARRAYS = ("start", "goal", "shortest_m")


def train(run: Run, *, resume: bool = False) -> Path:
    """Run all stages that are not finished; returns the report's path.

    Raises:
        UserError: bad input, or a stage that cannot succeed.
        KeyboardInterrupt: Ctrl-C; ``resume`` goes on from there.
    """
    from ct_jax.report import write_report  # matplotlib, which takes its time and has its say about folders

    with open_run(run, resume=resume):
        metrics = Metrics(run.folder)
        try:
            model = _model(run, metrics)
            _evaluate(run, model)
        finally:
            metrics.close()
        return write_report(run.folder)


def _model(run: Run, metrics: Metrics) -> TrainedModel:
    """The trained model, learned or, if the stages up to it are finished, read back."""
    last = "finetune" if run.settings.rounds else "fit"
    folder = run.folder / "model"
    if run.done(last) is not None and (folder / "model.json").is_file():
        return load_model(str(run.folder))
    controller, sac = _controller(run, metrics)
    data = _collect(run, controller)
    policy = _fit(run, data, metrics)
    if run.settings.rounds:
        policy = _finetune(run, policy, controller, data, metrics)
    model = TrainedModel(run.robot, replace(run.settings, sac=sac), policy, controller, _made(run))
    save_model(folder, model)
    return model


def _made(run: Run) -> dict[str, Any]:
    config = read_json(run.folder / "config.json")
    return {name: config[name] for name in ("command", "commit", "created", "hardware", "versions", "seed")}


# ------------------------------------------------------------------------------------------ roadmap and controller


def _prm(run: Run) -> Roadmap:
    """The roadmap of the first maze: it gives the controller its edges. Built again as quickly as it would be read."""
    maze = next(iter(run.mazes.values()))
    roadmap = build_roadmap(run.key("prm"), maze, radius_m=run.spec.radius_m, config=run.settings.prm)
    if run.done("prm") is None:
        with run.stage("prm") as (folder, info):
            np.savez_compressed(folder / "roadmap.npz", points=roadmap.points, edges=roadmap.edges)
            info |= {"points": len(roadmap.points), "edges": len(roadmap.edges)}
    return roadmap


def _controller(run: Run, metrics: Metrics) -> tuple[SacController, SacConfig]:
    """The run's own controller, or the given one, and its configuration."""
    config = run.settings.sac
    if run.settings.controller != "own":
        return load_controller(run.settings.controller, run.robot)
    if run.done("controller") is not None:
        return load_controller(str(run.folder), run.robot, mend=run.mend("controller"))
    roadmap = _prm(run)
    with run.stage("controller") as (folder, info):
        with training(folder, "controller", config.iterations, metrics) as watch:
            controller, held_out = train_controller(
                run.key("controller"), run.env, roadmap.maze, roadmap, config, **watch
            )
        save_controller(folder, run.robot, config, controller, _made(run) | {"held_out_success": held_out})
        info |= {"held_out_success": held_out}
    drop_checkpoints(folder)
    return controller, config


@contextmanager
def training(folder: Path, name: str, total: int, metrics: Metrics) -> Iterator[dict[str, Any]]:
    """A training's bar, metrics, and checkpoints in the folder: its ``on_progress`` and ``checkpoints``."""
    with Bar(name, total) as bar:
        checkpoints = Checkpoints(folder / f"checkpoints-{name}")

        def on_progress(done: int, report: float | dict[str, float]) -> None:
            values = report if isinstance(report, dict) else {"loss": report}
            metrics.log(name, done, **values)
            shown = next((word for word in ("success", "loss") if word in values), None)
            bar.update(done, f"{shown} {values[shown]:.4g}" if shown else "")

        yield {"on_progress": on_progress, "checkpoints": checkpoints}
        checkpoints.close()


def drop_checkpoints(folder: Path) -> None:
    """Delete what only an interrupted training needs."""
    for left in folder.glob("checkpoints-*"):
        shutil.rmtree(left, ignore_errors=True)


# -------------------------------------------------------------------------------------------- data and transformer


def _collect(run: Run, controller: SacController) -> Trajectories:
    config = run.settings.collect
    file = run.folder / "collect" / "trajectories.npz"
    if run.done("collect") is not None:
        return _read_trajectories(run, file)
    with run.stage("collect") as (_, info), Bar("collect", config.trajectories) as bar:
        env = run.env(maps=False, auto_reset=False, horizon=config.horizon)
        data = collect(
            run.key("collect"), env, run.stacked, controller, config, run.settings.prm,
            on_progress=lambda successes, episodes: bar.update(successes, f"of {episodes} episodes"),
        )  # fmt: skip
        storage.save(data, file)
        info |= describe(data)
    return data


def _read_trajectories(run: Run, file: Path) -> Trajectories:
    try:
        return storage.load(file)
    except UserError as bad:
        raise UserError(f"{bad}: {run.mend(file.parent.name)}") from None


def describe(data: Trajectories) -> dict[str, Any]:
    """Size of a dataset in words and numbers."""
    length = np.asarray(data.length)
    counts = {"trajectories": data.n, "steps": int(length.sum()), "bytes": data.nbytes}
    return counts | {"mean_length": float(length.mean())}


def _fit(run: Run, data: Trajectories, metrics: Metrics) -> TransformerPolicy:
    """Value network and transformer, from scratch."""
    policy, _ = blank_model(run.robot, run.settings)
    if run.done("fit") is not None:
        return _fit_both(run, "fit", 0, policy, data, metrics)
    with run.stage("fit") as (folder, info):
        policy = _fit_both(run, "fit", 0, policy, data, metrics)
        info |= {"parameters": sum(leaf.size for leaf in jax.tree.leaves(policy.params))}
    drop_checkpoints(folder)
    return policy


def _fit_both(
    run: Run, stage: str, number: int, policy: TransformerPolicy, data: Trajectories, metrics: Metrics
) -> TransformerPolicy:
    """Train the transformer from scratch (round 0) or on (later rounds), and at both ends the value network anew."""
    settings = run.settings
    last = number == settings.rounds
    suffix = f"-{number}" if number else ""
    keys = jax.random.split(jax.random.fold_in(run.key(stage), number), 4)
    value, model = ValueNetwork(settings.value.width), ControlTransformer(settings.model, policy.action_size)

    def train_one(name: str, learner: Fit, params: Any, data: Trajectories, key: jax.Array) -> Any:
        return _fit_network(run, stage, name + suffix, learner, params, data, metrics, key)

    value_params = policy.value_params
    if number == 0 or last:
        learner = _learner(value, settings.value.fit, settings.model.map_cell_m, run.spec)  # pyright: ignore[reportArgumentType]
        best = best_trajectories(data, settings.value, run.spec.goal_tolerance_m)
        value_params = train_one("value", learner, init_params(keys[0], value, data), best, keys[1])
    config = settings.fit
    if number:
        config = (settings.last_fit if last else None) or settings.round_fit or settings.fit
    params = policy.params if number else init_params(keys[2], model, data)
    learner = _learner(model, config, settings.model.map_cell_m, run.spec)  # pyright: ignore[reportArgumentType]
    params = train_one("fit", learner, params, data, keys[3])
    return replace(policy, params=params, value_params=value_params)


@functools.cache
def _learner(model: ControlTransformer | ValueNetwork, config: FitConfig, map_cell_m: float, robot: Robot) -> Fit:
    """One learner, and so one compilation, for all rounds that train alike."""
    loss = value_loss(model) if isinstance(model, ValueNetwork) else transformer_loss(model)
    return Fit(loss, config, map_cell_m, robot)


def _fit_network(
    run: Run, stage: str, name: str, learner: Fit, params: Any, data: Trajectories, metrics: Metrics, key: jax.Array
) -> Any:  # fmt: skip
    """Fit one network with a bar, metrics and checkpoints; its weights, once there, are read back."""
    folder = run.folder / stage
    file = folder / f"{name}.safetensors"
    if file.is_file():
        return jax.tree.map(jnp.asarray, load_weights(file, params, mend=run.mend(stage)))
    with training(folder, name, learner.config.updates, metrics) as watch:
        params = fit(key, learner, params, data, run.stacked, **watch)
    save_weights(file, params)
    return params


# ----------------------------------------------------------------------------------------------------- fine-tuning


def _finetune(
    run: Run, policy: TransformerPolicy, controller: SacController, data: Trajectories, metrics: Metrics
) -> TransformerPolicy:
    """Algorithm 4, ``rounds`` times: recoveries join the data, and training goes on."""
    settings = run.settings
    # One environment, and so one compilation, for all rounds.
    env = run.env(auto_reset=False, horizon=settings.recover.patience + settings.collect.horizon)
    with run.stage("finetune") as (folder, info):
        for number in range(1, run.settings.rounds + 1):
            data = storage.concatenate([data, _recoveries(run, env, number, policy, controller)])
            policy = _fit_both(run, "finetune", number, policy, data, metrics)
            drop_checkpoints(folder)
        info |= {"rounds": run.settings.rounds} | describe(data)
    return policy


def _recoveries(
    run: Run, env: MazeEnv, number: int, policy: TransformerPolicy, controller: SacController
) -> Trajectories:
    """Failures and recoveries of a round."""
    config = run.settings.recover
    file = run.folder / "finetune" / f"trajectories-{number}.npz"
    if file.is_file():
        return _read_trajectories(run, file)
    with Bar(f"recover-{number}", config.recoveries) as bar:
        found = recover(
            jax.random.fold_in(run.key("finetune"), number), env, run.stacked, policy, controller, config,
            run.settings.collect, run.settings.prm,
            on_progress=lambda recoveries, episodes: bar.update(recoveries, f"of {episodes} episodes"),
        )  # fmt: skip
    part = file.with_name("part-" + file.name)
    storage.save(found, part)
    part.replace(file)
    return found


# ------------------------------------------------------------------------------------------------------ evaluation


def _evaluate(run: Run, model: TrainedModel) -> None:
    """Every method in every maze, seen ones first; each row is kept as soon as it is there."""
    if run.done("evaluate") is not None:
        return
    env = run.env(auto_reset=False)
    with run.stage("evaluate") as (folder, _):
        rows = []
        for name, maze in join_mazes(run.mazes, run.eval_mazes).items():
            who = {"policy": model.policy, "controller": model.controller}
            rows += [evaluated(run, env, folder, name, maze, method, **who) for method in METHODS]
        write_json(folder / "results.json", {"rows": rows})


def evaluated(
    run: Run, env: MazeEnv, folder: Path, name: str, maze: Maze, method: str, *, policy: Learned,
    controller: SacController | None = None,
) -> dict[str, Any]:  # fmt: skip
    """A method's row of the table for one maze, with its episodes beside it in the folder; once there, read back."""
    file = folder / f"{slug(name)}-{method}.json"
    if not file.is_file():
        pairs = _stored_pairs(run, name, maze)
        episodes = _watched(env, maze, pairs, method, name, policy, controller, run.settings.prm)
        _save_episodes(file.with_suffix(".npz"), episodes)
        write_json(file, result_row(run.robot, method, name, episodes) | {"seen": name in run.mazes})
    return read_json(file)


def _watched(
    env: MazeEnv, maze: Maze, pairs: Pairs, method: str, name: str, policy: Learned,
    controller: SacController | None, prm: PrmConfig,
) -> Episodes:  # fmt: skip
    with Bar(f"{method} in {name}", len(pairs.start)) as bar:
        return evaluate(
            env, maze, pairs, method, policy=policy, controller=controller, prm=prm,
            on_progress=lambda steps, over: bar.update(over, f"step {steps}"),
        )  # fmt: skip


def result_row(robot: str, method: str, maze: str, episodes: Episodes) -> dict[str, Any]:
    """One line of the table, as ``ct-jax evaluate --json`` prints it."""
    pairs = {"episodes": len(episodes.success), "seed": episodes.pairs.seed}
    return {"robot": robot, "method": method, "maze": maze} | pairs | episodes.summary()


def _save_episodes(file: Path, episodes: Episodes) -> None:
    """Write what happened, for the report's pictures."""
    arrays = {name: getattr(episodes, name) for name in ("path", "success", "collided", "steps", "returns")}
    arrays |= {"start": episodes.pairs.start, "goal": episodes.pairs.goal}
    arrays |= {} if episodes.asked is None else {"asked": episodes.asked}
    np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]


def _stored_pairs(run: Run, name: str, maze: Maze) -> Pairs:
    """The evaluation's pairs: drawn once, written down, and read back ever after."""
    robot, n, seed = run.spec, run.settings.episodes, run.settings.pairs_seed
    file = run.folder / "evaluate" / f"pairs-{slug(name)}-{n}-{seed}.json"
    if file.is_file():
        found = read_json(file)
        start, goal, shortest_m = (np.asarray(found[name], np.float32) for name in PAIR_ARRAYS)
        return Pairs(start, goal, shortest_m, seed)
    pairs = draw_pairs(seed, maze, n, radius_m=robot.radius_m, tolerance_m=robot.goal_tolerance_m)
    write_json(file, {name: getattr(pairs, name).tolist() for name in PAIR_ARRAYS})
    return pairs


def results(folder: Path) -> list[dict[str, Any]]:
    """The rows of a run's table."""
    return read_json(folder / "evaluate" / "results.json")["rows"]


def evaluate_model(run: str, maze: str, *, episodes: int, seed: int, method: str, engine: str) -> dict[str, Any]:
    """Evaluate one method of a run folder or zoo model in one maze; returns its row of the table.

    Raises:
        UserError: unknown model, maze or method, or no episodes.
    """
    if not 1 <= episodes <= MAX_EPISODES:
        raise UserError(f"--episodes {episodes}: give a number from 1 to {MAX_EPISODES}")
    check_seed(seed)
    if method not in METHODS:
        raise UserError(f"no method named '{method}'; methods: {', '.join(METHODS)}")
    world = load_maze(maze)
    model = load_model(run)
    env = MazeEnv(model.robot, engine=engine, map_cell_m=model.settings.model.map_cell_m, auto_reset=False)
    robot = env.robot
    pairs = draw_pairs(seed, world, episodes, radius_m=robot.radius_m, tolerance_m=robot.goal_tolerance_m)
    prm, name = model.settings.prm, Path(maze).stem
    outcome = _watched(env, world, pairs, method, name, model.policy, model.controller, prm)
    return result_row(model.robot, method, maze, outcome)


def check_seed(seed: int) -> None:
    """Raise UserError unless random keys can be made of the seed."""
    if not 0 <= seed <= MAX_SEED:
        raise UserError(f"--seed {seed}: give a number from 0 to {MAX_SEED}")
