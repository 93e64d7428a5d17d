"""Settings: what a run writes down is what it was."""

import json
from dataclasses import asdict, fields, is_dataclass, replace

import pytest

from ct_envs import UserError
from ct_jax.configs import get_preset
from ct_jax.configs.point import PRESETS
from ct_jax.controller import ControllerConfig
from ct_jax.controllers.augment import AugmentConfig
from ct_jax.controllers.edges import EdgeConfig
from ct_jax.controllers.reward import RewardConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.fit import FitConfig
from ct_jax.settings import Settings, from_dict, to_dict, with_controller
from ct_jax.transformer import ModelConfig

ALL = (
    PRESETS
    | {f"{name} for the {robot}": get_preset(name, robot) for name in PRESETS for robot in ("ant", "humanoid")}
    | {
        "default": Settings(),
        "many mazes": Settings(random_mazes=3),
        "modes": Settings(model=ModelConfig(modes=4, commitment=3.0)),
        "skill with a stride": Settings(model=ModelConfig(skill=True, stride=3)),
        "edges": with_controller(
            Settings(),
            ControllerConfig(
                SacConfig(iterations=9),
                EdgeConfig(reward=RewardConfig(fall_ramp=(0.1, 0.9), tilt_m=2.0), chain=True, turn_ramp=(0.2, 0.3)),
                AugmentConfig(frame="heading", mirror=True),
            ),
        ),
        "rounds": Settings(rounds=2, round_fit=FitConfig(updates=3, mirror=True, turns=True)),
    }
)


@pytest.mark.parametrize("name", ALL)
def test_settings_survive_being_written(name):
    settings = ALL[name]
    again = from_dict(json.loads(json.dumps(to_dict(settings))))
    assert again == settings
    assert hash(again) == hash(settings)


OLD_NAMES = {
    "return_scale": "optimism", "clip_target_return": "reprompt", "controller_action_scale": "controller_effort",
    "action_scale": "effort",
}  # fmt: skip
# What a file of format 1 meant by leaving a setting out.
LEFT_OUT = {
    "most_samples": 25_600, "acting": "cache", "rooms": None, "random_mazes": 0, "controller_action_scale": 1.0,
    "modes": 1, "commitment": 0.0, "skill": False, "stride": 1, "turns": False, "precision": "float32",
}  # fmt: skip


def as_format_2(settings):
    """What the second version wrote of the same settings: those of a controller in one object."""
    values = asdict(settings)
    edges = values.pop("edges")
    values["sac"] |= edges.pop("reward") | edges | values.pop("augment")
    return values


def as_format_1(values):
    """What the first version wrote of the same settings, given those of the second."""
    if not isinstance(values, dict):
        return values
    return {
        OLD_NAMES.get(name, name): as_format_1(value)
        for name, value in values.items()
        if name not in LEFT_OUT or value != LEFT_OUT[name]
    }


@pytest.mark.parametrize("name", ALL)
def test_files_of_the_first_version_mean_what_they_meant(name):
    old = as_format_1(as_format_2(ALL[name]))
    assert not any(f'"{new}"' in json.dumps(old) for new in OLD_NAMES)
    assert from_dict(json.loads(json.dumps(old))) == ALL[name]


@pytest.mark.parametrize("name", ALL)
def test_files_of_the_second_version_mean_what_they_meant(name):
    old = {"format": 2} | as_format_2(ALL[name])
    assert from_dict(json.loads(json.dumps(old))) == ALL[name]


@pytest.mark.parametrize("number", [0, 4, 2.0, "2", True, None])
def test_settings_of_an_unknown_format_are_refused(number):
    with pytest.raises(UserError, match=r"format .*; this version reads 1 to 3"):
        from_dict(to_dict(Settings()) | {"format": number})


def test_an_unknown_preset_lists_the_known():
    for name in PRESETS:
        assert get_preset(name) is PRESETS[name]
        with pytest.raises(UserError, match=f"no preset named 'huge'.*{name}"):
            get_preset("huge")


@pytest.mark.parametrize(
    "break_it",
    [
        lambda d: d["fit"].update(momentum=0.9),
        lambda d: d.pop("model"),
        lambda d: d.update(colour="red"),
        lambda d: d["value"].pop("fit"),
    ],
)
def test_settings_of_another_version_are_refused(break_it):
    values = to_dict(Settings())
    break_it(values)
    with pytest.raises(UserError, match="another version"):
        from_dict(values)


@pytest.mark.parametrize("name", ALL)
def test_settings_agree_with_themselves(name):
    """Schedules end after they began."""
    s = ALL[name]
    for fit in (s.fit, s.round_fit, s.value.fit):
        assert fit is None or 0 < fit.warmup <= fit.updates or name == "rounds"
    assert s.sac.warmup * s.sac.envs >= s.sac.batch or s.sac.warmup < s.sac.iterations


def test_configs_are_frozen():
    for config in (Settings(), *(getattr(Settings(), f.name) for f in fields(Settings))):
        if is_dataclass(config):
            with pytest.raises(AttributeError):
                setattr(config, fields(config)[0].name, None)
            assert replace(config) == config


def test_a_gait_is_not_learned_in_a_demo():
    assert {get_preset("demo", robot).controller for robot in ("ant", "humanoid")} == {"zoo"}
    assert {get_preset(name, "humanoid").controller for name in PRESETS if name != "demo"} == {"own"}
    assert {get_preset(name, "point").controller for name in PRESETS} == {"own"}
