"""The cache of compiled kernels, on small trees of sources: a change anywhere gives another folder."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numba
import numpy as np
import pytest

from protocol import compiled as ours

NUMBA_CONFIG: Any = numba.config
_numbers = itertools.count()
DIGEST_LENGTH = 16


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache and the system's temporary place, both within tmp_path."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path


@pytest.fixture
def tree(places: Path) -> Path:
    """A project with one source in each package, and a copy of the module under test."""
    root = places / "tree"
    for package in ours.PACKAGES:
        (root / package / "deep").mkdir(parents=True)
        (root / package / "__init__.py").touch()
        (root / package / "deep" / "kernel.py").write_text("ANSWER = 41\n")
    shutil.copy(str(ours.__file__), root / "protocol" / "compiled.py")
    return root


def load(tree: Path) -> Any:
    """The module of that tree, as a new process would have it."""
    name = f"compiled_copy_{next(_numbers)}"
    spec = importlib.util.spec_from_file_location(name, tree / "protocol" / "compiled.py")
    assert spec is not None
    assert spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class TestFolder:
    def test_equal_sources_share_a_folder_in_the_users_cache(self, tree: Path, places: Path) -> None:
        folder = load(tree).cache_folder()
        assert folder.is_dir()
        assert folder.is_relative_to(places / "cache" / "fwav-hil")
        assert len(folder.name) == DIGEST_LENGTH
        for source in tree.rglob("*.py"):
            os.utime(source, (1, 1))  # a fresh checkout: other times, same bytes
        assert load(tree).cache_folder() == folder

    def test_the_place_of_the_tree_does_not_matter(self, tree: Path, places: Path) -> None:
        folder = load(tree).cache_folder()
        shutil.copytree(tree, places / "elsewhere")
        assert load(places / "elsewhere").cache_folder() == folder

    @pytest.mark.parametrize("package", ours.PACKAGES)
    def test_a_change_in_any_package_gives_another_folder(self, tree: Path, package: str) -> None:
        before = load(tree).cache_folder()
        (tree / package / "deep" / "kernel.py").write_text("ANSWER = 42\n")
        after = load(tree).cache_folder()
        assert after != before
        assert not list(after.iterdir())
        (tree / package / "deep" / "kernel.py").write_text("ANSWER = 41\n")
        assert load(tree).cache_folder() == before

    def test_a_source_that_comes_goes_or_moves_gives_another_folder(self, tree: Path) -> None:
        deep = tree / "controller" / "deep"
        folders = [load(tree).cache_folder()]
        (deep / "more.py").touch()
        folders.append(load(tree).cache_folder())
        (deep / "more.py").rename(deep / "other.py")
        folders.append(load(tree).cache_folder())
        (deep / "kernel.py").unlink()
        folders.append(load(tree).cache_folder())
        assert len(set(folders)) == len(folders)

    @pytest.mark.parametrize("library", ["numba", "np"])
    def test_another_compiler_gives_another_folder(
        self, tree: Path, library: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before = load(tree).cache_folder()
        module = load(tree)
        monkeypatch.setattr(getattr(module, library), "__version__", "0.0.0")
        assert module.cache_folder() != before

    def test_all_packages_of_the_project_count(self) -> None:
        root = Path(str(ours.__file__)).parents[1]
        with_kernels = {
            source.relative_to(root).parts[0]
            for source in root.glob("[a-z]*/**/*.py")
            if "@compiled" in source.read_text(encoding="utf-8")
        } - {"tests", "benchmarks"}
        assert "protocol" in with_kernels
        assert with_kernels <= set(ours.PACKAGES)


class TestFallback:
    # A file where a folder must be: that stops root, too, under whom tests may run.
    def test_where_the_users_cache_cannot_be_written_the_temporary_place_serves(self, tree: Path, places: Path) -> None:
        (places / "cache").write_text("in the way")
        folder = load(tree).cache_folder()
        assert folder.is_dir()
        assert folder.is_relative_to(places / "temporary" / f"fwav-hil-{os.getuid()}")
        assert load(tree).cache_folder() == folder

    def test_a_cache_that_may_be_read_only_is_passed_over(
        self, tree: Path, places: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def allows(path: Path, mode: int) -> bool:
            return not (mode & os.W_OK and path.is_relative_to(places / "cache"))

        monkeypatch.setattr(os, "access", allows)
        assert load(tree).cache_folder().is_relative_to(places / "temporary")

    def test_where_nothing_lasts_a_folder_of_its_own_serves(self, tree: Path, places: Path) -> None:
        (places / "cache").write_text("in the way")
        (places / "temporary" / f"fwav-hil-{os.getuid()}").write_text("in the way")
        module = load(tree)
        folder = module.cache_folder()
        assert folder.is_dir()
        assert folder.is_relative_to(places / "temporary")
        assert module.cache_folder() == folder
        assert load(tree).cache_folder() != folder


class TestTidying:
    def test_the_folders_used_last_are_kept_and_the_older_ones_go(self, tree: Path) -> None:
        kernels = load(tree).cache_folder().parent
        for age in range(1, 8):
            old = kernels / f"used-{age}-days-ago"
            old.mkdir()
            (old / "kernel.nbi").touch()
            os.utime(old, (10**9 - 86400 * age,) * 2)
        current = load(tree).cache_folder()
        assert {folder.name for folder in kernels.iterdir()} == {
            current.name,
            "used-1-days-ago",
            "used-2-days-ago",
            "used-3-days-ago",
        }

    def test_using_a_folder_makes_it_young_again(self, tree: Path) -> None:
        folder = load(tree).cache_folder()
        os.utime(folder, (1, 1))
        assert load(tree).cache_folder() == folder
        assert folder.stat().st_mtime > 10**9

    def test_a_folder_that_vanishes_meanwhile_is_no_error(self, tree: Path) -> None:
        # The process at the other end starts at the same moment and tidies up as well: what was listed is not there.
        folder = load(tree).cache_folder()
        (folder.parent / "gone").symlink_to(folder.parent / "nowhere")
        assert load(tree).cache_folder() == folder

    def test_warmth_belongs_to_the_folder(self, tree: Path) -> None:
        module = load(tree)
        assert not module.kernels_are_warm()
        module.mark_warm()
        assert module.kernels_are_warm()
        assert load(tree).kernels_are_warm()
        (tree / "bridge" / "deep" / "kernel.py").write_text("ANSWER = 42\n")
        assert not load(tree).kernels_are_warm()


@pytest.fixture
def numba_cache_dir(tmp_path: Path) -> Iterator[str]:
    """A place that the user gave numba for kernels of his own."""
    before = NUMBA_CONFIG.CACHE_DIR
    NUMBA_CONFIG.CACHE_DIR = str(tmp_path / "the-users")
    yield str(tmp_path / "the-users")
    NUMBA_CONFIG.CACHE_DIR = before


def double(value: float) -> float:
    return 2.0 * value


class TestPacking:
    VALUES: ClassVar[dict[str, Any]] = {
        "q": np.arange(6.0),
        "due": np.array([5, 6]),
        "ready": True,
        "count": 2,
        "mass": 0.5,
    }

    def test_what_is_packed_is_read_by_the_same_names(self) -> None:
        packed = ours.pack(self.VALUES)
        assert packed.shape == (1,)
        assert list(ours.views(packed)) == list(self.VALUES)
        for name, value in self.VALUES.items():
            assert np.array_equal(packed[0][name], value)
            assert np.array_equal(ours.views(packed)[name], value)

    def test_the_values_are_copied_and_the_views_are_not(self) -> None:
        q = np.zeros(3)
        packed = ours.pack({"q": q, "more": 1.0})
        q[0] = 1.0
        assert packed[0]["q"][0] == 0.0
        ours.views(packed)["q"][1] = 2.0
        assert packed[0]["q"][1] == 2.0

    def test_a_kernel_reads_and_writes_them_by_name(self, tree: Path) -> None:
        packed = ours.pack(self.VALUES)
        assert load(tree).compiled(use_packed)(packed) == 5.0 + 6 * 0.5 + 1.0 + 2.0
        assert packed[0]["q"][0] == -1.0

    def test_nothing_packed_is_nothing_to_see(self) -> None:
        assert ours.views(ours.pack({})) == {}


def use_packed(packed: Any) -> float:
    record = packed[0]
    record.q[0] = -1.0
    return float(record.q[5] + record.due[1] * record.mass + record.ready + record.count)


class TestKernels:
    def test_a_kernel_is_kept_in_the_folder_and_numbas_own_setting_stays(
        self, tree: Path, numba_cache_dir: str
    ) -> None:
        module = load(tree)
        kernel = module.compiled(double)
        assert numba_cache_dir == NUMBA_CONFIG.CACHE_DIR
        assert kernel(21.0) == 42.0
        assert list(module.cache_folder().rglob("*double*.nbi"))
        assert not Path(numba_cache_dir).exists()

    def test_the_setting_stays_when_compiling_fails(self, tree: Path, numba_cache_dir: str) -> None:
        with pytest.raises(TypeError):
            load(tree).compiled("no function")
        assert numba_cache_dir == NUMBA_CONFIG.CACHE_DIR

    def test_division_by_zero_is_infinite_and_no_exception(self, tree: Path) -> None:
        kernel = load(tree).compiled(lambda a, b: a / b)
        assert kernel(1.0, 0.0) == float("inf")

    def test_a_changed_callee_in_another_file_is_never_stale(self, tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """What the folders are for: numba by itself looks at the caller's file only."""
        monkeypatch.setattr(sys, "dont_write_bytecode", True)  # Python's own cache goes by whole seconds
        monkeypatch.syspath_prepend(tree / "plant_emulator")
        (tree / "plant_emulator" / "outer_kernel.py").write_text(OUTER)
        values = []
        for factor in (2.0, 2.0, 3.0, 2.0):
            (tree / "plant_emulator" / "inner_kernel.py").write_text(INNER.format(factor=factor))
            # As in a new process: nothing is imported yet.
            monkeypatch.setitem(sys.modules, "compiled_copy", load(tree))
            for name in ("inner_kernel", "outer_kernel"):
                monkeypatch.delitem(sys.modules, name, raising=False)
            values.append(importlib.import_module("outer_kernel").outer(10.0))
        assert values == [22.0, 22.0, 32.0, 22.0]


INNER = """
from compiled_copy import compiled

@compiled
def inner(value: float) -> float:
    return {factor} * value
"""
OUTER = """
from compiled_copy import compiled
from inner_kernel import inner

@compiled
def outer(value: float) -> float:
    return inner(value) + 2.0
"""
