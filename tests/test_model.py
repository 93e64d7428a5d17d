"""A shipped model acts as the one that was saved; what is not one is refused with the way out."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ct_envs import UserError
from ct_jax.controllers.sac import SacConfig
from ct_jax.fit import ValueConfig
from ct_jax.model import (
    TrainedModel,
    blank_model,
    load_controller,
    load_model,
    model_folder,
    save_controller,
    save_model,
    zoo_names,
)
from ct_jax.settings import Settings, controller_config
from ct_jax.transformer import ControlTransformer, ModelConfig, empty_cache

pytestmark = pytest.mark.rank_promotion("allow")  # brax's running statistics

SETTINGS = Settings(
    model=ModelConfig(layers=2, heads=2, width=8, context=3, context_acting=5, max_timestep=16),
    value=ValueConfig(width=8),
    sac=SacConfig(hidden=(8, 4)),
    return_scale=0.8,
    clip_target_return=True,
)


@pytest.fixture(scope="module")
def model():
    policy, controller = blank_model("point", SETTINGS)

    def draw(tree, seed):
        """Numbers of the kinds that the shapes are of."""
        leaves, structure = jax.tree.flatten(tree)
        keys = jax.random.split(jax.random.key(seed), len(leaves))
        floats = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
        drawn = [
            0.3 * jnp.abs(jax.random.normal(k, leaf.shape)) + 0.1 if is_float else jnp.full(leaf.shape, 3, leaf.dtype)
            for k, leaf, is_float in zip(keys, leaves, floats, strict=True)
        ]
        return jax.tree.unflatten(structure, drawn)

    return TrainedModel("point", SETTINGS, draw(policy, 1), draw(controller, 2), {"command": "ct-jax train point"})


def observations(n=3):
    keys = jax.random.split(jax.random.key(5), 4)
    maps = jax.random.bernoulli(keys[0], 0.5, (n, 2, 25, 25)).astype(jnp.float32)
    return maps, jax.random.normal(keys[1], (n, 2)), 9 * jax.random.normal(keys[2], (n, 2))


@jax.jit
def act(policy, maps, proprio, goal):
    rtg = jnp.full(len(goal), -500.0)
    cache, actions = empty_cache(policy.config, 2, len(goal)), []
    for _ in range(3):
        action, cache = policy.model.apply(policy.params, cache, maps, proprio, goal, rtg, method="act")
        actions.append(action)
    return jnp.stack(actions)


def test_it_acts_as_before(model, tmp_path):
    save_model(tmp_path / "model", model)
    found = load_model(str(tmp_path / "model"))
    maps, proprio, goal = observations()
    np.testing.assert_array_equal(act(found.policy, maps, proprio, goal), act(model.policy, maps, proprio, goal))
    np.testing.assert_array_equal(found.controller(proprio, goal), model.controller(proprio, goal))
    assert (found.robot, found.settings, found.made) == (model.robot, model.settings, model.made)
    assert (found.policy.return_scale, found.policy.clip_target_return) == (0.8, True)
    for a, b in zip(jax.tree.leaves(found.controller), jax.tree.leaves(model.controller), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.shape(a) == np.shape(b) and a.dtype == b.dtype
    assert {p.name for p in (tmp_path / "model").iterdir()} == {"weights.safetensors", "model.json"}


def test_a_run_folder_leads_to_its_model(model, tmp_path):
    save_model(tmp_path / "model", model)
    (tmp_path / "config.json").write_text("{}")
    assert model_folder(str(tmp_path)) == tmp_path / "model"
    assert load_model(str(tmp_path)).settings == SETTINGS


def test_a_half_written_run_says_how_to_go_on(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="--resume"):
        load_model(str(tmp_path))


def test_what_is_no_run_is_refused(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UserError, match="no run folder"):
            load_model(str(folder))


def test_an_unknown_zoo_model_lists_the_known():
    names = ", ".join("zoo:" + name for name in zoo_names()) or "zoo:NAME"
    with pytest.raises(UserError, match=f"no model 'zoo:unicorn' in the zoo; models: {names}"):
        load_model("zoo:unicorn")
    with pytest.raises(UserError):
        load_model("zoo:../../tests")


@pytest.mark.parametrize("name", zoo_names())
def test_zoo_models_load_and_are_small(name):
    folder = model_folder("zoo:" + name)
    assert sum(p.stat().st_size for p in folder.iterdir()) < 8e6
    assert load_model("zoo:" + name).made


def change(file, **values):
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def test_damage_is_named(model, tmp_path):
    meta, weights = tmp_path / "model.json", tmp_path / "weights.safetensors"

    def again():
        save_model(tmp_path, model)
        return load_model(str(tmp_path))

    again()
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(UserError, match=r"weights\.safetensors"):
        load_model(str(tmp_path))
    again()
    meta.write_text(meta.read_text()[:-10])
    with pytest.raises(UserError, match=r"model\.json:\d+"):
        load_model(str(tmp_path))
    for content in ("[]", "3", "{}"):
        meta.write_text(content)
        with pytest.raises(UserError, match=r"model\.json"):
            load_model(str(tmp_path))
    again()
    change(meta, robot="unicycle")
    with pytest.raises(UserError, match="unicycle"):
        load_model(str(tmp_path))
    again()
    wider = replace(SETTINGS, value=ValueConfig(width=16))
    save_model(tmp_path / "wider", replace(model, settings=wider))
    with pytest.raises(UserError, match=r"\(.*8.*\).*\(.*16.*\)"):
        load_model(str(tmp_path / "wider"))


def test_without_compilation(model, tmp_path):
    save_model(tmp_path, model)
    _, proprio, goal = observations(1)
    with jax.disable_jit():
        found = load_model(str(tmp_path))
        np.testing.assert_allclose(found.controller(proprio, goal), model.controller(proprio, goal), atol=1e-6)
    assert isinstance(found.policy.model, ControlTransformer)


# ---------------------------------------------------------------------------------------------------- controllers


@pytest.fixture
def controller_folder(model, tmp_path):
    config = controller_config(SETTINGS)
    save_controller(tmp_path / "controller", "point", config, model.controller, {"command": "ct-jax train point"})
    return tmp_path


def test_a_controller_acts_as_before(model, controller_folder):
    _, proprio, goal = observations()
    for where in (controller_folder, controller_folder / "controller"):  # a run's folder, or the controller's own
        found, config = load_controller(str(where), "point")
        np.testing.assert_array_equal(found(proprio, goal), model.controller(proprio, goal))
        assert config == controller_config(SETTINGS)


def test_the_controller_of_another_robot_is_refused_and_both_are_described(controller_folder):
    with pytest.raises(UserError) as refusal:
        load_controller(str(controller_folder), "ant")
    for words in ("robot point, proprio 2, actions 2", "robot ant, proprio 27, actions 8", "controller.json"):
        assert words in str(refusal.value)


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"robot": "point", "proprio": 2, "actions": 2, "sac": {"speed": 1}}']
)
def test_a_damaged_description_of_a_controller_is_refused(controller_folder, text):
    (controller_folder / "controller" / "controller.json").write_text(text)
    with pytest.raises(UserError, match=r"controller\.json"):
        load_controller(str(controller_folder), "point")


def test_damaged_or_pickled_weights_of_a_controller_are_refused(controller_folder):
    file = controller_folder / "controller" / "weights.safetensors"
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00\x8c\x07pickled\x94."):
        file.write_bytes(content)
        with pytest.raises(UserError, match="not a whole safetensors file"):
            load_controller(str(controller_folder), "point")


def test_where_there_is_no_controller_the_ways_out_are_told(tmp_path):
    with pytest.raises(UserError, match="give a run folder, 'zoo', or learn your 'own'"):
        load_controller(str(tmp_path), "point")
