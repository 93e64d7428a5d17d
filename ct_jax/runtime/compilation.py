"""A cache of compiled programs for later processes, in a folder that only this user can write to.

``JAX_COMPILATION_CACHE_DIR`` names another folder. ``JAX_ENABLE_COMPILATION_CACHE=0`` turns the cache off.
"""

import hashlib
import os
import platform
from pathlib import Path

import jax


def keep_programs() -> None:
    """Cache all programs, also those that compile fast: a run has hundreds. Without a private folder, cache none."""
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if jax.config.values["jax_compilation_cache_dir"]:
        return
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        home.mkdir(parents=True, exist_ok=True)
        folder = home / "ct-jax" / f"compiled-{_processor()}"
        private = all([_make_private(each) for each in (folder.parent, folder)])
    except (OSError, RuntimeError):  # the home folder is missing or cannot be written
        return
    if private:
        jax.config.update("jax_compilation_cache_dir", str(folder))


def _make_private(folder: Path) -> bool:
    """Make a folder that only this user can access. False if it belongs to another user: compiled programs are code."""
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        return False
    folder.chmod(0o700)
    return True


def _processor() -> str:
    """A digest of the processor's features. Machines with different processors must not share CPU programs."""
    can = platform.machine() + platform.processor()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text("utf-8", "replace").splitlines()
        can += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(can.encode()).hexdigest()[:12]
