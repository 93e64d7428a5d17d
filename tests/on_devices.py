"""The program of ``test_devices``. It runs in separate processes with different numbers of devices.

    python tests/on_devices.py FOLDER NAME [HOST:PORT PROCESSES PROCESS]

It trains on FOLDER/data.npz, saves and resumes, collects and evaluates, and writes the results to FOLDER/NAME.npz.
"""

import contextlib
import os
import re
import signal
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from ct_envs import POINT, MazeEnv, load_maze, stack_mazes
from ct_jax.collect import CollectConfig, collect
from ct_jax.evaluate import evaluate
from ct_jax.fit import Fit, FitConfig, fit, init_params, spread, transformer_loss
from ct_jax.learner import updates_on
from ct_jax.pairs import Pairs
from ct_jax.policy import TransformerPolicy
from ct_jax.prm import PrmConfig
from ct_jax.runtime import devices, interrupts
from ct_jax.runtime.checkpoint import Checkpoints
from ct_jax.runtime.interrupts import interruptible, raise_if_interrupted
from ct_jax.trajectories import Trajectories, load
from ct_jax.transformer import ControlTransformer, ModelConfig
from ct_jax.value import ValueNetwork
from ct_jax.worlds.mazes import MazeWorld

FOLDER, NAME = Path(sys.argv[1]), sys.argv[2]
interrupts.GRACE_S = 120.0  # on a busy machine, stopping takes longer
signals = contextlib.ExitStack()
signals.enter_context(interruptible())  # before the processes connect, as in the command line
if among := sys.argv[3:]:  # before JAX starts devices
    devices.start(among[0], int(among[1]), int(among[2]))

UPDATES = 20
CONFIG = FitConfig(updates=UPDATES, batch=8, steps=4, learning_rate=1e-2, warmup=2)
MODEL = ControlTransformer(
    ModelConfig(layers=1, heads=2, width=8, context=3, context_acting=3, dropout=0.2, max_timestep=64), 2
)
MAZE = load_maze("antmaze-umaze")
MAZES = stack_mazes([MAZE])
COLLECT = CollectConfig(trajectories=3, envs=7, reset_interval=4, starts="maze", noise=0.3, horizon=30, give_up=100)
PRM = PrmConfig(samples=30)


@struct.dataclass
class Push:
    """An untrained controller."""

    action_size: int = struct.field(pytree_node=False, default=2)

    def __call__(self, proprio, goal):
        return jnp.clip(goal - 0.5 * proprio, -1.0, 1.0)


def learner() -> tuple[Fit, dict]:
    made = Fit(transformer_loss(MODEL), CONFIG, 0.8, POINT)
    return made, init_params(jax.random.key(0), MODEL, empty(1, 1))


def empty(n: int, steps: int) -> Trajectories:
    """Empty trajectories of the point robot with these sizes."""
    shapes = {"position": 2, "proprio": 2, "action": 2, "label": 2, "reward": 0, "label_mask": 0, "collision": 0}
    arrays = {name: np.zeros((n, steps, size) if size else (n, steps), np.float32) for name, size in shapes.items()}
    counts = {name: np.zeros(n, np.int32) for name in ("maze", "length")}
    return Trajectories(**arrays, **counts, goal_world=np.zeros((n, 2), np.float32))


def train() -> dict[str, np.ndarray]:
    """Losses of three trainings: the first half of the updates, which a signal to the last process ends; all updates;
    and the second half, resumed from the checkpoints of the first training.
    """
    data, (made, params) = load(FOLDER / "data.npz"), learner()

    def losses(checkpoints: Path, stop: int = UPDATES) -> np.ndarray:
        found: list[float] = []

        def on_progress(update: int, loss: float) -> None:
            found.append(loss)
            if update == stop < UPDATES:
                if jax.process_index() == jax.process_count() - 1:
                    os.kill(os.getpid(), signal.SIGTERM)
                raise_if_interrupted()  # as in a progress bar

        with contextlib.suppress(KeyboardInterrupt), contextlib.closing(Checkpoints(checkpoints)) as manager:
            fit(
                jax.random.key(1), made, params, data, MAZES, chunk=1, checkpoints=manager, on_progress=on_progress
            )  # fmt: skip
        return np.array(found)

    result = {"half": losses(FOLDER / "checkpoints" / NAME, stop=UPDATES // 2)}
    signals.close()  # otherwise the watching thread would end this process
    result["losses"] = losses(FOLDER / f"none-{NAME}")
    return result | {f"from-{saved.name}": losses(saved) for saved in sorted((FOLDER / "checkpoints").iterdir())}


def traffic() -> dict[str, np.ndarray]:
    """Sizes of the largest replicated array and of the largest shard that a device receives."""
    made, params = learner()
    data, rtg = spread(load(FOLDER / "data.npz"), made.mesh)
    mazes = devices.place(MAZES, devices.replicated(made.mesh))
    ready = made.create(jax.random.key(1), params)
    program = updates_on(made.mesh).lower(ready, data, rtg, mazes, updates=2).compile().as_text()  # pyright: ignore
    moved = re.findall(r"= \(?(.*?)\)? (?:all-gather|all-to-all|collective-permute)(?:-start)?\(", program)
    shapes = [shape.split(",") for text in moved for shape in re.findall(r"\[([\d,]+)\]", text)]
    sizes = [np.prod([int(n) for n in shape]) for shape in shapes]
    return {"sent": np.max(sizes, initial=0), "rows": np.array(data.n), "table": np.array(data.position.size)}


def drive() -> dict[str, np.ndarray]:
    """Episodes collected, and episodes of a policy."""
    blind = MazeWorld(MazeEnv("point", maps=False, auto_reset=False), MAZE)
    found = collect(jax.random.key(2), blind, Push(), COLLECT, PRM)
    collected = {name: devices.joined(np.asarray(getattr(found, name))) for name in ("length", "goal_world")}
    first_steps = devices.joined(np.asarray(found.position)[:, :2])
    value = ValueNetwork(8)
    value_params = init_params(jax.random.key(3), value, empty(1, 1))
    policy = TransformerPolicy(learner()[1], value_params, MODEL.config, 2, value_width=8)
    world = MazeWorld(MazeEnv("point", auto_reset=False), MAZE)
    start = np.linspace([6.0, 6.0], [14.0, 6.0], 5, dtype=np.float32)
    episodes = evaluate(world, Pairs(start, start[::-1], np.ones(5), seed=0), "ct", policy=policy, horizon=20)
    parts = ("success", "collided", "steps", "returns", "path", "target_return")
    evaluated = {f"evaluated-{part}": getattr(episodes, part) for part in parts}
    return {"collected": first_steps} | collected | evaluated


if __name__ == "__main__":
    jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parent / ".jax_cache"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    found = train() | traffic() | drive() | {"devices": np.array(jax.device_count())}
    if devices.is_first():
        np.savez(FOLDER / f"{NAME}.npz", **found)
