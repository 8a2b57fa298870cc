"""The folders of the compiled kernels, and whether they are complete; determined without loading numba.

numba detects a change of a kernel's own file, but not of a kernel in another file that it calls. The kernels of a module
are therefore stored in a folder named after the module's key: a digest of its source, of the sources of all modules
of the project that it imports, directly or indirectly, and of the compiler's version and settings. An edit of these gives a
new, empty folder, so a stale kernel is never run; an edit anywhere else recompiles nothing.

These folders contain code that will be run: a folder that another user owns or can write to is never used.
"""

from __future__ import annotations

import ast
import atexit
import contextlib
import functools
import hashlib
import importlib.util
import os
import platform
import shutil
import stat
import tempfile
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import msgspec
import platformdirs

PACKAGES = ("protocol", "bridge", "controller", "plant_emulator", "fwav_hil")
_ROOT = Path(__file__).resolve().parent.parent
_DECORATORS = {"protocol.compiled.compiled", "protocol.compiled.inlined"}
_KEPT_FOLDERS = 12
"""Of each module, 0.2 MB a piece: several checkouts may be in use, and edited."""
_MOST_REMEMBERED = 5000


class _Source(NamedTuple):
    """Digest of a module's name and source, and the dotted names that it imports."""

    digest: str
    imports: list[str]


def kernels_are_warm(*packages: str) -> bool:
    """Whether all kernels for a start of these packages are compiled from the present sources; see `mark_warm`."""
    return all(mark.exists() for mark in _marks(packages))


def mark_warm(*packages: str) -> None:
    """Record that all kernels for a start of these packages are in the cache, until they or their imports change."""
    with contextlib.suppress(OSError):  # for example a full disk: then the next start checks again
        for mark in _marks(packages):
            mark.touch()


@functools.cache
def kernel_folder(module: str, file: str = "") -> Path:
    """The folder of a module's compiled kernels; it is created if missing.

    file   the module's source; needed only for a module outside the project
    """
    sources = _sources_of_project()
    if module not in sources:
        sources = {**_sources_beside(module, Path(file)), **sources}
    digest = hashlib.sha256(_compiler().encode())
    for name in sorted(_closure([module], sources)):
        digest.update(sources[name].digest.encode())
    folder = _cache_place() / f"{module}-{digest.hexdigest()[:16]}"
    is_new = not folder.is_dir()
    if not _is_ours(folder):
        return Path(tempfile.mkdtemp(dir=_throwaway_place()))
    if is_new:
        _forget_old(folder, f"{module}-*")
    return folder


def _marks(packages: tuple[str, ...]) -> list[Path]:
    """One marker file for each module with kernels in the packages or their imports: these kernels have been compiled."""
    sources = _sources_of_project()
    within = tuple(f"{package}." for package in packages)
    reached = _closure((name for name in sources if f"{name}.".startswith(within)), sources)
    mark = "warm-" + "+".join(packages)
    return [kernel_folder(name) / mark for name in sorted(reached) if not _DECORATORS.isdisjoint(sources[name].imports)]


def _closure(names: Iterable[str], sources: Mapping[str, _Source]) -> set[str]:
    """The modules among `names`, all modules that they import, directly or indirectly, and the packages of these."""
    reached: set[str] = set()
    ahead = list(names)
    while ahead:
        name = ahead.pop()
        if name in sources and name not in reached:
            reached.add(name)
            ahead += [name.rpartition(".")[0], *sources[name].imports]
    return reached


@functools.cache
def _sources_of_project() -> dict[str, _Source]:
    """All modules of the project. Parsing is much slower than reading, so the imports of a source are cached by digest."""
    kept = _cache_place() / "imports.json"
    try:
        known = msgspec.json.decode(kept.read_bytes(), type=dict[str, list[str]])
    except (OSError, ValueError):
        known = {}
    sources = _read_sources(_ROOT, PACKAGES, known)
    fresh = {digest: imports for digest, imports in sources.values() if digest not in known}
    if fresh:
        partial = kept.with_suffix(f".{os.getpid()}")
        with contextlib.suppress(OSError):
            partial.write_bytes(msgspec.json.encode({**(known if len(known) < _MOST_REMEMBERED else {}), **fresh}))
            partial.replace(kept)
    return sources


def _sources_beside(module: str, file: Path) -> dict[str, _Source]:
    """A module outside the project, with the other modules of its package, or the files beside a single file."""
    depth = module.count(".") + (file.name == "__init__.py")
    tops = [module.partition(".")[0]] if depth else [beside.stem for beside in file.parent.glob("*.py")]
    return {**_read_sources(file.parents[depth], tops, {}), module: _read_source(module, file, {})}


def _read_sources(root: Path, tops: Iterable[str], known: Mapping[str, list[str]]) -> dict[str, _Source]:
    """The modules in `root` that are named in `tops`, or are in a package named there."""
    sources = {}
    for top in tops:
        if (root / f"{top}.py").is_file():
            sources[top] = _read_source(top, root / f"{top}.py", known)
        for folder, _, files in os.walk(root / top):
            package = folder[len(str(root)) + 1 :].replace(os.sep, ".")
            for file in files:
                if file.endswith(".py"):
                    module = package if file == "__init__.py" else f"{package}.{file[:-3]}"
                    sources[module] = _read_source(module, Path(folder, file), known)
    return sources


def _read_source(module: str, file: Path, known: Mapping[str, list[str]]) -> _Source:
    text = file.read_bytes()
    digest = hashlib.sha256(f"{module}\n".encode() + text).hexdigest()
    imports = known.get(digest)
    if imports is None:
        imports = _imported(module if file.name == "__init__.py" else module.rpartition(".")[0], text)
    return _Source(digest, imports)


def _imported(package: str, source: bytes) -> list[str]:
    """The dotted names (of modules and of their members) that a module in `package` imports while it is loaded."""
    names: set[str] = set()
    try:
        ahead: list[ast.AST] = [ast.parse(source)]
    except SyntaxError:
        return []  # importing it will raise the error
    while ahead:
        node = ahead.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            origin = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            names |= {origin, *(f"{origin}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            ahead += node.orelse
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.expr):
            ahead += ast.iter_child_nodes(node)
    return sorted(names)


@functools.cache
def _compiler() -> str:
    """Everything else that machine code depends on; numba itself also checks the processor's features."""
    versions = [version(name) for name in ("numba", "llvmlite", "numpy", "pymavlink")]
    settings = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("NUMBA_")]
    return "\n".join([platform.python_version(), platform.machine(), *_processor(), *versions, *settings])


def _processor() -> list[str]:
    """Model and features of the first processor, where the system provides them in a file."""
    try:
        first, _, _ = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").partition("\n\n")
    except OSError:
        return []
    return [line for line in first.splitlines() if line.startswith(("model name", "flags", "Features", "CPU "))]


@functools.cache
def _cache_place() -> Path:
    """The user's cache; if not writable, the system's temporary folder; else a folder that is removed at exit."""
    for place in (
        Path(platformdirs.user_cache_dir("fwav-hil")),
        Path(tempfile.gettempdir()) / f"fwav-hil-{os.geteuid()}",
    ):
        with contextlib.suppress(OSError):
            place.parent.mkdir(parents=True, exist_ok=True)
            if _is_ours(place) and _is_ours(place / "compiled"):
                return place / "compiled"
    return _throwaway_place()


@functools.cache
def _throwaway_place() -> Path:
    place = tempfile.mkdtemp(prefix="fwav-hil-")
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return Path(place)


def _is_ours(folder: Path) -> bool:
    """Whether only this user owns and can write to the folder, which is created if missing and marked as used."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()  # status of a symbolic link itself: its owner could change its target later
        os.utime(folder)
    except OSError:
        return False
    shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not shared and os.access(folder, os.W_OK)


def _forget_old(folder: Path, pattern: str) -> None:
    """Remove the folders of older sources, except the last used ones."""
    with contextlib.suppress(OSError):  # another process may be removing them at the same time
        others = sorted((f for f in folder.parent.glob(pattern) if f != folder), key=lambda f: f.stat().st_mtime)
        for old in others[: -(_KEPT_FOLDERS - 1)]:
            shutil.rmtree(old, ignore_errors=True)
