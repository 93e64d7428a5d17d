"""Recoveries: the policy until it fails, the planner from then on, and each step taught by the right one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from ct_envs import POINT, MazeEnv, UserError, load_maze, make_maze, random_walls, stack_mazes
from ct_jax.collect import CollectConfig
from ct_jax.finetune import RecoverConfig, TakeoverPolicy, lie_for_ever, recover
from ct_jax.guided import Guided
from ct_jax.policy import TransformerPolicy
from ct_jax.prm import PrmConfig
from ct_jax.rollout import as_frame
from ct_jax.runtime.devices import data_mesh, fill_up
from ct_jax.trajectories import PER_STEP
from ct_jax.transformer import ControlTransformer, ModelConfig, sample_inputs
from ct_jax.types import act_as_intended
from ct_jax.value import ValueNetwork
from ct_jax.worlds.mazes import MazeWorld, start_episodes

pytestmark = pytest.mark.rank_promotion("allow")

N = 8
PRM = PrmConfig(samples=60)
COLLECTING = CollectConfig(reset_interval=4, envs=N, starts="maze", horizon=190)
CONFIG = RecoverConfig(recoveries=1, stuck_steps=5, stuck_m=1.0, patience=60, give_up=20.0)  # one wave
MAZES = stack_mazes([load_maze("antmaze-umaze")])
ENV = MazeEnv(POINT, engine="mujoco", auto_reset=False, maps=False)
WORLD = MazeWorld(ENV, MAZES)
HORIZON = CONFIG.patience + COLLECTING.horizon


@struct.dataclass
class Blind:
    """A policy that pushes straight for the goal, so that it succeeds or ends at a wall; or does nothing."""

    controller: object

    def init(self, frame, tasks):
        return ()

    def act(self, memory, frame, key):
        return act_as_intended(self.controller(frame.obs.proprio, frame.obs.goal_relative)), memory


def recoveries(own, push, seed=0, *, gain=1.0, **options):
    config = replace(CONFIG, **options)
    return recover(jax.random.key(seed), WORLD, own, push(gain), config, COLLECTING, PRM)


def test_rounds_recover_in_different_mazes(push):
    """Each of three rounds has two roadmaps; of five mazes they must between them see more than two."""
    world = MazeWorld(ENV, stack_mazes([make_maze(random_walls(seed, height=7, width=7)) for seed in range(5)]))
    config = replace(CONFIG, keep="relabelled", recoveries=1)
    rounds = [recover(jax.random.key(i), world, Blind(push()), push(), config, COLLECTING, PRM) for i in range(3)]
    assert len(set(np.concatenate([np.asarray(data.maze) for data in rounds]).tolist())) > 2


@pytest.fixture(scope="module")
def joined(push):
    return recoveries(Blind(push()), push, keep="joined")


def begins(data) -> np.ndarray:
    return np.asarray(data.label_mask).argmax(1)


def test_joined_recoveries_teach_the_recovery_only(joined):
    begin = begins(joined)
    assert (begin >= CONFIG.stuck_steps).all()  # it takes so long to see that it is stuck
    t = np.arange(joined.label_mask.shape[1])
    np.testing.assert_array_equal(joined.label_mask, (t >= begin[:, None]) & (t < joined.length[:, None]))
    last = joined.reward[np.arange(joined.n), joined.length - 1]
    assert (last > -POINT.goal_tolerance_m).all()  # every one of them arrived


def test_the_planner_takes_over_where_the_policy_is_stuck(joined):
    """Not before: at the takeover the robot has moved less than the limit in so many steps, for the first time."""
    w = CONFIG.stuck_steps
    for i, begin in enumerate(begins(joined)):
        position = joined.position[i, : joined.length[i]]
        moved = np.linalg.norm(position[w:] - position[:-w], axis=-1)
        stuck = np.flatnonzero(moved < CONFIG.stuck_m)
        assert begin == min(stuck[0] + w, CONFIG.patience)


def test_separate_recoveries_join_to_the_whole(joined, push):
    parts = recoveries(Blind(push()), push, keep="separate")
    n = joined.n
    assert parts.n == 2 * n
    np.testing.assert_array_equal(parts.length[:n] + parts.length[n:], joined.length)
    np.testing.assert_array_equal(parts.length[:n], begins(joined))
    for i in range(n):
        begin, end = parts.length[i], joined.length[i]
        for name in PER_STEP:
            first, second = (getattr(parts, name)[k, : parts.length[k]] for k in (i, n + i))
            if name == "label_mask":  # as trajectories of their own, both are imitated (paper)
                assert first.all() and second.all()
                continue
            np.testing.assert_array_equal(first, getattr(joined, name)[i, :begin], err_msg=name)
            np.testing.assert_array_equal(second, getattr(joined, name)[i, begin:end], err_msg=name)
    np.testing.assert_array_equal(parts.goal_world, np.tile(joined.goal_world, (2, 1)))
    assert all(np.asarray(getattr(parts, name)).dtype == np.float32 for name in PER_STEP)


def test_a_policy_that_does_not_move_is_rescued_every_time(push):
    data = recoveries(Blind(push(0.0)), push, keep="joined")
    assert data.n >= N - 1  # all, but for a start at the goal
    np.testing.assert_array_equal(begins(data), CONFIG.stuck_steps)


def test_patience_ends(push):
    """A slow policy that is never stuck by its measure is relieved when its time is over."""
    data = recoveries(Blind(push(0.3)), push, keep="joined", patience=7, stuck_m=0.0)
    np.testing.assert_array_equal(begins(data), 7)


def test_the_planner_may_take_over_by_chance(push):
    data = recoveries(Blind(push(0.0)), push, keep="separate", takeover=1.0)
    assert data.n <= 2 * N and (data.label_mask.sum(1) == data.length).all()
    assert len({tuple(goal) for goal in data.goal_world}) == data.n  # no failure has a step, so none is kept


def supervised_walk(push, keep: str, steps: int = 12):
    """Actions of a takeover policy beside those of the guide with the same memory."""
    tasks = WORLD.sample_tasks(jax.random.key(4), COLLECTING, PRM)
    state, record = start_episodes(ENV, tasks.episode_keys, tasks.maze, tasks.start, tasks.goal), []
    takeover = TakeoverPolicy(
        Blind(push(0.2)), Guided(push(), WORLD.guide("shortcut", PRM)), replace(CONFIG, keep=keep)
    )
    memory = takeover.init(as_frame(state), tasks)

    @jax.jit
    def once(state, memory):
        frame = as_frame(state)
        guided, _ = takeover.guided.act(memory.guided, frame, jax.random.key(0))
        own, _ = takeover.own.act((), frame, jax.random.key(0))
        action, after = takeover.act(memory, frame, jax.random.key(0))
        return jax.vmap(ENV.step)(state, action.executed), after, (action, own, guided)

    for _ in range(steps):
        state, memory, one = once(state, memory)
        record.append((*one, np.asarray(memory.rescued)))
    return record


@pytest.mark.parametrize("keep", ["joined", "relabelled"])
def test_who_acts_and_who_is_imitated(push, keep):
    seen = set()
    for action, own, guided, rescued in supervised_walk(push, keep):
        who = np.where(rescued[:, None], guided.executed, own.executed)
        np.testing.assert_array_equal(action.executed, who)
        np.testing.assert_array_equal(action.intended, who)
        if keep == "relabelled":
            np.testing.assert_array_equal(action.label, guided.label)
            np.testing.assert_array_equal(action.label_mask, 1.0)
        else:
            np.testing.assert_array_equal(action.label_mask, rescued)
            np.testing.assert_array_equal(np.asarray(action.label)[rescued], np.asarray(guided.label)[rescued])
        seen |= set(rescued.tolist())
    assert seen == {False, True}


def test_relabelled_steps_all_teach(push):
    data = recoveries(Blind(push(0.2)), push, keep="relabelled")
    assert (data.label_mask.sum(1) == data.length).all()
    inside = np.arange(data.label_mask.shape[1]) < data.length[:, None]
    assert np.abs(data.label - data.action)[inside].max() > 0.5  # what was done is not what is taught
    assert (np.abs(data.label[inside]) <= 1).all()


def test_a_policy_that_never_fails_and_a_planner_that_never_saves_end(push):
    options = {"recoveries": 2, "give_up": 8.0, "keep": "joined"}
    with pytest.raises(UserError, match="no recovery in 16 episodes"):
        recoveries(Blind(push(0.0)), push, gain=0.0, **options)
    walls = np.ones((7, 7), bool)
    walls[1:-1, 1:-1] = False
    world = MazeWorld(ENV, make_maze(walls))  # without walls in between, the policy always arrives
    config = replace(CONFIG, stuck_m=0.0, patience=150, **options)
    with pytest.raises(UserError, match="hardly fails"):
        recover(jax.random.key(0), world, Blind(push()), push(), config, COLLECTING, PRM)


def test_without_compilation(push):
    """A transformer under supervision, two steps, with everything on."""
    config = ModelConfig(layers=1, heads=1, width=4, context=2, context_acting=2, max_timestep=8)
    inputs = sample_inputs(2, 2)
    own = TransformerPolicy(
        jax.jit(ControlTransformer(config, 2).init)(jax.random.key(0), *inputs),
        jax.jit(ValueNetwork(4).init)(jax.random.key(0), *inputs[:3]), config, 2, value_width=4,
    )  # fmt: skip
    env = MazeEnv(POINT, engine="mujoco", auto_reset=False)
    world = MazeWorld(env, MAZES)
    tasks = world.sample_tasks(jax.random.key(0), replace(COLLECTING, envs=2), PrmConfig(samples=20))
    frame = as_frame(start_episodes(env, tasks.episode_keys, tasks.maze, tasks.start, tasks.goal))
    guided = Guided(push(), world.guide("explorer", PRM), 0.1)
    takeover = TakeoverPolicy(own, guided, replace(CONFIG, stuck_steps=1))
    memory = takeover.init(frame, tasks)
    expected, _ = jax.jit(TakeoverPolicy.act)(takeover, memory, frame, jax.random.key(1))
    with jax.disable_jit():
        action, after = takeover.act(memory, frame, jax.random.key(1))
        assert not after.rescued.any()
    np.testing.assert_allclose(action.executed, expected.executed, atol=1e-4)
    _, after = jax.jit(TakeoverPolicy.act)(takeover, after, frame, jax.random.key(2))
    assert after.rescued.all()
    assert jnp.isfinite(action.label).all()


def test_a_fall_is_paid_until_the_horizon(toy_data):
    """So that the return of a robot that soon fell is as bad as that of one that stood there for as long."""
    data = toy_data([5, 5], steps=8)
    paid = lie_for_ever(data, np.array([True, False]), horizon=20)
    expected = np.asarray(data.rtg)[0, 0] + 15 * np.asarray(data.reward)[0, 4]
    np.testing.assert_allclose(np.asarray(paid.rtg)[:, 0], [expected, np.asarray(data.rtg)[1, 0]], rtol=1e-5)


def test_touching_walls_time_and_again_is_a_failure(push):
    """Of three robots one touched a wall twice just now, and one touched it once."""
    config = replace(CONFIG, bumps=2, stuck_m=0.0, patience=99)
    takeover = TakeoverPolicy(Blind(push()), Guided(push(), WORLD.guide("explorer", PRM)), config)
    tasks = WORLD.sample_tasks(jax.random.key(0), replace(COLLECTING, envs=3), PRM)
    frame = as_frame(start_episodes(ENV, tasks.episode_keys, tasks.maze, tasks.start, tasks.goal))
    memory = takeover.init(frame, tasks)
    memory = memory.replace(touched=memory.touched.at[-2:, 1].set(1.0).at[0, 2].set(1.0))
    _, after = takeover.act(memory, frame, jax.random.key(0))
    np.testing.assert_array_equal(after.rescued, [False, True, False])


def test_a_fault_is_paid_like_a_fall_and_teaches_nothing_that_is_no_number(push, faulty):
    """Of standing still with a fault in step 4: relabelled, with the return of having stood there until the horizon."""
    n = len(fill_up(N, data_mesh()))
    own = faulty(jnp.ones(n, bool))
    data = recoveries(own, push, keep="relabelled", recoveries=N)
    finite = jax.tree.map(lambda leaf: bool(np.isfinite(leaf).all()), data)
    assert all(jax.tree.leaves(finite)), finite
    away = np.linalg.norm(np.asarray(data.goal_world) - np.asarray(data.position)[:, 0], axis=-1)
    faults = np.asarray(data.length) == 4
    assert faults.sum() >= N - 1  # but for a start at the goal
    np.testing.assert_allclose(np.asarray(data.rtg)[faults, 0], -HORIZON * away[faults], rtol=1e-3)
    with pytest.raises(UserError, match="the robot falls before the planner takes over"):
        recoveries(own, push, keep="joined", recoveries=N)
