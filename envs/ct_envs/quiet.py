"""Import MuJoCo and MJX without side effects. Import this module before them.

MJX prints on stdout that warp is missing, which we do not use. MuJoCo writes warnings to stderr and to MUJOCO_LOG.TXT
in the current folder; here they go to the logger ``ct_envs.mujoco`` with level INFO. MuJoCo cannot be imported if
MUJOCO_GL names a backend that is not installed, although physics does not need one.
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
    """A context to import MuJoCo without OpenGL. Afterwards it has the backend of MUJOCO_GL, if that is installed."""
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
    except Exception:  # it raises many kinds of errors, after it has set this variable
        os.environ.pop("PYOPENGL_PLATFORM", None)
        if platform is not None:
            os.environ["PYOPENGL_PLATFORM"] = platform


with _without_opengl():
    import mujoco
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda text: _log.info("%s", text))
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx
