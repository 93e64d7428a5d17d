"""Output to the terminal: without control characters, and with replacements for characters that it cannot show."""

import codecs
import io
import os
import stat
import sys
from typing import Any
from unicodedata import category

from ct_envs.errors import UserError

_LIKENESS = {"█": "#", "•": "*", "–": "-", "—": "-", "−": "-", "µ": "u"}
_ERRORS = "ct_jax.likeness"
_ALWAYS_FULL = os.makedev(1, 7)  # /dev/full


def printable(text: Any) -> str:
    """The text with Python escapes for characters that are neither visible nor a space, such as control codes."""
    return "".join(c if c.isprintable() or category(c) == "Zs" else ascii(c)[1:-1] for c in str(text))


def one_line(text: Any) -> str:
    """Like ``printable``, in one line: all white space becomes single spaces."""
    return printable(" ".join(str(text).split()))


def show_anything() -> None:
    """From now on, characters that stdout or stderr cannot encode are replaced by similar ones or by Python escapes."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # closed: the next opened file would get this number, and the printed text
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or io.TextIOWrapper(io.FileIO(1, "w", closefd=False))
    sys.stderr = sys.stderr or io.TextIOWrapper(io.FileIO(2, "w", closefd=False))
    codecs.register_error(_ERRORS, _alike)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors=_ERRORS)


def _alike(error: UnicodeError) -> tuple[str | bytes, int]:
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end]
    return "".join(_LIKENESS.get(c) or c.encode("ascii", "backslashreplace").decode() for c in text), error.end


def check_stdout() -> None:
    """Check that stdout can be written, before a long computation. Raises UserError."""
    found = os.fstat(1)
    full = stat.S_ISCHR(found.st_mode) and found.st_rdev == _ALWAYS_FULL
    if stat.S_ISREG(found.st_mode):
        disk = os.fstatvfs(1)
        full = disk.f_blocks > 0 and (disk.f_bfree if os.geteuid() == 0 else disk.f_bavail) == 0
    if full:
        raise UserError("stdout: cannot be written (no space left); make room, or send it to another place")
