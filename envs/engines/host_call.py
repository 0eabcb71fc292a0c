"""Calls from a jitted program to a function on NumPy arrays.

`jax.pure_callback` costs about 30 µs a call, and JAX does not keep programs that hold one in its
persistent compilation cache. XLA's foreign function interface knows neither cost, and its handlers
are C functions on C structures, which ctypes makes without a compiler: see the header
`xla/ffi/api/c_api.h`, which jaxlib bundles.
"""

import ctypes
import functools
import math
import pathlib
import re
import threading
import traceback
from collections.abc import Callable
from typing import Any

import jax
import ml_dtypes
import numpy as np

HostFunction = Callable[..., tuple[np.ndarray, ...]]

MAJOR, MINORS = 0, range(3, 6)
"""The versions of the interface that have the structures below; jax 0.10 has 0.3, 0.12 has 0.5."""


def host_call(
    function: HostFunction,
    result: tuple[jax.ShapeDtypeStruct, ...],
    *arguments: jax.Array | np.ndarray,
    name: str | None = None,
) -> tuple[jax.Array, ...]:
    """`function(*arguments)`, computed on the host with NumPy at each run of the program.

    Under `vmap`, nested too, all arguments and results have the batch axes in front. A function
    that raises makes the program raise a `jax.errors.JaxRuntimeError` with its traceback.

    Args:
      function: pure; it calls no JAX, and keeps no argument, whose memory is XLA's.
      result: the shapes and dtypes of the results, without batch axes.
      name: the same in every process and for no other function, so that compiled programs, which
        hold it, can be kept and used again. A named function is kept as long as the process lives,
        and the first of a name is the one that is called. Without a name, and where this version
        of XLA's interface is unknown, the call is a `jax.pure_callback`.
    """

    def callback(*arguments):
        def host(*arguments):
            return function(*map(np.asarray, arguments))

        return tuple(jax.pure_callback(host, result, *arguments, vmap_method="broadcast_all"))

    if name is None or not interface_is_known():
        return callback(*arguments)
    foreign = jax.ffi.ffi_call(_target(name, function), result, vmap_method="broadcast_all")
    return tuple(jax.lax.platform_dependent(*arguments, cpu=foreign, default=callback))


@functools.cache
def interface_is_known() -> bool:
    """Whether jaxlib's interface is one that this module was written for."""
    header = pathlib.Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h")
    if not header.is_file():
        return False
    version = re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header.read_text())
    found = {part: int(number) for part, number in version}
    return found.get("MAJOR") == MAJOR and found.get("MINOR") in MINORS


_handlers: dict[str, Any] = {}  # by target; XLA holds their addresses and cannot be told to forget
_registering = threading.Lock()


def _target(name: str, function: HostFunction) -> str:
    """The name under which XLA finds the function."""
    target = f"host_call:{name}"
    with _registering:
        if target not in _handlers:
            handler = _handler(function)
            address = ctypes.cast(handler, ctypes.c_void_p).value
            jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(address), platform="cpu")
            _handlers[target] = handler
    return target


def _handler(function: HostFunction) -> Any:
    """A C function for XLA; ctypes takes Python's lock round each call."""

    @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))
    def handler(frame):
        frame = frame.contents
        extension = frame.extension
        if extension and extension.contents.type == _METADATA:
            metadata = ctypes.cast(extension, ctypes.POINTER(_MetadataExtension))
            version = metadata.contents.metadata.contents.version
            version.major, version.minor = MAJOR, MINORS[0]
            return None
        try:
            buffers, results = frame.arguments.buffers, frame.results.buffers
            arguments = [_array(buffers[i]) for i in range(frame.arguments.size)]
            for argument in arguments:
                argument.setflags(write=False)
            for i, value in enumerate(function(*arguments)):
                array = _array(results[i])
                if (array.shape, array.dtype) != (value.shape, value.dtype):
                    raise ValueError(
                        f"result {i} must be {array.dtype} {array.shape}, "
                        f"got {value.dtype} {value.shape}"
                    )
                array[...] = value
        except BaseException:  # nothing passes through a C function: XLA raises it
            return _error(frame, f"error in a host function:\n{traceback.format_exc()}")
        return None

    return handler


def _array(buffer: Any) -> np.ndarray:
    """The memory of a buffer, as it is."""
    buffer = buffer.contents
    shape, dtype = buffer.dims[: buffer.rank], _DTYPES[buffer.dtype]
    size = math.prod(shape) * dtype.itemsize
    memory: Any = (ctypes.c_char * size).from_address(buffer.data or 0)
    return np.ndarray(shape, dtype, memory)


def _error(frame: "_CallFrame", message: str) -> int:
    """A new XLA_FFI_Error, which XLA frees."""
    arguments = _ErrorCreateArguments(message=message.encode(), code=_INTERNAL)
    arguments.struct_size = ctypes.sizeof(arguments)
    return frame.api.contents.error_create(arguments)


# ----- the structures of xla/ffi/api/c_api.h, as far as they are read

_METADATA = 1  # XLA_FFI_Extension_Metadata
_INTERNAL = 13  # XLA_FFI_Error_Code_INTERNAL

_DTYPES = {
    code: np.dtype(dtype)
    for code, dtype in {
        1: np.bool_,
        2: np.int8,
        3: np.int16,
        4: np.int32,
        5: np.int64,
        6: np.uint8,
        7: np.uint16,
        8: np.uint32,
        9: np.uint64,
        10: np.float16,
        11: np.float32,
        12: np.float64,
        16: ml_dtypes.bfloat16,
    }.items()
}  # by XLA_FFI_DataType


class _Extension(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
    )


class _Version(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    )


class _Metadata(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("version", _Version))


class _MetadataExtension(ctypes.Structure):
    _fields_ = (("base", _Extension), ("metadata", ctypes.POINTER(_Metadata)))


class _ErrorCreateArguments(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


class _Api(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        (
            "error_create",
            ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorCreateArguments)),
        ),
    )


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(ctypes.Structure):
    """XLA_FFI_Args and XLA_FFI_Rets."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _CallFrame(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )
