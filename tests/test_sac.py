"""The low-level controller's training: what goes into the replay, what is rewarded, and that it can be continued."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training import replay_buffers
from brax.training.types import Transition

from ct_envs import ANT, POINT, MazeEnv, Tasks, UserError, load_maze
from ct_envs.frames import symmetries
from ct_jax.controller import (
    ControllerConfig,
    SacController,
    blank_controller,
    edge_success,
    edges_in_a_row,
    learned,
    start_training,
    train_controller,
)
from ct_jax.controllers.augment import AugmentConfig
from ct_jax.controllers.edges import EdgeConfig, EdgeTask, chain_tasks, split_edges
from ct_jax.controllers.off_policy import OffPolicy, Replay
from ct_jax.controllers.reward import RewardConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.prm import PrmConfig, build_roadmap
from ct_jax.runtime.checkpoint import Checkpoints

pytestmark = pytest.mark.rank_promotion("allow")  # brax's running statistics

UMAZE = load_maze("antmaze-umaze")
SAC = SacConfig(envs=4, iterations=8, updates=2, warmup=3, batch=8, hidden=(8,), replay=64)
EDGES = EdgeConfig(episode_steps=4, held_out=0.2)
TINY = ControllerConfig(SAC, EDGES)
ENV = functools.partial(MazeEnv, POINT, engine="mujoco")


@pytest.fixture(scope="module")
def roadmap():
    return build_roadmap(jax.random.key(0), UMAZE, radius_m=0.5, config=PrmConfig(samples=40))


def with_sac(**changes) -> ControllerConfig:
    return replace(TINY, sac=replace(SAC, **changes))


def with_edges(reward: RewardConfig | None = None, **changes) -> ControllerConfig:
    return replace(TINY, edges=replace(EDGES, reward=reward or RewardConfig(), **changes))


def env_of(config: ControllerConfig = TINY, robot=POINT) -> MazeEnv:
    return MazeEnv(robot, engine="mujoco", maps=False, horizon=config.edges.episode_steps)


def task_of(config: ControllerConfig = TINY, robot=POINT) -> EdgeTask:
    return EdgeTask(env_of(config, robot), config.edges, config.augment, config.sac.discount)


def start(tasks: Tasks, config: ControllerConfig = TINY, robot=POINT, seed: int = 0) -> OffPolicy:
    return start_training(jax.random.key(seed), env_of(config, robot), UMAZE, tasks, config)


@pytest.fixture(scope="module")
def train_tasks(roadmap):
    return split_edges(roadmap, 0.2, 0)[0]


@pytest.fixture(scope="module")
def fresh(train_tasks):
    return start(train_tasks)


def leaves(tree) -> list[np.ndarray]:
    def plain(leaf):
        return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf

    return [np.asarray(plain(leaf)) for leaf in jax.tree.leaves(tree)]


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(leaves(a), leaves(b), strict=True))


# ----------------------------------------------------------------------------------------------------------- edges


def test_chained_tasks_begin_where_the_one_before_ends(roadmap):
    tasks = chain_tasks(split_edges(roadmap, 0.2, 0)[0], seed=1)
    follow = np.asarray(tasks.follow)
    np.testing.assert_array_equal(
        np.asarray(tasks.start)[follow], np.broadcast_to(np.asarray(tasks.goal)[:, None], (*follow.shape, 2))
    )
    assert len(np.unique(follow)) > len(follow) / 2  # not always the way back


def ends(tasks: Tasks) -> list[tuple]:
    return [(tuple(s), tuple(g)) for s, g in zip(np.asarray(tasks.start), np.asarray(tasks.goal), strict=True)]


@pytest.mark.parametrize("seed", range(3))
def test_held_out_edges_are_new_in_both_directions(roadmap, seed):
    train, test = (ends(tasks) for tasks in split_edges(roadmap, 0.2, seed))
    expected = roadmap.points[roadmap.edges]
    assert len(train) + len(test) == 2 * len(expected)
    assert {frozenset(edge) for edge in train}.isdisjoint(frozenset(edge) for edge in test)
    for edges in (train, test):
        assert {(goal, start) for start, goal in edges} == set(edges)  # there and back
    everything = {frozenset(map(tuple, edge)) for edge in expected}
    assert {frozenset(edge) for edge in train + test} == everything
    assert abs(len(test) / (2 * len(expected)) - 0.2) < 0.02


def test_the_seed_decides_which_edges_are_held_out(roadmap):
    first, again, other = (ends(split_edges(roadmap, 0.2, seed)[1]) for seed in (0, 0, 1))
    assert first == again != other


def test_too_few_edges_are_an_error(roadmap):
    few = replace(roadmap, edges=roadmap.edges[:4])
    with pytest.raises(UserError, match="only 4 edges"):
        split_edges(few, 0.1, 0)


# ------------------------------------------------------------------------------------------------------- training


def test_a_few_iterations(fresh):
    """Nothing is learned in the warm-up; afterwards everything moves, and stays finite."""
    warm, _ = fresh.train(SAC.warmup)
    assert same(warm.learner.policy, fresh.learner.policy) and same(warm.learner.critic, fresh.learner.critic)
    after, metrics = warm.train(5)
    for name in ("policy", "critic", "target_critic", "log_alpha"):
        assert not same(getattr(after.learner, name), getattr(warm.learner, name)), name
    assert all(np.isfinite(leaf).all() for leaf in leaves(after)) and np.isfinite(list(metrics.values())).all()
    assert int(after.iteration) == 8
    assert {"reward", "success", "episodes", "critic_loss", "actor_loss", "alpha"} <= set(metrics)


def test_learners_that_are_alike_share_one_program(train_tasks, fresh):
    """A second training with the same settings compiles no networks of its own."""
    assert start(train_tasks).learner.networks is fresh.learner.networks


def test_the_replay_holds_what_happened(fresh):
    """Row by row: what was seen, done and rewarded, in order, until the oldest is overwritten."""
    state, rows = fresh, []
    collect = jax.jit(OffPolicy.collect)
    for _ in range(3):
        before = state
        state, _ = collect(before)
        seen, now = (np.concatenate([s.env.obs["proprio"], s.env.obs["goal"]], -1) for s in (before, state))
        rows.append((seen, now, np.asarray(state.env.done), np.asarray(state.env.info["truncation"])))
    data = np.asarray(state.replay.data)[: 3 * SAC.envs]
    unflatten = state.buffer._unflatten_fn  # of rows, each a flat transition
    kept = unflatten(data)
    for i, (seen, now, done, truncation) in enumerate(rows):
        part = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i * SAC.envs : (i + 1) * SAC.envs], kept)
        np.testing.assert_array_equal(part.observation, seen)
        np.testing.assert_array_equal(part.next_observation, now)
        np.testing.assert_array_equal(part.discount, 1 - done)
        np.testing.assert_array_equal(part.extras["state_extras"]["truncation"], truncation)
        assert np.abs(part.action).max() <= 1
    for _ in range(20):
        state, _ = collect(state)
    newest = np.concatenate([state.env.obs["proprio"], state.env.obs["goal"]], -1)
    kept = unflatten(np.asarray(state.replay.data))
    assert len(kept.reward) == SAC.replay
    found = [(np.asarray(kept.next_observation) == row).all(1).any() for row in newest]
    assert all(found)


@pytest.mark.parametrize("size", [12, 13])
def test_the_ring_gives_what_braxs_queue_gives(size):
    """To the bit, while it fills and long after; 13 is no multiple of what is put in at once."""
    example = {"number": jnp.zeros(()), "pair": jnp.zeros(2)}
    ring, queue = (kind(size, example, 32) for kind in (Replay, replay_buffers.UniformSamplingQueue))
    ours, theirs = ring.init(jax.random.key(0)), queue.init(jax.random.key(0))
    for i in range(10):
        number = 4.0 * i + jnp.arange(4.0)
        rows = {"number": number, "pair": jnp.stack([number, -number], 1)}
        ours, theirs = ring.insert_internal(ours, rows), queue.insert_internal(theirs, rows)
        (ours, drawn), (theirs, expected) = ring.sample_internal(ours), queue.sample_internal(theirs)
        assert same(drawn, expected) and int(ring.size(ours)) == int(queue.size(theirs))


def test_the_target_follows_at_its_rate(train_tasks):
    state, _ = start(train_tasks, with_sac(updates=1)).train(SAC.warmup + 2)
    before = state.learner
    after = jax.jit(OffPolicy.learn)(state)[0].learner
    rate = SAC.target_rate
    for old, new, critic in zip(*map(leaves, (before.target_critic, after.target_critic, after.critic)), strict=True):
        np.testing.assert_allclose(new, (1 - rate) * old + rate * critic, atol=1e-6)
    assert not same(before.target_critic, after.target_critic)


@pytest.mark.parametrize("kind", ["velocity", "distance"])
def test_rewards(kind):
    """Velocity: metres nearer per second. Distance: minus the metres that are left. The bonus: at the goal only."""
    robot = replace(POINT, controller_reward=kind)
    task = task_of(robot=robot)
    tasks = Tasks(jnp.array([[6.0, 6.0], [6.0, 6.0]]), jnp.array([[6.9, 6.0], [6.0, 14.0]]), jnp.asarray(2))
    state = start(tasks, robot=robot, seed=1).env
    before = np.linalg.norm(state.obs["goal"], axis=-1)
    step, reward = jax.jit(jax.vmap(task.env.step)), jax.jit(task.reward)
    arrived = False
    for _ in range(4):
        action = jnp.tile(jnp.array([[1.0, 0.0]]), (SAC.envs, 1))
        after = step(state, action)
        left = -np.asarray(after.reward)
        dense = (before - left) / 0.1 if kind == "velocity" else -left
        won = (np.asarray(after.info["success"]) * np.asarray(after.done)) > 0
        bonus = EDGES.reward.arrival_bonus * won
        np.testing.assert_allclose(reward(state, action, after), dense + bonus, atol=1e-3)
        arrived |= won.any() and not won.all()
        state, before = after, np.linalg.norm(after.obs["goal"], axis=-1)
    assert arrived


def test_an_alive_bonus_is_all_that_a_fall_costs():
    """And being faster than asked for earns no more, while action_scale has its price."""
    config = with_edges(RewardConfig(alive_bonus=2.0, speed_mps=1.0, action_cost=0.5, arrival_bonus=0.0))
    task = task_of(config)
    state = start(Tasks(jnp.array([[6.0, 6.0]]), jnp.array([[6.0, 14.0]]), jnp.asarray(1)), config, seed=1).env
    left = np.linalg.norm(state.obs["goal"], axis=-1) - np.array([0.05, 0.2, -0.2, 0.05])  # in 0.1 s
    fall = jnp.array([0.0, 0.0, 0.0, 1.0])
    after = state.replace(reward=jnp.asarray(-left), done=fall, info=state.info | {"fall": fall})
    reward = task.reward(state, jnp.full((4, 2), 0.5), after)
    np.testing.assert_allclose(reward, np.array([0.5, 1.0, -2.0, 0.5]) - 0.125 + [2, 2, 2, 0], atol=1e-4)
    batch = Transition(jnp.zeros((4, 4)), jnp.zeros((4, 2)), reward, 1.0 - fall, jnp.zeros((4, 4)),
                       {"state_extras": {"truncation": 0 * fall, "fall": fall}})  # fmt: skip
    assert same(task.reward.pay_falls(batch, jnp.array(0.0), 0.9), batch)


def test_what_diverges_is_kept_and_paid_like_a_fall(monkeypatch, tmp_path, train_tasks):
    """Its last reward, what it costs for ever, and that nothing follows, even where arrivals end nothing."""
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning there
    state = start(chain_tasks(train_tasks, 0), with_edges(chain=True, through=True))
    physics = state.env.pipeline_state
    sick = state.env.replace(pipeline_state=physics.replace(qvel=physics.qvel.at[1, 0].set(jnp.inf)))
    after, _ = state.replace(env=sick).collect()
    kept = after.buffer._unflatten_fn(after.replay.data[: SAC.envs])
    np.testing.assert_array_equal(after.env.info["diverged"], [0, 1, 0, 0])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(kept))
    assert kept.reward[1] == after.env.reward[1] < 0  # minus the distance, as a fall's
    drawn = state.task.present(kept, after.maze, jax.random.key(0), jnp.array(0.0))
    np.testing.assert_array_equal(drawn.discount, [1, 0, 1, 1])
    expected = (kept.reward[1] - EDGES.reward.fall_m[0]) / (1.0 - SAC.discount)
    np.testing.assert_allclose(drawn.reward, kept.reward.at[1].set(expected), rtol=1e-5)


def test_starts_turn_away_from_their_goals_bit_by_bit(train_tasks):
    config = replace(with_sac(iterations=10), edges=replace(EDGES, turn_ramp=(0.2, 0.6)))
    state = start(train_tasks, config, ANT)
    for iteration, share in ((0, 0.0), (2, 0.0), (4, 0.5), (8, 1.0)):
        eased = state.task.ease(state.env, state.replace(iteration=jnp.asarray(iteration)).share)
        np.testing.assert_allclose(eased.info["tasks"].turn_rad, np.full(SAC.envs, np.pi * share), rtol=1e-6)


def test_in_a_share_of_the_environments_nothing_is_left_to_chance(train_tasks):
    state = start(train_tasks, with_sac(greedy=0.5, warmup=0))

    def moved(key: int) -> np.ndarray:
        after, _ = state.replace(key=jax.random.key(key)).collect()
        return np.asarray(after.env.obs["proprio"])  # pyright: ignore

    one, other = moved(1), moved(2)
    np.testing.assert_array_equal(one[:2], other[:2])
    assert (one[2:] != other[2:]).any(1).all()


def test_it_goes_on_as_if_nothing_had_happened(roadmap, tmp_path):
    """Interrupted by Ctrl-C and continued: the same controller, to the bit."""
    train = functools.partial(train_controller, jax.random.key(0), ENV, UMAZE, roadmap, TINY, chunk=4)
    seen = []
    whole, tested = train(on_progress=lambda i, metrics: seen.append((i, metrics["held_out"])))
    assert [i for i, _ in seen] == [4, 8] and all(0 <= share <= 1 for share in tested.values())
    assert seen[-1][1] == tested["held_out_success"]  # the curve ends where the controller is

    def interrupt(iteration, metrics):
        raise KeyboardInterrupt

    first = Checkpoints(tmp_path / "states")
    with pytest.raises(KeyboardInterrupt):
        train(on_progress=interrupt, checkpoints=first)
    first.close()
    second, rest = Checkpoints(tmp_path / "states"), []
    again, again_tested = train(on_progress=lambda i, _: rest.append(i), checkpoints=second)
    second.close()
    assert rest == [8]
    assert same(again, whole) and again_tested == tested


# ---------------------------------------------------------------------------------------------------- the result


def test_success_on_edges_is_the_share_that_is_walked(push, roadmap):
    env = MazeEnv(POINT, engine="mujoco", maps=False, auto_reset=False, horizon=40)
    _, tasks = split_edges(roadmap, 0.1, 0)
    assert edge_success(env, push(), UMAZE, tasks, jax.random.key(0)) > 0.95
    still = np.linalg.norm(tasks.start - tasks.goal, axis=1) < 0.5  # there from the first
    assert edge_success(env, push(0.0), UMAZE, tasks, jax.random.key(0)) == pytest.approx(still.mean())


def test_edges_in_a_row_end_with_the_first_that_is_not_walked(push, roadmap):
    env = MazeEnv(POINT, engine="mujoco", maps=False, horizon=30)
    tasks = chain_tasks(split_edges(roadmap, 0.1, 0)[0], seed=0)
    share = functools.partial(edges_in_a_row, env, maze=UMAZE, tasks=tasks, key=jax.random.key(0), walkers=50)
    found = [share(push(), edges=edges) for edges in (1, 6, 20)]  # 30 steps are too few for some edges
    assert 1 >= found[0] > found[1] > found[2] > 0
    assert share(push(0.0), edges=4) < 0.1


def test_the_controller_is_the_policy_without_chance(fresh):
    act, learner = learned(fresh, TINY), fresh.learner
    proprio, goal = fresh.env.obs["proprio"], fresh.env.obs["goal"]
    action = act(proprio, goal)
    assert action.shape == (SAC.envs, 2) and (np.abs(action) <= 1).all()
    np.testing.assert_allclose(act(proprio[:1], goal[:1]), action[:1], atol=1e-6)
    seen = jnp.concatenate([proprio, goal], -1)
    logits = learner.networks.policy_network.apply(learner.normalizer, learner.policy, seen)
    np.testing.assert_allclose(action, np.tanh(logits[:, :2]), atol=1e-6)


def test_without_compilation(train_tasks):
    begun = start(train_tasks, with_sac(envs=2, updates=1, warmup=1, batch=2, hidden=(4,), replay=8))
    compiled, _ = begun.train(2)
    with jax.disable_jit():
        plain, _ = begun.train(2)
    for a, b in zip(leaves(plain.learner.policy), leaves(compiled.learner.policy), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.slow
def test_it_learns_to_walk(roadmap):
    """The umaze in half a minute or so."""
    config = ControllerConfig(SacConfig(iterations=400, warmup=10, hidden=(64, 64)), EdgeConfig(episode_steps=40))
    _, tested = train_controller(jax.random.key(0), ENV, UMAZE, roadmap, config)
    assert tested["held_out_success"] > 0.9 and tested["twenty_in_a_row"] > 0.8


# ------------------------------------------------------------------------------------------------------- the ant


def test_a_heading_is_asked_of_a_robot_that_has_one():
    with pytest.raises(UserError, match="'point' has no heading"):
        task_of(replace(TINY, augment=AugmentConfig(frame="heading")))


def test_the_ants_controller_does_not_see_the_world_turn():
    controller, group = untrained(ANT, "heading"), symmetries(ANT)
    proprio = MazeEnv(ANT, engine="mujoco", maps=False, maze=UMAZE).reset(jax.random.key(0)).obs["proprio"]
    goal = jnp.array([3.0, 1.0])
    turned = (np.linalg.det(group.world) > 0) & (group.action == np.eye(8)).all((1, 2))
    turns = np.flatnonzero(turned)
    assert len(turns) == 4
    actions = controller(group.proprio[turns] @ proprio, group.world[turns] @ goal)
    np.testing.assert_allclose(actions, np.broadcast_to(actions[:1], actions.shape), atol=1e-5)
    assert not np.allclose(actions, controller(jnp.tile(proprio, (4, 1)), group.world[turns] @ goal), atol=1e-2)


@pytest.mark.parametrize("kind", ["velocity", "distance"])
def test_a_goal_drawn_afterwards_is_paid_as_if_it_had_been_there(kind, train_tasks):
    """The same way through the world, another goal: what the reward, arrivals included, would have said of it."""
    config = replace(with_sac(envs=64), edges=replace(EDGES, relabel=0.6, relabel_m=1.0))
    begun = start(train_tasks, config, replace(POINT, controller_reward=kind), seed=1)
    task, state = begun.task, begun.env
    after = jax.jit(jax.vmap(task.env.step))(state, jnp.ones((64, 2)))
    over = (np.arange(64) % 4 == 0) | (np.asarray(after.done) > 0)
    seen = [jnp.concatenate([s.obs["proprio"], s.obs["goal"]], -1) for s in (state, after)]
    action = jnp.ones((64, 2))
    batch = Transition(seen[0], action, jax.jit(task.reward)(state, action, after), 1.0 - over, seen[1], {})
    told = task.relabel(batch, jax.random.key(0))
    changed = np.asarray((told.observation != batch.observation).any(-1))
    assert not changed[over].any() and 0.4 < changed[~over].mean() < 0.8
    old, new = ((b.observation - b.next_observation)[:, -2:] for b in (batch, told))
    np.testing.assert_allclose(new, old, atol=1e-5)
    np.testing.assert_array_equal(told.observation[:, :-2], batch.observation[:, :-2])
    for name in ("observation", "next_observation", "reward", "discount"):
        np.testing.assert_array_equal(getattr(told, name)[~changed], getattr(batch, name)[~changed])
    before, left = (np.linalg.norm(o[changed, -2:], axis=-1) for o in (told.observation, told.next_observation))
    arrived = left < POINT.goal_tolerance_m
    assert arrived.any() and not arrived.all() and before.max() <= 1.0
    dense = (before - left) / 0.1 if kind == "velocity" else -left
    np.testing.assert_allclose(told.reward[changed], dense + EDGES.reward.arrival_bonus * arrived, atol=1e-3)
    np.testing.assert_array_equal(told.discount[changed], 1.0 - arrived)


def test_through_an_arrival_the_value_goes_on():
    """To the goal after it, which is out of reach yet; only falls end it."""
    config = with_edges(relabel=0.6, relabel_m=1.0, chain=True, through=True)
    at = jax.random.uniform(jax.random.key(0), (64, 2), minval=-0.3, maxval=0.3)
    seen, now = (jnp.concatenate([jnp.zeros((64, 2)), goal], -1) for goal in (at, at - 0.1))
    fall = (jnp.arange(64) % 4 == 0).astype(jnp.float32)
    arrived = (jnp.arange(64) % 4 == 1).astype(jnp.float32)
    batch = Transition(seen, jnp.zeros((64, 2)), jnp.zeros(64), 1.0 - fall - arrived, now,
                       {"state_extras": {"truncation": 0 * fall, "fall": fall}})  # fmt: skip
    told = task_of(config).present(batch, UMAZE, jax.random.key(1), jnp.array(0.0))
    np.testing.assert_array_equal(told.discount, 1.0 - fall)
    changed = np.asarray((told.observation != batch.observation).any(-1))
    assert 0.15 < changed.mean() < 0.45 and not changed[np.asarray(fall + arrived) > 0].any()
    away = np.linalg.norm(told.next_observation[changed, -2:], axis=-1)
    assert away.min() >= POINT.goal_tolerance_m and (np.asarray(told.reward)[changed] > 9).any()  # the bonus of some
    with pytest.raises(UserError, match="set chain"):
        with_edges(through=True)


def test_a_fall_costs_more_and_more():
    reward = task_of(with_edges(RewardConfig(fall_m=(5.0, 60.0), fall_ramp=(0.2, 0.8)))).reward
    batch = Transition(
        observation=jnp.zeros((2, 4)), action=jnp.zeros((2, 2)), reward=jnp.array([-3.0, -3.0]),
        discount=jnp.array([0.0, 1.0]), next_observation=jnp.zeros((2, 4)),
        extras={"state_extras": {"truncation": jnp.zeros(2), "fall": jnp.array([1.0, 0.0])}},
    )  # fmt: skip
    for share, cost in ((0.0, 80.0), (0.5, 355.0), (0.9, 630.0)):
        paid = reward.pay_falls(batch, jnp.array(share), 0.9)
        np.testing.assert_allclose(paid.reward, [-cost, -3.0], rtol=1e-5)


def test_effort_limits_what_the_controller_asks_for():
    full, gentle = (untrained(POINT, "world", action_scale=action_scale) for action_scale in (1.0, 0.25))
    proprio, goal = jnp.ones((5, 2)), 10 * jnp.ones((5, 2))
    np.testing.assert_allclose(0.25 * full(proprio, goal), gentle(proprio, goal), rtol=1e-6)
    config = with_sac(action_scale=0.5)
    assert config.scaled(0.5).sac.action_scale == 0.25 and config.scaled(1.0) == config


def untrained(robot, frame: str, action_scale: float = 1.0) -> SacController:
    """A controller as it begins."""
    env = MazeEnv(robot, engine="mujoco", maps=False)
    config = ControllerConfig(SacConfig(hidden=(16,), action_scale=action_scale), augment=AugmentConfig(frame=frame))
    return blank_controller(jax.random.key(3), env.proprio_size, env.action_size, config)
