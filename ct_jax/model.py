"""A trained model as it is shipped: transformer, value network and a learned controller in one folder, without pickle.

``weights.safetensors`` holds the arrays, ``model.json`` the robot, the settings and where they came from.
"""

from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from ct_envs import MazeEnv, UserError
from ct_envs.robots import get_robot
from ct_envs.turtlebot3 import ACTION_SIZE, PROPRIO_SIZE
from ct_jax.checkpoint import load_weights, read_json, save_weights, write_json
from ct_jax.controllers.differential_drive import DifferentialDrive
from ct_jax.controllers.sac import SacConfig, SacController, blank_controller
from ct_jax.files import make_folder, whole
from ct_jax.policy import TransformerPolicy
from ct_jax.presets import Settings, from_dict, sac_from_dict, to_dict
from ct_jax.transformer import ControlTransformer, sample_inputs
from ct_jax.value import ValueNetwork

ZOO = "zoo:"


@dataclass(frozen=True)
class TrainedModel:
    """What a run makes and an evaluation needs."""

    robot: str
    settings: Settings
    policy: TransformerPolicy
    controller: SacController | DifferentialDrive  # learned, as ``settings.sac`` describes it, or known
    made: dict[str, Any] = field(default_factory=dict)  # command, commit, hardware, date


def save_model(folder: Path, model: TrainedModel) -> None:
    """Write a model into a folder."""
    make_folder(folder, parents=True)
    (folder / "model.json").unlink(missing_ok=True)  # written last: it says that the weights are whole
    save_weights(folder / "weights.safetensors", _arrays(model.policy, model.controller))
    write_json(
        folder / "model.json",
        {"format": 1, "robot": model.robot, "settings": to_dict(model.settings), "made": model.made},
    )


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
    if (Path(run) / "config.json").is_file():
        raise UserError(f"{run}: not trained to the end yet; continue it with: ct-jax train ... --out {run} --resume")
    raise UserError(f"{run}: no run folder; give one that 'ct-jax train' wrote, or {_zoo_words()}")


def load_model(run: str) -> TrainedModel:
    """Read the model of a run folder, a model folder or a ``zoo:NAME``.

    Raises:
        UserError: there is none, or it is damaged.
    """
    folder = model_folder(run)
    file = folder / "model.json"
    mend = f"delete {folder} and continue the run with --resume" if folder.name == "model" else "fetch it anew"
    meta = read_json(file, mend=mend)
    try:
        robot, made = meta["robot"], meta.get("made", {})
        settings = from_dict(meta["settings"])
        get_robot(robot)
    except (KeyError, TypeError, UserError) as bad:
        raise UserError(f"{file}: not a model's description ({bad}); {mend}") from None
    policy, controller = blank_model(robot, settings)
    like = _arrays(policy, controller)
    arrays = jax.tree.map(jnp.asarray, load_weights(folder / "weights.safetensors", like, mend=mend))
    policy = replace(policy, params=arrays["transformer"], value_params=arrays["value"])
    if isinstance(controller, SacController):
        controller = replace(controller, normalizer=arrays["normalizer"], policy=arrays["controller"])
    return TrainedModel(robot, settings, policy, controller, made)


def save_controller(folder: Path, robot: str, config: SacConfig, controller: SacController, made: dict) -> None:
    """Write a controller into a folder: ``weights.safetensors``, and last ``controller.json``."""
    make_folder(folder, parents=True)
    save_weights(folder / "weights.safetensors", controller)
    write_json(folder / "controller.json", _sizes(robot) | {"format": 1, "sac": asdict(config), "made": made})


def load_controller(
    where: str, robot: str, *, mend: str = "give another, or learn your 'own'"
) -> tuple[SacController, SacConfig]:
    """Read the controller of a robot from a run folder, a controller's folder, or with "zoo" the shipped one.

    Args:
        mend: what the error tells a person to do about a damaged file.

    Raises:
        UserError: there is none, it is damaged, or it is another robot's (both are described).
    """
    folder = _controller_folder(where, robot)
    file = folder / "controller.json"
    found = read_json(file, mend=mend)
    needed = _sizes(robot)
    sizes = {name: found.get(name) for name in needed}
    if sizes != needed:
        words = [", ".join(f"{name} {value}" for name, value in each.items()) for each in (sizes, needed)]
        raise UserError(f"{file}: a controller of {words[0]}; this run needs {words[1]}; {mend}")
    try:
        config = sac_from_dict(found["sac"])
    except (KeyError, TypeError, AttributeError) as bad:
        raise UserError(f"{file}: not a controller's description ({bad}); {mend}") from None
    blank = jax.eval_shape(lambda key: _blank_sac(key, robot, config), jax.random.key(0))
    return jax.tree.map(jnp.asarray, load_weights(folder / "weights.safetensors", blank, mend=mend)), config


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
    if get_robot(robot).course == "room":
        return PROPRIO_SIZE, ACTION_SIZE
    env = MazeEnv(robot, engine="mujoco")
    return env.proprio_size, env.action_size


def blank_model(robot: str, settings: Settings) -> tuple[TransformerPolicy, SacController | DifferentialDrive]:
    """A policy and a controller of the right sizes, with the shapes of their arrays in place of the arrays."""
    proprio_size, action_size = sizes(robot)
    maps, proprio, goal, *rest = sample_inputs(proprio_size, action_size)
    if settings.model.skill and get_robot(robot).course == "room":
        raise UserError(f"model.skill is for a controller that was learned; the {robot}'s is known")
    sac = settings.sac if settings.model.skill else None
    transformer = ControlTransformer(settings.model, action_size, sac)
    value = ValueNetwork(settings.value.width)

    def build(key: jax.Array) -> TransformerPolicy:
        return TransformerPolicy(
            params=transformer.init(key, maps, proprio, goal, *rest),
            value_params=value.init(key, maps, proprio, goal),
            config=settings.model,
            action_size=action_size,
            value_width=settings.value.width,
            optimism=settings.optimism,
            reprompt=settings.reprompt,
            sac=sac,
        )

    policy = jax.eval_shape(build, jax.random.key(0))
    if get_robot(robot).course == "room":
        return policy, DifferentialDrive()
    return policy, jax.eval_shape(lambda key: _blank_sac(key, robot, settings.sac), jax.random.key(0))


def _blank_sac(key: jax.Array, robot: str, config: SacConfig) -> SacController:
    return blank_controller(key, *sizes(robot), config)


def _arrays(policy: TransformerPolicy, controller: SacController | DifferentialDrive) -> dict[str, Any]:
    arrays = {"transformer": policy.params, "value": policy.value_params}
    if isinstance(controller, SacController):
        arrays |= {"normalizer": controller.normalizer, "controller": controller.policy}
    return arrays
