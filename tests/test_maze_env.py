"""MazeEnv: pure functions, one program for all mazes, and correct outcomes at the end of an episode."""

import functools
from collections import Counter

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import VmapWrapper

from ct_envs import POINT, ROBOTS, MazeEnv, Tasks, UserError, load_maze, make_maze, random_walls, stack_mazes
from ct_envs.maze import load_walls, parse_walls
from ct_envs.maze_env import check_tasks
from ct_envs.occupancy import local_map

N = 8
UMAZE = load_maze("antmaze-umaze")
LARGE = load_maze("antmaze-large")
NEAR = Tasks(  # the goal is reached without motion; after a step or two to the right; not within the horizon
    start=jnp.array([[6.0, 6.0], [6.0, 6.0], [6.0, 6.0]]),
    goal=jnp.array([[6.0, 6.2], [6.9, 6.0], [13.0, 14.0]]),
    n=jnp.array(3),
)


@functools.cache
def compiled(engine: str = "mujoco", **options):
    """The compiled step of N environments. Tests with the same options share the program."""
    return jax.jit(jax.vmap(MazeEnv(POINT, engine=engine, **options).step))


# Resets do not depend on the options. All N environments have the same maze and tasks.
reset = jax.jit(jax.vmap(MazeEnv(POINT, engine="mujoco").reset, (0, None, None)))
HORIZON = 4


def far(tasks: Tasks) -> Tasks:
    """Tasks with only the last of three tasks."""
    return tasks.replace(start=jnp.tile(tasks.start[2:], (3, 1)), goal=jnp.tile(tasks.goal[2:], (3, 1)))


def at_step(state, number: int):
    """The state with its step counters set to this number."""
    steps = jnp.full_like(state.pipeline_state.episode_steps, number)
    return state.replace(pipeline_state=state.pipeline_state.replace(episode_steps=steps))


def keys(seed: int, n: int = N) -> jax.Array:
    return jax.random.split(jax.random.key(seed), n)


def actions(seed: int, length: int, n: int = N) -> jax.Array:
    return jax.random.uniform(jax.random.key(seed), (length, n, 2), minval=-1.5, maxval=1.5)


def assert_same(a, b, **tolerance) -> None:
    """Compare two states; random keys must be identical."""

    def plain(leaf):
        return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf

    jax.tree.map(lambda x, y: np.testing.assert_allclose(plain(x), plain(y), **tolerance), a, b)


# --------------------------------------------------------------------------------------------------- contract


def test_maze_env_is_brax_environment():
    env = MazeEnv("point", engine="mujoco", maze=UMAZE)
    assert isinstance(env, brax.envs.Env)
    assert env.backend == "mujoco"
    assert env.unwrapped is env
    state = jax.eval_shape(VmapWrapper(env).reset, keys(0, 2))
    after = jax.eval_shape(VmapWrapper(env).step, state, jnp.zeros((2, env.action_size)))
    assert {name: leaf.shape[1:] for name, leaf in after.obs.items()} == env.observation_size
    assert after.reward.shape == after.done.shape == (2,)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), state) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), after
    )  # so it can be used in a scan


def test_observations_without_maps_have_other_entries():
    step, bare_step = compiled(horizon=HORIZON), compiled(horizon=HORIZON, maps=False)
    assert MazeEnv(engine="mujoco", maps=False).observation_size == {"proprio": (2,), "goal": (2,)}
    state = reset(keys(1), UMAZE, None)
    bare = state.replace(obs={name: leaf for name, leaf in state.obs.items() if name != "map"})
    for action in actions(1, 3):
        state, bare = step(state, action), bare_step(bare, action)
        assert bare.obs.keys() == {"proprio", "goal"}
        assert_same({name: state.obs[name] for name in bare.obs}, bare.obs)


def test_unknown_names_are_error():
    with pytest.raises(
        UserError, match=", ".join(name for name, robot in ROBOTS.items() if robot.simulator == "mujoco")
    ):
        MazeEnv("unicycle")
    with pytest.raises(UserError, match="mjx, mujoco"):
        MazeEnv(engine="bullet")
    with pytest.raises(UserError, match="needs a maze"):
        MazeEnv(engine="mujoco").reset(jax.random.key(0))
    with pytest.raises(UserError, match="cells"):
        MazeEnv(engine="mujoco", maze=load_maze("antmaze-umaze", cell_m=3.0))
    with pytest.raises(UserError, match="too small"):
        MazeEnv(engine="mujoco", cell_m=2.0)


# ----------------------------------------------------------------------------------------------------- purity


def test_reset_and_step_are_deterministic():
    step, state, action = compiled(horizon=HORIZON), reset(keys(2), LARGE, None), actions(2, 1)[0]
    assert_same(state, reset(keys(2), LARGE, None))
    assert_same(step(state, action), step(state, action))


@pytest.mark.parametrize("auto_reset", [True, False])
def test_step_does_not_change_its_argument(auto_reset):
    env = MazeEnv(engine="mujoco", auto_reset=auto_reset)

    def look(key, action):
        state = env.reset(key, UMAZE, NEAR)
        leaves, info = jax.tree.leaves(state), dict(state.info)
        env.step(state, action)
        assert state.info.keys() == info.keys()
        assert all(now is before for now, before in zip(jax.tree.leaves(state), leaves, strict=True))

    jax.eval_shape(look, jax.random.key(0), jnp.zeros(2))


def test_jit_does_not_change_results():
    env = MazeEnv(POINT, engine="mujoco", horizon=HORIZON)
    path, step = actions(3, HORIZON + 1), compiled(horizon=HORIZON)
    state = reset(keys(3), UMAZE, NEAR)
    one = jax.tree.map(lambda leaf: leaf[0], state)
    with jax.disable_jit():
        alone = [one := env.step(one, action[0]) for action in path]
    for action, other in zip(path, alone, strict=True):
        state = step(state, action)
        assert_same(jax.tree.map(lambda leaf: leaf[0], state), other, atol=1e-5)


def test_each_environment_has_its_own_maze():
    step = compiled(horizon=HORIZON)
    singles = [LARGE, make_maze(random_walls(5)), make_maze(random_walls(6, density=0.3))] + [UMAZE] * (N - 3)
    alike = [reset(keys(4), maze, None) for maze in singles]
    state = jax.tree.map(lambda *leaves: jnp.stack([leaf[i] for i, leaf in enumerate(leaves)]), *alike)
    assert_same(state.info["maze"], stack_mazes(singles))
    together = [state := step(state, action) for action in actions(4, 4)]
    for i in range(4):
        alone = alike[i]  # the other environments are in this maze, too; only the i-th is compared
        for action, other in zip(actions(4, 4), together, strict=True):
            alone = step(alone, action)
            assert_same(*(jax.tree.map(lambda leaf: leaf[i], s.obs) for s in (alone, other)), atol=1e-5)  # noqa: B023


def test_many_mazes_compile_once():
    env = MazeEnv("point", engine="mujoco")
    traces = Counter()

    def counted(name):
        def call(*arguments):
            traces[name] += 1
            return getattr(env, name)(*arguments)

        return jax.jit(call)

    reset, step = counted("reset"), counted("step")
    for seed in range(4):
        state = reset(jax.random.key(seed), make_maze(random_walls(seed, height=7 + seed, width=12)))
        for _ in range(2):
            state = step(state, jnp.ones(2))
    assert traces == {"reset": 1, "step": 1}


# ------------------------------------------------------------------------------------------- what a step says


@pytest.mark.parametrize("maze", [LARGE, UMAZE], ids=["large", "umaze"])
def test_observation_and_reward_are_after_step(maze):
    step = compiled(horizon=HORIZON, auto_reset=False)
    state = reset(keys(5), maze, None)
    for action in actions(5, HORIZON - 1):
        state = step(state, action)
        position, goal = state.pipeline_state.qpos[:, :2], state.info["goal"]
        np.testing.assert_array_equal(state.info["position"], position)
        np.testing.assert_allclose(state.obs["goal"], goal - position, atol=1e-5)
        np.testing.assert_array_equal(state.obs["proprio"], state.pipeline_state.qvel)
        np.testing.assert_allclose(state.reward, -np.linalg.norm(goal - position, axis=-1), rtol=1e-5)
        maps = jax.vmap(lambda p, g: local_map(maze, p, g, cell_m=0.8))(position, goal)
        np.testing.assert_array_equal(state.obs["map"], maps)


def test_actions_beyond_one_are_clipped():
    step = compiled(horizon=HORIZON, auto_reset=False)
    state = reset(keys(6), LARGE, None)
    action = actions(6, 1)[0]
    assert (jnp.abs(action) > 1).any()
    assert_same(step(state, action), step(state, jnp.clip(action, -1, 1)))


def test_collision_is_reported_during_contact(wall_distance):
    """The engines report contacts at the start of the last substep, so the first or last contact may be missed."""
    step = compiled(horizon=HORIZON, auto_reset=False)
    state = reset(keys(7), LARGE, None)
    distances, told = [], []
    for _ in range(30):
        state = step(at_step(state, 0), jnp.ones((N, 2)))
        distances.append(wall_distance(load_walls("antmaze-large"), state.info["position"]))
        told.append(np.asarray(state.info["collision"]))
    distance, told = np.stack(distances), np.stack(told) > 0
    touching = distance < POINT.radius_m
    steady = (np.abs(distance - POINT.radius_m) > 1e-3)[1:] & (touching[1:] == touching[:-1])
    assert (told == touching)[1:][steady].mean() > 0.98  # except contacts between two steps
    assert 0.1 < told[1:][steady].mean() < 0.9 and steady.mean() > 0.8


# --------------------------------------------------------------------------------------- starts, goals, tasks


def test_starts_and_goals_are_free_and_connected(wall_distance):
    walls = parse_walls("#######\n#..#..#\n#..#..#\n#######")
    states = [reset(batch, make_maze(walls), None) for batch in keys(8, 128).reshape(-1, N)]
    start, goal = (np.concatenate([state.info[name] for state in states]) for name in ("position", "goal"))
    assert (wall_distance(walls, start) >= POINT.radius_m).all()
    assert (wall_distance(walls, goal) >= POINT.radius_m).all()
    np.testing.assert_array_equal(start[:, 0] < 14, goal[:, 0] < 14)
    assert 0.2 < (start[:, 0] < 14).mean() < 0.8
    assert len(np.unique(start, axis=0)) == len(np.unique(goal, axis=0)) == 128
    assert not any(np.asarray(state.pipeline_state.qvel).any() for state in states)


def test_only_first_n_tasks_are_drawn():
    step = compiled(horizon=HORIZON)
    row = jnp.arange(3.0)[:, None]
    tasks = Tasks(start=6.0 + 0.1 * row * jnp.ones((1, 2)), goal=14.0 + row * jnp.ones((1, 2)), n=jnp.array(2))
    state = reset(keys(9), UMAZE, tasks)
    np.testing.assert_allclose(state.info["position"], 6.0 + 0.1 * (state.info["goal"] - 14.0), atol=1e-5)
    seen = [np.asarray(state.info["goal"])]
    for _ in range(2 * HORIZON):
        state = step(state, jnp.zeros((N, 2)))
        seen.append(np.asarray(state.info["goal"]))
    for drawn in (seen[:1], seen[1:]):
        assert {tuple(goal) for goal in np.concatenate(drawn)} == {(14.0, 14.0), (15.0, 15.0)}
    assert (seen[0] != seen[-1]).any()


def test_reset_velocity_has_given_deviation():
    env = MazeEnv(engine="mujoco", maps=False, reset_velocity_mps=2.0)
    velocity = np.asarray(jax.jit(jax.vmap(env.reset, (0, None)))(keys(10, 400), LARGE).obs["proprio"])
    assert velocity.std() == pytest.approx(2.0, rel=0.1)
    assert np.abs(velocity.mean(0)).max() < 0.4


# ------------------------------------------------------------------------------------------- how episodes end


def test_auto_reset_returns_outcome_and_new_episode(wall_distance):
    """Compared with an environment without auto-reset: the outcomes are equal, and so are unfinished states."""
    step, plain_step = compiled(horizon=HORIZON), compiled(horizon=HORIZON, auto_reset=False)
    state = reset(keys(11), UMAZE, NEAR)
    outcomes = Counter()
    for action in 0.2 * actions(11, 24):
        after, plain = step(state, action), plain_step(state.replace(done=jnp.zeros(N)), action)
        for name in ("success", "truncation", "collision"):
            np.testing.assert_array_equal(after.info[name], plain.info[name])
        np.testing.assert_array_equal(after.done, plain.done)
        np.testing.assert_allclose(after.reward, plain.reward, rtol=1e-5)
        done = np.asarray(after.done) > 0
        pick = lambda state: (state.pipeline_state, state.obs, state.info["goal"], state.info["episode_steps"])  # noqa: E731
        assert_same(*(jax.tree.map(lambda x: x[~done], pick(s)) for s in (after, plain)), atol=1e-5)  # noqa: B023
        assert (np.asarray(after.info["episode_steps"])[done] == 0).all()
        assert (np.asarray(after.pipeline_state.qvel)[done] == 0).all()
        np.testing.assert_allclose(after.obs["goal"], after.info["goal"] - after.info["position"], atol=1e-5)
        assert wall_distance(load_walls("antmaze-umaze"), after.info["position"]).min() >= POINT.radius_m - 0.1
        outcomes.update(zip(np.asarray(plain.info["success"]), np.asarray(plain.info["truncation"]), strict=True))
        state = after
    assert set(outcomes) == {(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)}  # never success and truncation at once


def test_auto_reset_draws_new_start_and_goal():
    step, state = compiled(horizon=HORIZON), reset(keys(12), LARGE, None)
    starts, goals = [state.info["position"]], [state.info["goal"]]
    for _ in range(6):
        state = step(at_step(state, HORIZON - 1), jnp.zeros((N, 2)))
        assert (state.done == 1).all()
        starts.append(state.info["position"])
        goals.append(state.info["goal"])
    for drawn in (starts, goals):
        assert len(np.unique(np.concatenate(drawn), axis=0)) == 7 * N


def test_horizon_truncates():
    step, state = compiled(horizon=HORIZON, auto_reset=False), reset(keys(13), UMAZE, far(NEAR))
    for i in range(1, HORIZON + 1):
        state = step(state, jnp.zeros((N, 2)))
        assert (state.info["episode_steps"] == i).all()
        assert (state.done == (i == HORIZON)).all()
        assert (state.info["truncation"] == (i == HORIZON)).all()
        assert (state.info["success"] == 0).all()


def test_success_at_horizon_is_not_truncation():
    """The robot reaches the goal in the last step of the horizon."""
    step, right = compiled(horizon=HORIZON, auto_reset=False), jnp.broadcast_to(jnp.array([1.0, 0.0]), (N, 2))
    states = [reset(keys(14), UMAZE, far(NEAR))]
    for _ in range(HORIZON):
        states.append(step(states[-1], right))
    last, end = (np.asarray(state.info["position"])[0] for state in states[-2:])
    assert end[0] - last[0] > 0.2
    goal = end + np.array([POINT.goal_tolerance_m - 0.1, 0.0])
    state = reset(keys(14), UMAZE, NEAR.replace(start=far(NEAR).start, goal=jnp.tile(jnp.float32(goal), (3, 1))))
    for i in range(1, HORIZON + 1):
        state = step(state, right)
        assert (state.done == (i == HORIZON)).all() and (state.info["success"] == (i == HORIZON)).all()
        assert (state.info["truncation"] == 0).all()


def test_success_is_within_goal_tolerance():
    step = compiled(horizon=HORIZON, auto_reset=False)
    inner, outer = POINT.goal_tolerance_m - 0.01, POINT.goal_tolerance_m + 0.01
    for distance, success in ((inner, 1), (outer, 0)):
        at = jnp.full((3, 2), 6.0)
        state = reset(keys(15), UMAZE, Tasks(at, at + jnp.array([[0.6, 0.8]]) * distance, jnp.array(3)))
        state = step(state, jnp.zeros((N, 2)))
        assert (state.info["success"] == success).all() and (state.done == success).all()


def test_finished_environment_does_not_change_without_auto_reset():
    step, state = compiled(horizon=HORIZON, auto_reset=False), reset(keys(16), UMAZE, NEAR)
    for action in actions(16, 6):
        after = step(state, action)
        done = np.asarray(state.done) > 0
        assert_same(*(jax.tree.map(lambda leaf: leaf[done], s) for s in (state, after)))  # noqa: B023
        state = after
    assert (state.done == 1).all() and len(set(np.asarray(state.info["episode_steps"]).tolist())) > 1


@pytest.mark.rank_promotion("allow")  # MJX
@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("what", ["action", "state"])
def test_non_finite_values_end_their_own_episode_only(monkeypatch, tmp_path, engine, bad, what):
    monkeypatch.chdir(tmp_path)  # MuJoCo would write its log file there
    step, state, action = compiled(engine, horizon=HORIZON), reset(keys(17), LARGE, None), actions(17, 1)[0]
    clean = step(state, action)
    sick = np.arange(N) == 3
    poison = lambda leaf: jnp.where(sick[:, None], bad, leaf)  # noqa: E731
    if what == "action":
        after = step(state, action.at[3, 1].set(bad))
        assert np.isfinite(after.reward).all() and not [*tmp_path.iterdir()]
    else:
        physics = state.pipeline_state
        after = step(state.replace(pipeline_state=physics.replace(qvel=poison(physics.qvel))), action)
    others = np.flatnonzero(~sick)
    assert_same(*(jax.tree.map(lambda leaf: leaf[others], s) for s in (clean, after)))
    assert after.done[3] == 1 and after.info["success"][3] == 0 and after.info["truncation"][3] == 0
    np.testing.assert_array_equal(after.info["diverged"], sick)
    for _ in range(HORIZON - 2):  # the next episode
        after = step(after, action)
        assert (after.done == 0).all() and (after.info["diverged"] == 0).all()
        jax.tree.map(lambda leaf: np.testing.assert_array_equal(np.isfinite(leaf), True), after.obs)
        assert np.isfinite(after.reward).all()
    assert after.info["episode_steps"][3] == HORIZON - 2 and after.info["episode_steps"][0] == HORIZON - 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_action_keeps_previous_state(bad):
    step = compiled(horizon=HORIZON, auto_reset=False)
    state = reset(keys(18), LARGE, None)
    after = step(state, jnp.full((N, 2), bad))
    assert (after.done == 1).all() and (after.info["success"] == 0).all() and (after.info["diverged"] == 1).all()
    for name in ("qpos", "qvel", "goal"):
        np.testing.assert_array_equal(getattr(after.pipeline_state, name), getattr(state.pipeline_state, name))
    np.testing.assert_allclose(after.reward, -np.linalg.norm(state.obs["goal"], axis=-1), rtol=1e-5)


# ------------------------------------------------------------------------------------- what cannot be an episode

ENV = MazeEnv(POINT, engine="mujoco", maps=False)
WRONG_SHAPES = [
    {"start": jnp.ones(2)}, {"start": jnp.ones((2, 3, 2))}, {"goal": jnp.ones((2, 2))}, {"goal": jnp.ones((3, 3))},
    {"start": jnp.ones((0, 2)), "goal": jnp.ones((0, 2))}, {"n": jnp.ones(3, jnp.int32)}, {"n": jnp.array(3.0)},
    {"follow": jnp.zeros((2, 1), jnp.int32)}, {"follow": jnp.zeros((3, 0), jnp.int32)},
    {"follow": jnp.zeros(3, jnp.int32)}, {"follow": jnp.zeros((3, 1))}, {"turn_rad": jnp.zeros(3)},
]  # fmt: skip
FOLLOWED = {"n": jnp.array(1), "follow": jnp.array([[0], [0], [0]])}
WRONG_VALUES = [
    ({"start": NEAR.start.at[1].set(2.0)}, r"start\[1\] is \(2, 2\)"),  # in a wall
    ({"start": NEAR.start.at[2].set(-6.0)}, r"start\[2\]"), ({"start": NEAR.start.at[0].set(1e30)}, r"start\[0\]"),
    ({"goal": NEAR.goal.at[1, 0].set(jnp.nan)}, r"goal\[1\]"), ({"goal": NEAR.goal.at[1].set(-jnp.inf)}, r"goal\[1\]"),
    ({"goal": NEAR.goal.at[2].set(jnp.array([10.0, 10.0]))}, r"goal\[2\]"), ({"n": jnp.array(0)}, "n is 0"),
    ({"n": jnp.array(4)}, "n is 4"), ({"follow": jnp.array([[0], [3], [0]])}, "entry 3"),
    ({"follow": jnp.array([[0], [-1], [0]])}, "entry -1"), ({"turn_rad": jnp.array(jnp.nan)}, "turn_rad"),
    (FOLLOWED | {"start": NEAR.start.at[0].set(2.0)}, r"start\[0\]"),
    (FOLLOWED | {"follow": jnp.array([[2], [0], [0]]), "goal": NEAR.goal.at[2].set(2.0)}, r"goal\[2\]"),
]  # fmt: skip


def assert_one_line(call, match: str) -> None:
    with pytest.raises(UserError, match=match) as refused:
        call()
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize("change", WRONG_SHAPES, ids=lambda change: " ".join(change))
def test_tasks_with_wrong_shapes_are_error_also_if_traced(change):
    tasks = NEAR.replace(**change)
    for call in (ENV.reset, jax.jit(ENV.reset), lambda *a: jax.eval_shape(ENV.reset, *a)):
        assert_one_line(lambda: call(jax.random.key(0), UMAZE, tasks), f"tasks.({'|'.join(change)}) ")  # noqa: B023


@pytest.mark.parametrize(("change", "match"), WRONG_VALUES, ids=lambda value: value if isinstance(value, str) else "")
def test_invalid_tasks_are_error(change, match):
    tasks = NEAR.replace(**change)
    assert_one_line(lambda: ENV.reset(jax.random.key(0), UMAZE, tasks), match)
    assert_one_line(lambda: check_tasks(tasks, UMAZE), match)
    for shared in (jax.vmap(ENV.reset, (0, None, None)), lambda *a: jax.jit(lambda k: ENV.reset(k, *a[1:]))(a[0][0])):
        assert_one_line(lambda: shared(keys(0, 2), UMAZE, tasks), match)  # noqa: B023
    jax.eval_shape(ENV.reset, jax.random.key(0), UMAZE, tasks)  # without values, no error


def test_padding_of_tasks_is_not_checked():
    tasks = NEAR.replace(n=jnp.array(2), start=NEAR.start.at[2].set(jnp.nan), goal=NEAR.goal.at[2].set(2.0))
    ENV.reset(jax.random.key(0), UMAZE, tasks)
    ENV.reset(jax.random.key(0), UMAZE, tasks.replace(follow=jnp.array([[1], [0], [1]])))


def test_wrong_traced_tasks_behave_as_documented():
    begin = jax.jit(lambda tasks: ENV.reset(jax.random.key(0), UMAZE, tasks).pipeline_state)
    assert begin(NEAR.replace(n=jnp.array(0))).task == 0
    far = NEAR.replace(n=jnp.array(10**9))
    np.testing.assert_array_equal(begin(far).goal, NEAR.goal[2])


def test_wrong_cell_size_and_stacked_mazes_are_error():
    other = load_maze("antmaze-umaze", cell_m=3.0)
    for call in (ENV.reset, jax.vmap(ENV.reset, (0, None))):
        key = jax.random.key(0) if call == ENV.reset else keys(0, 2)
        assert_one_line(lambda: call(key, other), "cells are not 4.0 m wide")  # noqa: B023
    many = stack_mazes([UMAZE, UMAZE])
    for call in (ENV.reset, jax.jit(ENV.reset)):
        assert_one_line(lambda: call(jax.random.key(0), many), "vmap")  # noqa: B023
    assert_one_line(lambda: MazeEnv(engine="mujoco", maze=many), "vmap")


@pytest.mark.parametrize("shape", [(1,), (), (3,), (1, 2), (2, 2)])
def test_action_with_wrong_shape_is_error_also_if_traced(shape):
    state = jax.eval_shape(ENV.reset, jax.random.key(0), UMAZE)
    for call in (ENV.step, jax.jit(ENV.step)):
        assert_one_line(lambda: jax.eval_shape(call, state, jnp.ones(shape)), "action has shape")  # noqa: B023
    states = jax.eval_shape(jax.vmap(ENV.reset, (0, None)), keys(0), UMAZE)
    many = jax.vmap(ENV.step)
    assert_one_line(lambda: jax.eval_shape(many, states, jnp.ones((N, *shape))), "action has shape")
