"""Agent: a loaded policy acts on given observations as in an evaluation, and wrong observations are errors."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ct_jax
from ct_envs import MazeEnv, load_maze, stack_mazes
from ct_jax.model import sizes
from ct_jax.rollout import as_frame, run
from ct_jax.transformer import ControlTransformer
from ct_jax.worlds.mazes import start_episodes

ROBOTS = ("point", "ant", "humanoid", "turtlebot3")
N, STEPS = 3, 5


@functools.cache
def agent_of(robot):
    return ct_jax.load(f"zoo:{robot}").agent()


def observe(robot, n=N, seed=0):
    """Random observations with the right shapes and types."""
    rng, proprio = np.random.default_rng(seed), sizes(robot)[0]
    return {
        "map": rng.integers(0, 2, (n, 2, 25, 25)).astype(np.uint8),
        "proprio": rng.uniform(-1, 1, (n, proprio)).astype(np.float32),
        "goal": rng.uniform(-9, 9, (n, 2)).astype(np.float32),
    }


def act_along(agent, observations, rewards):
    """The actions [T, N, A] for observations and rewards."""
    memory, actions = agent.init(observations[0]), []
    for seen, reward in zip(observations, rewards, strict=True):
        action, memory = agent.act(memory, seen, reward)
        actions.append(np.asarray(action))
    return np.stack(actions)


@pytest.mark.rank_promotion("allow")
def test_agent_acts_as_in_an_evaluation():
    """For the observations of an evaluation, the actions equal the recorded ones."""
    model, agent = ct_jax.load("zoo:point"), agent_of("point")
    env = MazeEnv("point", engine="mujoco", auto_reset=False, map_cell_m=model.settings.model.map_cell_m)
    mazes = stack_mazes([load_maze("antmaze-umaze")] * N)
    begin = jnp.array([[6.0, 6.0], [14.0, 6.0], [6.0, 14.0]])
    start = start_episodes(env, jax.random.split(jax.random.key(0), N), mazes, begin, begin[::-1] + 0.7)
    with jax.default_matmul_precision("highest"):
        _, _, steps = run(env, model.policy, start, model.policy.init(as_frame(start)), jax.random.key(0), STEPS)
    step, state, memory = jax.jit(jax.vmap(env.step)), start, agent.init(start.obs)
    for recorded in np.asarray(steps.action):
        action, memory = agent.act(memory, state.obs, state.reward)
        np.testing.assert_allclose(action, recorded, rtol=0, atol=0 if jax.default_backend() == "cpu" else 1e-5)
        state = step(state, recorded)
    assert np.ptp(steps.action) > 0.1


@pytest.mark.parametrize("robot", ROBOTS)
def test_batch_of_one_equals_row_of_larger_batch(robot):
    agent = agent_of(robot)
    seen = [observe(robot, seed=step) for step in range(3)]
    rewards = [np.full(N, -float(step), np.float32) for step in range(3)]
    many = act_along(agent, seen, rewards)
    alone = act_along(agent, [{k: v[1:2] for k, v in each.items()} for each in seen], [r[1:2] for r in rewards])
    assert many.shape == (3, N, sizes(robot)[1]) and np.abs(many).max() <= 1
    np.testing.assert_allclose(alone[:, 0], many[:, 1], atol=2e-5)


def test_each_batch_size_compiles_once(monkeypatch):
    traced, own = [], ControlTransformer.act

    def act(self, cache, maps, *inputs):
        traced.append(len(maps))
        return own(self, cache, maps, *inputs)

    monkeypatch.setattr(ControlTransformer, "act", act)
    for n in (5, 6, 5, 6):
        act_along(agent_of("turtlebot3"), [observe("turtlebot3", n)] * 3, [np.zeros(n)] * 3)
    assert traced == [5, 6]


@pytest.mark.parametrize("kind", [np.float64, np.float16, jnp.float32])
def test_floats_of_any_precision_are_accepted(kind):
    seen = observe("turtlebot3")
    other = seen | {"goal": seen["goal"].astype(np.float16).astype(kind)}
    same = seen | {"goal": seen["goal"].astype(np.float16).astype(np.float32)}
    one, two = (act_along(agent_of("turtlebot3"), [each], [np.zeros(N)]) for each in (other, same))
    np.testing.assert_array_equal(one, two)


def nan(array):
    array = np.array(array)
    array[1] = np.nan
    return array


WRONG = {
    "a list": (lambda seen: [seen], "the observation is a list; give a dict of map, proprio, goal"),
    "missing": (lambda seen: {"map": seen["map"], "goal": seen["goal"]}, "the observation has no 'proprio'"),
    "no batch": (lambda seen: seen | {"goal": seen["goal"][0]}, r"'goal' has shape \(2,\); the \w+ needs \[N, 2\]"),
    "a number": (lambda seen: seen | {"goal": 1.0}, r"'goal' has shape \(\)"),
    "empty": (lambda seen: {k: v[:0] for k, v in seen.items()}, r"'map' has shape \(0, 2, 25, 25\).*N >= 1"),
    "too wide": (lambda seen: seen | {"proprio": np.pad(seen["proprio"], [(0, 0), (0, 1)])}, r"'proprio' has shape"),
    "another N": (lambda seen: seen | {"goal": seen["goal"][:2]}, "'goal' is of 2 episodes, 'map' of 3"),
    "ragged": (lambda seen: seen | {"goal": [[1.0], [1.0, 2.0]]}, r"'goal' is .*; give an array \[N, 2\]"),
    "nothing": (lambda seen: seen | {"goal": None}, r"'goal' has shape \(\)"),
    "words": (lambda seen: seen | {"goal": np.full((N, 2), "far")}, "'goal' is of type <U3; give float32"),
    "whole": (lambda seen: seen | {"goal": seen["goal"].astype(int)}, "'goal' is of type int64; give float32"),
    "float map": (lambda seen: seen | {"map": seen["map"] / 1.0}, "'map' is of type float64; give uint8"),
    "a picture": (lambda seen: seen | {"map": 255 * seen["map"]}, "'map' holds 255; give 0 and 1 only"),
    "NaN": (lambda seen: seen | {"proprio": nan(seen["proprio"])}, "'proprio' is not finite in row 1"),
    "too large": (lambda seen: seen | {"goal": np.full((N, 2), 1e300)}, "'goal' is not finite in row 0"),
}


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("fault", WRONG)
def test_wrong_observation_is_error_of_one_line(robot, fault):
    agent, (spoil, words) = agent_of(robot), WRONG[fault]
    with pytest.raises(ct_jax.UserError, match=words) as told:
        agent.init(spoil(observe(robot)))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("reward", "words"),
    [
        (0.0, r"'reward' has shape \(\); the point needs \[N\]"),
        (np.zeros(2), "'reward' is of 2 episodes, 'map' of 3"),
        (np.zeros((N, 1)), r"'reward' has shape \(3, 1\)"),
        (np.full(N, np.nan), "'reward' is not finite in row 0"),
    ],
)
def test_wrong_reward_is_error(reward, words):
    agent, seen = agent_of("point"), observe("point")
    memory = agent.init(seen)
    with pytest.raises(ct_jax.UserError, match=words):
        agent.act(memory, seen, reward)


def test_memory_of_other_episodes_is_error():
    agent, seen = agent_of("point"), observe("point")
    others = [agent.init(observe("point", 1)), agent_of("turtlebot3").init(observe("turtlebot3")), None, 3.0]
    for memory in others:
        with pytest.raises(ct_jax.UserError, match="the memory is of another model or batch size"):
            agent.act(memory, seen, np.zeros(N))


def test_error_inside_jit_names_the_alternative():
    agent = agent_of("point")
    with pytest.raises(ct_jax.UserError, match=r"inside jax\.jit, use the agent's policy"):
        jax.jit(agent.init)(observe("point"))
