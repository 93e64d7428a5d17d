"""The setup of all tests: a CPU backend, few threads, a private compilation cache, and strict shapes.

jax and numpy read the environment variables at their first import, so the variables are set before these imports.
"""

import contextlib
import dataclasses
import fcntl
import io
import json
import multiprocessing
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Most of the time of a test is compilation. The compiled program runs for milliseconds.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

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

# Compiled programs are cached between runs. Only this user may write to the cache, because it contains code.
_CACHE = Path(__file__).parent / ".jax_cache"
_CACHE.mkdir(mode=0o700, exist_ok=True)
_CACHE.chmod(0o700)
jax.config.update("jax_compilation_cache_dir", str(_CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)

# No deadline: the time of an example depends on compilation and on the machine.
hypothesis.settings.register_profile("ct_jax", deadline=None)
hypothesis.settings.load_profile("ct_jax")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Run each test and its fixtures with rank promotion as an error, so that (n, 1) and (n,) are not combined.

    MJX and brax's running statistics need rank promotion. A test that uses them has
    `@pytest.mark.rank_promotion("allow")`, or its file has this mark as `pytestmark`.
    """
    marker = item.get_closest_marker("rank_promotion")
    before = jax.config.jax_numpy_rank_promotion
    jax.config.update("jax_numpy_rank_promotion", marker.args[0] if marker else "raise")
    try:
        return (yield)
    finally:
        jax.config.update("jax_numpy_rank_promotion", before)


# Each compiled program uses some of the 65530 memory maps that Linux allows per process. Without a free memory map, XLA
# crashes. A test without jit has thousands of programs, one for each operation and shape.
_MANY_MAPS = 20_000


def pytest_runtest_logreport(report):
    """Clear compiled programs before memory maps run out. Counting takes milliseconds, so fast tests are skipped."""
    if report.duration > 2.0 and _memory_maps() > _MANY_MAPS:
        jax.clear_caches()


def _memory_maps() -> int:
    """The number of memory maps of this process; 0 if the system is not Linux."""
    maps = Path("/proc/self/maps")
    return len(maps.read_bytes().splitlines()) if maps.is_file() else 0


@pytest.fixture
def jit_disabled():
    """Run the test without jit, so that asserts and Python errors inside jitted code are raised."""
    with jax.disable_jit():
        yield


@pytest.fixture(scope="session")
def fork():
    """Start functions in forked processes, which have imported everything but have not started JAX."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["ct_jax.pipeline", "ct_jax.report", "ct_envs.turtlebot3_pool"])

    def start(target, *arguments):
        process = context.Process(target=target, args=arguments)
        process.start()
        return process

    return start


@pytest.fixture(scope="session")
def wall_distance():
    """Distance [m] from points [..., 2] to the nearest wall of a grid [H, W]: a plain NumPy loop over the walls."""

    def distance(walls, points, cell_m=4.0):
        points = np.asarray(points, np.float64)
        nearest = np.full(points.shape[:-1], np.inf)
        for row, column in np.argwhere(np.pad(np.asarray(walls), 1, constant_values=True)) - 1:
            centre = (np.array([column, row]) + 0.5) * cell_m
            beyond = np.maximum(np.abs(points - centre) - cell_m / 2, 0.0)
            nearest = np.minimum(nearest, np.hypot(beyond[..., 0], beyond[..., 1]))
        return nearest

    return distance


@pytest.fixture(scope="session")
def push():
    """An untrained controller for the point robot: the desired velocity minus the current velocity."""
    import jax.numpy as jnp
    from flax import struct

    @struct.dataclass
    class Push:
        gain: float = 1.0
        action_size: int = struct.field(pytree_node=False, default=2)

        def __call__(self, proprio, goal):
            away = jnp.linalg.norm(goal, axis=-1, keepdims=True)
            wanted = goal * jnp.minimum(2.0, 3.0 / jnp.maximum(away, 1e-6))
            return self.gain * jnp.clip(wanted / 4.0 + 0.5 * (wanted - proprio), -1.0, 1.0)

    return Push


@pytest.fixture(scope="session")
def faulty():
    """A policy with zero actions. In given environments, its actions are not finite from a given step on."""
    import jax.numpy as jnp
    from flax import struct

    from ct_jax.types import act_as_intended

    @struct.dataclass
    class Faulty:
        which: Any  # bool [N]
        value: float = float("nan")
        step: int = 3
        size: int = struct.field(pytree_node=False, default=2)

        def init(self, frame, tasks=None):
            return jnp.zeros((), jnp.int32)

        def act(self, memory, frame, key):
            bad = jnp.asarray(self.which) & (memory >= self.step)
            action = jnp.zeros((*bad.shape, self.size))
            return act_as_intended(action.at[:, -1].set(jnp.where(bad, self.value, 0.0))), memory + 1

    return Faulty


@pytest.fixture(scope="session")
def toy_data():
    """Make random trajectories of the given lengths. ``proprio`` contains the index of the trajectory and the step."""
    from ct_jax.trajectories import Trajectories

    def make(lengths, *, seed=0, mazes=1, steps=None, side_m=20.0):
        rng = np.random.default_rng(seed)
        n, steps = len(lengths), steps or max(lengths)

        def draw(*shape, low=-1.0, high=1.0):
            return rng.uniform(low, high, (n, *shape)).astype(np.float32)

        which, step = np.meshgrid(np.arange(n), np.arange(steps), indexing="ij")
        return Trajectories(
            position=draw(steps, 2, low=4.0, high=side_m - 4.0),
            proprio=np.stack([which, step], -1).astype(np.float32),
            action=draw(steps, 2),
            label=draw(steps, 2),
            reward=draw(steps, low=-20.0, high=0.0),
            label_mask=np.ones((n, steps), np.float32),
            collision=(draw(steps) > 0.5).astype(np.float32),
            goal_world=draw(2, low=4.0, high=side_m - 4.0),
            maze=rng.integers(0, mazes, n).astype(np.int32),
            length=np.asarray(lengths, np.int32),
        )

    return make


ISLANDS = """\
#########
#...#...#
#...#...#
#########
"""  # two separate regions


@dataclasses.dataclass(frozen=True)
class TinyRun:
    """A finished run of the command line: arguments, folder and output. Copy the folder before you change it."""

    folder: Path
    arguments: list[str]
    stdout: str
    stderr: str


@pytest.fixture(scope="session")
def tiny_settings():
    """Settings of a run with all stages that takes seconds and learns nothing."""
    from ct_jax import settings as p

    fit = p.FitConfig(updates=40, batch=4, steps=8)
    return p.Settings(
        prm=p.PrmConfig(samples=40, most_samples=40),
        sac=p.SacConfig(envs=4, iterations=50, updates=1, warmup=2, batch=8, hidden=(8,), replay=200),
        edges=p.EdgeConfig(episode_steps=5),
        collect=p.CollectConfig(
            trajectories=2, envs=8, horizon=50, reset_interval=8, starts="maze", guide="explorer", give_up=1000
        ),
        model=p.ModelConfig(layers=1, heads=2, width=16, context=4, context_acting=4),
        value=p.ValueConfig(fit=dataclasses.replace(fit, steps=1), width=16),
        fit=fit,
        recover=p.RecoverConfig(recoveries=1, patience=10, stuck_steps=5, keep="relabelled", give_up=1000),
        rounds=1,
        episodes=4,
    )


@pytest.fixture
def tiny(monkeypatch, tiny_settings):
    """Add a preset "tiny" with short episodes to the command line, and keep the JAX settings of the tests."""
    _know_tiny(monkeypatch, tiny_settings)


def _know_tiny(patch: pytest.MonkeyPatch, settings) -> None:
    from ct_envs import robots
    from ct_jax import cli
    from ct_jax.configs import point

    patch.setitem(robots.ROBOTS, "point", dataclasses.replace(robots.POINT, horizon=50))
    patch.setitem(point.PRESETS, "tiny", settings)
    patch.setattr(cli, "prepare_jax", lambda *_: None)


@pytest.fixture(scope="session")
def islands(tmp_path_factory):
    """A maze file of two separate regions."""
    file = tmp_path_factory.mktemp("mazes") / "islands.txt"
    file.write_text(ISLANDS)
    return file


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory, tiny_settings, islands):
    """An uninterrupted run, shared by all test workers. Tests that use it need ``rank_promotion("allow")``."""
    ours = tmp_path_factory.getbasetemp()
    root = ours.parent if "PYTEST_XDIST_WORKER" in os.environ else ours
    with (root / "tiny-run.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        said = root / "tiny-run.json"
        if not said.is_file():
            run = _make_tiny_run(root / "tiny-run", tiny_settings, islands)
            said.write_text(json.dumps(dataclasses.asdict(run) | {"folder": str(run.folder)}))
        found = json.loads(said.read_text())
        return TinyRun(**found | {"folder": Path(found["folder"])})


def _make_tiny_run(folder, tiny_settings, islands) -> TinyRun:
    from ct_jax.cli import main

    arguments = ["train", "point", "--preset", "tiny", "--maze", str(islands), "--eval-maze", "antmaze-umaze"]
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        _know_tiny(patch, tiny_settings)
        status = main([*arguments, "--out", str(folder)])
    assert status == 0, err.getvalue()
    return TinyRun(folder, arguments, out.getvalue(), err.getvalue())
