"""Compiled kernels (numba) and the cache they are kept in.

numba notices that a kernel's own file changed, but not that a kernel it calls in another file did. The cache folder is
therefore named after a digest of every source file of the project and of the compiler's versions: a change anywhere
gives a new, empty folder, so neither a developer nor an upgrade ever runs a stale kernel.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt
import platformdirs

Packed: TypeAlias = npt.NDArray[np.void]
"""A structured array of shape (1,), as `pack` makes them."""

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

PACKAGES = ("protocol", "bridge", "controller", "plant_emulator", "fwav_hil")
_KEPT_FOLDERS = 4


@functools.cache
def cache_folder() -> Path:
    """Folder of the compiled kernels of exactly these sources; created on first use.

    Where the user's cache place cannot be written, a folder under the system's temporary place is used instead.
    """
    digest = hashlib.sha256(f"{numba.__version__} {np.__version__}".encode())
    root = Path(__file__).resolve().parent.parent
    for package in PACKAGES:
        for source in sorted((root / package).rglob("*.py")):
            digest.update(source.relative_to(root).as_posix().encode())
            digest.update(source.read_bytes())
    name = digest.hexdigest()[:16]
    for place in (
        Path(platformdirs.user_cache_dir("fwav-hil")),
        Path(tempfile.gettempdir()) / f"fwav-hil-{os.getuid()}",
    ):
        folder = place / "kernels" / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(folder)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            _forget_old(folder)
            return folder
    return Path(tempfile.mkdtemp(prefix="fwav-hil-"))


def _forget_old(folder: Path) -> None:
    """Remove the folders of older sources, keeping the few used last (several checkouts may be in use)."""
    with contextlib.suppress(OSError):  # the process at the other end may be tidying up at the same time
        others = sorted((f for f in folder.parent.iterdir() if f != folder), key=lambda f: f.stat().st_mtime)
        for old in others[: -(_KEPT_FOLDERS - 1)]:
            shutil.rmtree(old, ignore_errors=True)


def kernels_are_warm() -> bool:
    """Whether a process has compiled every kernel into the cache of these sources (see `mark_warm`)."""
    return (cache_folder() / "warm").exists()


def mark_warm() -> None:
    """Record that every kernel has been compiled, so that the next start need not look."""
    (cache_folder() / "warm").touch()


def compiled(function: Kernel) -> Kernel:
    """Compile `function` with numba when it is first called, and keep the result in the cache of these sources.

    No fast-math: the same expression must give the same bits in the control process and in `simulate`.
    """
    return _compile(function, forceinline=False)


def inlined(function: Kernel) -> Kernel:
    """As `compiled`, but part of each kernel that calls it.

    For the innermost loops: a call that hands arrays over costs as much as copying a short frame.
    """
    return _compile(function, forceinline=True)


def _compile(function: Kernel, *, forceinline: bool) -> Kernel:
    config: Any = numba.config
    place = config.CACHE_DIR
    config.CACHE_DIR = str(cache_folder())  # read by numba while it decorates, and nowhere later
    try:
        return cast("Kernel", numba.njit(cache=True, error_model="numpy", forceinline=forceinline)(function))
    finally:
        config.CACHE_DIR = place


@functools.cache
def _structure(kinds: tuple[tuple[str, str, tuple[int, ...]], ...]) -> np.dtype[np.void]:
    """One dtype object for each layout: numba knows the one it has met at once, but compares an equal one field by field.

    That costs some microseconds for each argument of each call.
    """
    return np.dtype(list(kinds))


def pack(values: Mapping[str, Any]) -> Packed:
    """Arrays, numbers and truth values by name, copied into one structured array of shape (1,).

    A kernel that is called from Python takes one array at once far sooner than a dozen. Inside a kernel `packed[0]` is
    read by the same names as a NamedTuple's fields, so a function takes either.
    """
    columns = [(name, np.asarray(value)) for name, value in values.items()]
    kinds = tuple((name, "i8" if array.dtype == bool else array.dtype.str, array.shape) for name, array in columns)
    packed = np.zeros(1, dtype=_structure(kinds))
    for name, array in columns:
        packed[name][0] = array
    return packed


def views(packed: Packed) -> dict[str, npt.NDArray[Any]]:
    """The fields of a packed structure as arrays that share its memory, by name."""
    return {name: packed[name][0] for name in packed.dtype.names or ()}
