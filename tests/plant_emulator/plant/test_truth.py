"""Ground truth on disk: whole after every flush, whatever happens next."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from plant_emulator.plant.integrate import Plant, fill_row
from plant_emulator.plant.truth import ROW, TruthWriter, load_truth
from protocol.errors import RunFolderError
from protocol.scenario import find_scenario, load_scenario

BLOCK = 1024
"""Rows after which the writer flushes by itself."""


@pytest.fixture(scope="module")
def plant() -> Plant:
    return Plant(load_scenario(find_scenario("flapper")))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ground_truth.npy"


def append(writer: TruthWriter, plant: Plant, ticks: range) -> None:
    """Rows whose every number tells its tick and its column apart."""
    state = plant.state
    for k in ticks:
        state.motion[:] = 1000.0 * k + np.arange(12)
        state.tau[:] = 1000.0 * k + 100.0 + np.arange(6)
        state.u[:] = 1000.0 * k + 200.0 + np.arange(6)
        row = np.full(31, np.nan)
        fill_row(state, 1000.0 * k + 300.0 + np.arange(6.0), row)
        writer.append(4_000_000 * k, row)


def assert_rows(path: Path, count: int) -> None:
    rows = np.load(path)
    assert rows.dtype == ROW
    k = np.arange(count)
    assert rows["t_ns"].tolist() == (4_000_000 * k).tolist()
    for field, offset in (("q", 0.0), ("q_dot", 6.0), ("command", 300.0), ("tau", 100.0), ("u", 200.0)):
        assert rows[field].tolist() == (1000.0 * k[:, None] + offset + np.arange(6)).tolist()
    assert load_truth(path).tobytes() == rows.tobytes()


def test_the_file_can_be_read_after_every_flush(path: Path, plant: Plant) -> None:
    with TruthWriter(path) as writer:
        assert_rows(path, 0)
        for start, end in ((0, 1), (1, 10), (10, 10), (10, 2000)):
            append(writer, plant, range(start, end))
            writer.flush()
            assert_rows(path, end)
    assert_rows(path, 2000)


def test_what_is_not_flushed_is_written_at_the_end(path: Path, plant: Plant) -> None:
    with TruthWriter(path) as writer:
        append(writer, plant, range(3))
        assert_rows(path, 0)
    assert_rows(path, 3)


def test_an_error_in_the_run_leaves_the_rows_so_far(path: Path, plant: Plant) -> None:
    with pytest.raises(ZeroDivisionError), TruthWriter(path) as writer:
        append(writer, plant, range(5))
        raise ZeroDivisionError
    assert_rows(path, 5)


def test_a_full_block_is_written_by_itself(path: Path, plant: Plant) -> None:
    with TruthWriter(path) as writer:
        append(writer, plant, range(BLOCK - 1))
        assert_rows(path, 0)
        append(writer, plant, range(BLOCK - 1, BLOCK + 1))
        assert_rows(path, BLOCK)


def test_the_header_grows_in_place(path: Path, plant: Plant) -> None:
    """It has the same length for any count, so that no row ever has to move."""
    with TruthWriter(path) as writer:
        header = path.stat().st_size
        for start, end in ((0, 1), (1, 11), (11, 1200)):
            append(writer, plant, range(start, end))
            writer.flush()
            assert path.stat().st_size == header + end * ROW.itemsize


def test_closing_twice_is_closing_once(path: Path, plant: Plant) -> None:
    writer = TruthWriter(path)
    append(writer, plant, range(2))
    writer.close()
    writer.close()
    assert_rows(path, 2)


@pytest.mark.parametrize("name", ["missing/ground_truth.npy", "."])
def test_a_path_that_cannot_be_written_is_a_named_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(RunFolderError, match="cannot write the ground truth") as caught:
        TruthWriter(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)
    assert caught.value.exit_code == 6


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full exists on Linux only")
def test_a_full_disk_at_the_start_is_a_named_error() -> None:
    with pytest.raises(RunFolderError, match="cannot write the ground truth /dev/full"):
        TruthWriter(Path("/dev/full"))


@contextlib.contextmanager
def disk_full_at(size: int) -> Iterator[None]:
    """As on a full disk, the write that passes `size` is cut short and the next one fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_fills_up_is_an_error_and_costs_no_row_already_written(path: Path, plant: Plant) -> None:
    writer = TruthWriter(path)
    append(writer, plant, range(1000))
    writer.flush()
    append(writer, plant, range(1000, 1010))
    with disk_full_at(path.stat().st_size + 3 * ROW.itemsize + 7):
        for _ in range(2):
            with pytest.raises(RunFolderError, match="cannot write the ground truth"):
                writer.flush()
            assert_rows(path, 1000)
    writer.close()  # there is room again: nothing is lost
    assert_rows(path, 1010)


@pytest.mark.parametrize("content", [None, b"", b"no such file format", b"\x93NUMPY\x01\x00\xff\x00{"])
def test_what_is_no_ground_truth_is_a_named_error(path: Path, content: bytes | None) -> None:
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RunFolderError, match="cannot read the ground truth"):
        load_truth(path)
