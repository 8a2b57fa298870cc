"""Where compiled kernels are kept, and whether they are there; numba is not loaded to know it.

numba notices that a kernel's own file changed, but not that a kernel it calls in another file did. The kernels of a module
are therefore kept in a folder that is named after the module's key: a digest of its source, of the sources of all modules
of the project that it imports, directly or not, and of what compiles them. An edit there gives a new, empty folder, so
no stale kernel is ever run; an edit anywhere else recompiles nothing.

What lies in these folders is code that will be run: a folder that another user owns or can write to is never used.
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
    """The digest of a module's name and source, and the dotted names that it imports."""

    digest: str
    imports: list[str]


def kernels_are_warm(*packages: str) -> bool:
    """Whether a start of these packages finds all that it needs compiled from the present sources; see `mark_warm`."""
    return all(mark.exists() for mark in _marks(packages))


def mark_warm(*packages: str) -> None:
    """Record that every kernel which a start of these packages needs is in the cache, until they or their imports change."""
    with contextlib.suppress(OSError):  # a full disk, say: then the next start looks
        for mark in _marks(packages):
            mark.touch()


@functools.cache
def kernel_folder(module: str, file: str = "") -> Path:
    """The folder of a module's compiled kernels; made where there is none.

    file   the module's source; needed only of a module outside the project
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
    """One file for each module with kernels that the packages hold or import: it says that these have been compiled."""
    sources = _sources_of_project()
    within = tuple(f"{package}." for package in packages)
    reached = _closure((name for name in sources if f"{name}.".startswith(within)), sources)
    mark = "warm-" + "+".join(packages)
    return [kernel_folder(name) / mark for name in sorted(reached) if not _DECORATORS.isdisjoint(sources[name].imports)]


def _closure(names: Iterable[str], sources: Mapping[str, _Source]) -> set[str]:
    """Those of these names that are modules, all that they import, directly or not, and the packages that these are in."""
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
    """Every module of the project. Parsing costs far more than reading: what a source imports is kept, by its digest."""
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
    """A module outside the project, and the others of its package; of a single file, the files beside it."""
    depth = module.count(".") + (file.name == "__init__.py")
    tops = [module.partition(".")[0]] if depth else [beside.stem for beside in file.parent.glob("*.py")]
    return {**_read_sources(file.parents[depth], tops, {}), module: _read_source(module, file, {})}


def _read_sources(root: Path, tops: Iterable[str], known: Mapping[str, list[str]]) -> dict[str, _Source]:
    """The modules in `root` that are named `tops`, or lie in a package of such a name."""
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
    """The dotted names, of modules and of things in modules, that a module in `package` imports while it is loaded."""
    names: set[str] = set()
    try:
        ahead: list[ast.AST] = [ast.parse(source)]
    except SyntaxError:
        return []  # importing it will say so
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
    """What machine code depends on besides the source; numba itself looks at the processor's features once more."""
    versions = [version(name) for name in ("numba", "llvmlite", "numpy", "pymavlink")]
    settings = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("NUMBA_")]
    return "\n".join([platform.python_version(), platform.machine(), *_processor(), *versions, *settings])


def _processor() -> list[str]:
    """Model and features of the first processor, where the system shows them in a file."""
    try:
        first, _, _ = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").partition("\n\n")
    except OSError:
        return []
    return [line for line in first.splitlines() if line.startswith(("model name", "flags", "Features", "CPU "))]


@functools.cache
def _cache_place() -> Path:
    """The user's cache; where that cannot be written, the system's temporary place; else one that ends with this process."""
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
    """Whether the folder, made if need be and marked as used, belongs to this user, who alone can write to it."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()  # of a link itself: whoever made it could point it elsewhere later
        os.utime(folder)
    except OSError:
        return False
    shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not shared and os.access(folder, os.W_OK)


def _forget_old(folder: Path, pattern: str) -> None:
    """Remove the folders of older sources, keeping the few used last."""
    with contextlib.suppress(OSError):  # another process may be tidying up at the same time
        others = sorted((f for f in folder.parent.glob(pattern) if f != folder), key=lambda f: f.stat().st_mtime)
        for old in others[: -(_KEPT_FOLDERS - 1)]:
            shutil.rmtree(old, ignore_errors=True)
