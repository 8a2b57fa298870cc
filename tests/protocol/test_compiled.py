"""Kernels and their packed arguments."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numba
import numpy as np
import pytest

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
