"""Environment steps/s of ``MazeEnv`` under jit against raw ``mujoco.batch`` of the same model, and against peers.

    python benchmarks/rollout.py [--envs 256] [--steps 100]

Both sides take the same number of control steps with the same actions; ours adds walls, observations with maps, rewards
and auto-reset. The peer is Gymnasium-Robotics' ant maze as it is run side by side, one process an environment, with as
many of them as gives the most steps/s; it is measured where it is installed (``pip install -e '.[bench]'``). Its
control step is five physics steps, as ours.
"""

import importlib.util
import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import tyro
from _table import Results, time_pairs
from mujoco.batch import Batch

from ct_envs import MazeEnv, load_maze


@dataclass(frozen=True)
class Options:
    """Sizes of the benchmark."""

    envs: int = 256
    """Environments."""
    steps: int = 100
    """Control steps a call."""
    robots: tuple[str, ...] = ("point", "ant")
    """Robots."""
    peer: str = "AntMaze_Large-v5"
    """Environment of Gymnasium-Robotics that the ant is compared with."""
    peer_envs: tuple[int, ...] = (1, 2, 4, 8, 16)
    """Numbers of its environments that are tried."""


def rollouts(env: MazeEnv, actions: jax.Array):
    """A compiled function that takes all the actions in turn, as users run it."""

    @jax.jit
    def run(state):
        def step(state, action):
            state = jax.vmap(env.step)(state, action)
            return state, state.reward  # the observations are in the carried state, so every step makes them

        return jax.lax.scan(step, state, actions)

    return run


def prepare(robot: str, options: Options, *, maps: bool) -> tuple[MazeEnv, jax.Array, Any]:
    """An environment, the actions of all steps, and the states before them."""
    env = MazeEnv(robot, engine="mujoco", maze=load_maze("antmaze-large"), maps=maps)
    shape = (options.steps, options.envs, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0)
    return env, actions, jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), options.envs))


def main(options: Options) -> None:
    """Run and print."""
    results = Results("rollout")
    for robot in options.robots:
        measure(robot, options, results)
    if "ant" in options.robots:
        if importlib.util.find_spec("gymnasium_robotics") is None:
            print("Gymnasium-Robotics is not installed, so it is not measured: pip install -e '.[bench]'")
        else:
            measure_peer(options, results)
    results.finish()


def measure(robot: str, options: Options, results: Results) -> None:
    """The lines of one robot."""
    for maps in (True, False):
        env, actions, start = prepare(robot, options, maps=maps)
        run = rollouts(env, actions)

        batch = Batch(env.engine.model, nsim=options.envs)
        ctrl, qpos = batch.bind("ctrl"), batch.bind("qpos")
        qpos[:] = np.asarray(start.pipeline_state.qpos)
        given = np.asarray(actions, np.float64)

        def raw(batch=batch, ctrl=ctrl, given=given, substeps=env.engine.n_substeps):
            for action in given:
                ctrl[:] = action
                batch.step(nstep=substeps)

        ours, limit = time_pairs(lambda run=run, start=start: run(start), raw)
        work = options.envs * options.steps
        what = "with maps" if maps else "proprioception only"
        results.add(
            f"{robot}, {options.envs} environments, {what}", "steps/s", [work / t for t in ours],
            against="raw mujoco.batch", ratios=[b / a for a, b in zip(ours, limit, strict=True)],
        )  # fmt: skip
        if not maps:
            results.add(f"{robot}, raw mujoco.batch", "steps/s", [work / t for t in limit])


def measure_peer(options: Options, results: Results) -> None:
    """The line of Gymnasium-Robotics' ant maze, and ours against it."""
    import gymnasium  # pyright: ignore[reportMissingImports]
    import gymnasium_robotics  # pyright: ignore[reportMissingImports]

    gymnasium.register_envs(gymnasium_robotics)

    def walk(n: int) -> tuple[Any, np.ndarray]:
        envs = gymnasium.make_vec(options.peer, num_envs=n, vectorization_mode="async")
        envs.reset(seed=0)
        return envs, np.random.default_rng(0).uniform(-1.0, 1.0, (options.steps, *envs.action_space.shape))  # pyright: ignore

    def take(envs: Any, actions: np.ndarray) -> None:
        for action in actions.astype(np.float32):
            envs.step(action)

    speeds = {}
    for n in options.peer_envs:
        envs, actions = walk(n)
        take(envs, actions)
        begun = time.perf_counter()
        take(envs, actions)
        speeds[n] = n * options.steps / (time.perf_counter() - begun)
        envs.close()
    best = max(speeds, key=lambda n: speeds[n])
    envs, actions = walk(best)
    env, ours_actions, start = prepare("ant", options, maps=True)
    run = rollouts(env, ours_actions)
    ours, theirs = time_pairs(lambda: run(start), lambda: take(envs, actions))
    envs.close()
    mine, peer = options.envs * options.steps, best * options.steps
    results.add(
        f"ant, {options.envs} environments, with maps", "steps/s", [mine / t for t in ours],
        against=f"Gymnasium-Robotics {options.peer}, {best} processes",
        ratios=[(mine / a) / (peer / b) for a, b in zip(ours, theirs, strict=True)],
    )  # fmt: skip
    results.add(f"Gymnasium-Robotics {options.peer}, {best} processes", "steps/s", [peer / t for t in theirs])


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
