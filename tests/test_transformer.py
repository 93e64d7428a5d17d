"""The transformer: who sees what, and that acting step by step is the policy that was trained."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs

from ct_envs import UserError
from ct_envs.occupancy import MAP_CELLS
from ct_jax.controller import ControllerConfig, make_controller
from ct_jax.controllers.sac import SacConfig, make_networks
from ct_jax.heads import HeadingHead, make_head, with_skill
from ct_jax.transformer import (
    ControlTransformer,
    MapEncoder,
    ModelConfig,
    Modes,
    band,
    empty_cache,
    empty_history,
    sample_inputs,
)

P, A = 3, 2
TINY = ModelConfig(layers=1, heads=2, width=16, context=4, context_acting=4, max_timestep=64)
INPUTS = ("maps", "proprio", "goal", "action", "rtg", "timestep", "valid")


def episode(seed: int, batch: int = 2, steps: int = 12) -> dict[str, jax.Array]:
    """A random piece of an episode."""
    keys = jax.random.split(jax.random.key(seed), 5)
    return {
        "maps": jax.random.bernoulli(keys[0], 0.4, (batch, steps, 2, MAP_CELLS, MAP_CELLS)).astype(jnp.uint8),
        "proprio": jax.random.normal(keys[1], (batch, steps, P)),
        "goal": 10 * jax.random.normal(keys[2], (batch, steps, 2)),
        "action": jax.random.uniform(keys[3], (batch, steps, A), minval=-1.0),
        "rtg": -2000 * jax.random.uniform(keys[4], (batch, steps)),
        "timestep": jnp.tile(jnp.arange(steps), (batch, 1)),
        "valid": jnp.ones((batch, steps)),
    }


@functools.cache
def params_of(config: ModelConfig):
    """Random parameters, every bias and embedding away from zero: a fresh start would hide mistakes."""
    fresh = jax.jit(ControlTransformer(config, A).init)(jax.random.key(0), *sample_inputs(P, A))
    leaves, structure = jax.tree.flatten(fresh)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    noise = [leaf + 0.2 * jax.random.normal(k, leaf.shape) for leaf, k in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(structure, noise)


@functools.partial(jax.jit, static_argnames=("config", "context"))
def forward(config: ModelConfig, params, piece, context=None):
    return ControlTransformer(config, A).apply(params, *(piece[name] for name in INPUTS), context=context)


def predict(config: ModelConfig, piece, context=None) -> np.ndarray:
    return np.asarray(forward(config, params_of(config), piece, context))


def changed_steps(config: ModelConfig, piece, **change) -> list[int]:
    """Steps at which the prediction depends on the change."""
    before, after = predict(config, piece), predict(config, piece | change)
    return np.flatnonzero(np.abs(after - before).max((0, 2)) > 1e-6).tolist()


# -------------------------------------------------------------------------------------------------- causality


@pytest.mark.parametrize("name", ["maps", "proprio", "goal", "rtg"])
def test_a_step_is_seen_by_itself_and_the_next_of_the_band(name):
    """With one layer: at t, ..., t + K - 1 and nowhere else."""
    piece, t = episode(0), 3
    other = piece[name].at[:, t].set(episode(1)[name][:, t])
    assert changed_steps(TINY, piece, **{name: other}) == [t, t + 1, t + 2, t + 3]


def test_an_action_is_not_seen_by_itself():
    piece, t = episode(0), 3
    other = piece["action"].at[:, t].add(1.0)
    assert changed_steps(TINY, piece, action=other) == [t + 1, t + 2, t + 3]


def test_past_actions_can_be_left_out():
    """Nothing of them is left, not even parameters, and what else is seen, and when, stays the same."""
    config, piece, t = replace(TINY, actions=False), episode(0), 3
    assert changed_steps(config, piece, action=piece["action"] + 1.0) == []
    assert "embed_action" not in params_of(config)["params"]
    other = piece["proprio"].at[:, t].set(episode(1)["proprio"][:, t])
    assert changed_steps(config, piece, proprio=other) == [t, t + 1, t + 2, t + 3]


def test_layers_lengthen_the_memory_and_never_turn_it_round():
    """With three layers a step reaches 3 (K - 1) steps ahead, through those between, and never back."""
    config, piece, t = replace(TINY, layers=3, context=3), episode(0), 4
    seen = changed_steps(config, piece, proprio=piece["proprio"].at[:, t].add(5.0))
    assert seen == list(range(t, t + 7))


def test_the_band_by_its_words():
    step = np.arange(5)
    for context in (1, 2, 9):
        expected = [[0 <= q - k < context for k in step] for q in step]
        np.testing.assert_array_equal(band(jnp.asarray(step), jnp.asarray(step), context), expected)


def test_steps_that_are_not_there_do_not_matter():
    piece = episode(0)
    cut = piece | {"valid": piece["valid"].at[0, 7:].set(0.0)}
    garbage = {name: leaf.at[0, 7:].set(episode(5)[name][0, 7:]) for name, leaf in cut.items() if name != "valid"}
    before, after = predict(TINY, cut), predict(TINY, garbage | {"valid": cut["valid"]})
    np.testing.assert_allclose(after[0, :7], before[0, :7], atol=1e-6)
    np.testing.assert_allclose(after[1], before[1], atol=1e-6)
    np.testing.assert_allclose(before[0, :7], predict(TINY, piece)[0, :7], atol=1e-6)


# ----------------------------------------------------------------------------------------------------- acting


@functools.partial(jax.jit, static_argnames="config")
def act_along(config: ModelConfig, params, piece):
    """What the policy does, step by step, seeing the states and returns of a piece and its own actions."""
    model = ControlTransformer(config, A)
    n, steps = piece["rtg"].shape
    states = [jnp.swapaxes(piece[name], 0, 1) for name in ("maps", "proprio", "goal", "rtg")]
    window = config.acting == "window"

    def once(past, state):
        action, past = model.apply(params, past, *state, method="act_on_window" if window else "act")
        return past, action

    past = empty_history(config, piece["proprio"].shape[-1], A, n) if window else empty_cache(config, A, n)
    _, actions = jax.lax.scan(once, past, states, length=steps)
    return jnp.swapaxes(actions, 0, 1)


@pytest.mark.parametrize(("layers", "context", "acting"), [(1, 4, 4), (3, 4, 4), (3, 4, 7), (1, 6, 2), (3, 3, 1)])
def test_acting_with_the_cache_is_the_forward_pass(layers, context, acting):
    """Over 3 K steps, also with another memory than in training, and past the last timestep embedding."""
    config = replace(TINY, layers=layers, context=context, context_acting=acting, max_timestep=16)
    piece = episode(layers, steps=21)
    acted = act_along(config, params_of(config), piece)
    whole = predict(config, piece | {"action": acted}, context=acting)
    assert np.abs(whole).max() < 20 and (np.abs(acted) < 1).any()
    np.testing.assert_allclose(acted, np.clip(whole, -1.0, 1.0), atol=1e-4)
    if acting != context and acting > 1:
        assert np.abs(predict(config, piece | {"action": acted}) - whole).max() > 1e-3  # the length of memory tells


@pytest.mark.parametrize(("layers", "acting"), [(1, 4), (3, 4), (3, 7), (3, 1)])
def test_acting_without_past_actions_is_the_forward_pass(layers, acting):
    config = replace(TINY, layers=layers, context_acting=acting, max_timestep=16, actions=False)
    piece = episode(layers, steps=21)
    whole = predict(config, piece, context=acting)
    np.testing.assert_allclose(act_along(config, params_of(config), piece), np.clip(whole, -1.0, 1.0), atol=1e-4)


@pytest.mark.parametrize(("layers", "k", "actions"), [(1, 4, True), (3, 4, True), (3, 6, False), (2, 1, True)])
def test_acting_on_a_window_is_training_on_pieces_of_its_length(layers, k, actions):
    """Each action is the last one of the forward pass on the last K steps alone; a cache of K remembers more."""
    config = replace(
        TINY, layers=layers, context=k, context_acting=k, acting="window", actions=actions, max_timestep=64
    )
    piece = episode(layers, steps=13)
    acted = act_along(config, params_of(config), piece)
    for t in range(13):
        first = max(0, t + 1 - k)
        last = {name: leaf[:, first : t + 1] for name, leaf in (piece | {"action": acted}).items()}
        np.testing.assert_allclose(acted[:, t], np.clip(predict(config, last)[:, -1], -1.0, 1.0), atol=1e-4)
    kept = act_along(replace(config, acting="cache"), params_of(config), piece)
    np.testing.assert_allclose(kept[:, :k], acted[:, :k], atol=1e-4)
    if layers > 1 and k > 1:
        assert np.abs(kept - acted).max() > 1e-3


def test_a_window_knows_neither_stride_nor_commitment():
    for wrong in ({"stride": 2}, {"commitment": 1.0}):
        with pytest.raises(UserError, match="acting"):
            replace(TINY, acting="window", **wrong)


@pytest.mark.parametrize("stride", [2, 5])
@pytest.mark.parametrize("actions", [True, False])
def test_with_a_stride_each_step_sees_only_those_whole_strides_before_it(stride, actions):
    config = replace(TINY, context_acting=3, max_timestep=16, actions=actions, stride=stride)
    piece = episode(4, steps=21)
    acted = act_along(config, params_of(config), piece)
    for origin in range(stride):
        every = {name: leaf[:, origin::stride] for name, leaf in (piece | {"action": acted}).items()}
        whole = predict(config, every, context=3)
        np.testing.assert_allclose(acted[:, origin::stride], np.clip(whole, -1.0, 1.0), atol=1e-4)


def propose(model, params, inputs) -> Modes:
    return jax.jit(lambda p: model.apply(p, *inputs, method="propose"))(params)  # pyright: ignore


def skilled(**changes):
    """A model whose head is a controller, its parameters, and the controller."""
    config = ControllerConfig(SacConfig(hidden=(8, 8), action_scale=0.5))
    normalizer = running_statistics.init_state(specs.Array((P + 2,), jnp.dtype("float32")))
    normalizer = normalizer.replace(mean=jnp.arange(P + 2.0) / 5, std=1.0 + jnp.arange(P + 2.0))
    policy = make_networks(P + 2, A, config.sac.hidden).policy_network.init(jax.random.key(3))
    controller = make_controller(normalizer, policy, A, config)
    sizes = replace(TINY, skill=True, **changes)
    model = ControlTransformer(sizes, A, make_head(sizes, A, config))
    params = jax.jit(model.init)(jax.random.key(0), *sample_inputs(P, A))
    return model, with_skill(params, controller), controller


@pytest.mark.rank_promotion("allow")  # brax's running statistics
@pytest.mark.parametrize("modes", [1, 3])
def test_a_skill_is_the_controller_sent_where_the_trunk_says(modes):
    """Every proposed action is the controller's for some point, to be found by turning the one knob there is."""
    model, params, controller = skilled(modes=modes)
    piece = episode(1)
    inputs = [piece[name] for name in INPUTS]
    params["params"]["head"]["Dense_0"]["kernel"] *= 0.0
    where = jnp.arange(2.0 * modes).reshape(modes, 2) - 1.5
    params["params"]["head"]["Dense_0"]["bias"] = where.ravel() / 10.0
    found = np.asarray(propose(model, params, inputs).action)
    for i in range(modes):
        flat = piece["proprio"].reshape(-1, P)
        meant = controller(flat, jnp.broadcast_to(where[i], (len(flat), 2)))
        np.testing.assert_allclose(found[:, :, i].reshape(-1, A), meant, atol=1e-5)
    assert np.abs(found).max() <= 0.5  # its action_scale


@pytest.mark.rank_promotion("allow")
def test_a_skill_gets_no_gradient_and_leads_the_trunk():
    model, params, _ = skilled()
    inputs = [episode(1)[name] for name in INPUTS]
    gradient = jax.jit(jax.grad(lambda p: (propose(model, p, inputs).best() ** 2).sum()))(params)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient["skill"]))
    assert all(np.any(gradient["params"][name]["kernel"]) for name in ("embed_goal", "embed_state"))


def three_modes():
    """A model of three modes, a piece, and what it proposes at each of its steps."""
    config, piece = replace(TINY, modes=3, actions=False), episode(2, steps=21)
    params, inputs = params_of(config), [piece[name] for name in INPUTS]
    modes = propose(ControlTransformer(config, A), params, inputs)
    return config, params, piece, modes


def actions_of(modes, which):
    return np.take_along_axis(np.asarray(modes.action), which[..., None, None], 2)[:, :, 0]


def test_of_several_modes_the_likeliest_is_acted():
    """With the cache as in the forward pass, and not always the same one."""
    config, params, piece, modes = three_modes()
    assert modes.action.shape == (2, 21, 3, A) and modes.logit.shape == (2, 21, 3)
    which = np.asarray(modes.logit).argmax(-1)
    assert len(np.unique(which)) > 1
    chosen = actions_of(modes, which)
    np.testing.assert_allclose(predict(config, piece), chosen, atol=1e-6)
    np.testing.assert_allclose(act_along(config, params, piece), np.clip(chosen, -1.0, 1.0), atol=1e-4)


def test_committed_it_keeps_to_a_mode_unless_another_is_much_likelier():
    """By hand from the logits of a forward pass; and where nothing else counts, for ever to the first choice."""
    config, params, piece, modes = three_modes()
    logit, kept = np.asarray(modes.logit), []
    commitment = float(np.quantile(np.diff(np.sort(logit, -1), axis=-1), 0.1))  # enough for some, too little for others
    mode = logit[:, 0].argmax(-1)
    for t in range(21):
        mode = (logit[:, t] + commitment * (np.arange(3) == mode[:, None]) * (t > 0)).argmax(-1)
        kept.append(mode)
    kept = np.stack(kept, 1)
    assert len(np.unique(kept)) > 1 and (kept != logit.argmax(-1)).any()
    for c, which in ((commitment, kept), (1e6, np.broadcast_to(kept[:, :1], kept.shape))):
        acted = act_along(replace(config, commitment=c), params, piece)
        np.testing.assert_allclose(acted, np.clip(actions_of(modes, which), -1.0, 1.0), atol=1e-4)


def test_with_one_mode_nothing_chooses():
    assert "predict_mode" not in params_of(TINY)["params"]
    modes = propose(ControlTransformer(TINY, A), params_of(TINY), [episode(0)[name] for name in INPUTS])
    np.testing.assert_allclose(modes.action[:, :, 0], predict(TINY, episode(0)), atol=1e-5)


def test_each_mode_of_a_robot_with_a_heading_has_directions_of_its_own():
    """Where the modes' directions change places, their actions do, and nothing else changes."""
    head = HeadingHead(directions=3, action_size=4, modes=2, width=8)
    x, proprio = jax.random.normal(jax.random.key(0), (5, 16)), jax.random.normal(jax.random.key(1), (5, 27))
    params = head.init(jax.random.key(2), x, proprio)
    swapped = jax.tree.map(lambda leaf: leaf, params)
    swapped["params"]["Dense_0"] = {name: jnp.roll(p, 2 * 3, -1) for name, p in params["params"]["Dense_0"].items()}
    before, after = head.apply(params, x, proprio), head.apply(swapped, x, proprio)
    assert np.abs(before[:, 0] - before[:, 1]).max() > 1e-2
    np.testing.assert_allclose(after, before[:, ::-1], atol=1e-6)


def test_episodes_do_not_see_each_other():
    piece, other = episode(0), episode(1)
    mixed = {name: jnp.stack([piece[name][0], other[name][1]]) for name in INPUTS}
    params = params_of(TINY)
    acted = act_along(TINY, params, mixed)
    np.testing.assert_allclose(acted[0], act_along(TINY, params, piece)[0], atol=1e-5)
    np.testing.assert_allclose(acted[1], act_along(TINY, params, other)[1], atol=1e-5)


# ------------------------------------------------------------------------------------------------- embeddings


def test_without_returns_it_is_behaviour_cloning():
    piece = episode(0)
    other = piece["rtg"] - 500.0
    assert changed_steps(TINY, piece, rtg=other) == list(range(12))
    assert changed_steps(replace(TINY, returns=False), piece, rtg=other) == []


def test_the_three_tokens_of_a_step_share_their_timestep():
    """A vector added to one row of the table of timesteps is added to all three tokens of that step only.

    So it is the same as adding it to the three embeddings' biases where all steps are that step.
    """
    piece = episode(0, steps=3)
    at_five = piece | {"timestep": jnp.full((2, 3), 5)}
    params = params_of(TINY)
    push = jnp.linspace(-1.0, 1.0, TINY.width)

    def moved(tree, path, at):
        node = tree["params"]
        for name in path[:-1]:
            node = node[name]
        copied = jax.tree.map(lambda leaf: leaf, tree)
        target = copied["params"]
        for name in path[:-1]:
            target = target[name]
        target[path[-1]] = node[path[-1]].at[at].add(push)
        return copied

    by_time = moved(params, ("embed_timestep", "embedding"), 5)
    by_bias = params
    for name in ("embed_return", "embed_state", "embed_action"):
        by_bias = moved(by_bias, (name, "bias"), slice(None))
    np.testing.assert_allclose(forward(TINY, by_time, at_five), forward(TINY, by_bias, at_five), atol=1e-5)
    assert np.abs(forward(TINY, by_time, at_five) - predict(TINY, at_five)).max() > 1e-3
    np.testing.assert_array_equal(forward(TINY, by_time, piece), predict(TINY, piece))  # steps 0, 1, 2


def test_the_timestep_is_absolute():
    piece = episode(0)
    assert changed_steps(TINY, piece, timestep=piece["timestep"] + 20) == list(range(12))


def test_timesteps_past_the_last_embedding_have_the_last():
    piece = episode(0)
    late = piece | {"timestep": jnp.full((2, 12), 63)}
    np.testing.assert_array_equal(predict(TINY, late), predict(TINY, late | {"timestep": jnp.full((2, 12), 500)}))
    assert changed_steps(TINY, late, timestep=jnp.full((2, 12), 62)) == list(range(12))


def test_the_map_encoder_is_two_convolutions():
    maps = episode(0, batch=1, steps=3)["maps"].astype(jnp.float32)
    encoder = MapEncoder(8)
    variables = jax.jit(encoder.init)(jax.random.key(0), maps)
    variables = jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(jax.random.key(1), leaf.shape), variables)
    dense = variables["params"]

    def convolve(x, name, side, stride):
        kernel = dense[name]["kernel"]
        # patches are (channel, row, column) in the first layer, (row, column, channel) in the second
        channels = x.shape[1]
        if name == "conv5":
            kernel = kernel.reshape(channels, side, side, -1).transpose(3, 0, 1, 2)
        else:
            kernel = kernel.reshape(side, side, channels, -1).transpose(3, 2, 0, 1)
        bias = dense[name]["bias"][None, :, None, None]
        return jax.nn.relu(jax.lax.conv(x, kernel, (stride, stride), "VALID") + bias)

    x = convolve(convolve(maps[0], "conv5", 5, 5), "conv3", 3, 1)
    flat = x.transpose(0, 2, 3, 1).reshape(3, -1)
    expected = flat @ dense["out"]["kernel"] + dense["out"]["bias"][None]
    np.testing.assert_allclose(encoder.apply(variables, maps)[0], expected, atol=1e-4)


def test_dropout_is_for_training_only():
    piece = [episode(0)[name] for name in INPUTS]
    model = ControlTransformer(replace(TINY, dropout=0.5), A)
    params = params_of(TINY)

    @jax.jit
    def drop(key):
        return model.apply(params, *piece, deterministic=False, rngs={"dropout": key})

    train = [drop(jax.random.key(i)) for i in (0, 0, 1)]
    np.testing.assert_array_equal(train[0], train[1])
    assert np.abs(train[0] - train[2]).max() > 1e-3
    np.testing.assert_array_equal(predict(replace(TINY, dropout=0.5), episode(0)), predict(TINY, episode(0)))


def test_it_runs_without_compilation():
    piece = episode(0, batch=1, steps=2)
    whole = predict(TINY, piece)
    with jax.disable_jit():
        np.testing.assert_allclose(predict(TINY, piece), whole, atol=1e-5)
