"""Compiled kernels (numba), and the packed arguments that they take."""

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
"""A structured array of shape (1,), as `pack` makes them."""

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def _load_numpy_support() -> None:
    """Load numba's support of NumPy, which it needs for every kernel, without SciPy's linear algebra.

    It would be imported only to see whether there is a BLAS, for `np.convolve` in kernels: a third of a second at every
    start. No kernel here has one.
    """
    name = "scipy.linalg.cython_blas"
    if name in sys.modules or "numba.np.arraymath" in sys.modules:
        return
    sys.modules[name] = None  # type: ignore[assignment]  # this is how importing it is made to fail
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[name]


_load_numpy_support()


def compiled(function: Kernel) -> Kernel:
    """Compile `function` with numba when it is first called, and keep the result in the cache (`kernel_cache`).

    No fast-math: the same expression must give the same bits in the control process and in `simulate`.
    """
    return _compile(function, forceinline=False)


def inlined(function: Kernel) -> Kernel:
    """As `compiled`, but part of each kernel that calls it.

    For the innermost loops: a call that hands arrays over costs as much as copying a short frame.
    """
    return _compile(function, forceinline=True)


def _compile(function: Kernel, *, forceinline: bool) -> Kernel:
    kernel: Any = numba.njit(error_model="numpy", forceinline=forceinline)(function)
    make_cache: Any = _Cache
    kernel._cache = make_cache(function)  # what `cache=True` sets, with folders of our own
    return cast("Kernel", kernel)


class _Locator(caching._CacheLocator):
    """Where the machine code of one function lies: in the folder of its module's key, so it is never stale."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._folder = kernel_folder(function.__module__, file)
        self._line = function.__code__.co_firstlineno
        self._py_file = file  # numba names it in warnings

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator | None:
        return cls(function, file) if Path(file).exists() else None

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(mode=0o700, exist_ok=True)  # another process may have tidied it up

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Implementation(caching.CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_Locator]  # noqa: RUF012  # as numba declares it


class _Cache(caching.FunctionCache):
    """numba's cache of one function; it bears with damaged entries, full disks, and processes that compile at once."""

    _impl_class = _Implementation

    def load_overload(self, signature: Any, target: Any) -> Any:
        load: Any = super().load_overload
        flush: Any = self.flush
        try:
            return load(signature, target)
        except Exception:  # noqa: BLE001  # whatever unpickling raises: the machine lost power while it was written, say
            with contextlib.suppress(OSError):
                flush()
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        save: Any = super().save_overload
        with contextlib.suppress(OSError):  # what cannot be kept is compiled again
            self._impl.locator.ensure_cache_path()
            with (Path(self.cache_path) / "lock").open("w") as lock:
                with contextlib.suppress(OSError):  # there are network file systems without locks
                    fcntl.flock(lock, fcntl.LOCK_EX)  # two that add to one index at a time could choose the same name
                save(signature, result)


@functools.cache
def _structure(
    kinds: tuple[tuple[str, str, tuple[int, ...]], ...], messages: tuple[tuple[str, np.dtype[np.void]], ...]
) -> np.dtype[np.void]:
    """One dtype object for each layout: numba knows the one it has met at once, but compares an equal one field by field.

    That costs some microseconds for each argument of each call.
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
    """Arrays, numbers and truth values by name, copied into one structured array of shape (1,).

    A kernel that is called from Python takes one array at once far sooner than a dozen. Inside a kernel `packed[0]` is
    read by the same names as a NamedTuple's fields, so a function takes either. A message NAME (the dtype of its payload) is
    there as NAME, field by field, and as NAME_bytes.
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
