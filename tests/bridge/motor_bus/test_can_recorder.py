"""The record of the motor bus on a disk that refuses."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from bridge.motor_bus.can_recorder import CanRecorder
from protocol.can_frame import CanFrame
from protocol.errors import RunFolderError
from tests.disk import small_disk

ROOM = 30_000


def fill(recorder: CanRecorder) -> None:
    for number in range(2000):
        recorder.watch(number * 1_000_000, CanFrame(0x123, number.to_bytes(8, "little")))
        if number % 50 == 49:
            recorder.settle()
    recorder.close()


def test_a_full_disk_ends_the_run(tmp_path: Path) -> None:
    recorder = CanRecorder(tmp_path / "bus.log")
    with small_disk(ROOM):
        with pytest.raises(RunFolderError, match=r"cannot write the bus log .*bus.log: File too"):
            fill(recorder)
        recorder.close()  # as at the end of a run, whose error is the first one


def test_or_is_told_once_and_what_was_written_can_be_read(tmp_path: Path) -> None:
    told: list[str] = []
    with small_disk(ROOM):
        fill(CanRecorder(tmp_path / "bus.log", told.append))
    assert len(told) == 1
    assert "cannot write the bus log" in told[0]
    whole = (tmp_path / "bus.log").read_text().rpartition("\n")[0] + "\n"
    (tmp_path / "bus.log").write_text(whole)
    with can.LogReader(tmp_path / "bus.log") as reader:
        assert len(list(reader)) > 300


@pytest.mark.parametrize(("suffix", "start_s"), [(".log", 1.0), (".blf", 0.0), (".asc", 0.0), (".csv", 0.0)])
def test_stamps_are_the_runs_time_and_none_of_candumps_is_in_second_zero(
    tmp_path: Path, suffix: str, start_s: float
) -> None:
    fill(CanRecorder(tmp_path / f"bus{suffix}"))
    with can.LogReader(tmp_path / f"bus{suffix}") as reader:
        stamps = [message.timestamp for message in reader]
    first = stamps[0] if suffix in (".blf", ".asc") else 0.0  # these may count from the date of the file
    assert [stamp - first for stamp in stamps] == pytest.approx([start_s + 1e-3 * row for row in range(2000)], abs=2e-6)
