"""``import ct_jax``: the public names, and results that do not depend on the caller's JAX settings."""

import contextlib
import io
import json
import pkgutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import ct_jax
from ct_envs import MazeEnv, load_maze
from ct_jax.cli import main
from ct_jax.types import act_as_intended

SUBMODULES = sorted(f"ct_jax.{module.name}" for module in pkgutil.iter_modules(ct_jax.__path__))

# Each public name is the same object for any order of imports.
SAME = """
import importlib, sys
import ct_jax
first = {{name: getattr(ct_jax, name) for name in ct_jax.__all__}} if {names_first} else {{}}
for module in {modules}:
    importlib.import_module(module)
then = {{name: getattr(ct_jax, name) for name in ct_jax.__all__}}
assert all(first.get(name, it) is it for name, it in then.items())
for name, it in then.items():
    module, own = ct_jax._SOURCE[name]
    assert it is getattr(sys.modules[module], own), name
    assert not isinstance(it, type(sys)), name
"""


def run_python(text: str) -> str:
    """The output of a separate process."""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_public_names_differ_from_submodules():
    assert not set(ct_jax.__all__) & {name.removeprefix("ct_jax.") for name in SUBMODULES}


@pytest.mark.parametrize(("names_first", "modules"), [(True, SUBMODULES), (False, SUBMODULES[::-1])])
def test_public_name_does_not_depend_on_import_order(names_first, modules):
    run_python(SAME.format(names_first=names_first, modules=modules))


def test_import_of_package_is_light():
    said = run_python("import sys, ct_jax\nprint([m for m in ('jax', 'numpy', 'ct_envs') if m in sys.modules])")
    assert said.strip() == "[]"


def test_all_lists_exactly_the_public_names():
    assert set(ct_jax.__all__) == set(ct_jax._SOURCE) <= set(dir(ct_jax))
    with pytest.raises(AttributeError, match="has no attribute 'unicorn'"):
        _ = ct_jax.unicorn  # pyright: ignore


# -------------------------------------------------------------------------------------------------------- numerics


@contextlib.contextmanager
def other_settings():
    """JAX settings that differ from ours."""
    with jax.default_matmul_precision("bfloat16"), jax.numpy_rank_promotion("raise"), jax.enable_x64(True):
        yield


@pytest.mark.rank_promotion("allow")
def test_python_and_command_line_evaluate_equally(tiny_run):
    """The rows are equal bit for bit for other JAX settings of the caller, and these settings do not change."""
    folder, out = str(tiny_run.folder), io.StringIO()
    with contextlib.redirect_stdout(out), pytest.MonkeyPatch.context() as patch:
        patch.setattr("ct_jax.cli.prepare_jax", lambda *_: None)
        arguments = ["--maze", "antmaze-umaze", "--episodes", "3", "--horizon", "20"]
        assert main(["evaluate", folder, *arguments, "--json"]) == 0
    row = json.loads(out.getvalue())
    with other_settings():
        same = ct_jax.evaluate_model(folder, method="ct", seed=0, maze="antmaze-umaze", episodes=3, horizon=20)
        assert jnp.zeros(1, float).dtype == jnp.float64
        assert jax.config.jax_default_matmul_precision == "bfloat16"
    del row["wall_s"], same["wall_s"]
    assert row == json.loads(json.dumps(same))


@struct.dataclass
class Witness:
    """A policy or controller that stores the text of a compiled product."""

    said: list = struct.field(pytree_node=False)
    action_size: int = struct.field(pytree_node=False, default=2)

    def init(self, frame, tasks=None):
        return jnp.zeros(frame.done.shape[0])

    def act(self, memory, frame, key):
        return act_as_intended(self(frame.obs.proprio, None)), memory

    def __call__(self, proprio, goal):
        one = jax.ShapeDtypeStruct((2, 2), jnp.float32)
        self.said.append(jax.jit(jnp.dot).lower(one, one).as_text())
        return jnp.zeros((len(proprio), 2))


def a_world():
    return ct_jax.MazeWorld(MazeEnv("point", engine="mujoco", auto_reset=False), load_maze("antmaze-umaze"))


def evaluate(witness):
    world = a_world()
    ct_jax.evaluate_pairs(world, world.draw_pairs(0, 1), "ct", policy=witness, horizon=2)


def act(witness):
    agent = ct_jax.Agent(witness, "point", 2)
    seen = {"map": np.zeros((1, 2, 25, 25), np.uint8), "proprio": np.zeros((1, 2)), "goal": np.ones((1, 2))}
    agent.act(agent.init(seen), seen, np.zeros(1))


COLLECT = ct_jax.CollectConfig(trajectories=1, envs=1, horizon=2, give_up=1.0)
PRM = ct_jax.PrmConfig(samples=20)


def collect(witness):
    with contextlib.suppress(ct_jax.UserError):  # who stands still never arrives
        ct_jax.collect_trajectories(jax.random.key(0), a_world(), witness, COLLECT, PRM)


def recover(witness):
    config = ct_jax.RecoverConfig(recoveries=1, give_up=1.0)
    with contextlib.suppress(ct_jax.UserError):  # likewise
        ct_jax.recover(jax.random.key(0), a_world(), witness, witness, config, COLLECT, PRM)


@pytest.mark.rank_promotion("allow")
@pytest.mark.parametrize("entry", [evaluate, act, collect, recover])
def test_compiled_products_are_exact(entry):
    witness = Witness([])
    with jax.default_matmul_precision("bfloat16"):
        entry(witness)
    assert witness.said and all("precision = [HIGHEST, HIGHEST]" in text for text in witness.said)
