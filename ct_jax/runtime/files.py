"""Writing files: complete or not at all, never through a link, and with the permissions of the umask.

Other users may be able to write to a run folder. Therefore its contents must not redirect writes: a link in the place
of a file is replaced, and a link in the place of a folder is an error.
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
_TRIAL_BYTES = 1 << 16  # on a full disk, empty files can still be made
_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_APPEND = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
_MODE = 0o666  # the umask is applied to it
_HINTS = {
    errno.ENOSPC: "make room", errno.EDQUOT: "make room", errno.ENOENT: "give a folder that exists",
    errno.ENOTDIR: "give a folder that exists",
}  # fmt: skip


@contextmanager
def whole(file: Path) -> Iterator[BinaryIO]:
    """A new file, open for writing bytes. It replaces ``file`` at the end. After an error, ``file`` is unchanged.

    Its ``name`` is a path in the same folder, for writers that need a path.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        with _beside(file) as opened:
            yield opened
            opened.close()  # an error here still leaves the old file
            os.replace(opened.name, file)
    except OSError as bad:
        raise UserError(f"{_cannot_be_written(file, bad)}; what is finished is kept") from None


@contextmanager
def _beside(file: Path) -> Iterator[BinaryIO]:
    """A new file in the same folder. It is deleted at the end unless it was renamed."""
    part = file.with_name(f"{file.name}.{secrets.token_hex(8)}.part")  # random, so that no link can have this name
    try:
        with open(part, "w+b", opener=lambda path, _: os.open(path, _NEW, _MODE)) as opened:
            yield opened
    finally:
        with suppress(OSError):
            part.unlink()


def write_text(file: Path, text: str) -> None:
    """Write text as UTF-8. Characters that cannot be encoded become question marks. Raises UserError."""
    with whole(file) as opened:
        opened.write(text.encode("utf-8", "replace"))


def save_arrays(file: Path, **arrays: np.ndarray) -> None:
    """Write arrays as a compressed ``.npz`` file, without pickle. Raises UserError."""
    with whole(file) as opened:
        np.savez_compressed(opened, **arrays)


def append_to(file: Path) -> BinaryIO:
    """Open a file for reading and appending; create it if it does not exist. Raises UserError, also for a link."""
    try:
        return open(file, "r+b", opener=lambda path, _: os.open(path, _APPEND, _MODE))
    except OSError as bad:
        raise UserError(_cannot_be_written(file, bad)) from None


def make_folder(folder: Path, *, parents: bool = False) -> None:
    """Make a folder if it does not exist. Raises UserError, also for a link."""
    try:
        if folder.is_symlink():
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        folder.mkdir(parents=parents, exist_ok=True)
    except OSError as bad:
        raise UserError(_cannot_be_written(folder, bad)) from None


def check_writable(*files: Path, option: str = "") -> None:
    """Check that files can be written, before a long computation.

    Args:
        option: name of the command line option, for the error.

    Raises:
        UserError: a file cannot be written.
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
    """Make the folders of files, and check that the files can be written. Raises UserError."""
    for file in files:
        make_folder(file.parent, parents=True)
    check_writable(*files)


def check_folders(folder: Path) -> None:
    """Raise UserError if a folder contains a link to a folder: files written there would be outside."""
    for where, names, _ in os.walk(folder):
        for name in names:
            if (path := Path(where) / name).is_symlink():
                raise UserError(f"{path}: a link, through which a run's files would leave it; put the folder there")


def drop_parts(folder: Path) -> None:
    """Delete unfinished files of killed processes."""
    for where, _, names in os.walk(folder):
        for name in filter(_PART.fullmatch, names):
            with suppress(OSError):
                (Path(where) / name).unlink()


def _cannot_be_written(file: Path, bad: OSError, option: str = "") -> str:
    """The error text for a file that cannot be written, with the remedy."""
    what = f"{option} {file}" if option else f"{file}"
    if bad.errno == errno.ELOOP:
        return f"{what}: a link; delete it, and the thing itself takes its place"
    hint = _HINTS.get(bad.errno or 0, "choose another place")
    return f"{what}: cannot be written ({bad.strerror or bad}); {hint}"
