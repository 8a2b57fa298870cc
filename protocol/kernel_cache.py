"""The folder that compiled kernels are kept in; numba is not loaded to know it.

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
from importlib.metadata import version
from pathlib import Path

import platformdirs

PACKAGES = ("protocol", "bridge", "controller", "plant_emulator", "fwav_hil")
_KEPT_FOLDERS = 4


@functools.cache
def cache_folder() -> Path:
    """Folder of the compiled kernels of exactly these sources; created on first use.

    Where the user's cache place cannot be written, a folder under the system's temporary place is used instead.
    """
    digest = hashlib.sha256(" ".join(version(name) for name in ("numba", "llvmlite", "numpy")).encode())
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
