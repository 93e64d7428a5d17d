"""Environment steps/s of ``MazeEnv`` under jit against raw ``mujoco.batch`` of the same model.

    python benchmarks/rollout.py [--envs 256] [--steps 100]

Both sides take the same number of control steps with the same actions; ours adds walls, observations with maps, rewards
and auto-reset.
"""

from dataclasses import dataclass

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


def rollouts(env: MazeEnv, actions: jax.Array):
    """A compiled function that takes all the actions in turn, as users run it."""

    @jax.jit
    def run(state):
        def step(state, action):
            state = jax.vmap(env.step)(state, action)
            return state, state.reward  # the observations are in the carried state, so every step makes them

        return jax.lax.scan(step, state, actions)

    return run


def main(options: Options) -> None:
    """Run and print."""
    results = Results("rollout")
    for robot in options.robots:
        measure(robot, options, results)
    results.finish()


def measure(robot: str, options: Options, results: Results) -> None:
    """The lines of one robot."""
    maze = load_maze("antmaze-large")
    keys = jax.random.split(jax.random.key(0), options.envs)
    for maps in (True, False):
        env = MazeEnv(robot, engine="mujoco", maze=maze, maps=maps)
        actions = jax.random.uniform(
            jax.random.key(1), (options.steps, options.envs, env.action_size), minval=-1.0, maxval=1.0
        )
        start = jax.jit(jax.vmap(env.reset))(keys)
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


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
