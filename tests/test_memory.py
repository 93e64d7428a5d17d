"""Returned memory pages keep their contents."""

from pathlib import Path

import numpy as np
import pytest

from ct_envs.memory import zeros_given_back

STATUS = Path("/proc/self/smaps_rollup")
pytestmark = pytest.mark.skipif(not STATUS.is_file(), reason="only Linux says how much memory a process takes")
MEGABYTES = 64


def dirty_mb() -> float:
    """Private memory of this process that has been written [MB]."""
    return next(int(line.split()[1]) for line in STATUS.read_text().splitlines() if "Private_Dirty" in line) / 1024


def fill(array: np.ndarray, pattern: str) -> None:
    array[:] = 0  # write it, so that the system allocates the pages
    if pattern == "ones":
        array[:] = 1
    elif pattern == "some":
        array[:: len(array) // 5] = 1
    elif pattern == "ends":
        array[[0, -1]] = 1


@pytest.mark.parametrize("pattern", ["zeros", "ones", "some", "ends"])
def test_contents_are_kept_and_zero_pages_are_returned(pattern):
    with zeros_given_back():
        array = np.empty(MEGABYTES * 2**20, np.uint8)
        fill(array, pattern)
        full = dirty_mb()
    freed = full - dirty_mb()
    expected = np.empty_like(array)
    fill(expected, pattern)
    assert (array == expected).all()
    assert (freed > MEGABYTES - 25) == (pattern != "ones") and (pattern != "ones" or abs(freed) < 5)
    array[:] = 2  # it can still be written
    assert (array == 2).all()


def test_earlier_memory_is_not_changed():
    array = np.empty(MEGABYTES * 2**20, np.uint8)
    array[:] = 0
    before = dirty_mb()
    with zeros_given_back():
        pass
    assert abs(dirty_mb() - before) < 5 and not array.any()
