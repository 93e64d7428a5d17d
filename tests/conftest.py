"""What every test runs under: a CPU backend, few threads, a private compile cache, and strict shapes.

jax and numpy read the environment variables once, when first imported, so they are set above those imports.
"""

import os
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

_workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if _workers > 1:
    _cores = max(1, (os.cpu_count() or 1) // _workers)
    for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_name, str(_cores))
    # XLA's CPU thread pool. Two at least: a callback can hang where no thread is free (jax issue 24255).
    os.environ.setdefault("NPROC", str(max(2, _cores)))

import hypothesis  # noqa: E402
import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

# Compiled programs are kept between runs. A cache that others can write to can run their code: ours only.
_CACHE = Path(__file__).parent / ".jax_cache"
_CACHE.mkdir(mode=0o700, exist_ok=True)
_CACHE.chmod(0o700)
jax.config.update("jax_compilation_cache_dir", str(_CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)

# An example that compiles takes as long as it takes: a deadline would only measure the machine.
hypothesis.settings.register_profile("ct_jax", deadline=None)
hypothesis.settings.load_profile("ct_jax")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Runs a test and its fixtures with rank promotion an error, so that (n, 1) never meets (n,) unnoticed.

    MJX and brax (its running statistics) rely on rank promotion, so a test that steps them says so with
    `@pytest.mark.rank_promotion("allow")`, or a whole file with `pytestmark = ...` of the same mark.
    Flax, optax and Orbax work under "raise".
    """
    marker = item.get_closest_marker("rank_promotion")
    before = jax.config.jax_numpy_rank_promotion
    jax.config.update("jax_numpy_rank_promotion", marker.args[0] if marker else "raise")
    try:
        return (yield)
    finally:
        jax.config.update("jax_numpy_rank_promotion", before)


@pytest.fixture
def jit_disabled():
    """Runs the test operation by operation, so that asserts and Python errors inside jitted code are seen."""
    with jax.disable_jit():
        yield


@pytest.fixture(scope="session")
def wall_distance():
    """Distance [m] from points [..., 2] to the nearest wall of a grid [H, W], one wall after the other, in float64."""

    def distance(walls, points, cell_m=4.0):
        points = np.asarray(points, np.float64)
        nearest = np.full(points.shape[:-1], np.inf)
        for row, column in np.argwhere(np.pad(np.asarray(walls), 1, constant_values=True)) - 1:
            centre = (np.array([column, row]) + 0.5) * cell_m
            beyond = np.maximum(np.abs(points - centre) - cell_m / 2, 0.0)
            nearest = np.minimum(nearest, np.hypot(beyond[..., 0], beyond[..., 1]))
        return nearest

    return distance
