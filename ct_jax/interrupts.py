"""Ctrl-C and SIGTERM, so that they stop a run where it can be continued.

MuJoCo steps in callbacks of compiled programs, and those run on the main thread. An exception raised there would come
back as an error of XLA, so a signal that arrives in a callback waits for ``raise_if_interrupted``; one that arrives
while something is being saved waits for that.

Python handles no signal while XLA compiles or runs a long program. Whoever sends SIGTERM kills soon after, so a thread
watches: what has not stopped in time is saved by that thread, and ended.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from ct_jax.terminal import one_line

GRACE_S = 4.0  # after SIGTERM, until the thread saves by itself: SIGKILL often comes after ten
_CALLBACKS = ("ct_envs.host_call", "jax._src.callback")


class Terminated(KeyboardInterrupt):
    """SIGTERM: like Ctrl-C, but what asked for it expects it to be obeyed, not reported."""


_KINDS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
_waiting: list[type[KeyboardInterrupt]] = []
_holders: list[object] = []
_rescues: list[Callable[[], None]] = []
_largest: Callable[[int], int] | None = None  # of the numbers that several processes name


def obey_together(largest: Callable[[int], int]) -> None:
    """With several processes a signal to any of them stops all, where all look for one, and only there."""
    global _largest
    _largest = largest


def raise_if_interrupted() -> None:
    """Raise what a signal asked for during a callback. Long loops call it between their compiled programs."""
    kinds = [None, *_KINDS.values()]
    kind = kinds.index(_waiting[0]) if _waiting else 0
    if _largest is not None:
        kind = _largest(kind)
    if kind:
        _waiting.clear()
        raise kinds[kind]


@contextmanager
def uninterrupted() -> Iterator[None]:
    """A signal that arrives within is obeyed at the end."""
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
    """Within, ``save`` is called, from another thread, if SIGTERM finds the program where it cannot be stopped."""
    _rescues.append(save)
    try:
        yield
    finally:
        _rescues.remove(save)


@contextmanager
def interruptible(farewell: str = "stopped") -> Iterator[None]:
    """SIGINT raises ``KeyboardInterrupt`` and SIGTERM ``Terminated`` within, as soon as that is safe.

    Args:
        farewell: what is said on stderr where SIGTERM has to end the process without them.
    """
    if threading.current_thread() is not threading.main_thread():  # only there can signals be handled
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
    """Wait for SIGTERM, as the system reports it; if the program has not stopped in time, save and end it."""
    while signals := os.read(reader, 64):
        if signal.SIGTERM in signals and not over.wait(GRACE_S):
            break
    if over.is_set() or _largest is not None:  # one process can save nothing without the others
        return
    for save in reversed(_rescues):
        try:
            save()
        except Exception as error:  # what was saved before is still there
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
