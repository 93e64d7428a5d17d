"""All settings of a run, and how files hold them."""

from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, Final

from ct_envs import UserError
from ct_envs.checked import Above, Checked, Within, from_json, shown
from ct_envs.turtlebot3 import MAX_NOISE
from ct_envs.turtlebot3_world import MAX_DENSITY, TRAIN_DENSITY
from ct_jax.collect import CollectConfig
from ct_jax.controller import ControllerConfig
from ct_jax.controllers.augment import AugmentConfig
from ct_jax.controllers.edges import EdgeConfig
from ct_jax.controllers.reward import RewardConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.finetune import RecoverConfig
from ct_jax.fit import FitConfig, ValueConfig
from ct_jax.prm import PrmConfig
from ct_jax.transformer import ModelConfig

MAX_WORLDS = 1000
MAX_FACTOR = MAX_DENSITY / max(TRAIN_DENSITY)  # obstacle density relative to training
MAX_SEED = 2**32 - 1
MAX_RETURN_SCALE = 10.0
MAX_EPISODES, MAX_RANDOM_MAZES = 100_000, 10_000


@dataclass(frozen=True)
class RoomConfig(Checked):
    """The rooms of training and evaluation."""

    # Density of obstacles in training; the published numbers are measured at 1.
    density: Annotated[float, Within(0, MAX_FACTOR)] = 1.0
    # If given, each room's density is drawn between ``density`` and this.
    densest: Annotated[float, Within(0, MAX_FACTOR)] | None = None
    # Level of sensor and motion noise in training; 1 is that of a real robot.
    noise: Annotated[float, Within(0, MAX_NOISE)] = 0.0
    worlds: Annotated[int, Within(1, MAX_WORLDS)] = 20  # number of evaluation rooms (paper)

    @property
    def densities(self) -> tuple[float, float]:
        """The range from which the densities of the training rooms are drawn."""
        return self.density, self.density if self.densest is None else self.densest


@dataclass(frozen=True)
class Settings(Checked):
    """Everything a run depends on besides its robot, mazes, engine and seed."""

    prm: PrmConfig = PrmConfig()  # roadmaps
    controller: str = "own"  # learn one's "own", take the one of the "zoo", or that of a folder
    # The controller's learner (Soft Actor-Critic). Values marked "paper" are from sec. III-G.
    sac: SacConfig = SacConfig()
    edges: EdgeConfig = EdgeConfig()  # the controller's task: walks along edges
    augment: AugmentConfig = AugmentConfig()  # the controller's frame and symmetries
    # Factor of a learned controller's actions when it follows a planner: with less, the robot falls less.
    controller_action_scale: Annotated[float, Above(0, 1)] = 1.0
    collect: CollectConfig = CollectConfig()  # planner-guided collection (paper, Algorithm 3)
    model: ModelConfig = ModelConfig()  # the transformer (paper, table I)
    value: ValueConfig = ValueConfig()  # the value network and its training (paper, sec. III-D)
    fit: FitConfig = FitConfig()  # the first training of the transformer (paper, table I)
    recover: RecoverConfig = RecoverConfig()  # collection of recoveries (paper, Algorithm 4)
    rounds: Annotated[int, Within(0, 1000)] = 0  # I: iterations of fine-tuning on recoveries (paper, Algorithm 1)
    round_fit: FitConfig | None = None  # the training in each round but the last; by default as ``fit``
    last_fit: FitConfig | None = None  # the training in the last round; by default as ``round_fit``
    return_scale: Annotated[float, Above(0, MAX_RETURN_SCALE)] = 1.0  # k: ask for k * V (paper, sec. III-D)
    clip_target_return: bool = False  # never ask for more than V of the present state
    # Number of random mazes to collect and recover in, besides the named ones.
    random_mazes: Annotated[int, Within(0, MAX_RANDOM_MAZES)] = 0
    episodes: Annotated[int, Within(1, MAX_EPISODES)] = 100  # start-goal pairs of the evaluation in each maze (paper)
    # Seed of the start-goal pairs: not the run's, so that all models have the same pairs.
    pairs_seed: Annotated[int, Within(0, MAX_SEED)] = 0
    rooms: RoomConfig | None = None  # of a robot that drives in rooms; for such a one, ``episodes`` are in each room


def controller_config(settings: Settings) -> ControllerConfig:
    """The settings of the low-level controller."""
    return ControllerConfig(settings.sac, settings.edges, settings.augment)


def with_controller(settings: Settings, config: ControllerConfig) -> Settings:
    """The settings with those of another low-level controller."""
    return replace(settings, sac=config.sac, edges=config.edges, augment=config.augment)


def with_fits(settings: Settings, **changes: Any) -> Settings:
    """The settings with changes to all trainings of the transformer."""
    fits = {name: getattr(settings, name) for name in ("fit", "round_fit", "last_fit")}
    return replace(settings, **{name: replace(fit, **changes) for name, fit in fits.items() if fit is not None})


# ----------------------------------------------------------------------------------------------------------- files

FORMAT: Final = 3  # of settings in files; a file without a number is of format 1

# Format 1 had other names, and left settings out that came after its first version, where they had these values. The
# values do not change when the defaults change. In format 2, "sac" was one object: see ``_settings_2``.
_NAMES_1 = {
    "optimism": "return_scale", "reprompt": "clip_target_return", "controller_effort": "controller_action_scale",
    "effort": "action_scale",
}  # fmt: skip
_FIT_1 = {"precision": "float32", "turns": False}
_ABSENT_1: dict[str, dict[str, Any]] = {
    "": {"rooms": None, "random_mazes": 0, "controller_action_scale": 1.0},
    "prm": {"most_samples": 25_600},
    "sac": {"greedy": 0.0},
    "model": {"acting": "cache", "modes": 1, "commitment": 0.0, "skill": False, "stride": 1},
    "fit": _FIT_1, "round_fit": _FIT_1, "last_fit": _FIT_1,
}  # fmt: skip


def to_dict(settings: Settings) -> dict[str, Any]:
    """The settings as JSON holds them."""
    return {"format": FORMAT} | asdict(settings)


def from_dict(values: Any) -> Settings:
    """The settings that ``to_dict`` gave, of this version or an earlier one.

    Raises:
        UserError: they are of a later version, or out of their ranges.
    """
    return from_json(Settings, _upgraded(values), "settings")


def controller_from_dict(values: Any, number: int) -> ControllerConfig:
    """The settings of a controller, which are a part of settings of this format.

    Raises:
        UserError: one is unknown or out of its range.
    """
    if number == 1 and isinstance(values, dict):
        values = {name: _part_1(name, part) for name, part in values.items()}
    return from_json(ControllerConfig, values if number == FORMAT else _settings_2(values), "controller")


def _upgraded(values: Any) -> Any:
    """Settings of any format as this version has them."""
    if not isinstance(values, dict):
        return values
    number = values.get("format", 1)
    if type(number) is not int or not 1 <= number <= FORMAT:
        raise UserError(f"settings are of format {shown(number)}; this version reads 1 to {FORMAT}")
    values = {name: value for name, value in values.items() if name != "format"}
    for upgrade in (_settings_1, _settings_2)[number - 1 :]:
        values = upgrade(values)
    return values


def _settings_1(values: dict[str, Any]) -> dict[str, Any]:
    parts = {name: _part_1(name, value) for name, value in _part_1("", values).items()}
    value = parts.get("value")
    return parts | {"value": value | {"fit": _part_1("fit", value.get("fit"))}} if isinstance(value, dict) else parts


def _part_1(name: str, values: Any) -> Any:
    """A part of format 1 under its new names, with what was left out."""
    if not isinstance(values, dict):
        return values
    return _ABSENT_1.get(name, {}) | {_NAMES_1.get(entry, entry): value for entry, value in values.items()}


def _settings_2(values: Any) -> Any:
    """Settings of format 2, in which "sac" held the settings of edges, reward and frame, too."""
    flat = values.get("sac") if isinstance(values, dict) else None
    if not isinstance(flat, dict):
        return values

    def part(kind: type) -> dict[str, Any]:
        return {field.name: flat[field.name] for field in fields(kind) if field.name in flat}

    edges, reward, augment = (part(kind) for kind in (EdgeConfig, RewardConfig, AugmentConfig))
    sac = {name: value for name, value in flat.items() if name not in edges | reward | augment}
    return values | {"sac": sac, "edges": edges | {"reward": reward}, "augment": augment}
