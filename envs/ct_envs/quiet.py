"""Imports MuJoCo and MJX so that they do nothing unasked; for whoever imports them first.

MJX would say on stdout that there is no warp, which we do not use. MuJoCo would write its warnings to MUJOCO_LOG.TXT in
the current folder, and to stderr: they go to the logger ``ct_envs.mujoco`` as INFO. And it would not load at all where
MUJOCO_GL names what is not installed, although physics draws nothing.
"""

import contextlib
import importlib
import io
import logging
import os
import sys
from collections.abc import Iterator

_log = logging.getLogger("ct_envs.mujoco")


@contextlib.contextmanager
def _without_opengl() -> Iterator[None]:
    """MuJoCo loads within as if MUJOCO_GL were off; afterwards, it has what that variable names, if it is there."""
    wanted, platform = os.environ.get("MUJOCO_GL"), os.environ.get("PYOPENGL_PLATFORM")
    if not wanted or "mujoco" in sys.modules:
        yield
        return
    os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        os.environ["MUJOCO_GL"] = wanted
    from mujoco.rendering.classic import gl_context

    try:
        mujoco.GLContext = importlib.reload(gl_context).GLContext
    except Exception:  # it fails in many ways, and has set this variable by then
        os.environ.pop("PYOPENGL_PLATFORM", None)
        if platform is not None:
            os.environ["PYOPENGL_PLATFORM"] = platform


with _without_opengl():
    import mujoco
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda text: _log.info("%s", text))
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx
