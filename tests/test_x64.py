"""JAX_ENABLE_X64=1 does not change results: random draws, episodes, and 32-bit types are the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_envs import POINT, MazeEnv, load_maze, stack_mazes
from ct_envs.robots import ANT
from ct_jax.collect import CollectConfig, collect
from ct_jax.controller import ControllerConfig, start_training
from ct_jax.controllers.augment import AugmentConfig
from ct_jax.controllers.edges import EdgeConfig, chain_tasks, split_edges
from ct_jax.controllers.sac import SacConfig
from ct_jax.evaluate import evaluate
from ct_jax.finetune import RecoverConfig, recover
from ct_jax.fit import Fit, FitConfig, fit, init_params, transformer_loss, value_loss
from ct_jax.policy import TransformerPolicy
from ct_jax.prm import PrmConfig, build_roadmap
from ct_jax.transformer import ControlTransformer, ModelConfig, sample_inputs
from ct_jax.value import ValueNetwork
from ct_jax.worlds.mazes import MazeWorld

pytestmark = pytest.mark.rank_promotion("allow")  # MJX and brax

PRM = PrmConfig(samples=40)


@pytest.fixture
def both():
    """The results of a function without and with 64 bits, as NumPy arrays."""

    def call(function):
        found = []
        for wide in (False, True):
            jax.config.update("jax_enable_x64", wide)
            try:
                found.append(jax.device_get(function()))
            finally:
                jax.config.update("jax_enable_x64", False)
        return found

    return call


def plain(leaf):
    """An array; a random key becomes its numbers."""
    leaf = jnp.asarray(leaf) if not isinstance(leaf, np.ndarray) else leaf
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else np.asarray(leaf)


def assert_alike(narrow, wide, *, atol: float = 1e-4) -> None:
    """Compare numbers and types."""
    assert jax.tree.structure(narrow) == jax.tree.structure(wide)
    for (path, a), b in zip(jax.tree.leaves_with_path(narrow), jax.tree.leaves(wide), strict=True):
        a, b = plain(a), plain(b)
        where = jax.tree_util.keystr(path)
        assert a.dtype == b.dtype, f"{where}: {a.dtype} and {b.dtype}"
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=atol, err_msg=where)


@pytest.mark.parametrize(("robot", "engine"), [(POINT, "mujoco"), (POINT, "mjx"), (ANT, "mujoco")])
@pytest.mark.parametrize("auto_reset", [True, False])
def test_environments_do_not_depend_on_x64(both, robot, engine, auto_reset):
    env = MazeEnv(robot, engine=engine, auto_reset=auto_reset, horizon=3)
    maze = load_maze("antmaze-umaze")

    def drive():
        state = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(jax.random.key(0), 4), maze)
        step = jax.vmap(env.step)
        actions = np.random.default_rng(0).uniform(-1.2, 1.2, (5, 4, env.action_size))  # float64
        once = jax.jit(lambda state, actions: jax.lax.scan(lambda s, a: (step(s, a), s), state, actions))
        return once(state, jnp.asarray(actions))

    assert_alike(*both(drive), atol=1e-3)


def happened(maze, method, **who):
    """The episodes of a method in the first 60 steps, its pairs included."""
    world = MazeWorld(MazeEnv(POINT, engine="mujoco", auto_reset=False), maze)
    done = evaluate(world, world.draw_pairs(0, 3), method, prm=PRM, horizon=60, **who)
    names = ("success", "collided", "fell", "timeout", "steps", "returns", "travelled_m", "path", "target_return")
    pairs = (done.pairs.start, done.pairs.goal, np.asarray(done.pairs.shortest_m, np.float32))
    return {name: np.asarray(value, np.float32) for name in names if (value := getattr(done, name)) is not None}, pairs


@pytest.mark.parametrize("method", ["planner", "explorer"])
def test_guides_do_not_depend_on_x64(both, push, method):
    assert_alike(*both(lambda: happened(load_maze("antmaze-large"), method, controller=push())), atol=0.1)


CONFIG = ModelConfig(layers=1, heads=2, width=8, context=3, context_acting=3, max_timestep=8, modes=2, stride=2)


def transformer(clip_target_return: bool = False) -> TransformerPolicy:
    inputs = sample_inputs(2, 2)
    return TransformerPolicy(
        jax.jit(ControlTransformer(CONFIG, 2).init)(jax.random.key(0), *inputs),
        jax.jit(ValueNetwork(4).init)(jax.random.key(0), *inputs[:3]), CONFIG, 2, value_width=4,
        clip_target_return=clip_target_return,
    )  # fmt: skip


def test_transformer_does_not_depend_on_x64(both):
    policy = jax.device_get(transformer(clip_target_return=True))  # drawn without 64 bits, like a shipped model
    assert_alike(*both(lambda: happened(load_maze("antmaze-large"), "ct", policy=policy)), atol=1e-2)


@pytest.mark.parametrize("options", [{}, {"relabel": 0.5, "chain": True, "turn_ramp": (0.2, 0.6)}])
def test_sac_does_not_depend_on_x64(both, options):
    """The state has the same types, and the initial values are the same. Later draws of brax differ."""
    sac = SacConfig(envs=4, iterations=8, updates=1, warmup=2, batch=8, hidden=(8,), replay=64)
    config = ControllerConfig(sac, EdgeConfig(episode_steps=4, **options), AugmentConfig(mirror=bool(options)))
    robot = ANT if options else POINT
    maze = load_maze("antmaze-umaze")

    def learn():
        env = MazeEnv(robot, engine="mujoco", maps=False, horizon=4)
        roadmap = build_roadmap(jax.random.key(0), maze, radius_m=robot.radius_m, config=PRM)
        tasks = chain_tasks(split_edges(roadmap, 0.2, 0)[0], 0)
        state, metrics = start_training(jax.random.key(0), env, maze, tasks, config).train(sac.warmup + 1)
        assert np.isfinite(jax.tree.leaves(metrics)).all()
        return state

    narrow, wide = both(learn)
    assert_alike(narrow.replay.data[:8], wide.replay.data[:8], atol=1e-3)
    assert_alike(*([np.zeros(0, plain(leaf).dtype) for leaf in jax.tree.leaves(state)] for state in (narrow, wide)))


@pytest.mark.parametrize("kind", ["transformer", "value"])
def test_fit_does_not_depend_on_x64(both, toy_data, kind):
    data = toy_data([9, 12], side_m=20.0)
    mazes = stack_mazes([load_maze("antmaze-umaze")])
    model = ControlTransformer(CONFIG, 2) if kind == "transformer" else ValueNetwork(4)
    loss = transformer_loss(model) if isinstance(model, ControlTransformer) else value_loss(model)
    config = FitConfig(updates=2, batch=4, steps=4, warmup=1, mirror=True, shift_timestep=2)
    params = jax.device_get(init_params(jax.random.key(0), model, data))

    def learn():
        return fit(jax.random.key(0), Fit(loss, config, 0.8, POINT, stride=2), params, data, mazes)

    assert_alike(*both(learn))


def test_collection_does_not_depend_on_x64(both, push):
    world = MazeWorld(MazeEnv(POINT, engine="mujoco", auto_reset=False), stack_mazes([load_maze("antmaze-umaze")] * 2))
    config = CollectConfig(trajectories=3, reset_interval=2, envs=4, horizon=200, noise=0.3)
    recovering = RecoverConfig(recoveries=1, stuck_steps=5, patience=10, takeover=0.1, keep="joined")
    policy = jax.device_get(transformer())

    def gather():
        collected = collect(jax.random.key(0), world, push(), config, PRM)
        recovered = recover(jax.random.key(0), world, policy, push(), recovering, config, PRM)
        return [(data.length, data.goal_world, data.position[:, 0]) for data in (collected, recovered)]

    assert_alike(*both(gather), atol=1e-2)
