"""SAC alone: the learner of the controller, with the maze in sight and the whole of it to cross."""

import functools
from dataclasses import replace

import jax
import numpy as np
import pytest

from ct_envs import POINT, MazeEnv, load_maze
from ct_envs.occupancy import local_map
from ct_jax.baselines.sac_alone import SacAloneConfig, start_training, train_sac_alone
from ct_jax.controllers.off_policy import OffPolicy
from ct_jax.controllers.sac import SacConfig
from ct_jax.evaluate import Pairs, evaluate
from ct_jax.runtime.checkpoint import Checkpoints
from ct_jax.worlds.mazes import MazeWorld

pytestmark = pytest.mark.rank_promotion("allow")  # brax's replay

UMAZE = load_maze("antmaze-umaze")
SAC = SacConfig(envs=4, iterations=6, updates=2, warmup=2, batch=8, hidden=(8,), replay=64, discount=0.9)
TINY = SacAloneConfig(SAC)
SHORT = replace(POINT, horizon=5)
ENV = functools.partial(MazeEnv, SHORT, engine="mujoco", map_cell_m=0.7)


def start(config: SacAloneConfig = TINY) -> OffPolicy:
    return start_training(jax.random.key(0), ENV(maps=False), UMAZE, config)


@pytest.fixture(scope="module")
def fresh():
    return start()


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_a_few_iterations(fresh):
    """Nothing is learned in the warm-up; afterwards everything moves, and stays finite."""
    warm, _ = fresh.train(2)
    assert same(warm.learner.policy, fresh.learner.policy) and same(warm.learner.critic, fresh.learner.critic)
    state, metrics = warm.train(2)
    for name in ("policy", "critic", "target_critic"):
        assert not same(getattr(state.learner, name), getattr(warm.learner, name)), name
    assert np.isfinite([float(value) for value in metrics.values()]).all()


def test_its_critics_have_the_controllers_norm(fresh):
    normed = start(replace(TINY, sac=replace(SAC, critic_norm=True))).learner
    found = ["LayerNorm" in jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(normed.critic)]
    assert any(found) and not all(found)
    plain = jax.tree.leaves_with_path(fresh.learner.critic)
    assert not any("LayerNorm" in jax.tree_util.keystr(path) for path, _ in plain)


def test_maps_are_recomputed_as_they_were(fresh):
    """From what the replay keeps, the networks see what an environment with maps shows."""
    inputs = fresh.task.inputs(fresh.task.observe(fresh.env), UMAZE)
    info = fresh.env.info
    shown = jax.vmap(lambda at, to: local_map(UMAZE, at, to, cell_m=0.7))(info["position"], info["goal"])
    np.testing.assert_array_equal(inputs.map[:, 0], shown[:, 0])
    assert (inputs.map[:, 1] != shown[:, 1]).mean() < 0.01  # a goal between two cells may fall into either
    np.testing.assert_array_equal(inputs.goal_relative, fresh.env.obs["goal"])
    np.testing.assert_array_equal(inputs.proprio, fresh.env.obs["proprio"])
    assert 0 < np.mean(inputs.map[:, 0]) < 1


def test_the_task_is_the_maze(fresh, wall_distance):
    """Fresh starts and goals anywhere, every time an episode of the robot's horizon is over; minus the distance."""
    starts, state = [], fresh
    collect = jax.jit(OffPolicy.collect)
    for _ in range(16):
        before = state
        state, _ = collect(state)
        reward = state.buffer._unflatten_fn(state.replay.data).reward[: int(state.replay.insert_position)][-4:]
        won = np.asarray(state.env.info["success"] * state.env.done) > 0
        np.testing.assert_allclose(reward, state.env.reward + TINY.reward.arrival_bonus * won, rtol=1e-6)
        over = np.asarray(state.env.done) > 0
        assert (np.asarray(before.env.info["episode_steps"])[over & ~won] == 4).all()
        starts += list(np.asarray(state.env.info["position"])[over])
    assert len(starts) >= 8
    assert wall_distance(np.asarray(UMAZE.walls), np.array(starts)).min() >= POINT.radius_m
    apart = np.linalg.norm(np.array(starts)[:, None] - np.array(starts)[None], axis=-1)
    assert apart.max() > 4.0


@pytest.fixture(scope="module")
def whole():
    return train_sac_alone(jax.random.key(0), ENV, UMAZE, TINY, chunk=2)


def test_it_goes_on_as_if_nothing_had_happened(whole, tmp_path):
    """Interrupted by Ctrl-C and continued: the same policy, to the bit."""
    train = functools.partial(train_sac_alone, jax.random.key(0), ENV, UMAZE, TINY, chunk=2)

    def interrupt(iteration, metrics):
        if iteration == 4:
            raise KeyboardInterrupt

    first = Checkpoints(tmp_path / "states")
    with pytest.raises(KeyboardInterrupt):
        train(on_progress=interrupt, checkpoints=first)
    first.close()
    second, rest = Checkpoints(tmp_path / "states"), []
    again = train(on_progress=lambda i, _: rest.append(i), checkpoints=second)
    second.close()
    assert rest == [6] and same(again, whole)


def test_the_policy_can_be_evaluated(whole):
    """By the same function as all methods; without chance, and with no return to ask for."""
    pairs = Pairs(np.float32([[6, 6], [6, 14]]), np.float32([[12, 6], [6, 6]]), np.float32([6, 8]), 0)
    env = ENV(auto_reset=False)
    once, again = (evaluate(MazeWorld(env, UMAZE), pairs, "sac", policy=whole) for _ in range(2))
    np.testing.assert_array_equal(once.path, again.path)
    assert once.path.shape == (5, 2, 2) and once.target_return is None
    assert (once.returns < 0).all()


def test_without_compilation(fresh):
    warm, _ = fresh.train(2)
    with jax.disable_jit():
        state, _ = warm.collect()[0].learn()
    assert not same(state.learner.policy, warm.learner.policy)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state.learner.policy, state.learner.critic)))
