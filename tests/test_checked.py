"""Settings are checked when they are created: from Python, from the command line and from a file."""

import dataclasses
import functools
from dataclasses import dataclass, fields, replace
from types import NoneType
from typing import Annotated, Literal, get_args, get_origin, get_type_hints

import jax
import pytest
import tyro

from ct_envs import UserError
from ct_envs.checked import Above, Checked, Share, Within, from_json, shown
from ct_envs.turtlebot3 import Turtlebot3Config
from ct_jax.baselines.cql import CqlConfig
from ct_jax.baselines.sac_alone import SacAloneConfig
from ct_jax.controller import ControllerConfig
from ct_jax.settings import (
    AugmentConfig,
    CollectConfig,
    EdgeConfig,
    FitConfig,
    ModelConfig,
    PrmConfig,
    RecoverConfig,
    RewardConfig,
    RoomConfig,
    SacConfig,
    Settings,
    ValueConfig,
    from_dict,
    to_dict,
)

CONFIGS = [
    AugmentConfig, CollectConfig, ControllerConfig, CqlConfig, EdgeConfig, FitConfig, ModelConfig, PrmConfig,
    RecoverConfig, RewardConfig, RoomConfig, SacAloneConfig, SacConfig, Settings, Turtlebot3Config, ValueConfig,
]  # fmt: skip
FREE_TEXT = {"Settings.controller", "Turtlebot3Config.urdf"}  # names of a folder and a file


def unbounded(hint) -> list[object]:
    """The numbers without a range and the texts without choices in an annotation."""
    if get_origin(hint) is Annotated:
        base, *notes = get_args(hint)
        if any(isinstance(note, Within) for note in notes):
            return [part for entry in get_args(base) for part in unbounded(entry)] if get_origin(base) is tuple else []
        return [hint]
    if get_origin(hint) is Literal or hint in (bool, NoneType, Ellipsis):
        return []
    if get_args(hint):
        return [part for entry in get_args(hint) for part in unbounded(entry)]
    return [] if isinstance(hint, type) and issubclass(hint, Checked) else [hint]


def refusal(build) -> str:
    with pytest.raises(UserError) as caught:
        build()
    text = str(caught.value)
    assert "\n" not in text and len(text) < 300, text
    return text


@pytest.mark.parametrize("config", CONFIGS)
def test_all_settings_have_ranges_or_choices(config):
    hints = get_type_hints(config, include_extras=True)
    assert hints.keys() == {field.name for field in fields(config)}
    loose = {f"{config.__name__}.{name}" for name, hint in hints.items() if unbounded(hint)}
    assert loose <= FREE_TEXT


def test_unbounded_setting_is_found():
    assert unbounded(int) == unbounded(tuple[int, ...]) == unbounded(int | None) == [int]
    assert not unbounded(Annotated[int, Within(1, 2)] | None)


@pytest.mark.parametrize("config", CONFIGS)
def test_command_line_builds_all_configs(config):
    """tyro accepts the annotations. A forbidden value gives an error of tyro, not a traceback."""
    assert tyro.cli(config, args=[]) == config()
    for name, hint in get_type_hints(config).items():
        if hint is int:
            with pytest.raises(SystemExit):
                tyro.cli(config, args=[f"--{name.replace('_', '-')}", "-7"], console_outputs=False)


WRONG = [
    (ModelConfig, {"layers": "3"}, "a whole number from 1 to 64"),
    (ModelConfig, {"layers": 3.0}, "ModelConfig.layers is 3.0; give a whole number from 1 to 64"),
    (ModelConfig, {"layers": 0}, "ModelConfig.layers is 0; give a whole number from 1 to 64"),
    (ModelConfig, {"layers": True}, "layers is True"),
    (ModelConfig, {"heads": 0}, "heads is 0"),
    (ModelConfig, {"heads": 3}, "ModelConfig.width is 128; give a multiple of heads, 3"),
    (ModelConfig, {"width": 0}, "width is 0"),
    (ModelConfig, {"modes": 0}, "modes is 0"),
    (ModelConfig, {"stride": 0}, "stride is 0"),
    (ModelConfig, {"context_acting": -5}, "context_acting is -5"),
    (ModelConfig, {"context_acting": 10**9}, "context_acting is 1000000000"),
    (ModelConfig, {"context_acting": 10**5000}, "context_acting is too large to be shown (int)"),
    (ModelConfig, {"map_cell_m": 0}, "map_cell_m is 0; give a number above 0, at most 100"),
    (ModelConfig, {"map_cell_m": "x"}, "map_cell_m is 'x'"),
    (ModelConfig, {"map_cell_m": float("nan")}, "map_cell_m is nan"),
    (ModelConfig, {"map_cell_m": float("inf")}, "map_cell_m is inf"),
    (ModelConfig, {"map_cell_m": 10**5000}, "map_cell_m is"),
    (ModelConfig, {"frame": "sideways"}, "ModelConfig.frame is 'sideways'; give one of world, heading"),
    (ModelConfig, {"frame": 1}, "frame is 1"),
    (ModelConfig, {"returns": 1}, "ModelConfig.returns is 1; give True or False"),
    (ModelConfig, {"dropout": 1.0}, "dropout is 1.0"),
    (Settings, {"return_scale": -3.0}, "Settings.return_scale is -3.0; give a number above 0, at most 10"),
    (Settings, {"return_scale": "x"}, "return_scale is 'x'"),
    (Settings, {"model": None}, "Settings.model is None; give a ModelConfig"),
    (Settings, {"model": FitConfig()}, "give a ModelConfig"),
    (Settings, {"rooms": 3}, "give a RoomConfig or None"),
    (Settings, {"controller": "a\nb"}, "a line of text"),
    (SacConfig, {"hidden": "ab"}, "hidden is 'ab'; give a tuple of 1 to 16 entries"),
    (SacConfig, {"hidden": [8]}, "hidden is [8]"),
    (SacConfig, {"hidden": ()}, "hidden is ()"),
    (SacConfig, {"hidden": (8, 0)}, "for each entry a whole number from 1 to 16384"),
    (RewardConfig, {"fall_m": (1.0,)}, "a tuple of 2 entries"),
    (RewardConfig, {"fall_ramp": (0.5, 0.2)}, "RewardConfig.fall_ramp is (0.5, 0.2)"),
    (EdgeConfig, {"turn_ramp": (0.5, 0.2)}, "EdgeConfig.turn_ramp"),
    (EdgeConfig, {"through": True}, "set chain"),
    (SacConfig, {"replay": 3}, "at least the number of envs, 64"),
    (AugmentConfig, {"frame": "body"}, "one of world, heading"),
    (CollectConfig, {"guide": "oracle"}, "one of roadmap, shortcut, explorer"),
    (CollectConfig, {"starts": "corners"}, "CollectConfig.starts is 'corners'; give one of vertices, maze"),
    (RecoverConfig, {"keep": "somehow"}, "one of separate, joined, relabelled"),
    (RecoverConfig, {"bumps": 0}, "from 1 to 100000 or None"),
    (FitConfig, {"precision": "float8"}, "one of float32, bfloat16"),
    (CqlConfig, {"frame": "body"}, "one of world, heading"),
    (RoomConfig, {"noise": 9.0}, "noise is 9.0"),
    (PrmConfig, {"samples": 1}, "samples is 1"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("config", "values", "words"), WRONG, ids=lambda value: value if isinstance(value, str) else "-"
)
def test_wrong_setting_is_error_of_one_line_with_allowed_values(config, values, words):
    """For a new config, and for ``dataclasses.replace``."""
    assert words in refusal(lambda: config(**values))
    assert words in refusal(lambda: replace(config(), **values))


@pytest.mark.parametrize("config", CONFIGS)
def test_configs_are_static_arguments(config):
    assert hash(config()) == hash(config()) and config() == replace(config())
    traced = []

    @functools.partial(jax.jit, static_argnums=1)
    def f(x, settings):
        traced.append(settings)
        return x

    f(1.0, config()), f(1.0, replace(config()))
    assert len(traced) == 1


def test_integers_are_accepted_as_floats():
    assert PrmConfig(connect_m=9) == PrmConfig(connect_m=9.0)


@dataclass(frozen=True)
class Inner(Checked):
    share: Share = 0.5
    sizes: Annotated[tuple[Annotated[int, Above(0, 9)], ...], Within(0, 3)] = (1, 2)


@dataclass(frozen=True)
class Outer(Checked):
    inner: Inner = Inner()
    other: Inner | None = None


def test_json_round_trip_is_identity():
    for config in (Outer(), Outer(Inner(0.25, ()), Inner(1, (3,)))):
        assert from_json(Outer, dataclasses.asdict(config), "outer") == config
        lists = {"inner": {"share": config.inner.share, "sizes": list(config.inner.sizes)}}
        assert from_json(Outer, lists, "outer").inner == config.inner


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (None, "outer is None; give an object"),
        ([], "outer is []"),
        ({}, "'inner' is missing"),
        ({"inner": {}, "colour": 1}, "another version: 'colour' is unknown"),
        ({"inner": {"shore": 1}}, "outer.inner of another version: 'shore' is unknown"),
        ({"inner": {"share": 2}}, "outer.inner.share is 2; give a number from 0 to 1"),
        ({"inner": {"sizes": {}}}, "outer.inner.sizes is {}"),
        ({"inner": {}, "other": 3}, "outer.other is 3"),
        ({"inner": {}, "other": {"share": "1"}}, "outer.other.share is '1'"),
    ],
)
def test_wrong_json_is_error_with_its_path(values, words):
    assert words in refusal(lambda: from_json(Outer, values, "outer"))


def test_wrong_settings_in_file_are_error_with_their_path():
    for name, value, words in (
        ("layers", "3", "settings.model.layers is '3'; give a whole number from 1 to 64"),
        ("heads", 3, "settings.model: ModelConfig.width is 128; give a multiple of heads, 3"),
    ):
        values = to_dict(Settings())
        values["model"][name] = value
        assert words in refusal(lambda values=values: from_dict(values))


def test_anything_can_be_shown():
    deep = []
    for _ in range(100_000):
        deep = [deep]
    for value in (deep, 10**5000, "x" * 1000, "a\nb", {"a": 10**5000}, float("nan")):
        assert len(shown(value)) <= 60 and shown(value).isprintable()
    while deep:  # take it apart in steps: Python would recurse
        deep = deep.pop()
