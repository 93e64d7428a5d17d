"""Every file that is written: whole or not at all, never through a link, and readable as the umask says.

A run's folder may lie where others can write. So nothing that lies there decides where a file goes: a link in the place
of a file is replaced, and a link in the place of a folder is refused.
"""

import errno
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ct_envs.errors import UserError

_PART = re.compile(r".+\.[0-9a-f]{16}\.part")
_TRIAL_BYTES = 1 << 16  # a full disk still makes empty files
_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_APPEND = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
_MODE = 0o666  # less the umask
_HINTS = {
    errno.ENOSPC: "make room", errno.EDQUOT: "make room", errno.ENOENT: "give a folder that exists",
    errno.ENOTDIR: "give a folder that exists",
}  # fmt: skip


@contextmanager
def whole(file: Path) -> Iterator[BinaryIO]:
    """A new file, open for bytes, that takes the place of ``file`` at the end; if anything fails, nothing has changed.

    Its ``name`` is a path in the same folder, for writers that want one.

    Raises:
        UserError: it cannot be written.
    """
    try:
        with _beside(file) as opened:
            yield opened
            opened.close()  # what fails only now fails before the old file is gone
            os.replace(opened.name, file)
    except OSError as bad:
        raise UserError(f"{_cannot_be_written(file, bad)}; what is finished is kept") from None


@contextmanager
def _beside(file: Path) -> Iterator[BinaryIO]:
    """A new file in the same folder, which goes at the end unless it has got another name."""
    part = file.with_name(f"{file.name}.{secrets.token_hex(8)}.part")  # which nobody can have put a link at
    try:
        with open(part, "w+b", opener=lambda path, _: os.open(path, _NEW, _MODE)) as opened:
            yield opened
    finally:
        with suppress(OSError):
            part.unlink()


def write_text(file: Path, text: str) -> None:
    """Write text as UTF-8; what Unicode has no place for becomes a question mark. Raises UserError."""
    with whole(file) as opened:
        opened.write(text.encode("utf-8", "replace"))


def save_arrays(file: Path, **arrays: np.ndarray) -> None:
    """Write arrays as a compressed ``.npz`` file, without pickle. Raises UserError."""
    with whole(file) as opened:
        np.savez_compressed(opened, **arrays)


def append_to(file: Path) -> BinaryIO:
    """Open a file to read and to append to; it is made where there is none. Raises UserError, also for a link."""
    try:
        return open(file, "r+b", opener=lambda path, _: os.open(path, _APPEND, _MODE))
    except OSError as bad:
        raise UserError(_cannot_be_written(file, bad)) from None


def make_folder(folder: Path, *, parents: bool = False) -> None:
    """Make a folder where there is none. Raises UserError, also for a link."""
    try:
        if folder.is_symlink():
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        folder.mkdir(parents=parents, exist_ok=True)
    except OSError as bad:
        raise UserError(_cannot_be_written(folder, bad)) from None


def check_writable(*files: Path, option: str = "") -> None:
    """Try whether files could be written, before the work that they are for.

    Args:
        option: that named them, for the error.

    Raises:
        UserError: one cannot.
    """
    for file in files:
        try:
            if file.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
            with _beside(file) as opened:
                opened.write(bytes(_TRIAL_BYTES))
        except OSError as bad:
            raise UserError(_cannot_be_written(file, bad, option)) from None


def prepare_outputs(*files: Path) -> None:
    """Make the folders of files, and try whether they could be written, before the work. Raises UserError."""
    for file in files:
        make_folder(file.parent, parents=True)
    check_writable(*files)


def check_folders(folder: Path) -> None:
    """Raises UserError for a link to a folder anywhere inside: what is written there would leave it."""
    for where, names, _ in os.walk(folder):
        for name in names:
            if (path := Path(where) / name).is_symlink():
                raise UserError(f"{path}: a link, through which a run's files would leave it; put the folder there")


def drop_parts(folder: Path) -> None:
    """Delete what processes that were killed left of files that they had not finished."""
    for where, _, names in os.walk(folder):
        for name in filter(_PART.fullmatch, names):
            with suppress(OSError):
                (Path(where) / name).unlink()


def _cannot_be_written(file: Path, bad: OSError, option: str = "") -> str:
    """What is wrong with a file that cannot be written, and what helps."""
    what = f"{option} {file}" if option else f"{file}"
    if bad.errno == errno.ELOOP:
        return f"{what}: a link; delete it, and the thing itself takes its place"
    hint = _HINTS.get(bad.errno or 0, "choose another place")
    return f"{what}: cannot be written ({bad.strerror or bad}); {hint}"
