"""Tables of time stamps: rows in, a file, rows out; and files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bridge.latency import segments as legs
from bridge.latency.segments import ANSWER_COLUMNS, SAMPLE_COLUMNS, TICK_COLUMNS, LegTable, load_legs, save_legs
from bridge.timing.timesync import Estimate
from protocol.errors import RunFolderError


def table(columns: tuple[str, ...], rows: int) -> LegTable:
    made = LegTable(columns)
    for number in range(rows):
        made.add(*(1000 * number + column for column in range(len(columns))))
    return made


def test_rows_are_kept_in_their_order() -> None:
    assert table(TICK_COLUMNS, 3).rows.tolist() == [[0, 1, 2, 3], [1000, 1001, 1002, 1003], [2000, 2001, 2002, 2003]]
    assert LegTable(SAMPLE_COLUMNS).rows.shape == (0, 5)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8])
def test_a_full_block_is_followed_by_another(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(legs, "_BLOCK", 2)
    assert table(TICK_COLUMNS, count).rows[:, 0].tolist() == [1000 * number for number in range(count)]


@pytest.mark.parametrize("clock", [None, Estimate(-5, 7, 3), Estimate(2**60, 0, 1)])
def test_what_is_saved_is_loaded(clock: Estimate | None, tmp_path: Path) -> None:
    path = tmp_path / "legs.npz"
    ticks, answers = table(TICK_COLUMNS, 4), table(ANSWER_COLUMNS, 0)
    save_legs(path, {"ticks": ticks, "answers": answers}, clock)
    (came, none), estimate = load_legs(path, "ticks", "answers")
    assert came.tolist() == ticks.rows.tolist()
    assert none.shape == (0, 5)
    assert estimate == clock


def test_where_nothing_can_be_written_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"cannot write .*legs.npz.*--out"):
        save_legs(tmp_path / "nowhere" / "legs.npz", {}, None)


def test_a_missing_file_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"there is no .*legs\.npz.*--legs"):
        load_legs(tmp_path / "legs.npz", "ticks")


@pytest.fixture
def saved(tmp_path: Path) -> bytes:
    path = tmp_path / "whole.npz"
    save_legs(path, {"ticks": table(TICK_COLUMNS, 50)}, Estimate(1, 2, 3))
    return path.read_bytes()


def assert_refused(path: Path, *names: str) -> None:
    with pytest.raises(RunFolderError, match=r"damaged.*--legs") as caught:
        load_legs(path, *names)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_a_file_that_was_cut_short_is_refused(saved: bytes, share: float, tmp_path: Path) -> None:
    path = tmp_path / "legs.npz"
    path.write_bytes(saved[: round(share * len(saved))])
    assert_refused(path, "ticks")


def test_a_file_with_a_wrong_byte_is_refused(saved: bytes, tmp_path: Path) -> None:
    path = tmp_path / "legs.npz"
    at = saved.index((1003).to_bytes(8, "little"))
    path.write_bytes(saved[:at] + b"\xff" + saved[at + 1 :])
    assert_refused(path, "ticks")


def test_files_of_other_kinds_are_refused(tmp_path: Path) -> None:
    for number, data in enumerate((b"text", b"PK\x03\x04 no zip", bytes(1000))):
        path = tmp_path / f"{number}.npz"
        path.write_bytes(data)
        assert_refused(path, "ticks")
    array = tmp_path / "array.npy"
    np.save(array, np.zeros(3))
    assert_refused(array, "ticks")
    assert_refused(tmp_path, "ticks")


@pytest.mark.parametrize(
    "arrays",
    [
        {"clock": np.zeros(3, dtype=np.int64)},
        {"ticks": np.zeros((2, 4), dtype=np.int64)},
        {"clock": np.zeros(2, dtype=np.int64), "ticks": np.zeros((2, 4), dtype=np.int64)},
        {"clock": np.zeros(3, dtype=np.int64), "ticks": np.zeros((2, 5), dtype=np.int64)},
        {"clock": np.zeros(3, dtype=np.int64), "ticks": np.zeros(4, dtype=np.int64)},
        {"clock": np.zeros(3, dtype=np.int64), "ticks": np.zeros((2, 4))},
    ],
    ids=["no table", "no clock", "short clock", "columns", "flat", "floats"],
)
def test_arrays_that_are_no_table_are_refused(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    np.savez(tmp_path / "legs.npz", **arrays)  # type: ignore[arg-type]
    assert_refused(tmp_path / "legs.npz", "ticks")
