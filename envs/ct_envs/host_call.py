"""Python functions that compiled programs call on the CPU by name. Such programs can be cached for other processes.

JAX cannot cache programs with a ``pure_callback`` on disk, and nearly all of our programs step MuJoCo. XLA's foreign
function interface finds a function by its name, and passes its own buffers. A call takes a quarter of the time.

The structures are those of ``xla/ffi/api/c_api.h`` (``jax.ffi.include_dir()``), up to the last field that we use.
"""

import ctypes
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_int, c_int64, c_size_t, c_uint32, c_void_p

import jax
import numpy as np

_VERSION = (0, 1)  # of the interface: the first version with everything that this file needs
_INTERNAL = 13  # error code
_DTYPES = {11: np.dtype(np.float32), 12: np.dtype(np.float64)}


class _Version(ctypes.Structure):
    _fields_ = (("size", c_size_t), ("extension", c_void_p), ("major", c_int), ("minor", c_int))


class _Metadata(ctypes.Structure):
    _fields_ = (("size", c_size_t), ("version", _Version), ("traits", c_uint32))


class _Extension(ctypes.Structure):
    _fields_ = (("size", c_size_t), ("type", c_int), ("next", c_void_p), ("metadata", POINTER(_Metadata)))


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("size", c_size_t), ("extension", c_void_p), ("dtype", c_int), ("data", c_void_p), ("rank", c_int64),
        ("shape", POINTER(c_int64)),
    )  # fmt: skip


class _Buffers(ctypes.Structure):
    _fields_ = (
        ("size", c_size_t), ("extension", c_void_p), ("n", c_int64), ("types", c_void_p),
        ("items", POINTER(POINTER(_Buffer))),
    )  # fmt: skip


class _Failure(ctypes.Structure):
    _fields_ = (("size", c_size_t), ("extension", c_void_p), ("message", c_char_p), ("code", c_int))


class _Api(ctypes.Structure):
    _fields_ = (
        ("size", c_size_t), ("extension", c_void_p), ("version", _Version), ("internal", c_void_p),
        ("fail", ctypes.CFUNCTYPE(c_void_p, POINTER(_Failure))),
    )  # fmt: skip


class _Frame(ctypes.Structure):
    _fields_ = (
        ("size", c_size_t), ("extension", POINTER(_Extension)), ("api", POINTER(_Api)), ("context", c_void_p),
        ("stage", c_int), ("arguments", _Buffers), ("results", _Buffers),
    )  # fmt: skip


_Handler = ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))
_registered: dict[str, object] = {}  # by name; XLA holds no reference to a handler


def register(name: str, function: Callable[[np.ndarray, np.ndarray], None]) -> None:
    """Register a function for ``jax.ffi.ffi_call(name, ...)`` with one argument and one result. Later calls do nothing.

    Args:
        name: stored in every program that calls it; it must name the same function in every process.
        function: reads its first array and fills its second. Both are XLA's buffers: do not keep them. The function
            must not use JAX.
    """
    if name in _registered:
        return

    @_Handler
    def handle(pointer):
        frame = pointer.contents
        if frame.extension:  # the first call only asks for the handler's version
            version = frame.extension.contents.metadata.contents.version
            version.major, version.minor = _VERSION
            return None
        try:
            function(_array(frame.arguments.items[0]), _array(frame.results.items[0]))
        except BaseException as error:  # no exception may reach XLA
            text = f"{type(error).__name__}: {error}".encode()
            return frame.api.contents.fail(_Failure(ctypes.sizeof(_Failure), None, text, _INTERNAL))

    _registered[name] = handle
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(ctypes.cast(handle, c_void_p).value), platform="cpu")


def _array(pointer) -> np.ndarray:
    """A buffer as an array that shares its memory."""
    buffer = pointer.contents
    dtype, shape = _DTYPES[buffer.dtype], tuple(buffer.shape[: buffer.rank])
    memory = (ctypes.c_char * (dtype.itemsize * int(np.prod(shape)))).from_address(buffer.data)
    return np.frombuffer(memory, dtype).reshape(shape)
