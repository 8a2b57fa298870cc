"""Kernels and their packed arguments."""

from __future__ import annotations

import errno
import fcntl
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numba
import numpy as np
import pytest
from numba.core import caching

from protocol import compiled as ours
from tests.protocol.source_tree import load_compiled as load

NUMBA_CONFIG: Any = numba.config


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
    def test_a_kernel_is_kept_in_its_modules_folder_and_numbas_own_place_stays(
        self, tree: Path, numba_cache_dir: str
    ) -> None:
        module = load(tree)
        kernel = module.compiled(double)
        assert numba_cache_dir == NUMBA_CONFIG.CACHE_DIR
        assert kernel(21.0) == 42.0
        assert list(module.kernel_folder(__name__, __file__).glob("*double*.nbi"))
        assert not Path(numba_cache_dir).exists()

    def test_a_checkout_elsewhere_with_the_same_sources_finds_it(self, tree: Path, places: Path) -> None:
        """Else the mark that all kernels are there would not be true of the second checkout."""
        shutil.copytree(tree, places / "elsewhere")
        for root, hits in ((tree, 0), (places / "elsewhere", 1)):
            kernel = load(root).compiled(double)
            assert kernel(21.0) == 42.0
            assert sum(kernel.stats.cache_hits.values()) == hits

    def test_what_is_no_function_is_refused(self, tree: Path) -> None:
        with pytest.raises(TypeError):
            load(tree).compiled("no function")

    def test_division_by_zero_is_infinite_and_no_exception(self, tree: Path) -> None:
        kernel = load(tree).compiled(lambda a, b: a / b)
        assert kernel(1.0, 0.0) == float("inf")

    def test_a_changed_callee_in_another_file_is_never_stale(self, tree: Path) -> None:
        """What the keys are for: numba by itself looks at the caller's file only. Each value is a process's."""
        (tree / "plant_emulator" / "outer_kernel.py").write_text(OUTER)
        values = []
        for factor in (2.0, 2.0, 3.0, 2.0):
            (tree / "protocol" / "inner_kernel.py").write_text(INNER.format(factor=factor))
            program = (
                "from plant_emulator.outer_kernel import outer; print(outer(10.0), outer.stats.cache_hits.total())"
            )
            said = subprocess.run(
                [sys.executable, "-B", "-c", program], cwd=tree, check=True, capture_output=True, text=True
            ).stdout.split()
            values.append((float(said[0]), int(said[1])))
        assert values == [(22.0, 0), (22.0, 1), (32.0, 0), (22.0, 1)]


INNER = """
from protocol.compiled import compiled

@compiled
def inner(value: float) -> float:
    return {factor} * value
"""
OUTER = """
from protocol.compiled import compiled
from protocol.inner_kernel import inner

@compiled
def outer(value: float) -> float:
    return inner(value) + 2.0
"""


class TestEntryPoint:
    def test_it_computes_what_the_kernel_does(self) -> None:
        kernel = ours.compiled(double)
        assert ours.entry_point(kernel, 1.0)(21.0) == kernel(21.0) == 42.0

    def test_the_number_of_arguments_is_checked(self) -> None:
        with pytest.raises(TypeError, match="expected 1 argument"):
            ours.entry_point(ours.compiled(double), 1.0)(1.0, 2.0)  # type: ignore[call-arg]

    def test_without_numba_it_is_the_function(self) -> None:
        assert ours.entry_point(double, 1.0) is double


class TestTroubledCache:
    @pytest.mark.parametrize("ending", [".nbi", ".nbc"])
    @pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
    def test_a_half_written_entry_is_compiled_again_and_mended(self, tree: Path, ending: str, share: float) -> None:
        module = load(tree)
        assert module.compiled(double)(21.0) == 42.0
        (entry,) = module.kernel_folder(__name__, __file__).glob(f"*{ending}")
        data = entry.read_bytes()
        entry.write_bytes(data[: int(share * len(data))])
        for hits in (0, 1):
            kernel = load(tree).compiled(double)
            assert kernel(21.0) == 42.0
            assert sum(kernel.stats.cache_hits.values()) == hits

    @pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EROFS])
    def test_a_disk_that_refuses_is_no_error(self, tree: Path, number: int, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object) -> None:
            raise OSError(number, "refused")

        module = load(tree)
        monkeypatch.setattr(caching.IndexDataCacheFile, "save", refuse)
        assert module.compiled(double)(21.0) == 42.0
        assert not list(module.kernel_folder(__name__, __file__).glob("*.nb?"))

    def test_a_folder_tidied_up_meanwhile_is_made_again(self, tree: Path) -> None:
        module = load(tree)
        kernel = module.compiled(double)
        folder = module.kernel_folder(__name__, __file__)
        shutil.rmtree(folder)
        assert kernel(21.0) == 42.0
        assert list(folder.glob("*.nbi"))
        assert folder.stat().st_mode & 0o777 == 0o700

    def test_only_one_process_at_a_time_adds_to_a_folder(self, tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """numba reads the index, chooses a free name and writes both: two at once could choose the same."""
        refused: list[bool] = []
        true_save: Any = caching.IndexDataCacheFile.save

        def save(file: Any, key: object, data: object) -> None:
            with (Path(file._cache_path) / "lock").open("w") as other:
                try:
                    fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    refused.append(False)
                except BlockingIOError:
                    refused.append(True)
            true_save(file, key, data)

        monkeypatch.setattr(caching.IndexDataCacheFile, "save", save)
        assert load(tree).compiled(double)(21.0) == 42.0
        assert refused == [True]

    def test_processes_that_compile_at_once_all_keep_what_they_made(self, tree: Path) -> None:
        (tree / "protocol" / "twice.py").write_text(
            "from protocol.compiled import compiled\n@compiled\ndef twice(value):\n    return value + value\n"
        )
        program = "import sys; from protocol.twice import twice; value = eval(sys.argv[1]); "
        program += "print(twice(value), twice.stats.cache_hits.total())"
        doubled = {"1": "2", "1.0": "2.0", "True": "2", "1j": "2j", "(1,)": "(1, 1)"}
        for hits in (0, 1):
            running = [
                subprocess.Popen([sys.executable, "-c", program, value], cwd=tree, stdout=subprocess.PIPE, text=True)
                for value in doubled
            ]
            said = [process.communicate()[0].strip() for process in running]
            assert said == [f"{expected} {hits}" for expected in doubled.values()]


def test_kernels_need_no_linear_algebra_of_scipy(tmp_path: Path) -> None:
    """Which would be a third of a second at every start; a program's own kernels still get it where they ask for it."""
    (tmp_path / "program.py").write_text("""
import sys
from protocol.compiled import compiled

@compiled
def total(values):
    return values.sum()

import numpy as np
print(total(np.ones(3)), "scipy.linalg" in sys.modules)
import scipy.linalg.cython_blas
import numba
print(numba.njit(lambda a: np.dot(a, a))(np.ones((2, 2)))[0, 0])
""")
    told = subprocess.run(
        [sys.executable, str(tmp_path / "program.py")], check=True, capture_output=True, text=True
    ).stdout.split()
    assert told == ["3.0", "False", "2.0"]
