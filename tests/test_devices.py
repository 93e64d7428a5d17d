"""Several real devices and processes: the same losses, checkpoints and episodes as on one device."""

import fcntl
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from ct_envs import UserError
from ct_jax.runtime import devices
from ct_jax.trajectories import is_saved, load, save

pytestmark = pytest.mark.slow  # on two cores a minute
PROGRAM = Path(__file__).with_name("on_devices.py")


def begin(*arguments: str, host_devices: int = 1) -> subprocess.Popen:
    environment = os.environ | {
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={host_devices}", "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join(sys.path), "TF_CPP_MIN_LOG_LEVEL": "3",
    }  # fmt: skip
    command = [sys.executable, str(PROGRAM), *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(*processes: subprocess.Popen, timeout_s: float = 300.0) -> None:
    """Wait for all processes, and end those that remain."""
    try:
        said = [process.communicate(timeout=timeout_s)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert all(process.returncode == 0 for process in processes), said


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("localhost", 0))
        return found.getsockname()[1]


@pytest.fixture(scope="session")
def runs(tmp_path_factory, toy_data):
    """Results by name: one device, four devices in one process, and two processes. All test workers share them."""
    ours = tmp_path_factory.getbasetemp()
    folder = (ours.parent if "PYTEST_XDIST_WORKER" in os.environ else ours) / "devices"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "two.npz").is_file():
            save(toy_data([9, 17, 20, 12, 5], seed=1), folder / "data.npz")
            finish(begin(str(folder), "one"))
            finish(begin(str(folder), "four", host_devices=4))
            address = f"localhost:{free_port()}"
            finish(*(begin(str(folder), "two", address, "2", str(i)) for i in range(2)))
    return {name: dict(np.load(folder / f"{name}.npz")) for name in ("one", "four", "two")}


def test_runs_use_their_number_of_devices(runs):
    assert [int(runs[name]["devices"]) for name in ("one", "four", "two")] == [1, 4, 2]


@pytest.mark.parametrize("name", ["four", "two"])
def test_loss_equals_loss_of_one_device(runs, name):
    one, several = runs["one"]["losses"], runs[name]["losses"]
    assert len(one) == 20 and len(set(one)) == 20
    np.testing.assert_allclose(several, one, rtol=1e-5)


@pytest.mark.parametrize("name", ["one", "four", "two"])
def test_signal_to_one_process_stops_all_at_same_step(runs, name):
    np.testing.assert_allclose(runs[name]["half"], runs["one"]["losses"][:10], rtol=1e-5)


@pytest.mark.parametrize(("name", "saved"), [("one", "one"), ("four", "one"), ("two", "one"), ("two", "four")])
def test_training_resumes_on_any_number_of_devices(runs, name, saved):
    found = runs[name][f"from-{saved}"]
    assert len(found) == 10
    np.testing.assert_allclose(found, runs["one"]["losses"][10:], rtol=1e-5)


@pytest.mark.parametrize("name", ["four", "two"])
def test_device_receives_only_sampled_steps(runs, name):
    """A device receives only the sampled steps, not the trajectories."""
    sent, rows, table = (int(runs[name][what]) for what in ("sent", "rows", "table"))
    assert 0 < sent <= rows < table


def by_goal(run) -> tuple[np.ndarray, ...]:
    """Collected trajectories, in an order that does not depend on which process collected them."""
    order = np.lexsort(run["goal_world"].T)
    return tuple(run[name][order] for name in ("goal_world", "length", "collected"))


@pytest.mark.parametrize("name", ["four", "two"])
def test_collected_trajectories_are_the_same(runs, name):
    for several, one in zip(by_goal(runs[name]), by_goal(runs["one"]), strict=True):
        np.testing.assert_allclose(several, one, atol=1e-5)


@pytest.mark.parametrize("name", ["four", "two"])
def test_evaluated_episodes_are_the_same(runs, name):
    parts = [part for part in runs["one"] if part.startswith("evaluated")]
    assert runs["one"]["evaluated-path"].shape == (20, 5, 2) and len(parts) == 6
    for part in parts:
        np.testing.assert_allclose(runs[name][part], runs["one"][part], rtol=1e-4, atol=1e-5, err_msg=part)


# --------------------------------------------------------------------------------------------- and without others


@pytest.mark.parametrize("n", [1, 5, 8])
def test_padding_repeats_last_index(n):
    order = devices.fill_up(n, devices.data_mesh())
    assert len(order) % jax.device_count() == 0
    assert order[:n].tolist() == list(range(n)) and set(order[n:]) <= {n - 1}


def test_files_of_several_processes_are_divided_evenly(tmp_path, toy_data, monkeypatch):
    parts, file = [toy_data([3, 4], seed=1), toy_data([5, 6, 7], seed=2)], tmp_path / "data.npz"
    monkeypatch.setattr(devices, "joined", lambda rows: rows)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    for i, part in enumerate(parts):
        assert not is_saved(file)
        monkeypatch.setattr(jax, "process_index", lambda i=i: i)
        monkeypatch.setattr(devices, "first", lambda action: action())
        save(part, file)
    assert is_saved(file) and load(file).length.tolist() == [5, 6, 7]
    found = []
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    for i in range(3):
        monkeypatch.setattr(jax, "process_index", lambda i=i: i)
        found.append(load(file).length.tolist())
    assert [n for share in found for n in share] == [3, 4, 5, 6, 7] and max(map(len, found)) == 2


LISTEN = """
import os, sys
from ct_envs import UserError
from ct_jax.runtime import devices
try:
    devices.start(sys.argv[1], 1, 0)
except UserError as bad:
    print(bad)
else:
    for file in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in open(file):
            _, where, _, state, *_ = line.split()
            if where.endswith(f":{int(sys.argv[1].rpartition(':')[2]):04X}") and state == "0A":
                print(where.partition(":")[0])
sys.stdout.flush()
os._exit(0)
"""
LOOPBACK = {"0100007F", "0000000000000000FFFF00000100007F"}  # also as IPv6 writes it


def listening(address: str) -> str:
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", LISTEN, address]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120).stdout


@pytest.mark.skipif(not Path("/proc/net/tcp").is_file(), reason="only Linux says who listens where")
@pytest.mark.parametrize(
    ("host", "expected"),
    [("localhost", LOOPBACK), ("127.0.0.1", LOOPBACK), ("[::1]", {"00000000000000000000000001000000"})],
)
def test_coordinator_listens_only_at_its_address(host, expected):
    if host == "[::1]" and not _has_ipv6():
        pytest.skip("no IPv6 here")
    (found,) = listening(f"{host}:{free_port()}").splitlines()
    assert found in expected or (host == "localhost" and found == "00000000000000000000000001000000")


def _has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6) as tried:
            tried.bind(("::1", 0))
    except OSError:
        return False
    return True


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_address_of_other_machine_is_error(host):
    with pytest.raises(UserError, match=rf"^--coordinator {host}:5: cannot listen there \(.*; give an address of"):
        devices.listening_address(f"{host}:5")


def test_port_in_use_is_error():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        address = f"127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(UserError, match=r"cannot listen there \(Address already in use\)"):
            devices.listening_address(address)
    assert devices.listening_address(address) == address


def test_indivisible_batch_is_error(monkeypatch):
    class Device:
        def __init__(self, process: int):
            self.process_index, self.id = process, process

    monkeypatch.setattr(jax, "devices", lambda: [Device(i) for i in range(3)])
    with pytest.raises(UserError, match="3 processes cannot share a batch of 4 evenly"):
        devices.data_mesh(4)
    assert devices.data_mesh(6).size == 3
