"""Algorithm 1, stage by stage: prm, controller, collect, fit, finetune, evaluate, report.

Each stage writes into its own folder of the run and ends with ``done.json``; a finished stage is read back instead of
run again. ``config.json`` says what the run is of, and a run is only continued as what it was begun.
"""

import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from ct_envs import Maze, MazeEnv, UserError, load_maze, stack_mazes
from ct_envs.maze import draw_walls, unpadded
from ct_envs.robots import get_robot
from ct_jax import trajectories as storage
from ct_jax.checkpoint import Checkpoints, load_weights, read_json, save_weights, write_json
from ct_jax.collect import collect
from ct_jax.controllers.sac import SacController, train_controller
from ct_jax.evaluate import METHODS, Episodes, Pairs, draw_pairs, evaluate
from ct_jax.finetune import recover
from ct_jax.fit import Fit, FitConfig, best_trajectories, fit, init_params, transformer_loss, value_loss
from ct_jax.model import TrainedModel, blank_model, load_model, save_model
from ct_jax.policy import TransformerPolicy
from ct_jax.presets import Settings, to_dict
from ct_jax.prm import Roadmap, build_roadmap
from ct_jax.progress import Bar, Metrics
from ct_jax.report import write_report
from ct_jax.trajectories import Trajectories
from ct_jax.transformer import ControlTransformer
from ct_jax.value import ValueNetwork

STAGES = ("prm", "controller", "collect", "fit", "finetune", "evaluate", "report")


@dataclass(frozen=True)
class Run:
    """A run: a folder, and what it is of."""

    folder: Path
    robot: str
    preset: str
    settings: Settings
    mazes: dict[str, Maze]  # trained in
    eval_mazes: dict[str, Maze]  # evaluated in besides them
    seed: int
    engine: str

    def env(self, **options: Any) -> MazeEnv:
        """The run's environment, with options of ``MazeEnv``."""
        return MazeEnv(self.robot, engine=self.engine, map_cell_m=self.settings.model.map_cell_m, **options)

    def key(self, stage: str) -> jax.Array:
        """The stage's own randomness."""
        return jax.random.fold_in(jax.random.key(self.seed), STAGES.index(stage))

    @property
    def stacked(self) -> Maze:
        return stack_mazes(list(self.mazes.values()))


# ------------------------------------------------------------------------------------------------ the run's folder


def open_run(run: Run, *, resume: bool) -> None:
    """Make the run's folder, or check that the one there is the same run.

    Raises:
        UserError: the folder is in use and ``resume`` is not given, or it is another run's.
    """
    config = run.folder / "config.json"
    if run.folder.exists() and any(run.folder.iterdir()):
        if not config.is_file():
            raise UserError(f"{run.folder}: not empty and no run folder; choose another with --out")
        before, now = read_json(config), _identity(run)
        for name, value in now.items():
            if before.get(name) != value:
                shown = (before.get(name), value) if isinstance(value, str | int) else ("others", "these")
                raise UserError(
                    f"{config}: a run with {name} {shown[0]}, not {shown[1]}; choose another folder with --out"
                )
        if not resume:
            raise UserError(f"{run.folder}: holds a run already; continue it with --resume or choose another --out")
        return
    run.folder.mkdir(parents=True, exist_ok=True)
    write_json(config, _identity(run) | provenance())


def _identity(run: Run) -> dict[str, Any]:
    def texts(mazes: dict[str, Maze]) -> dict[str, str]:
        return {name: draw_walls(unpadded(maze)) for name, maze in mazes.items()}

    settings = _as_json(to_dict(run.settings))
    return {
        "robot": run.robot,
        "preset": run.preset,
        "seed": run.seed,
        "engine": run.engine,
        "mazes": texts(run.mazes),
        "eval_mazes": texts(run.eval_mazes),
        "settings": settings,
    }


def _as_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _as_json(inner) for name, inner in value.items()}
    return list(value) if isinstance(value, tuple) else value


def provenance() -> dict[str, Any]:
    """Command, commit, date, hardware and versions: what is needed to make a result again."""
    git = shutil.which("git")
    commit = "unknown"
    if git:
        here = Path(__file__).parent
        found = subprocess.run([git, "describe", "--always", "--dirty"], cwd=here, capture_output=True, text=True)
        commit = found.stdout.strip() or commit
    packages = ("jax", "flax", "optax", "brax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy", "networkx")
    return {
        "command": " ".join(["ct-jax", *sys.argv[1:]] if Path(sys.argv[0]).name == "ct-jax" else sys.argv),
        "commit": commit,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "hardware": hardware(),
        "versions": {"python": platform.python_version()} | {name: metadata.version(name) for name in packages},
    }


def hardware() -> str:
    """The devices in words."""
    devices = jax.devices()
    kind = devices[0].device_kind if devices[0].platform != "cpu" else f"{platform.machine()} CPU"
    return f"{len(devices)} x {kind}, {_cores()} cores"


def _cores() -> int:
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def stage_done(run: Run, stage: str) -> dict[str, Any] | None:
    """What the finished stage said of itself; None if it has not finished."""
    file = run.folder / stage / "done.json"
    return read_json(file) if file.is_file() else None


@contextmanager
def _stage(run: Run, stage: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """A stage's folder, and a dict of what it says of itself, written last."""
    folder = run.folder / stage
    folder.mkdir(exist_ok=True)
    info: dict[str, Any] = {}
    begun = time.perf_counter()
    yield folder, info
    write_json(folder / "done.json", info | {"wall_s": round(time.perf_counter() - begun, 2)})


# ------------------------------------------------------------------------------------------------------ the stages


def train(run: Run, *, resume: bool = False) -> Path:
    """Run all stages that are not finished; returns the report's path.

    Raises:
        UserError: bad input, or a stage that cannot succeed.
    """
    open_run(run, resume=resume)
    metrics = Metrics(run.folder)
    try:
        roadmap = _prm(run)
        controller = _controller(run, roadmap, metrics)
        data = _collect(run, controller)
        policy = _fit(run, data, metrics)
        policy = _finetune(run, policy, controller, data, metrics)
        save_model(run.folder / "model", TrainedModel(run.robot, run.settings, policy, controller, _made(run)))
        _evaluate(run, policy, controller)
    finally:
        metrics.close()
    return write_report(run.folder)


def _made(run: Run) -> dict[str, Any]:
    config = read_json(run.folder / "config.json")
    return {name: config[name] for name in ("command", "commit", "created", "hardware", "versions", "seed")}


def _prm(run: Run) -> Roadmap:
    """The roadmap of the first maze: it gives the controller its edges."""
    maze = next(iter(run.mazes.values()))
    roadmap = build_roadmap(
        run.key("prm"), maze, radius_m=get_robot(run.robot).radius_m, config=run.settings.prm
    )
    if stage_done(run, "prm") is None:
        with _stage(run, "prm") as (folder, info):
            np.savez_compressed(folder / "roadmap.npz", points=roadmap.points, edges=roadmap.edges)
            info |= {"points": len(roadmap.points), "edges": len(roadmap.edges)}
    return roadmap


def _controller(run: Run, roadmap: Roadmap, metrics: Metrics) -> SacController:
    config = run.settings.sac
    _, blank = blank_model(run.robot, run.settings)
    file = run.folder / "controller" / "weights.safetensors"
    if stage_done(run, "controller") is not None:
        return jax.tree.map(jnp.asarray, load_weights(file, blank))
    with _stage(run, "controller") as (folder, info), Bar("controller", config.iterations) as bar:
        checkpoints = Checkpoints(folder / "checkpoints")

        def on_progress(done: int, values: dict[str, float]) -> None:
            bar.update(done, f"success {values['success']:.2f}")
            metrics.log("controller", done, **values)

        controller, held_out = train_controller(
            run.key("controller"), run.env, roadmap.maze, roadmap, config,
            on_progress=on_progress, checkpoints=checkpoints,
        )  # fmt: skip
        checkpoints.close()
        save_weights(file, controller)
        shutil.rmtree(folder / "checkpoints", ignore_errors=True)
        info |= {"held_out_success": held_out}
    return controller


def _collect(run: Run, controller: SacController) -> Trajectories:
    config = run.settings.collect
    file = run.folder / "collect" / "trajectories.npz"
    if stage_done(run, "collect") is not None:
        return storage.load(file)
    with _stage(run, "collect") as (_, info), Bar("collect", config.trajectories) as bar:
        env = run.env(maps=False, auto_reset=False, horizon=config.horizon)
        data = collect(
            run.key("collect"), env, run.stacked, controller, config, run.settings.prm,
            on_progress=lambda successes, episodes: bar.update(successes, f"of {episodes} episodes"),
        )  # fmt: skip
        storage.save(data, file)
        info |= describe(data)
    return data


def describe(data: Trajectories) -> dict[str, Any]:
    """Size of a dataset in words and numbers."""
    length = np.asarray(data.length)
    return {"trajectories": data.n, "steps": int(length.sum()), "mean_length": float(length.mean()), "bytes": data.nbytes}


def _train_network(
    run: Run, stage: str, name: str, loss: Callable, config: FitConfig, params: Any, data: Trajectories,
    metrics: Metrics, key: jax.Array,
) -> Any:  # fmt: skip
    """Fit one network with a bar, metrics and checkpoints."""
    with Bar(name, config.updates) as bar:
        checkpoints = Checkpoints(run.folder / stage / f"checkpoints-{name}")

        def on_progress(done: int, value: float) -> None:
            bar.update(done, f"loss {value:.4f}")
            metrics.log(name, done, loss=value)

        learner = Fit(loss, config, run.settings.model.map_cell_m)
        params = fit(key, learner, params, data, run.stacked, on_progress=on_progress, checkpoints=checkpoints)
        checkpoints.close()
    return params


def _fit(run: Run, data: Trajectories, metrics: Metrics) -> TransformerPolicy:
    settings = run.settings
    policy, _ = blank_model(run.robot, settings)
    file = run.folder / "fit" / "weights.safetensors"
    if stage_done(run, "fit") is not None:
        return jax.tree.map(jnp.asarray, load_weights(file, policy))
    with _stage(run, "fit") as (folder, info):
        policy = _fit_both(run, "fit", "", settings.fit, policy, data, metrics, fresh=True)
        save_weights(file, policy)
        for left in folder.glob("checkpoints-*"):
            shutil.rmtree(left, ignore_errors=True)
        info |= {"parameters": sum(leaf.size for leaf in jax.tree.leaves(policy.params))}
    return policy


def _fit_both(
    run: Run, stage: str, suffix: str, config: FitConfig, policy: TransformerPolicy, data: Trajectories,
    metrics: Metrics, *, fresh: bool,
) -> TransformerPolicy:  # fmt: skip
    """Train the value network, and train the transformer (on)."""
    settings = run.settings
    keys = jax.random.split(jax.random.fold_in(run.key(stage), sum(map(ord, suffix))), 4)
    value = ValueNetwork(settings.value.width)
    value_params = _train_network(
        run, stage, "value" + suffix, value_loss(value), settings.value.fit, init_params(keys[0], value, data),
        best_trajectories(data, settings.value), metrics, keys[1],
    )  # fmt: skip
    model = ControlTransformer(settings.model, policy.action_size)
    params = init_params(keys[2], model, data) if fresh else policy.params
    params = _train_network(run, stage, "fit" + suffix, transformer_loss(model), config, params, data, metrics, keys[3])
    return policy.replace(params=params, value_params=value_params)


def _finetune(
    run: Run, policy: TransformerPolicy, controller: SacController, data: Trajectories, metrics: Metrics
) -> TransformerPolicy:
    """Algorithm 4, ``rounds`` times: recoveries join the data, and training goes on."""
    settings = run.settings
    for i in range(1, settings.rounds + 1):
        stage = "finetune"
        folder = run.folder / stage
        folder.mkdir(exist_ok=True)
        data = storage.concatenate([data, _recoveries(run, i, policy, controller)])
        file = folder / f"weights-{i}.safetensors"
        if (folder / f"done-{i}.json").is_file():
            policy = jax.tree.map(jnp.asarray, load_weights(file, policy))
            continue
        policy = _fit_both(run, stage, f"-{i + 1}", settings.round_fit or settings.fit, policy, data, metrics, fresh=False)
        save_weights(file, policy)
        for left in folder.glob("checkpoints-*"):
            shutil.rmtree(left, ignore_errors=True)
        write_json(folder / f"done-{i}.json", describe(data))
    if settings.rounds and stage_done(run, "finetune") is None:
        with _stage(run, "finetune") as (_, info):
            info |= {"rounds": settings.rounds} | describe(data)
    return policy


def _recoveries(run: Run, i: int, policy: TransformerPolicy, controller: SacController) -> Trajectories:
    """Failures and recoveries of round i."""
    config = run.settings.recover
    file = run.folder / "finetune" / f"trajectories-{i}.npz"
    if file.is_file():
        return storage.load(file)
    with Bar(f"recover-{i}", config.recoveries) as bar:
        env = run.env(auto_reset=False, horizon=config.patience + run.settings.collect.horizon)
        found = recover(
            jax.random.fold_in(run.key("finetune"), i), env, run.stacked, policy, controller, config,
            run.settings.collect, run.settings.prm,
            on_progress=lambda recoveries, episodes: bar.update(recoveries, f"of {episodes} episodes"),
        )  # fmt: skip
    part = file.with_name("part-" + file.name)
    storage.save(found, part)
    part.replace(file)
    return found


def _evaluate(run: Run, policy: TransformerPolicy, controller: SacController) -> None:
    if stage_done(run, "evaluate") is not None:
        return
    env = run.env(auto_reset=False)
    todo = [(m, k, m in run.mazes) for m in {**run.mazes, **run.eval_mazes} for k in METHODS]
    rows = []
    with _stage(run, "evaluate") as (folder, _):
        for name, method, seen in todo:
            maze = (run.mazes | run.eval_mazes)[name]
            pairs = stored_pairs(folder, run.robot, name, maze, run.settings.episodes, run.seed)
            with Bar(f"{method} in {name}", run.settings.episodes) as bar:
                episodes = evaluate(
                    env, maze, pairs, method, policy=policy, controller=controller, prm=run.settings.prm,
                    on_progress=lambda steps, over, bar=bar: bar.update(over, f"step {steps}"),
                )  # fmt: skip
            save_episodes(folder / f"{slug(name)}-{method}.npz", episodes)
            rows.append(result_row(run.robot, method, name, episodes) | {"seen": seen})
        write_json(folder / "results.json", {"rows": rows})


def result_row(robot: str, method: str, maze: str, episodes: Episodes) -> dict[str, Any]:
    """One line of the table, as ``ct-jax evaluate --json`` prints it."""
    head = {"robot": robot, "method": method, "maze": maze, "episodes": len(episodes.success), "seed": episodes.pairs.seed}
    return head | episodes.summary()


def slug(name: str) -> str:
    """A maze's name as part of a file name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)


def save_episodes(file: Path, episodes: Episodes) -> None:
    """Write what happened, for the report's pictures."""
    asked = {} if episodes.asked is None else {"asked": episodes.asked}
    np.savez_compressed(
        file, path=episodes.path, success=episodes.success, collided=episodes.collided, steps=episodes.steps,
        returns=episodes.returns, start=episodes.pairs.start, goal=episodes.pairs.goal, **asked,
    )  # fmt: skip


def stored_pairs(folder: Path, robot: str, name: str, maze: Maze, n: int, seed: int) -> Pairs:
    """The evaluation's pairs: drawn once, written down, and read back ever after."""
    spec = get_robot(robot)
    file = folder / f"pairs-{slug(name)}-{n}-{seed}.json"
    if file.is_file():
        found = read_json(file)
        return Pairs(*(np.asarray(found[k], np.float32) for k in ("start", "goal", "shortest_m")), seed)
    pairs = draw_pairs(seed, maze, n, radius_m=spec.radius_m, tolerance_m=spec.goal_tolerance_m)
    write_json(file, {k: getattr(pairs, k).tolist() for k in ("start", "goal", "shortest_m")})
    return pairs


def load_mazes(names: tuple[str, ...]) -> dict[str, Maze]:
    """Mazes by name or file, in order."""
    return {name: load_maze(name) for name in names}


def default_mazes(robot: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The paper's training and evaluation mazes for a robot. Raises UserError for an unknown one."""
    get_robot(robot)
    return ("antmaze-large",), ("antmaze-large-eval",)


def evaluate_model(run: str, maze: str, *, episodes: int, seed: int, method: str, engine: str) -> dict[str, Any]:
    """Evaluate one method of a run folder or zoo model in one maze; returns its row of the table.

    Raises:
        UserError: unknown model, maze or method, or no episodes.
    """
    if episodes < 1:
        raise UserError(f"--episodes {episodes}: give at least 1")
    if seed < 0:
        raise UserError(f"--seed {seed}: give a number of 0 or more")
    if method not in METHODS:
        raise UserError(f"no method named '{method}'; methods: {', '.join(METHODS)}")
    model, world = load_model(run), load_maze(maze)
    env = MazeEnv(model.robot, engine=engine, map_cell_m=model.settings.model.map_cell_m, auto_reset=False)
    robot = env.robot
    pairs = draw_pairs(seed, world, episodes, radius_m=robot.radius_m, tolerance_m=robot.goal_tolerance_m)
    with Bar(f"{method} in {Path(maze).name}", episodes) as bar:
        done = evaluate(
            env, world, pairs, method, policy=model.policy, controller=model.controller, prm=model.settings.prm,
            on_progress=lambda steps, over: bar.update(over, f"step {steps}"),
        )  # fmt: skip
    return result_row(model.robot, method, maze, done)


def print_table(folder: Path) -> None:
    """Print the results of a run."""
    print_rows(read_json(folder / "evaluate" / "results.json")["rows"])


def print_rows(rows: list[dict[str, Any]]) -> None:
    """Print results as a table."""
    table = Table(box=None, header_style="bold")
    for name in ("maze", "method", "success %", "95 %", "SPL", "return / 100", "collided %", "steps"):
        table.add_column(name, justify="left" if name in ("maze", "method") else "right")
    for row in rows:
        low, high = row["success_ci95"]
        table.add_row(
            f"{row['maze']}{' (seen)' if row.get('seen') else ''}", row["method"], f"{100 * row['success_rate']:.0f}",
            f"{100 * low:.0f}-{100 * high:.0f}", f"{row['spl']:.2f}", f"{row['return_scaled']:.1f}",
            f"{100 * row['collision_rate']:.0f}", f"{row['steps_mean']:.0f}",
        )  # fmt: skip
    Console().print(table)

