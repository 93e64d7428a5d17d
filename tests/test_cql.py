"""Conservative Q-learning: it learns what is better, distrusts what it never saw, and knows where an episode ends."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_envs import POINT, MazeEnv, load_maze, stack_mazes
from ct_jax.baselines.cql import Cql, CqlConfig, train_cql, transitions
from ct_jax.baselines.networks import tanh_gaussian
from ct_jax.learner import train
from ct_jax.rollout import as_frame
from ct_jax.rollout import run as roll_out
from ct_jax.runtime.checkpoint import Checkpoints
from ct_jax.trajectories import sample_windows, select
from ct_jax.worlds.mazes import start_episodes

UMAZE = load_maze("antmaze-umaze")
MAZES = stack_mazes([UMAZE])
TINY = CqlConfig(updates=4, batch=8, width=8, samples=3, imitation=2, learning_rate=1e-2)


def make(**changes) -> Cql:
    return Cql(replace(TINY, **changes), 0.8, POINT, 2)


@pytest.fixture(scope="module")
def learner():
    """One for all, so that it compiles once."""
    return make()


@pytest.fixture(scope="module")
def arriving(toy_data):
    """Random trajectories, the first two of which end at their goals and the third nowhere."""
    data = toy_data([5, 1, 4], steps=7)
    reward = np.minimum(data.reward, -1.0)
    reward[0, 4] = reward[1, 0] = -0.4
    return data.replace(reward=reward)


@pytest.fixture(scope="module")
def fork(toy_data):
    """One state; to the right one is there, to the left one has to come back from far away."""
    data = toy_data([1, 2] * 20)
    still = np.zeros_like(data.position) + np.float32([6, 6])
    right = np.zeros_like(data.action) + np.float32([0.7, 0.0])
    left = right * np.float32([-1, 1])
    odd = (np.arange(data.n) % 2 == 1)[:, None]
    first = (np.arange(2) == 0)[None]
    return data.replace(
        position=np.where((odd & ~first)[..., None], np.float32([6, 14]), still),
        proprio=np.zeros_like(data.proprio),
        action=np.where((odd & first)[..., None], left, right) + 0.05 * data.action,
        reward=np.where(odd & first, -8.0, -0.3).astype(np.float32),
        goal_world=np.zeros_like(data.goal_world) + np.float32([6.8, 6]),
        maze=np.zeros_like(data.maze),
    )


@pytest.fixture(scope="module")
def good(fork):
    """The better half of it, twice."""
    return select(fork, np.tile(np.arange(0, fork.n, 2), 2))


def run(learner, data, seed=0, **options):
    return train_cql(jax.random.key(seed), learner, data, MAZES, **{"chunk": 1} | options)


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def draw(data, n=2000):
    pick = jax.jit(sample_windows, static_argnames=("batch", "steps", "overhang", "map_cell_m"))
    window = pick(jax.random.key(0), data, data.reward, MAZES, batch=2000, steps=2, overhang=1, map_cell_m=0.8)
    return jax.tree.map(lambda leaf: leaf[:n], transitions(window, POINT.goal_tolerance_m))


# ------------------------------------------------------------------------------------------------------- transitions


def test_every_step_is_drawn_alike_and_followed_by_the_next(arriving):
    batch = draw(arriving)
    rows, counts = np.unique(batch.now.proprio, axis=0, return_counts=True)
    everything = [(i, t) for i, n in enumerate(arriving.length) for t in range(n)]
    assert [tuple(row) for row in rows] == everything
    assert counts.min() > 0.75 * 200 and counts.max() < 1.25 * 200
    i, t = np.asarray(batch.now.proprio, int).T
    np.testing.assert_array_equal(batch.reward, arriving.reward[i, t])
    np.testing.assert_array_equal(batch.action, arriving.action[i, t])
    inner = t + 1 < arriving.length[i]
    np.testing.assert_array_equal(batch.after.proprio[inner], np.stack([i, t + 1], -1)[inner])
    after = arriving.position[i, np.minimum(t + 1, 6)]
    np.testing.assert_array_equal(batch.after.goal_relative[inner], (arriving.goal_world[i] - after)[inner])


def test_only_an_arrival_is_an_end(arriving):
    """The end of a trajectory that was cut short is no end, but nobody knows what came after it either."""
    batch = draw(arriving)
    i, t = np.asarray(batch.now.proprio, int).T
    last = t + 1 == arriving.length[i]
    np.testing.assert_array_equal(batch.arrived, last & (i < 2))
    np.testing.assert_array_equal(batch.known, ~(last & (i == 2)))


def test_nothing_is_bootstrapped_at_the_end(arriving):
    """There the aim is the reward alone, whatever the targets say and whatever is stored after the end."""
    learner = make(soft_target=True, reward_scale=0.5)
    state = learner.create(jax.random.key(0), arriving)
    wild = jax.tree.map(lambda leaf: leaf + 3.0, state.target)
    batch = draw(arriving, 64)
    after = jax.tree.map(lambda leaf: leaf + jnp.ones((), leaf.dtype), batch.after)
    losses = jax.jit(learner._critic_losses)
    key = jax.random.key(1)
    here = losses(state.params, state.target, batch, key)
    elsewhere = losses(state.params, wild, batch.replace(after=after), key)
    end = np.asarray(batch.arrived) > 0
    assert 0 < end.sum() < 64
    np.testing.assert_allclose(here[0][end], elsewhere[0][end], rtol=1e-5)
    assert (np.abs(here[0] - elsewhere[0])[~end] > 0.1).all()
    q = jax.jit(learner.critics.apply)(state.params.critics, batch.now, batch.action[:, None])[:, 0]
    np.testing.assert_allclose(here[0][end], ((q - 0.5 * batch.reward[:, None]) ** 2).sum(-1)[end], rtol=1e-4)


def test_what_is_not_known_teaches_nothing(learner, arriving):
    reward = arriving.reward.copy()
    reward[2, 3] = -1e4
    assert same(run(learner, arriving), run(learner, arriving.replace(reward=reward)))
    reward[2, 2] = -1e4
    assert not same(run(learner, arriving), run(learner, arriving.replace(reward=reward)))


# ---------------------------------------------------------------------------------------------------------- learning


@pytest.fixture(scope="module")
def careful():
    return make(alpha=0.5, batch=16, imitation=0, width=16, learning_rate=5e-3)


@pytest.fixture(scope="module")
def careless():
    """No penalty, no entropy; its policy only imitates."""
    return make(alpha=0.0, batch=16, imitation=10**6, width=16, learning_rate=5e-3, temperature=0.0)


def taught(learner, data):
    state = learner.create(jax.random.key(0), data)
    for _ in range(3):
        state, info = train(state, 100, data, MAZES)
    assert np.isfinite(list(info.values())).all()
    return state


@pytest.fixture(scope="module")
def imitator(careless, good):
    return taught(careless, good)


def test_the_penalty_lowers_what_was_not_seen(careful, imitator, good):
    """Q of the data lies above Q of uniform actions in the same states, and without the penalty it does not."""
    batch = draw(good, 200)
    anything = jax.random.uniform(jax.random.key(5), (200, 30, 2), minval=-1.0, maxval=1.0)
    actions = jnp.concatenate([batch.action[:, None], anything], 1)
    states, apply = (taught(careful, good), imitator), jax.jit(careful.critics.apply)
    q = [apply(state.params.critics, batch.now, actions) for state in states]
    above = [float((each[:, 0] - each[:, 1:].mean(1)).mean()) for each in q]
    assert above[0] > 0.5 > 2 * abs(above[1])


def test_a_policy_without_critics_imitates(careless, imitator, good):
    mode = tanh_gaussian(2).mode(jax.jit(careless.actor.apply)(imitator.params.actor, draw(good, 2).now))
    np.testing.assert_allclose(mode[0], [0.7, 0.0], atol=0.1)
    assert float(jnp.exp(imitator.params.log_temperature)) == 0.0  # nothing stays nothing


@pytest.mark.rank_promotion("allow")
def test_the_better_action_is_imitated(careful, fork):
    policy = taught(careful, fork).policy
    env = MazeEnv(POINT, engine="mujoco", auto_reset=False, horizon=5)
    state = start_episodes(
        env, jax.random.split(jax.random.key(0), 1), MAZES, jnp.array([[6.0, 6.0]]), jnp.array([[6.8, 6.0]])
    )
    action, memory = policy.act((), as_frame(state), jax.random.key(0))
    again, _ = policy.act(memory, as_frame(state), jax.random.key(1))
    np.testing.assert_allclose(action.executed[0], [0.7, 0.0], atol=0.3)
    np.testing.assert_array_equal(action.executed, again.executed)  # without chance
    _, _, steps = roll_out(env, policy, state, (), jax.random.key(0), 5)
    assert np.isfinite(steps.reward).all()


def test_the_soft_maximum_is_that_of_all_actions(fork):
    """Importance weights make of the samples an estimate of log of the integral of exp Q, whatever the policy is."""
    learner = make(samples=4000, imitation=0)
    state = learner.create(jax.random.key(0), fork)
    batch = draw(fork, 2)
    _, gap, _ = jax.jit(learner._critic_losses)(state.params, state.target, batch, jax.random.key(1))
    axis = jnp.linspace(-0.995, 0.995, 200)
    grid = jnp.stack(jnp.meshgrid(axis, axis), -1).reshape(1, -1, 2).repeat(2, 0)
    q = jax.jit(learner.critics.apply)(
        state.params.critics, batch.now, jnp.concatenate([batch.action[:, None], grid], 1)
    )
    integral = jax.nn.logsumexp(q[:, 1:], axis=1) + jnp.log(4.0 / 200**2)
    np.testing.assert_allclose(gap, (integral - q[:, 0]).sum(-1), atol=0.3)  # unweighted, it would be 2.8 less


# ---------------------------------------------------------------------------------------------------- stop and go on


def test_the_target_follows_at_its_rate(learner, arriving):
    state = learner.create(jax.random.key(0), arriving)
    after, _ = train(state, 1, arriving, MAZES)
    rate = TINY.target_rate
    jax.tree.map(
        lambda old, new, now: np.testing.assert_allclose(new, (1 - rate) * old + rate * now, atol=1e-6),
        state.target, after.target, after.params.critics,
    )  # fmt: skip
    assert not same(state.target, after.target)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_training_goes_on_to_the_same_end(learner, arriving, tmp_path, stop):
    """To the bit. After Ctrl-C from the state of that moment, after a crash from the last one that was saved."""
    whole = run(learner, arriving)

    def interrupt(update, metrics):
        if update == 2:
            raise stop

    first = Checkpoints(tmp_path / "states", every_s=0.0 if stop is RuntimeError else 1e9)
    with pytest.raises(stop):
        run(learner, arriving, checkpoints=first, on_progress=interrupt)
    first.close()
    second, seen = Checkpoints(tmp_path / "states"), []
    again = run(learner, arriving, seed=5, checkpoints=second, on_progress=lambda u, _: seen.append(u))
    second.close()
    assert seen == ([3, 4] if stop is KeyboardInterrupt else [2, 3, 4])
    assert same(again, whole)


def test_without_compilation(arriving):
    learner = make(batch=2, width=4, samples=1, updates=1, imitation=1, mirror=True)
    compiled = run(learner, arriving)
    with jax.disable_jit():
        plain = run(learner, arriving)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), plain, compiled)
