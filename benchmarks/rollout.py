"""Environment steps/s of ``MazeEnv``, compared with raw physics and with peers; and planner-guided trajectories/s.

    python benchmarks/rollout.py [--full]

Ours takes random actions under jit. In addition to the physics it computes walls, observations, rewards and auto-reset.
*maps*: all observations; *proprio*: without local maps; *nothing*: no observations. The limit is raw physics: the same
model, number of control steps and actions, and nothing else. It is ``mujoco.batch`` for the engine "mujoco" (CPU) and
vmapped ``mjx.step`` for "mjx". The peers have an ant, too: the ant mazes of Gymnasium-Robotics and OGBench, with one
process per environment and the number of environments that gives the most steps/s; and brax's ant under vmap, without a
maze or resets. A control step is five physics steps for all of them. *collection* is Algorithm 3 with the shipped
controllers and the settings of the preset ``cpu``, including the roadmaps.
"""

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _harness import Contestant, Options, Results, command_line, has_peer
from mujoco import mjx
from mujoco.batch import Batch

from ct_envs import MazeEnv, load_maze
from ct_jax.collect import collect
from ct_jax.configs import get_preset
from ct_jax.model import load_controller
from ct_jax.runtime.run import cores
from ct_jax.worlds.mazes import MazeWorld

MAZE = "antmaze-large"
MIDDLE = 256  # number of environments at which the observations and the peers are compared
GYMNASIUM = {
    "Gymnasium-Robotics": ("gymnasium_robotics", "AntMaze_Large-v5"),
    "OGBench": ("ogbench", "antmaze-large-v0"),
}


@dataclass(frozen=True)
class RolloutOptions(Options):
    """Sizes of the benchmark."""

    envs: tuple[int, ...] = (1, 64, 256, 4096)
    """Numbers of environments (--full: powers of two up to 4096)."""
    robots: tuple[str, ...] = ("point", "ant")
    """Robots."""
    work: int = 25_600
    """Control steps per call on the fast engine, summed over the environments. MJX on CPU takes a fiftieth of them."""
    peers: bool = True
    """Also measure the peers."""
    peer_envs: tuple[int, ...] = (1, 2, 4, 8, 16)
    """Numbers of environments to try for the peers."""
    trajectories: int = 200
    """Trajectories to collect per call. 0 leaves the collection out."""


def main(options: RolloutOptions) -> None:
    """Run the benchmark."""
    results = Results(__file__, options)
    on_cpu = jax.default_backend() == "cpu"
    envs = tuple(2**i for i in range(13)) if options.full else options.envs
    for robot in options.robots:
        for n in envs:
            for seen in ("maps", "proprio", "nothing") if n == MIDDLE else ("maps",):
                measure(robot, "mujoco" if on_cpu else "mjx", n, seen, options, results)
        if on_cpu:
            measure(robot, "mjx", 64, "maps", options, results)
        growth(robot, envs, options, results)
    if "ant" in options.robots and options.peers:
        measure_peers(options, results)
    for robot in options.robots if options.trajectories else ():
        collection(robot, options, results)
    results.finish()


def steps_of(engine: str, envs: int, options: RolloutOptions) -> int:
    """Control steps per call."""
    scale = 1.0 if engine == "mujoco" else 0.02 if jax.default_backend() == "cpu" else 40.0
    return int(np.clip(scale * options.work / envs, 5, 400))


@dataclass(frozen=True)
class Prepared:
    """An environment, the actions of all steps [T, N, A], and the initial states."""

    env: MazeEnv
    actions: jax.Array
    start: Any

    @property
    def work(self) -> int:
        return self.actions.shape[0] * self.actions.shape[1]


def prepare(robot: str, engine: str, envs: int, options: RolloutOptions, *, maps: bool = True) -> Prepared:
    """Prepare the inputs of a rollout."""
    env = MazeEnv(robot, engine=engine, maze=load_maze(MAZE), maps=maps)
    shape = (steps_of(engine, envs, options), envs, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0)
    return Prepared(env, actions, jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), envs)))


def rollout(ready: Prepared, *, observe: bool = True) -> Contestant:
    """A compiled rollout over all actions."""
    step = jax.vmap(ready.env.step)

    @jax.jit
    def run(state: Any, actions: jax.Array) -> Any:
        def once(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            after = step(state, action)
            # XLA computes the observations only if the next step gets them.
            return after if observe else after.replace(obs=state.obs), after.reward

        return jax.lax.scan(once, state, actions)

    return Contestant(lambda: run(ready.start, ready.actions), ready.work)


def raw_mujoco(ready: Prepared) -> Contestant:
    """The same physics steps in MuJoCo's threads."""
    n, engine = ready.actions.shape[1], ready.env.engine
    batch = Batch(engine.model, nsim=n, nthread=min(n, cores()))
    ctrl, qpos, actions = batch.bind("ctrl"), batch.bind("qpos"), np.asarray(ready.actions, np.float64)
    qpos[:] = np.asarray(ready.start.pipeline_state.qpos)

    def run() -> None:
        for action in actions:
            ctrl[:] = action
            batch.step(nstep=engine.n_substeps)

    return Contestant(run, ready.work)


def raw_mjx(ready: Prepared) -> Contestant:
    """The same physics steps in XLA."""
    engine = ready.env.engine
    model = mjx.put_model(engine.model)
    step = jax.vmap(mjx.step, in_axes=(None, 0))

    @jax.jit
    def run(qpos: jax.Array, actions: jax.Array) -> jax.Array:
        data = jax.vmap(lambda qpos: mjx.make_data(model).replace(qpos=qpos))(qpos)

        def once(data: Any, action: jax.Array) -> tuple[Any, None]:
            data, _ = jax.lax.scan(
                lambda d, _: (step(model, d), None), data.replace(ctrl=action), length=engine.n_substeps
            )
            return data, None

        return jax.lax.scan(once, data, actions)[0].qpos

    return Contestant(lambda: run(ready.start.pipeline_state.qpos, ready.actions), ready.work)


LIMITS: dict[str, tuple[str, Callable[[Prepared], Contestant]]] = {
    "mujoco": ("raw mujoco.batch", raw_mujoco),
    "mjx": ("raw mjx.step", raw_mjx),
}


def measure(robot: str, engine: str, envs: int, seen: str, options: RolloutOptions, results: Results) -> None:
    """The row of one size, compared with raw physics."""
    ready = prepare(robot, engine, envs, options, maps=seen == "maps")
    limit, raw = LIMITS[engine]
    asked = {}
    if (robot, seen) == ("ant", "maps"):
        asked = {("mujoco", MIDDLE): {limit: 0.88}, ("mjx", 4096): {limit: 0.85}}.get((engine, envs), {})
    ours = rollout(ready, observe=seen != "nothing")
    results.race(f"{robot}, {engine}, {envs} envs, {seen}", "steps/s", ours, {limit: raw(ready)}, asked=asked)


def growth(robot: str, envs: tuple[int, ...], options: RolloutOptions, results: Results) -> None:
    """The row of the growth of the time per step with the number of environments."""
    small, large = min(64, max(envs)), max(envs)
    engine = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    few, many = (rollout(prepare(robot, engine, n, options)) for n in (small, large))
    label = f"a step of {small}"
    results.race(f"{robot}, growth: a step of {large}", "µs", many, {label: few}, asked={label: 1 / 1.3})


def measure_peers(options: RolloutOptions, results: Results) -> None:
    """The rows of the peers."""
    others, close = {}, []
    for name, (module, task) in GYMNASIUM.items():
        if has_peer(module, name):
            others[f"{name}, {task}"], envs = side_by_side(module, task, options)
            close.append(envs)
    ready = prepare("ant", "auto", MIDDLE, options)
    others["brax ant, backend mjx"] = brax_ant("mjx", ready)
    if options.full:
        others["brax ant, backend generalized"] = brax_ant("generalized", ready)
    asked = {name: 12.0 for name in others if name.startswith("Gymnasium")}
    results.race(f"ant, {MIDDLE} envs, maps", "steps/s", rollout(ready), others, asked=asked)
    for envs in close:
        envs.close()


def make_gymnasium(module: str, task: str) -> Any:
    """A peer's environment; runs in its own process."""
    import gymnasium  # pyright: ignore[reportMissingImports]

    gymnasium.register_envs(importlib.import_module(module))
    return gymnasium.make(task)


def side_by_side(module: str, task: str, options: RolloutOptions) -> tuple[Contestant, Any]:
    """A peer with the number of processes at which it is fastest, and its environments."""
    from gymnasium.vector import AsyncVectorEnv  # pyright: ignore[reportMissingImports]

    steps = max(5, options.work // MIDDLE)

    def walk(n: int) -> tuple[Any, Callable[[], None]]:
        envs = AsyncVectorEnv([lambda: make_gymnasium(module, task)] * n, context="forkserver")
        envs.reset(seed=0)
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (steps, *envs.action_space.shape)).astype(np.float32)  # pyright: ignore

        def take() -> None:
            for action in actions:
                envs.step(action)

        return envs, take

    speeds = {}
    for n in options.peer_envs:
        envs, take = walk(n)
        take()
        begun = time.perf_counter()
        take()
        speeds[n] = n / (time.perf_counter() - begun)
        envs.close()
    best = max(speeds, key=lambda n: speeds[n])
    envs, take = walk(best)
    return Contestant(take, steps * best), envs


def brax_ant(backend: str, ready: Prepared) -> Contestant:
    """brax's ant with the same number of environments. On a CPU it takes a fiftieth of the steps, to limit the time."""
    from brax.envs import get_environment

    env = get_environment("ant", backend=backend)
    steps, n, _ = ready.actions.shape
    if jax.default_backend() == "cpu":
        steps = max(1, steps // 50)
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), n))
    step = jax.vmap(env.step)

    @jax.jit
    def run(state: Any, actions: jax.Array) -> Any:
        def once(state: Any, action: jax.Array) -> tuple[Any, None]:
            return step(state, action), None

        return jax.lax.scan(once, state, actions)[0].reward

    return Contestant(lambda: run(start, ready.actions[:steps]), steps * n)


def collection(robot: str, options: RolloutOptions, results: Results) -> None:
    """The rows of planner-guided trajectories."""
    settings = get_preset("cpu", robot)
    controller, _ = load_controller("zoo", robot)
    env = MazeEnv(robot, maps=False, auto_reset=False, horizon=settings.collect.horizon)
    world = MazeWorld(env, load_maze(MAZE))
    for guide in ("roadmap", "shortcut", "explorer"):
        size = max(1, round(1.25 * options.trajectories))
        config = replace(settings.collect, trajectories=options.trajectories, envs=size, guide=guide)

        def run(config=config) -> object:
            return jnp.asarray(collect(jax.random.key(0), world, controller, config, settings.prm).length)

        name = f"{robot}, collection guided by {guide}"
        results.race(name, "trajectories/s", Contestant(run, options.trajectories))


if __name__ == "__main__":
    command_line(main, RolloutOptions, __doc__)
