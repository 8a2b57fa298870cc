"""The cache of compiled kernels, on small trees of sources: a change anywhere gives another folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from protocol import kernel_cache as ours
from tests.protocol.source_tree import load_kernel_cache as load

DIGEST_LENGTH = 16


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

    @pytest.mark.parametrize("library", ["numba", "llvmlite", "numpy"])
    def test_another_compiler_gives_another_folder(
        self, tree: Path, library: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before = load(tree).cache_folder()
        module = load(tree)
        monkeypatch.setattr(module, "version", lambda name: "0.0.0" if name == library else version(name))
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


def test_to_know_whether_the_kernels_are_there_loads_neither_numba_nor_numpy() -> None:
    program = "import sys; from protocol.kernel_cache import kernels_are_warm as warm; warm(); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.split()
    assert "protocol.kernel_cache" in loaded
    assert not {"numba", "numpy"} & set(loaded)
