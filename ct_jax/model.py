"""A trained model as it is shipped: transformer, value network and a learned controller in one folder, without pickle.

``weights.safetensors`` holds the arrays, ``model.json`` the robot, the settings and where they came from.
"""

from dataclasses import asdict, dataclass, field, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from ct_envs import UserError
from ct_envs.checked import shown
from ct_jax.agent import Agent
from ct_jax.configs import find_robot
from ct_jax.controller import ControllerConfig, SacController, blank_controller
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.heads import make_head
from ct_jax.policy import TransformerPolicy
from ct_jax.runtime.checkpoint import arrange_weights, read_json, read_weights, save_weights, write_json
from ct_jax.runtime.files import make_folder, whole
from ct_jax.runtime.numerics import with_own_numerics
from ct_jax.settings import (
    Settings,
    controller_config,
    controller_from_dict,
    from_dict,
    to_dict,
    with_controller,
)
from ct_jax.transformer import ControlTransformer, sample_inputs
from ct_jax.value import ValueNetwork
from ct_jax.worlds import kind_of

ZOO = "zoo:"
FORMAT = 4  # of model.json and controller.json; this version reads 1 to it
BOUND = 2  # from this format on, weights are bound to what the file beside them says of them
_SETTINGS_OF = {1: 1, 2: 1, 3: 2, 4: 3}  # the format of a controller's settings in each format of its file
PARTS = tuple(part.name for part in fields(ControllerConfig))  # of a controller's settings; before format 4 only "sac"


@dataclass(frozen=True)
class TrainedModel:
    """What a run makes and an evaluation needs."""

    robot: str
    settings: Settings
    policy: Any  # a ``TransformerPolicy``, or what a baseline learned
    controller: SacController | DifferentialDrive | None  # learned, as the settings describe it, or known
    made: dict[str, Any] = field(default_factory=dict)  # command, commit, hardware, date

    def agent(self) -> Agent:
        """The policy, for your own observations."""
        return Agent(self.policy, self.robot, sizes(self.robot)[0])


def save_model(folder: Path, model: TrainedModel) -> None:
    """Write a model into a folder."""
    make_folder(folder, parents=True)
    (folder / "model.json").unlink(missing_ok=True)  # written last: it says that the weights are whole
    said = {"robot": model.robot, "settings": to_dict(model.settings)}
    save_weights(folder / "weights.safetensors", _arrays(model.policy, model.controller), of=said)
    write_json(folder / "model.json", {"format": FORMAT} | said | {"made": model.made})


def zoo_names() -> list[str]:
    """Names of the models that ship with the package."""
    root = resources.files("ct_jax") / "zoo"
    return sorted(p.name for p in root.iterdir() if (p / "model.json").is_file()) if root.is_dir() else []


def _zoo_words() -> str:
    return ", ".join(ZOO + name for name in zoo_names()) or "zoo:NAME (none ships with this version)"


def model_folder(run: str) -> Path:
    """Where the model of a run folder, a model folder or a ``zoo:NAME`` lies. Raises UserError."""
    if run.startswith(ZOO):
        name = run.removeprefix(ZOO)
        if name not in zoo_names():
            raise UserError(f"no model '{run}' in the zoo; models: {_zoo_words()}")
        return Path(str(resources.files("ct_jax") / "zoo" / name))
    for folder in (Path(run) / "model", Path(run)):
        if (folder / "model.json").is_file():
            return folder
    config = Path(run) / "config.json"
    if config.is_file():
        said = read_json(config, hint="restore it")
        if "baseline" in said:
            method = shown(said.get("method"), quoted=False)
            raise UserError(f"{run}: a run of {method}, without a transformer; evaluate it with --method {method}")
        raise UserError(f"{run}: not trained to the end yet; continue it with: ct-jax train ... --out {run} --resume")
    raise UserError(f"{run}: no run folder; give one that 'ct-jax train' wrote, or {_zoo_words()}")


@with_own_numerics
def load_model(run: str) -> TrainedModel:
    """Read the model of a run folder, a model folder or a ``zoo:NAME``.

    Raises:
        UserError: there is none, or it is damaged.
    """
    folder = model_folder(run)
    file = folder / "model.json"
    hint = f"delete {folder} and continue the run with --resume" if folder.name == "model" else "fetch it anew"
    found, number = _read_description(file, hint)
    said = {name: found.get(name) for name in ("robot", "settings")}
    try:
        robot, settings = find_robot(said["robot"]).name, from_dict(said["settings"])
        _check_robot(robot, settings)
    except UserError as bad:
        raise UserError(f"{file}: not a model's description ({bad}); {hint}") from None
    weights = folder / "weights.safetensors"
    arrays = read_weights(weights, of=said, bound=number >= BOUND, hint=hint)
    policy, controller = blank_model(robot, settings)
    arrays = jax.tree.map(jnp.asarray, arrange_weights(weights, arrays, _arrays(policy, controller), hint=hint))
    policy = replace(policy, params=arrays["transformer"], value_params=arrays["value"])
    if isinstance(controller, SacController):
        controller = replace(controller, normalizer=arrays["normalizer"], policy=arrays["controller"])
    return TrainedModel(robot, settings, policy, controller, found["made"])


def _read_description(file: Path, hint: str) -> tuple[dict[str, Any], int]:
    """What ``model.json`` or ``controller.json`` says, and its format.

    Raises:
        UserError: no JSON, or of a format that this version does not know.
    """
    found = {"made": {}} | read_json(file, hint=hint)
    number = found.get("format")
    if type(number) is not int or not 1 <= number <= FORMAT:
        raise UserError(f"{file}: of format {shown(number)}; this version of ct-jax reads 1 to {FORMAT}; {hint}")
    if not isinstance(found["made"], dict):
        raise UserError(f"{file}: 'made' is {shown(found['made'])}, not an object; {hint}")
    return found, number


def save_controller(folder: Path, robot: str, config: ControllerConfig, controller: SacController, made: dict) -> None:
    """Write a controller into a folder: ``weights.safetensors``, and last ``controller.json``."""
    make_folder(folder, parents=True)
    said = {"robot": robot} | asdict(config)
    save_weights(folder / "weights.safetensors", controller, of=said)
    write_json(folder / "controller.json", _sizes(robot) | said | {"format": FORMAT, "made": made})


def load_controller(
    where: str, robot: str, *, hint: str = "give another, or learn your 'own'"
) -> tuple[SacController, ControllerConfig]:
    """Read the controller of a robot from a run folder, a controller's folder, or with "zoo" the shipped one.

    Args:
        hint: what the error tells a person to do about a damaged file.

    Raises:
        UserError: there is none, it is damaged, or it is another robot's (both are described).
    """
    folder = _controller_folder(where, robot)
    file = folder / "controller.json"
    found, number = _read_description(file, hint)
    needed = _sizes(robot)
    sizes = {name: found.get(name) for name in needed}
    if sizes != needed:
        words = [
            ", ".join(f"{name} {shown(value, quoted=False)}" for name, value in each.items())
            for each in (sizes, needed)
        ]
        raise UserError(f"{file}: a controller of {words[0]}; this run needs {words[1]}; {hint}")
    parts = {name: found[name] for name in PARTS if name in found}
    said = {"robot": found.get("robot")} | parts
    try:
        config = controller_from_dict(parts, _SETTINGS_OF[number])
        _check_robot(robot, with_controller(Settings(), config))
    except UserError as bad:
        raise UserError(f"{file}: not a controller's description ({bad}); {hint}") from None
    weights = folder / "weights.safetensors"
    arrays = read_weights(weights, of=said, bound=number >= BOUND, hint=hint)
    controller = arrange_weights(weights, arrays, _blank_sac(robot, config), hint=hint)
    return jax.tree.map(jnp.asarray, controller), config


def copy_controller(where: str, robot: str, folder: Path) -> None:
    """Copy a controller's files into a folder that exists, if ``load_controller`` takes it. Raises UserError, as it."""
    load_controller(where, robot)
    for name in ("weights.safetensors", "controller.json"):
        with whole(folder / name) as opened:
            opened.write((_controller_folder(where, robot) / name).read_bytes())


def _controller_folder(where: str, robot: str) -> Path:
    if where == "zoo":
        folders = (Path(str(resources.files("ct_jax") / "zoo" / "controllers" / robot)),)
    else:
        folders = Path(where) / "controller", Path(where)
    found = next((folder for folder in folders if (folder / "controller.json").is_file()), None)
    if found is None:
        raise UserError(f"no controller of robot '{robot}' in '{where}'; give a run folder, 'zoo', or learn your 'own'")
    return found


def _sizes(robot: str) -> dict[str, Any]:
    """What a controller must agree in with its robot."""
    proprio, actions = sizes(robot)
    return {"robot": robot, "proprio": proprio, "actions": actions}


def sizes(robot: str) -> tuple[int, int]:
    """Entries of a robot's proprioception and of its action."""
    found = find_robot(robot)
    return kind_of(found).sizes(found)


def blank_model(robot: str, settings: Settings) -> tuple[TransformerPolicy, SacController | DifferentialDrive]:
    """A policy and a controller of the right sizes, with the shapes of their arrays in place of the arrays.

    Raises:
        UserError: settings that are not for the robot.
    """
    _check_robot(robot, settings)
    proprio_size, action_size = sizes(robot)
    maps, proprio, goal, *rest = sample_inputs(proprio_size, action_size)
    head = make_head(settings.model, action_size, controller_config(settings))
    transformer = ControlTransformer(settings.model, action_size, head)
    value = ValueNetwork(settings.value.width)

    def build(key: jax.Array) -> TransformerPolicy:
        transformer_key, value_key = jax.random.split(key)
        return TransformerPolicy(
            params=transformer.init(transformer_key, maps, proprio, goal, *rest),
            value_params=value.init(value_key, maps, proprio, goal),
            config=settings.model,
            action_size=action_size,
            value_width=settings.value.width,
            return_scale=settings.return_scale,
            clip_target_return=settings.clip_target_return,
            head=head,
        )

    policy = jax.eval_shape(build, jax.random.key(0))
    known = kind_of(find_robot(robot)).KNOWN_CONTROLLER
    return policy, known or _blank_sac(robot, controller_config(settings))


def _check_robot(robot: str, settings: Settings) -> None:
    """Raise UserError for settings that are not for the robot."""
    if settings.model.skill and kind_of(find_robot(robot)).KNOWN_CONTROLLER:
        raise UserError(f"model.skill is for a controller that was learned; the {robot}'s is known")
    for name, frame in (("model", settings.model.frame), ("augment", settings.augment.frame)):
        if frame == "heading" and not find_robot(robot).has_heading:
            raise UserError(f"{name}.frame is 'heading', which the {robot} has not; give 'world'")


def _blank_sac(robot: str, config: ControllerConfig) -> SacController:
    """A controller with the shapes of its arrays."""
    return jax.eval_shape(lambda key: blank_controller(key, *sizes(robot), config), jax.random.key(0))


def _arrays(policy: TransformerPolicy, controller: SacController | DifferentialDrive | None) -> dict[str, Any]:
    arrays = {"transformer": policy.params, "value": policy.value_params}
    if isinstance(controller, SacController):
        arrays |= {"normalizer": controller.normalizer, "controller": controller.policy}
    return arrays
