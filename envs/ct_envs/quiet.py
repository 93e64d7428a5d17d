"""Imports MJX without its word on stdout about warp, which we do not use; for whoever imports it first."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401
