"""MuJoCo without side effects: it writes no file, prints nothing, and needs no OpenGL for physics."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

STEP = """
import logging, sys
import jax, jax.numpy as jnp
from ct_envs import MazeEnv, load_maze
env = MazeEnv("ant", engine="mujoco", auto_reset=False, maps=False)
state = jax.jit(env.reset)(jax.random.key(0), load_maze("antmaze-umaze"))
physics = state.pipeline_state.replace(qvel=jnp.full(env.engine.model.nv, 1e12))
state = jax.jit(env.step)(state.replace(pipeline_state=physics), jnp.zeros(env.action_size))
print(float(state.done), float(state.info["success"]))
"""
NAN = """
import logging, sys
if len(sys.argv) > 1:
    logging.basicConfig(level=logging.INFO, format="%(name)s %(message)s")
import ct_envs.quiet
import mujoco, numpy as np
ball = "<body><freejoint/><geom size='.1'/></body>"
model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{ball}</worldbody></mujoco>")
data = mujoco.MjData(model)
data.qvel[:] = np.nan
mujoco.mj_step(model, data)
try:
    mujoco.MjModel.from_xml_string("<mujoco><bad/></mujoco>")
except ValueError as error:
    print(error)
"""


def python(code: str, *arguments: str, cwd: Path, **variables: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | variables
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=environment, cwd=cwd
    )


def test_warnings_go_to_logger_and_errors_are_raised(tmp_path):
    done = python(NAN, cwd=tmp_path)
    assert "bad" in done.stdout and done.stderr == ""
    assert "ct_envs.mujoco Nan, Inf or huge value in Q" in python(NAN, "log", cwd=tmp_path).stderr
    assert list(tmp_path.iterdir()) == []


def test_diverged_state_writes_no_log_file(tmp_path):
    done = python(STEP, cwd=tmp_path)
    assert (done.stdout, done.stderr) == ("1.0 0.0\n", "")
    assert list(tmp_path.iterdir()) == []


def test_existing_warning_handler_is_kept(tmp_path):
    code = "import mujoco; mujoco.set_mju_user_warning(print); import ct_envs.quiet"
    assert python(f"{code}; assert mujoco.get_mju_user_warning() is print", cwd=tmp_path).returncode == 0


@pytest.mark.parametrize("value", ["nonsense", "osmesa", "egl", "glfw", "off", ""])
def test_physics_does_not_need_opengl(value, tmp_path):
    code = "import os; from ct_envs import MazeEnv; MazeEnv('point'); print(*map(os.environ.get, ('MUJOCO_GL', 'X')))"
    done = python(code, cwd=tmp_path, MUJOCO_GL=value)
    assert done.stdout == f"{value} None\n", done.stderr


@pytest.mark.parametrize("first", ["", "import ct_envs.quiet;"])
def test_opengl_backend_of_mujoco_is_kept(first, tmp_path):
    code = "import os, mujoco; print(getattr(mujoco, 'GLContext', None), os.environ.get('PYOPENGL_PLATFORM'))"
    assert (
        python(first + code, cwd=tmp_path, MUJOCO_GL="egl").stdout == python(code, cwd=tmp_path, MUJOCO_GL="egl").stdout
    )
