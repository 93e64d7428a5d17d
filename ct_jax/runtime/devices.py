"""Several devices and several processes: the mesh, the placement of arrays on it, and messages between processes.

Every process runs the same program on the whole mesh. The mesh has one axis, "data". Sharded arrays are split along
this axis, in the order of the processes. All other arrays are whole in every process. Only process 0 writes files. It
also makes all decisions that depend on files, clocks or signals: if processes decided differently, they would wait for
each other forever.

With one process, all of these functions are the identity.
"""

import json
import os
import re
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ct_envs import UserError
from ct_jax.runtime import interrupts

Tree = TypeVar("Tree")
T = TypeVar("T")
AXIS = "data"


_SAID = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")  # environment variables that select devices
_PARSE_FLAGS = "from jaxlib import xla_client; xla_client.CompileOptions()"


def check_flags() -> None:
    """Raise UserError if XLA would abort the process because of XLA_FLAGS. Call it before JAX starts devices.

    A subprocess parses the flags, which takes a tenth of a second.
    """
    if not (flags := os.environ.get("XLA_FLAGS")):
        return
    tried = subprocess.run([sys.executable, "-c", _PARSE_FLAGS], capture_output=True, text=True, errors="replace")
    if tried.returncode and (reasons := re.findall(r"^[EF]\d{4} [^]]*\] (.*)", tried.stderr, re.MULTILINE)):
        raise UserError(f"XLA_FLAGS='{flags}': {reasons[0].rstrip('.')}; correct or unset that variable")


def start_backend() -> None:
    """Start JAX's devices. Raises UserError if they do not start."""
    try:
        jax.devices()
    except Exception as bad:  # many kinds of errors, some of them without a message
        said = " ".join(f"{name}='{os.environ[name]}'" for name in _SAID if os.environ.get(name))
        reason = " ".join(str(bad).split())[:300] or "no such platform is installed"
        hint = (
            "set JAX_PLATFORMS=cpu and unset XLA_FLAGS, or install the platform's plug-in "
            "(NVIDIA: pip install 'jax[cuda13]')"
        )
        raise UserError(f"JAX finds no device{' with ' * bool(said)}{said} ({reason}); {hint}") from None


def start(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Join the other processes. Call it before JAX starts devices.

    Process 0 listens only at the coordinator's address. Anyone who can reach that port can join, read, change and stop
    the training: there is no password and no encryption. See ``docs/security.md``.

    Args:
        coordinator: HOST:PORT of process 0. If None, JAX detects the coordinator and the processes, and the
            coordinator listens at all addresses unless JAX_COORDINATOR_BIND_ADDRESS names one.

    Raises:
        UserError: no cluster or no other process is found, or the address does not belong to this machine.
    """
    jax.config.update("jax_enable_preemption_service", False)  # it would replace our handler of SIGTERM
    listens = None if coordinator is None or process != 0 else listening_address(coordinator)
    try:
        jax.distributed.initialize(coordinator, processes, process, coordinator_bind_address=listens)
    except (ValueError, RuntimeError) as bad:
        where = f"{coordinator}: process {process} of {processes} cannot join" if coordinator else "no cluster is found"
        hint = "" if coordinator else "; name it with --coordinator HOST:PORT --processes N --process I"
        raise UserError(f"{where} ({' '.join(str(bad).split())[:200]}){hint}") from None
    interrupts.obey_together(largest)


def listening_address(coordinator: str) -> str:
    """A numeric HOST:PORT (IPv6 in brackets) for a coordinator whose HOST may be a name.

    Raises:
        UserError: the address does not belong to this machine, or the port is in use.
    """
    host, _, port = coordinator.rpartition(":")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:  # the errors of gRPC would not say the reason
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind(address)
    except OSError as bad:
        hint = "give an address of process 0's own machine, and a port that is free there"
        raise UserError(f"--coordinator {coordinator}: cannot listen there ({bad.strerror or bad}); {hint}") from None
    return f"[{address[0]}]:{port}" if family == socket.AF_INET6 else f"{address[0]}:{port}"


def is_first() -> bool:
    """Whether this is process 0. Only process 0 prints and writes files."""
    return jax.process_index() == 0


# ---------------------------------------------------------------------------------------------- placement of arrays


def data_mesh(batch: int | None = None) -> Mesh:
    """All devices along one axis, "data", process after process.

    With ``batch``: only as many devices as can share the batch evenly, the same number in each process.

    Raises:
        UserError: the processes cannot share the batch evenly.
    """
    devices = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
    count = Counter(device.process_index for device in devices)
    each = min(count.values())
    if batch is not None:
        if batch % len(count):
            raise UserError(f"{len(count)} processes cannot share a batch of {batch} evenly; start a number that can")
        each = max(n for n in range(1, each + 1) if batch % (n * len(count)) == 0)
    first = np.cumsum([0, *count.values()])[:-1]
    return Mesh(np.array([devices[i + j] for i in first for j in range(each)]), (AXIS,))


def replicated(mesh: Mesh) -> NamedSharding:
    """A sharding with the whole array on every device."""
    return NamedSharding(mesh, PartitionSpec())


def sharded(mesh: Mesh, axis: int = 0) -> NamedSharding:
    """A sharding that splits the arrays along an axis."""
    return NamedSharding(mesh, PartitionSpec(*[None] * axis, AXIS))


def place(tree: Tree, sharding: NamedSharding) -> Tree:
    """Put arrays onto the mesh. Every process has them whole."""

    def put(leaf: Any) -> jax.Array:
        if sharding.is_fully_addressable:
            return jax.device_put(leaf, sharding)
        if isinstance(leaf, jax.Array) and jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put(jax.random.key_data(leaf)))
        whole = np.asarray(leaf)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(put, tree)


def feed(tree: Tree, mesh: Mesh) -> Tree:
    """Put each process's own rows onto its devices, as one sharded array. All processes have equally many rows."""
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharded(mesh), leaf), tree)


def alike(state: Tree) -> Tree:
    """A state that each process computed, as replicated arrays, so that all processes can save it together."""
    if jax.process_count() == 1:
        return state
    return place(state, replicated(data_mesh(jax.process_count())))


def fill_up(n: int, mesh: Mesh) -> np.ndarray:
    """Indices 0 ... n-1. The last one is repeated until the devices can share them evenly."""
    return np.minimum(np.arange(-(-n // mesh.size) * mesh.size), n - 1)


def own(tree: Tree, mesh: Mesh, axis: int = 0) -> Tree:
    """The part of sharded arrays that is on this process's devices, as NumPy."""
    if jax.process_count() > 1:
        tree = jax.jit(lambda tree: tree, out_shardings=sharded(mesh, axis))(tree)  # reshards if needed
        tree = multihost_utils.global_array_to_host_local_array(tree, mesh, sharded(mesh, axis).spec)
    return jax.tree.map(np.asarray, tree)


def own_rows(rows: np.ndarray) -> np.ndarray:
    """This process's share of rows. Every process has all of them, and the shares are equal."""
    return np.split(rows, jax.process_count())[jax.process_index()]


# ----------------------------------------------------------------------------------------- messages between processes


def joined(rows: np.ndarray) -> np.ndarray:
    """The rows of all processes, one process after the other. Each may have a different number of rows."""
    if jax.process_count() == 1:
        return rows
    own_bytes = np.frombuffer(np.ascontiguousarray(rows).tobytes(), np.uint8)  # JAX would convert 64 bits to 32
    counts = multihost_utils.process_allgather(np.asarray(len(own_bytes), np.uint32))
    found = multihost_utils.process_allgather(np.pad(own_bytes, (0, counts.max() - len(own_bytes))))
    every_byte = b"".join(part[:n].tobytes() for part, n in zip(found, counts, strict=True))
    return np.frombuffer(every_byte, rows.dtype).reshape(-1, *rows.shape[1:])


def largest(number: int) -> int:
    """The maximum of a number over all processes."""
    return int(joined(np.array([number])).max())


def first(action: Callable[[], T]) -> T:
    """Run an action in process 0 only, and return its result in every process. The result must be valid JSON.

    Raises:
        UserError: in every process, if the action failed in process 0.
    """
    if jax.process_count() == 1:
        return action()
    said: dict[str, Any] = {}
    if is_first():
        try:
            said = {"value": action()}
        except (ValueError, OSError) as bad:
            said = {"error": str(bad)}
    text = joined(np.frombuffer(json.dumps(said).encode() if is_first() else b"", np.uint8))
    said = json.loads(text.tobytes())
    if "error" in said:
        raise UserError(said["error"])
    return said["value"]
