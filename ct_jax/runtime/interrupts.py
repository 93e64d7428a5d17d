"""Ctrl-C and SIGTERM: they stop a run at points where it can be resumed.

MuJoCo runs in callbacks of compiled programs, on the main thread. An exception in a callback would become an error of
XLA. Therefore a signal during a callback is pending until ``raise_if_interrupted``, and a signal during a save is
pending until the save has finished.

Python does not handle signals while XLA compiles or runs a long program. SIGTERM is usually followed by SIGKILL.
Therefore a thread watches for SIGTERM. If the program has not stopped in time, the thread saves and ends it.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from ct_jax.runtime.terminal import one_line

GRACE_S = 4.0  # time from SIGTERM until the thread saves; SIGKILL often follows after ten seconds
_CALLBACKS = ("ct_envs.host_call", "jax._src.callback")


class Terminated(KeyboardInterrupt):
    """SIGTERM. It stops the program like Ctrl-C, but the exit status is 0."""


_KINDS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
_waiting: list[type[KeyboardInterrupt]] = []
_holders: list[object] = []
_rescues: list[Callable[[], None]] = []
_largest: Callable[[int], int] | None = None  # maximum of a number over all processes


def obey_together(largest: Callable[[int], int]) -> None:
    """For several processes: a signal to any process stops all of them, at the next ``raise_if_interrupted``."""
    global _largest
    _largest = largest


def raise_if_interrupted() -> None:
    """Raise the exception of a pending signal. Long loops call it between compiled programs."""
    kinds = [None, *_KINDS.values()]
    kind = kinds.index(_waiting[0]) if _waiting else 0
    if _largest is not None:
        kind = _largest(kind)
    if kind:
        _waiting.clear()
        raise kinds[kind]


@contextmanager
def uninterrupted() -> Iterator[None]:
    """A context in which signals are pending. They are handled at its end."""
    holder = object()
    _holders.append(holder)
    try:
        yield
    finally:
        _holders.remove(holder)
    if threading.current_thread() is threading.main_thread():
        raise_if_interrupted()


@contextmanager
def rescued_by(save: Callable[[], None]) -> Iterator[None]:
    """A context with a ``save`` for SIGTERM. Another thread calls it if the program cannot be stopped in time."""
    _rescues.append(save)
    try:
        yield
    finally:
        _rescues.remove(save)


@contextmanager
def interruptible(farewell: str = "stopped") -> Iterator[None]:
    """A context in which SIGINT raises ``KeyboardInterrupt`` and SIGTERM raises ``Terminated``, as soon as it is safe.

    Args:
        farewell: message on stderr if the watching thread ends the process after SIGTERM.
    """
    if threading.current_thread() is not threading.main_thread():  # Python handles signals only on the main thread
        yield
        return
    before = {number: signal.signal(number, _handle) for number in _KINDS}
    over = threading.Event()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    wakeup = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    watcher = threading.Thread(target=_watch, args=(reader, over, farewell), name="sigterm", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        signal.set_wakeup_fd(wakeup)
        os.close(writer)
        watcher.join()
        os.close(reader)
        _waiting.clear()
        for number, handler in before.items():
            signal.signal(number, handler)


def _watch(reader: int, over: threading.Event, farewell: str) -> None:
    """Wait for SIGTERM. If the program does not stop in time, save and end it."""
    while signals := os.read(reader, 64):
        if signal.SIGTERM in signals and not over.wait(GRACE_S):
            break
    if over.is_set() or _largest is not None:  # several processes can only save together
        return
    for save in reversed(_rescues):
        try:
            save()
        except Exception as error:  # earlier checkpoints are still there
            print(f"error: {one_line(error)}", file=sys.stderr)
    print(farewell, file=sys.stderr, flush=True)
    os._exit(0)


def _handle(number: int, frame: FrameType | None) -> None:
    kind = _KINDS[signal.Signals(number)]
    if _holders or _largest is not None or _in_callback(frame):
        _waiting.append(kind)
    else:
        raise kind


def _in_callback(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__") in _CALLBACKS:
            return True
        frame = frame.f_back
    return False
