"""Compiled kernels (numba), and their packed arguments."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import importlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt
from numba.core import caching

from protocol.kernel_cache import kernel_folder

Packed: TypeAlias = npt.NDArray[np.void]
"""A structured array of shape (1,), as made by `pack`."""

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def _load_numpy_support() -> None:
    """Load numba's NumPy support, which every kernel needs, without SciPy's linear algebra.

    numba imports that only to check for a BLAS, for `np.convolve` in kernels, which no kernel here uses: this saves a third
    of a second at every start.
    """
    name = "scipy.linalg.cython_blas"
    if name in sys.modules or "numba.np.arraymath" in sys.modules:
        return
    sys.modules[name] = None  # type: ignore[assignment]  # makes its import fail
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[name]


_load_numpy_support()


def compiled(function: Kernel) -> Kernel:
    """Compile `function` with numba at its first call, and store the result in the cache (`kernel_cache`).

    Without fast-math: the same expression must give bit-identical results in the control process and in `simulate`.
    """
    return _compile(function, forceinline=False)


def inlined(function: Kernel) -> Kernel:
    """As `compiled`, but inlined into each kernel that calls it.

    For the innermost loops: a call with array arguments takes as long as copying a short frame.
    """
    return _compile(function, forceinline=True)


def entry_point(kernel: Kernel, *arguments: Any) -> Kernel:
    """The machine code of `kernel` for arguments of the types of these, to be called in its place.

    It saves the search by argument types, which takes more than half a microsecond where structured arrays are among them.
    Whoever calls it passes the same types each time: only their number is checked.
    """
    compiled_kernel: Any = kernel
    if not hasattr(kernel, "overloads"):  # numba is switched off
        return kernel
    type_of: Any = numba.typeof
    types = tuple(type_of(argument) for argument in arguments)
    compiled_kernel.compile(types)
    return cast("Kernel", compiled_kernel.overloads[types].entry_point)


def _compile(function: Kernel, *, forceinline: bool) -> Kernel:
    kernel: Any = numba.njit(error_model="numpy", forceinline=forceinline)(function)
    make_cache: Any = _Cache
    kernel._cache = make_cache(function)  # as `cache=True` does, but in our own folders
    return cast("Kernel", kernel)


class _Locator(caching._CacheLocator):
    """Location of the machine code of one function: in the folder of its module's key, so it is never stale."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._folder = kernel_folder(function.__module__, file)
        self._line = function.__code__.co_firstlineno
        self._py_file = file  # numba shows it in warnings

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator | None:
        return cls(function, file) if Path(file).exists() else None

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(mode=0o700, exist_ok=True)  # another process may have removed it

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Implementation(caching.CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_Locator]  # noqa: RUF012  # as numba declares it


class _Cache(caching.FunctionCache):
    """numba's cache of one function, tolerant of damaged entries, full disks and processes that compile concurrently."""

    _impl_class = _Implementation

    def load_overload(self, signature: Any, target: Any) -> Any:
        load: Any = super().load_overload
        flush: Any = self.flush
        try:
            return load(signature, target)
        except Exception:  # noqa: BLE001  # any error of unpickling, for example after a power loss during the write
            with contextlib.suppress(OSError):
                flush()
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        save: Any = super().save_overload
        with contextlib.suppress(OSError):  # a kernel that cannot be stored is compiled again
            self._impl.locator.ensure_cache_path()
            with (Path(self.cache_path) / "lock").open("w") as lock:
                with contextlib.suppress(OSError):  # some network file systems have no locks
                    fcntl.flock(lock, fcntl.LOCK_EX)  # two concurrent additions to an index could choose the same name
                save(signature, result)


@functools.cache
def _structure(
    kinds: tuple[tuple[str, str, tuple[int, ...]], ...], messages: tuple[tuple[str, np.dtype[np.void]], ...]
) -> np.dtype[np.void]:
    """One dtype object per layout: numba recognises the same object at once, but compares an equal one field by field.

    That would take some microseconds for each argument of each call.
    """
    columns = [(name, np.dtype((kind, shape))) for name, kind, shape in kinds]
    offsets = np.cumsum([0, *(kind.itemsize for _, kind in columns)]).tolist()
    at = offsets.pop()
    for name, message in messages:
        columns += [(name, message), (f"{name}_bytes", np.dtype(("u1", (message.itemsize,))))]
        offsets += [at, at]  # the same memory twice: by field, and byte by byte
        at += message.itemsize
    return np.dtype(
        {"names": [name for name, _ in columns], "formats": [kind for _, kind in columns], "offsets": offsets}
    )


def pack(values: Mapping[str, Any], messages: Mapping[str, np.dtype[np.void]] | None = None) -> Packed:
    """Arrays, numbers and booleans by name, copied into one structured array of shape (1,).

    Calling a kernel from Python is much faster with one array than with a dozen. Inside a kernel the fields of `packed[0]`
    are read like those of a NamedTuple, so a function accepts both. A message NAME (the dtype of its payload) is accessible
    by field as NAME, and as bytes as NAME_bytes.
    """
    columns = [(name, np.asarray(value)) for name, value in values.items()]
    kinds = tuple((name, "i8" if array.dtype == bool else array.dtype.str, array.shape) for name, array in columns)
    packed = np.zeros(1, dtype=_structure(kinds, tuple((messages or {}).items())))
    for name, array in columns:
        packed[name][0] = array
    return packed


def views(packed: Packed) -> dict[str, npt.NDArray[Any]]:
    """The fields of a packed structure as arrays that share its memory, by name."""
    return {name: packed[name][0] for name in packed.dtype.names or ()}
