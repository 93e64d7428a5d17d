"""Ctrl-C and SIGTERM, so that they stop a run where it can be continued.

MuJoCo steps in callbacks of compiled programs, and those run on the main thread. An exception raised there would come
back as an error of XLA, so a signal that arrives in a callback waits for ``raise_if_interrupted``.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_CALLBACKS = ("ct_envs.host_call", "jax._src.callback")


class Terminated(KeyboardInterrupt):
    """SIGTERM: like Ctrl-C, but what asked for it expects it to be obeyed, not reported."""


_KINDS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
_waiting: list[type[KeyboardInterrupt]] = []


def raise_if_interrupted() -> None:
    """Raise what a signal asked for during a callback. Long loops call it between their compiled programs."""
    if _waiting:
        kind = _waiting[0]
        _waiting.clear()
        raise kind


@contextmanager
def interruptible() -> Iterator[None]:
    """SIGINT raises ``KeyboardInterrupt`` and SIGTERM ``Terminated`` within, as soon as that is safe."""
    if threading.current_thread() is not threading.main_thread():  # only there can signals be handled
        yield
        return
    before = {number: signal.signal(number, _handle) for number in _KINDS}
    try:
        yield
    finally:
        _waiting.clear()
        for number, handler in before.items():
            signal.signal(number, handler)


def _handle(number: int, frame: FrameType | None) -> None:
    kind = _KINDS[signal.Signals(number)]
    if _in_callback(frame):
        _waiting.append(kind)
    else:
        raise kind


def _in_callback(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__") in _CALLBACKS:
            return True
        frame = frame.f_back
    return False
