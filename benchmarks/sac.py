"""SAC for the low-level controller: gradient updates/s, and the time until it succeeds on 90 % of the held-out edges.

    python benchmarks/sac.py [--full]

The peer is Stable-Baselines3's SAC (torch). Its ``VecEnv`` wraps our compiled, vectorised environments, and it has the
same networks, batch, rewards and normalised inputs. Two settings are measured: one environment with one update per
step, and our setting (64 environments, 8 updates per step). The times include stepping, storing and sampling. Our
environments reset themselves and do not keep the last observation, so for the peer a time-out is the same as a failure.
*Products alone* is an upper limit: the number of operations of an update, as counted by XLA, in matrix products of the
same size, four of them in parallel. With --full the peer is also trained until it succeeds on 90 % of the edges.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _harness import Contestant, Options, Results, command_line, has_peer
from flax import struct

from ct_envs import MazeEnv, Tasks, load_maze
from ct_envs.maze import Maze
from ct_jax.controller import ControllerConfig, SacController, edge_success, learned, start_training
from ct_jax.controllers.edges import split_edges
from ct_jax.controllers.off_policy import OffPolicy
from ct_jax.controllers.sac import SacConfig
from ct_jax.prm import build_roadmap

PEER = "Stable-Baselines3"
PRODUCTS = "products alone"
CHUNK = 5  # iterations between two evaluations


@dataclass(frozen=True)
class SacOptions(Options):
    """Sizes of the benchmark."""

    robots: tuple[str, ...] = ("point", "ant")
    """Robots for the updates per second."""
    updates: int = 128
    """Updates per call."""
    learner: str = "point"
    """Robot for the training time."""
    walks: float = 0.9
    """Success rate on the held-out edges at which the training ends."""
    patience_s: float = 1200.0
    """Training time after which the training is stopped [s]."""


def main(options: SacOptions) -> None:
    """Run the benchmark."""
    results = Results(__file__, options)
    peer = has_peer("stable_baselines3", PEER)
    for robot in options.robots:
        flop = None
        for envs, updates, asked in ((1, 1, 2.5), (64, 8, 5.0)):
            ours = Learner(robot, SacConfig(envs=envs, updates=updates))
            flop = flop or update_flop(ours)
            count(ours, flop, peer, asked, options, results)
    learn(peer and options.full, options, results)
    results.finish()


def count(ours: "Learner", flop: float, peer: bool, asked: float, options: SacOptions, results: Results) -> None:
    """The rows of a robot's updates per second; ``flop`` is the number of operations per update."""
    config = ours.state.config
    iterations = max(1, options.updates // config.updates)
    work = float(iterations * config.updates)
    others = {PRODUCTS: products(config, flop, work)}
    if peer:
        theirs = PeerLearner(ours)
        others[PEER] = Contestant(lambda: theirs.train(iterations), work)
    name = f"{ours.env.robot.name}, {config.envs} environments, {config.updates} updates a step"
    results.race(name, "updates/s", Contestant(lambda: ours.train(iterations), work), others, asked={PEER: asked})


def update_flop(learner: "Learner") -> float:
    """Floating-point operations of an update, as counted by XLA, for a learner with one update per iteration."""
    one = jax.jit(OffPolicy.learn).lower(learner.state).compile()
    return float(one.cost_analysis()["flops"])  # pyright: ignore


def products(config: SacConfig, flop: float, updates: float) -> Contestant:
    """The operations of a number of updates, as matrix products of the batch with a hidden layer."""
    width = config.hidden[-1]
    layer = jax.random.normal(jax.random.key(0), (width, width)) / width**0.5
    batches = tuple(jax.random.normal(jax.random.key(1), (4, config.batch, width)))
    times = max(1, round(updates * flop / (4 * 2 * config.batch * width**2)))
    multiply = jax.jit(lambda x: jax.lax.fori_loop(0, times, lambda _, x: tuple(each @ layer for each in x), x))
    return Contestant(lambda: multiply(batches), updates)


def learn(peer: bool, options: SacOptions, results: Results) -> None:
    """The row of the training time until the success rate is high enough."""
    name = f"{options.learner}: until {100 * options.walks:.0f} % of the edges are walked"
    ours = Learner(options.learner, SacConfig())
    reached = time_to(options, ours.train, lambda: ours.success(ours.controller))
    if not peer:
        results.add(name, "s", [reached])
        return
    theirs = PeerLearner(ours)
    other = time_to(options, theirs.train, lambda: ours.success(theirs.controller))
    results.add(name, "s", [reached], against=PEER, other=[other], ratios=[other / reached])


def time_to(options: SacOptions, train: Callable[[int], Any], success: Callable[[], float]) -> float:
    """Training time [s] until the success rate is high enough, without the evaluations; infinite beyond the limit."""
    spent = 0.0
    while success() < options.walks:
        if spent > options.patience_s:
            return float("inf")
        begun = time.perf_counter()
        train(CHUNK)
        spent += time.perf_counter() - begun
    return spent


class Learner:
    """Our learner, on the edges of a roadmap of ``antmaze-large``."""

    def __init__(self, robot: str, sac: SacConfig):
        self.maze, self._config = load_maze("antmaze-large"), ControllerConfig(sac)
        edges = self._config.edges
        options = {"horizon": edges.episode_steps, "maps": False}
        self.env = MazeEnv(robot, engine="auto", reset_velocity_mps=edges.reset_velocity_mps, **options)
        self._still = MazeEnv(robot, engine="auto", auto_reset=False, **options)
        roadmap = build_roadmap(jax.random.key(0), self.maze, radius_m=self.env.robot.radius_m)
        self.tasks, self._held_out = split_edges(roadmap, edges.held_out, 0)
        begun = start_training(jax.random.key(0), self.env, self.maze, self.tasks, self._config)
        self.state, _ = begun.train(sac.warmup)
        self.state.train(CHUNK)  # compiles

    def train(self, iterations: int) -> Any:
        """Train for a number of iterations."""
        self.state, report = self.state.train(iterations)
        return jax.block_until_ready(report)

    @property
    def controller(self) -> SacController:
        """The current controller."""
        return learned(self.state, self._config)

    def success(self, controller: Any) -> float:
        """Success rate of a controller on the held-out edges."""
        return edge_success(self._still, controller, self.maze, self._held_out, jax.random.key(1))


@struct.dataclass
class PeerController:
    """The peer's policy as a controller."""

    mean: jax.Array
    deviation: jax.Array
    layers: tuple[tuple[jax.Array, jax.Array], ...]
    action_size: int = struct.field(pytree_node=False)

    def __call__(self, proprio: jax.Array, goal: jax.Array) -> jax.Array:
        seen = jnp.concatenate([proprio, goal], -1)
        x = jnp.clip((seen - self.mean[None]) / self.deviation[None], -10.0, 10.0)
        for weight, bias in self.layers[:-1]:
            x = jax.nn.relu(x @ weight.T + bias[None])
        weight, bias = self.layers[-1]
        return jnp.tanh(x @ weight.T + bias[None])


class PeerLearner:
    """Stable-Baselines3's learner, on the same tasks with the same settings."""

    def __init__(self, ours: Learner):
        import torch  # pyright: ignore[reportMissingImports]
        from stable_baselines3 import SAC  # pyright: ignore[reportMissingImports]
        from stable_baselines3.common.vec_env import VecNormalize  # pyright: ignore[reportMissingImports]

        config, size = ours.state.config, ours.env.action_size
        self._envs, self._action_size = config.envs, size
        self._normal = VecNormalize(vec_env(ours.state, ours.maze, ours.tasks), norm_reward=False)
        torch.manual_seed(0)
        self._sac = SAC(
            "MlpPolicy", self._normal, learning_rate=config.learning_rate, buffer_size=config.replay,
            learning_starts=config.warmup * config.envs, batch_size=config.batch, tau=config.target_rate,
            gamma=config.discount, train_freq=(1, "step"), gradient_steps=config.updates,
            ent_coef=f"auto_{config.initial_temperature}", target_entropy=-0.5 * size,
            policy_kwargs={"net_arch": list(config.hidden)},
        )  # fmt: skip
        self.train(config.warmup)

    def train(self, iterations: int) -> None:
        """Train for a number of iterations."""
        self._sac.learn(iterations * self._envs, reset_num_timesteps=False)

    @property
    def controller(self) -> PeerController:
        """The current controller."""
        actor, seen = self._sac.policy.actor, self._normal.obs_rms
        linear = [layer for layer in actor.latent_pi if hasattr(layer, "weight")] + [actor.mu]
        layers = tuple(
            tuple(jnp.asarray(leaf.detach().cpu().numpy()) for leaf in (layer.weight, layer.bias)) for layer in linear
        )
        deviation = jnp.asarray(np.sqrt(seen.var + self._normal.epsilon), jnp.float32)
        return PeerController(jnp.asarray(seen.mean, jnp.float32), deviation, layers, self._action_size)  # pyright: ignore


def vec_env(training: OffPolicy, maze: Maze, tasks: Tasks) -> Any:
    """Our learner's environments, with its observations and rewards, as a ``VecEnv``."""
    from gymnasium.spaces import Box  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

    task, config = training.task, training.config
    env, n = task.env, config.envs

    @jax.jit
    def step(state: Any, action: jax.Array) -> tuple[Any, ...]:
        after = jax.vmap(env.step)(state, config.action_scale * action)
        return after, task.observe(after), task.reward(state, action, after), after.done

    class Environments(VecEnv):
        """All environments; one compiled call steps them."""

        def __init__(self) -> None:
            seen = Box(-np.inf, np.inf, (task.observation_size,), np.float32)
            super().__init__(n, seen, Box(-1.0, 1.0, (env.action_size,), np.float32))
            reset = jax.vmap(env.reset, in_axes=(0, None, None))
            self._state = jax.jit(reset)(jax.random.split(jax.random.key(0), n), maze, tasks)

        def reset(self) -> np.ndarray:
            return np.asarray(task.observe(self._state))

        def step_async(self, actions: np.ndarray) -> None:
            before = self._observed if hasattr(self, "_observed") else self.reset()
            self._state, observed, reward, done = step(self._state, jnp.asarray(actions))
            self._observed, over = np.asarray(observed), np.asarray(done) > 0
            infos = [{"terminal_observation": before[i]} if over[i] else {} for i in range(n)]
            self._answer = self._observed, np.asarray(reward), over, infos

        def step_wait(self) -> tuple[Any, ...]:
            return self._answer

        def close(self) -> None: ...

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [None] * n

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
            return [None] * n

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * n

    return Environments()


if __name__ == "__main__":
    command_line(main, SacOptions, __doc__)
