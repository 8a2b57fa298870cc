"""A small tree of sources with copies of the modules that keep kernels, and how to load those as a new process would."""

from __future__ import annotations

import importlib.util
import itertools
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from protocol import compiled, kernel_cache

_COPIED = (compiled, kernel_cache)
_numbers = itertools.count()

KERNEL = "from protocol.compiled import compiled\n"
SOURCES = {
    "protocol.rotations": KERNEL,
    "plant_emulator.plant.body": f"{KERNEL}from protocol.rotations import turn\n",
    "plant_emulator.tick": f"{KERNEL}import plant_emulator.plant.body as body\n",
    "controller.laws.law": KERNEL,
    "controller.process": "from controller.laws import law\n",
    "fwav_hil.cli": "from controller import process\n",
}
"""A project in small: rotations are used by the body, which the emulator's tick uses; the law does without."""


def make_tree(root: Path, sources: Mapping[str, str] = SOURCES) -> Path:
    """A project of these modules, and copies of the modules under test."""
    for package in kernel_cache.PACKAGES:
        (root / package).mkdir(parents=True)
        (root / package / "__init__.py").touch()
    for module, text in sources.items():
        source = source_of(root, module)
        source.parent.mkdir(exist_ok=True)
        (source.parent / "__init__.py").touch()
        source.write_text(text)
    for copied in _COPIED:
        shutil.copy(str(copied.__file__), root / "protocol")
    return root


def source_of(root: Path, module: str) -> Path:
    """The file of a module in a tree."""
    return root.joinpath(*module.split(".")).with_suffix(".py")


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
