"""Calls of a Python function from a compiled program on a CPU, by a name that outlives the process.

To XLA a call of `jax.pure_callback` is a number that means something in one process, so JAX's
cache keeps no program with one, and each start compiles it again. Here the function is one of XLA's
foreign functions, which a program calls by name.

The structures are those of XLA's C interface (`xla/ffi/api/c_api.h`, version 0.3), which jaxlib
promises to call for a year at least after it changes. Each begins with its size and a pointer to
extensions.
"""

import atexit
import contextlib
import ctypes
import functools
import math
import os
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.records import Array

API_VERSION = (0, 3)
_METADATA, _INTERNAL_ERROR = 1, 13  # of the extensions', of the errors' enumeration
_HEAD: list[Any] = [("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p)]
_registered: dict[str, Any] = {}  # programs call them as long as the process lasts


class _Buffer(ctypes.Structure):
    _fields_ = [*_HEAD, ("dtype", ctypes.c_int), ("data", ctypes.c_void_p)]
    _fields_ += [("rank", ctypes.c_int64), ("dims", ctypes.POINTER(ctypes.c_int64))]


class _Buffers(ctypes.Structure):
    _fields_ = [*_HEAD, ("size", ctypes.c_int64), ("types", ctypes.c_void_p)]
    _fields_ += [("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer)))]


class _Version(ctypes.Structure):
    _fields_ = [*_HEAD, ("major", ctypes.c_int), ("minor", ctypes.c_int)]


class _ErrorArguments(ctypes.Structure):
    _fields_ = [*_HEAD, ("message", ctypes.c_char_p), ("code", ctypes.c_int)]


class _Api(ctypes.Structure):
    _fields_ = [*_HEAD, ("version", _Version), ("internal", ctypes.c_void_p)]
    _fields_ += [("create_error", ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p))]


class _Metadata(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("version", _Version)]
    _fields_ += [("traits", ctypes.c_uint32), ("state_type", ctypes.c_int64)]


class _Extension(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("type", ctypes.c_int)]
    _fields_ += [("next", ctypes.c_void_p), ("metadata", ctypes.POINTER(_Metadata))]


class _Frame(ctypes.Structure):
    _fields_ = [*_HEAD, ("api", ctypes.POINTER(_Api)), ("context", ctypes.c_void_p)]
    _fields_ += [("stage", ctypes.c_int), ("given", _Buffers), ("wanted", _Buffers)]


_HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Frame))


def register(name: str, function: Callable[[np.ndarray], np.ndarray]) -> None:
    """Gives programs on a CPU a function to call by name; a name's first function stays.

    Args:
      name: of the function. Programs that call it are found again by it in later processes, so it
        must say all that the function depends on besides its argument.
      function: of an array [..., n] float32, returns one [..., m] float32. XLA calls it from any of
        its threads. What it raises, the program raises as `jax.errors.JaxRuntimeError`.
    """
    if name not in _registered:
        handler = _HANDLER(functools.partial(_answer, function))
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
        _registered[name] = handler


@atexit.register
def _wait() -> None:
    """Waits for what is still being computed: a call after Python's end would crash the process."""
    for array in jax.live_arrays() if _registered else ():
        with contextlib.suppress(Exception):  # its program failed: not ours to tell
            array.block_until_ready()


def run(
    name: str, host: Callable, given: Sequence[Array], shapes: Sequence[tuple[int, ...]]
) -> list[Array]:
    """Calls `host` from a program, on arrays packed into a row: a callback's cost is per argument.

    On a GPU machine by JAX's own callback, which it does not keep in its cache.

    Args:
      name: of the function, as for `register`.
      host: of a row [..., n], returns one [..., m] of arrays of the shapes.
      given: arrays, float32 in the row.
      shapes: of the arrays to return.
    """
    row = jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in given])
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    if jax.default_backend() == "cpu":
        register(name, host)
        out = call(name, int(ends[-1]), row)
    else:
        shape = jax.ShapeDtypeStruct((int(ends[-1]),), jnp.float32)
        out = jax.pure_callback(host, shape, row, vmap_method="broadcast_all")
    parts = jnp.split(out, ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def unpack(targets: Sequence[np.ndarray], rows: np.ndarray) -> None:
    """Writes packed rows [N, n] into arrays [N, ...]."""
    end = 0
    for target in targets:
        begin, end = end, end + math.prod(target.shape[1:])
        if end > begin:
            target[...] = rows[:, begin:end].reshape(target.shape)


def usable_cores() -> int:
    """Returns how many cores this process may use.

    MuJoCo by itself starts a thread for each core of the machine: 64 threads on two cores stepped
    ants at 0.74 of the rate of two.
    """
    return len(os.sched_getaffinity(0))


def call(name: str, width: int, row: Array) -> Array:
    """Calls a registered function on a row [n], under vmap on [..., n]; returns [..., width]."""
    shape = jax.ShapeDtypeStruct((width,), np.float32)
    return jax.ffi.ffi_call(name, shape, vmap_method="broadcast_all")(row)


def _answer(function: Callable[[np.ndarray], np.ndarray], pointer: Any) -> int | None:
    """Answers a call of XLA's: with nothing, or with the address of an error."""
    frame = pointer.contents
    if _asks_version(frame.extension):  # once, when it is registered
        return None
    try:
        _array(frame.wanted)[...] = function(_array(frame.given))
    except BaseException as error:  # or Python prints it, and XLA goes on with no result
        message = "".join(traceback.format_exception(error)).encode()
        size = ctypes.sizeof(_ErrorArguments)
        arguments = _ErrorArguments(size, None, message, _INTERNAL_ERROR)
        return frame.api.contents.create_error(ctypes.addressof(arguments))
    return None


def _asks_version(address: int | None) -> bool:
    """Tells XLA for which version of its interface this is written, if that is what it asks."""
    extension = ctypes.cast(address, ctypes.POINTER(_Extension)).contents if address else None
    if extension is None or extension.type != _METADATA:
        return False
    version = extension.metadata.contents.version
    version.major, version.minor = API_VERSION
    return True


def _array(buffers: _Buffers) -> np.ndarray:
    """Returns the first of the buffers as an array, in its place."""
    buffer = buffers.buffers[0].contents
    shape = tuple(buffer.dims[: buffer.rank])
    numbers = (ctypes.c_float * math.prod(shape)).from_address(buffer.data)
    return np.ctypeslib.as_array(numbers).reshape(shape)
