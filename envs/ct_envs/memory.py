"""Memory that C code fills with zeros and may never use, given back to the system until it does.

A PyBullet client clears two buffers of 8 MB, for what nobody here asks it. A page that was given back reads as zeros,
so nothing changes but the memory that the process takes.
"""

import ctypes
import re
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import MADV_DONTNEED, PAGESIZE
from pathlib import Path

import numpy as np

_MAPS = Path("/proc/self/maps")
_ANONYMOUS = re.compile(r"([0-9a-f]+)-([0-9a-f]+) rw.p \S+ \S+ 0 *$", re.MULTILINE)  # private, of no file, no stack
_FEWEST = 1024  # pages in a row: Python's own objects, which come and go meanwhile, have never so many to themselves

Range = tuple[int, int]  # of addresses


@contextmanager
def zeros_given_back() -> Iterator[None]:
    """Gives back, at the end, the pages of zeros that were allocated within; elsewhere than on Linux, none.

    No other thread may work meanwhile: what it writes while its page is given back would be lost.
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
    """What is in ranges and not in others; both are in order."""
    for start, end in ranges:
        for low, high in others:
            if low < end and high > start:
                if low > start:
                    yield start, low
                start = max(start, high)
        if start < end:
            yield start, end
