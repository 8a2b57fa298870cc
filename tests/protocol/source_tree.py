"""A small tree of sources with copies of the modules that keep kernels, and how to load those as a new process would."""

from __future__ import annotations

import importlib.util
import itertools
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from protocol import compiled, kernel_cache

_COPIED = (compiled, kernel_cache)
_numbers = itertools.count()


def make_tree(root: Path) -> Path:
    """A project with one source in each package, and copies of the modules under test."""
    for package in kernel_cache.PACKAGES:
        (root / package / "deep").mkdir(parents=True)
        (root / package / "__init__.py").touch()
        (root / package / "deep" / "kernel.py").write_text("ANSWER = 41\n")
    for module in _COPIED:
        shutil.copy(str(module.__file__), root / "protocol")
    return root


def load_kernel_cache(tree: Path) -> Any:
    """`protocol.kernel_cache` of that tree."""
    return _load(tree / "protocol" / "kernel_cache.py")


def load_compiled(tree: Path) -> Any:
    """`protocol.compiled` of that tree, with its own cache."""
    name = "protocol.kernel_cache"
    ours = sys.modules[name]
    sys.modules[name] = load_kernel_cache(tree)
    try:
        return _load(tree / "protocol" / "compiled.py")
    finally:
        sys.modules[name] = ours


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"{path.stem}_copy_{next(_numbers)}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
