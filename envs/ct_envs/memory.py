"""Return memory pages to the system that C code has filled with zeros but may never use.

A PyBullet client clears two buffers of 8 MB that we do not use. A returned page still reads as zeros, so only the
memory usage of the process changes.
"""

import ctypes
import re
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import MADV_DONTNEED, PAGESIZE
from pathlib import Path

import numpy as np

_MAPS = Path("/proc/self/maps")
_ANONYMOUS = re.compile(r"([0-9a-f]+)-([0-9a-f]+) rw.p \S+ \S+ 0 *$", re.MULTILINE)  # private, without file or stack
_FEWEST = 1024  # minimum number of consecutive pages; Python's own objects never have this many

Range = tuple[int, int]  # of addresses


@contextmanager
def zeros_given_back() -> Iterator[None]:
    """A context that returns zero pages to the system at its end, if they were allocated inside it. Linux only.

    No other thread may run at that time: its writes to a page that is being returned would be lost.
    """
    before = list(_anonymous())
    yield
    for start, end in _without(list(_anonymous()), before):
        memory = (ctypes.c_char * (end - start)).from_address(start)
        used = np.frombuffer(memoryview(memory), np.uint64).reshape(-1, PAGESIZE // 8).any(1)
        edges = np.flatnonzero(np.diff(used, prepend=True, append=True))
        for first, last in edges.reshape(-1, 2).tolist():
            if last - first >= _FEWEST:
                address = ctypes.c_void_p(start + first * PAGESIZE)
                ctypes.CDLL(None).madvise(address, ctypes.c_size_t((last - first) * PAGESIZE), MADV_DONTNEED)


def _anonymous() -> Iterator[Range]:
    """The process's private memory, in order."""
    if _MAPS.is_file():
        yield from ((int(a, 16), int(b, 16)) for a, b in _ANONYMOUS.findall(_MAPS.read_text("utf-8", "replace")))


def _without(ranges: list[Range], others: list[Range]) -> Iterator[Range]:
    """The parts of ``ranges`` that are not in ``others``. Both are sorted."""
    for start, end in ranges:
        for low, high in others:
            if low < end and high > start:
                if low > start:
                    yield start, low
                start = max(start, high)
        if start < end:
            yield start, end
