"""Settings: what a run writes down is what it was."""

import json
from dataclasses import asdict, fields, is_dataclass, replace

import pytest

from ct_envs import UserError
from ct_jax.fit import FitConfig
from ct_jax.presets import _LATER, PRESETS, Settings, from_dict, get_preset, to_dict
from ct_jax.transformer import ModelConfig

ALL = (
    PRESETS
    | {f"{name} for the {robot}": get_preset(name, robot) for name in PRESETS for robot in ("ant", "humanoid")}
    | {
        "default": Settings(),
        "many mazes": Settings(random_mazes=3),
        "modes": Settings(model=ModelConfig(modes=4, commitment=3.0)),
        "skill with a stride": Settings(model=ModelConfig(skill=True, stride=3)),
        "rounds": Settings(rounds=2, round_fit=FitConfig(updates=3, mirror=True, turns=True)),
    }
)


@pytest.mark.parametrize("name", ALL)
def test_settings_survive_being_written(name):
    settings = ALL[name]
    again = from_dict(json.loads(json.dumps(to_dict(settings))))
    assert again == settings
    assert hash(again) == hash(settings)


def test_settings_that_came_later_are_written_only_where_they_say_something():
    """So that a run of before goes on; and what is left out means the default."""
    words = json.dumps(to_dict(Settings()))
    assert not [name for name in _LATER if f'"{name}"' in words]
    words = json.dumps(asdict(Settings()))
    assert all(f'"{name}": {json.dumps(value)}' in words for name, value in _LATER.items())


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
