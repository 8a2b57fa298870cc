"""Logs of a CAN bus by other programs: each frame, its time, what is amiss."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from protocol.can_frame import CanFrame
from protocol.errors import LogError
from protocol.logs.can_log import classical_frames, read_can_log
from protocol.logs.files import CAN, messages, open_log

FRAMES = [
    can.Message(timestamp=100.0, arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02", channel=0),
    can.Message(timestamp=100.25, arbitration_id=0x123, is_extended_id=True, data=bytes(8), channel=0),
    can.Message(timestamp=100.5, arbitration_id=0x7FF, is_extended_id=False, is_remote_frame=True, channel=0),
    can.Message(timestamp=101.0, arbitration_id=0x123, is_extended_id=False, data=b"", channel=0),
]


def written(path: Path, frames: list[can.Message] = FRAMES) -> Path:
    with can.Logger(path) as writer:
        for frame in frames:
            writer.on_message_received(frame)
    return path


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc"])
def test_each_identifier_is_a_table(tmp_path: Path, suffix: str) -> None:
    log = open_log(written(tmp_path / f"bus{suffix}"))
    assert log.kind == CAN
    counts = {"ID_123": 2, "ID_00000123": 1, "ID_7FF": 1}
    made = log.tables()
    if suffix == ".trc":  # python-can writes no remote frames there
        assert log.counts() == {name: count for name, count in counts.items() if name != "ID_7FF"}
        return
    assert log.counts() == counts
    assert made["ID_123"]["data"].tolist() == ["0102", ""]
    assert made["ID_7FF"]["remote"].tolist() == [True]
    first = int(made["ID_123"]["t_us"][0])
    assert [message.t_us - first for message in messages(log)] == pytest.approx(
        [0, 250_000, 500_000, 1_000_000], abs=1000
    )
    assert not any(log.counters.values())


def test_frames_for_a_classical_bus(tmp_path: Path) -> None:
    more = [
        can.Message(timestamp=102, arbitration_id=1, is_fd=True, data=bytes(12), is_extended_id=False, channel=0),
        can.Message(timestamp=103, is_error_frame=True, channel=0),
    ]
    times, frames = classical_frames(read_can_log(written(tmp_path / "a.log", FRAMES + more), ".log"))
    assert frames == [
        CanFrame(0x123, b"\x01\x02"), CanFrame(0x123, bytes(8), extended=True), CanFrame(0x7FF, remote=True), CanFrame(0x123),
    ]  # fmt: skip
    assert times.tolist() == [100_000_000, 100_250_000, 100_500_000, 101_000_000]


def test_candump_lines_without_sense_are_counted_and_passed_over(tmp_path: Path) -> None:
    lines = written(tmp_path / "a.log").read_text().splitlines()
    lines[1:1] = ["(1.0) can0 12", "(nan) can0 123#00", "(1e30) can0 123#00", "(1.0) can0 XYZ#00", "\x00\xff"]
    (tmp_path / "b.log").write_text("\n".join(lines), encoding="latin-1")
    log = open_log(tmp_path / "b.log")
    assert sum(log.counts().values()) == 4
    assert log.counters["unreadable_lines"] + log.counters["impossible_times"] == 5


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc"])
def test_a_damaged_log_gives_what_comes_before_or_a_sentence(tmp_path: Path, suffix: str) -> None:
    whole = written(tmp_path / f"bus{suffix}").read_bytes()
    for size in range(20, len(whole), 7):
        (tmp_path / "cut").write_bytes(whole[:size])
        try:
            assert sum(open_log(tmp_path / "cut").counts().values()) <= 4
        except LogError as error:
            assert "holds no message" in str(error)
