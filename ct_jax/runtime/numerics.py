"""The numerical settings of this package. They are the same for the command line and for any calling program."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
T = TypeVar("T")


@contextmanager
def own_numerics() -> Iterator[None]:
    """Exact float32 products (TF32 hurts physics and learning), 32 bits, and the rank promotion that MJX relies on.

    The settings hold for this thread until the context ends. The caller's own settings do not change.
    """
    with jax.default_matmul_precision("highest"), jax.enable_x64(False), jax.numpy_rank_promotion("allow"):
        yield


def with_own_numerics(function: Callable[P, T]) -> Callable[P, T]:
    """A function that runs, traces and compiles with ``own_numerics``."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        with own_numerics():
            return function(*args, **kwargs)

    return wrapped
