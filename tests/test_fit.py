"""Supervised training: it learns, it can be stopped and continued, and it is one program on any number of devices."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_envs import POINT, UserError, load_maze, stack_mazes
from ct_jax.fit import (
    MODE_SPREAD,
    Fit,
    FitConfig,
    ValueConfig,
    best_trajectories,
    fit,
    init_params,
    transformer_loss,
    value_loss,
)
from ct_jax.learner import train, updates_on
from ct_jax.pipeline import make_learner
from ct_jax.runtime.checkpoint import Checkpoints
from ct_jax.trajectories import sample_windows
from ct_jax.transformer import ControlTransformer, ModelConfig, Modes
from ct_jax.value import ValueNetwork

MAZES = stack_mazes([load_maze("antmaze-umaze")])
CONFIG = FitConfig(updates=8, batch=4, steps=3, learning_rate=1e-2, warmup=2)
MODEL = ControlTransformer(
    ModelConfig(layers=1, heads=1, width=8, context=3, context_acting=3, dropout=0.2, max_timestep=32), 2
)


@pytest.fixture(scope="module")
def data(toy_data):
    data = toy_data([9, 17, 20], seed=1)
    return data.replace(label=np.tanh(data.position - 10.0), proprio=data.position / 10.0)


@pytest.fixture(scope="module")
def learner():
    """One for all, so that it compiles once."""
    return Fit(transformer_loss(MODEL), CONFIG, 0.8, POINT)


@pytest.fixture(scope="module")
def params(data):
    return init_params(jax.random.key(0), MODEL, data)


def run(learner, params, data, seed=0, **options):
    return fit(jax.random.key(seed), learner, params, data, MAZES, **{"chunk": 2} | options)


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


# ---------------------------------------------------------------------------------------------------------- learning


def test_the_loss_falls(data, params):
    losses = []
    run(
        Fit(transformer_loss(MODEL), replace(CONFIG, updates=120, batch=16), 0.8, POINT),
        params,
        data,
        chunk=20,
        on_progress=lambda update, loss: losses.append((update, loss)),
    )
    assert [update for update, _ in losses] == [20, 40, 60, 80, 100, 120]
    assert losses[-1][1] < 0.5 * losses[0][1]


def test_bfloat16_learns_alike_and_keeps_its_parameters_in_float32(data, params):
    losses = {}
    for precision in ("float32", "bfloat16"):
        learner = make_learner(MODEL, replace(CONFIG, updates=60, batch=16, precision=precision), 0.8, POINT)
        seen = losses.setdefault(precision, [])
        trained = run(learner, params, data, chunk=20, on_progress=lambda update, loss, seen=seen: seen.append(loss))
        assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(trained))
    assert losses["float32"] != losses["bfloat16"]
    np.testing.assert_allclose(losses["bfloat16"], losses["float32"], rtol=0.1)


def test_the_seed_decides(learner, params, data):
    once, again, other = (run(learner, params, data, seed) for seed in (0, 0, 1))
    assert same(once, again)
    assert not same(once, other)


def test_chunks_compile_once_and_change_nothing(data, params):
    learner = Fit(transformer_loss(MODEL), CONFIG, 0.8, POINT)
    before = updates_on(learner.mesh)._cache_size()  # pyright: ignore
    by_two = run(learner, params, data, chunk=2)
    assert updates_on(learner.mesh)._cache_size() == before + 1  # pyright: ignore
    by_four = run(learner, params, data, chunk=4)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), by_two, by_four)


def test_the_rate_warms_up_from_zero(data, params):
    learner = Fit(transformer_loss(MODEL), replace(CONFIG, warmup=4, weight_decay=0.0), 0.8, POINT)
    state = learner.create(jax.random.key(0), params)
    sizes = []
    for _ in range(6):
        after, _ = train(state, 1, data, data.rtg, MAZES)
        moved = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), after.params, state.params)
        sizes.append(float(jnp.stack(jax.tree.leaves(moved)).max()))
        state = after
    assert sizes[0] == 0.0
    # Adam's first moves are about as long as the rate
    np.testing.assert_allclose(sizes[1], 0.25 * CONFIG.learning_rate, rtol=0.3)
    assert 0 < sizes[1] < sizes[2] < 1.5 * CONFIG.learning_rate


def test_neither_biases_nor_skills_decay():
    learner = Fit(
        lambda params, window, key: (jnp.zeros(()), {}), replace(CONFIG, weight_decay=0.5, warmup=1), 0.8, POINT
    )
    params = {"kernel": jnp.ones((2, 2)), "bias": jnp.ones(2), "skill": {"kernel": jnp.ones((2, 2))}}
    state = learner.descent.init(params)
    for _ in range(2):
        change, state = learner.descent.update(jax.tree.map(jnp.zeros_like, params), state, params)
    assert (change["kernel"] < 0).all() and (change["bias"] == 0).all() and (change["skill"]["kernel"] == 0).all()


# ---------------------------------------------------------------------------------------------------- stop and go on


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_training_goes_on_to_the_same_end(learner, params, data, tmp_path, stop):
    """To the bit. After Ctrl-C from the state of that moment, after a crash from the last one that was saved."""
    whole = run(learner, params, data)

    def interrupt(update: int, loss: float) -> None:
        if update == 4:
            raise stop

    first = Checkpoints(tmp_path / "states", every_s=0.0 if stop is RuntimeError else 1e9)
    with pytest.raises(stop):
        run(learner, params, data, checkpoints=first, on_progress=interrupt)
    first.close()
    second, seen = Checkpoints(tmp_path / "states"), []
    other = jax.tree.map(jnp.zeros_like, params)
    again = run(learner, other, data, seed=5, checkpoints=second, on_progress=lambda u, _: seen.append(u))
    second.close()
    assert seen == ([6, 8] if stop is KeyboardInterrupt else [4, 6, 8])
    assert same(again, whole)


# ------------------------------------------------------------------------------------------------------- what counts


def test_what_is_not_to_be_imitated_teaches_nothing(data, params):
    data = data.replace(label_mask=(np.random.default_rng(0).random(data.label_mask.shape) < 0.5).astype(np.float32))
    window = sample_windows(jax.random.key(0), data, data.rtg, MAZES, batch=8, steps=3, map_cell_m=0.8)
    assert 0 < window.label_mask.mean() < 1
    loss = transformer_loss(MODEL)
    grad = jax.jit(jax.value_and_grad(lambda *inputs: loss(*inputs)[0]))
    shown = grad(params, window, jax.random.key(1))
    other = window.replace(label=jnp.where(window.label_mask[..., None] > 0, window.label, 1e3))
    assert same(shown, grad(params, other, jax.random.key(1)))
    nothing = grad(params, window.replace(label_mask=0 * window.label_mask), jax.random.key(1))
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(nothing))
    half = window.replace(label_mask=0.5 * window.label_mask)  # a weight of all is no weight
    np.testing.assert_allclose(grad(params, half, jax.random.key(1))[0], shown[0], rtol=1e-5)


def test_two_modes_learn_either_way_where_one_learns_neither(data):
    """Half of the pieces are told left, half right: one mode's best is between them, of two each takes a side."""
    window = sample_windows(jax.random.key(0), data, data.rtg, MAZES, batch=8, steps=3, map_cell_m=0.8)
    window = window.replace(label=jnp.where(jnp.arange(8)[:, None, None] < 4, 1.0, -1.0) + 0 * window.label)
    window = window.replace(label_mask=jnp.ones_like(window.label_mask))

    def loss_of(action, logit):
        model = SimpleNamespace(apply=lambda *inputs, **options: Modes(jnp.asarray(action), jnp.asarray(logit)))
        return float(transformer_loss(model)({}, window, jax.random.key(0))[0])

    steps, size = window.rtg.shape, window.label.shape[-1]
    one = lambda value: loss_of(np.full((*steps, 1, size), value, np.float32), np.zeros((*steps, 1), np.float32))  # noqa: E731
    assert np.allclose([one(0.0), one(1.0), one(0.5)], [1.0, 2.0, (0.25 + 2.25) / 2], rtol=1e-5)  # the squared error
    sides = np.broadcast_to(np.array([1.0, -1.0], np.float32)[:, None], (*steps, 2, size))
    both = loss_of(sides, np.zeros((*steps, 2), np.float32))
    assert np.isclose(both, MODE_SPREAD * np.log(2), rtol=1e-5)  # right, but for not knowing which
    assert loss_of(sides, np.broadcast_to(np.array([9.0, 0.0], np.float32), (*steps, 2))) > both


def score(data):
    straight = np.linalg.norm(data.goal_world - data.position[:, 0], axis=1)
    return np.asarray(data.rtg)[:, 0] / np.maximum(straight, 1.0) ** 2


@pytest.mark.parametrize("top", [1.0, 0.5, 0.1])
def test_the_value_network_sees_the_best(toy_data, top):
    data = toy_data(list(range(5, 25)))
    best = best_trajectories(data, ValueConfig(top=top), np.inf)
    assert best.n == max(1, round(top * data.n))
    chosen = np.isin(data.length, best.length)
    assert score(data)[chosen].min() >= score(data)[~chosen].max(initial=-np.inf)


def test_the_value_network_sees_no_collision(toy_data):
    data = toy_data([5] * 6, steps=8)
    collision = np.zeros((6, 8), np.float32)
    collision[0, 0] = collision[1, 4] = 1.0
    collision[2, 5] = 1.0  # after its end: none of it
    data = data.replace(collision=collision, proprio=data.proprio)
    best = best_trajectories(data, ValueConfig(collision_free=True), np.inf)
    np.testing.assert_array_equal(best.proprio[:, 0, 0], [2, 3, 4, 5])
    both = best_trajectories(data, ValueConfig(collision_free=True, top=0.5), np.inf)
    assert both.n == 2 and set(both.proprio[:, 0, 0]) < {2, 3, 4, 5}


def test_the_value_network_sees_arrivals_only(toy_data):
    data = toy_data([4, 5, 6], steps=8)
    reward = np.array(data.reward) - 1.0
    reward[1, 4] = reward[2, 6] = -0.3  # the last step of the second; the third was cut short a step before
    best = best_trajectories(data.replace(reward=reward), ValueConfig(), 0.5)
    np.testing.assert_array_equal(best.length, [5])
    with pytest.raises(UserError, match="no trajectory arrives"):
        best_trajectories(data.replace(reward=reward - 1.0), ValueConfig(), 0.5)


def test_no_trajectory_without_a_collision_is_an_error(toy_data):
    data = toy_data([5, 5])
    with pytest.raises(UserError, match="collision"):
        best_trajectories(data.replace(collision=1 + 0 * data.collision), ValueConfig(collision_free=True), np.inf)


def test_without_compilation(data):
    model = ValueNetwork(4)
    learner = Fit(value_loss(model), FitConfig(updates=2, batch=2, steps=1, warmup=1), 0.8, POINT)
    params = init_params(jax.random.key(0), model, data)
    compiled = run(learner, params, data)
    with jax.disable_jit():
        plain = run(learner, params, data)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), plain, compiled)
