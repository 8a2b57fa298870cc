"""Telemetry logs: read back by us and by pymavlink's own log reader, cut, damaged, and on disks that refuse."""

from __future__ import annotations

import os
import random
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import RunFolderError
from protocol.logs.tlog import TlogWriter, read_tlog
from protocol.wire.codec import FrameWriter, layout, layouts_by_id
from protocol.wire.streams import STREAMS
from tests.disk import small_disk

Records = list[tuple[int, bytes]]
STAMP_BYTES = 8


def _records(count: int, step_us: int = 1000) -> Records:
    """(time, frame) of every kind of message of the link, in turn."""
    writer, chance = FrameWriter(1, 191), random.Random(5)
    messages = [layout(row.message) for row in STREAMS]
    return [
        (number * step_us, writer.seal(message, chance.randbytes(message.size)))
        for number in range(count)
        for message in [messages[number % len(messages)]]
    ]


RECORDS = _records(40)
LAST = len(RECORDS[-1][1])


def _write(path: Path, records: Records) -> bytes:
    with TlogWriter(path) as log:
        for t_us, frame in records:
            log.write(t_us, frame)
    return path.read_bytes()


def _read(path: Path) -> Records:
    return [(t_us, frame.raw) for t_us, frame in read_tlog(path)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for the tests whose many examples share one file name."""
    return tmp_path_factory.mktemp("tlog")


@pytest.fixture
def mavutil(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("MAVLINK20", "1")
    monkeypatch.setenv("MAVLINK_DIALECT", "common")
    from pymavlink import mavutil

    return mavutil


def _read_by_pymavlink(mavutil: Any, path: Path) -> Records:
    log = mavutil.mavlink_connection(str(path), dialect="common")
    try:
        messages = iter(log.recv_msg, None)
        return [(round(1e6 * message._timestamp), bytes(message.get_msgbuf())) for message in messages]
    finally:
        log.close()


class TestReading:
    def test_a_log_is_a_big_endian_stamp_before_each_frame(self, tmp_path: Path) -> None:
        expected = b"".join(struct.pack(">Q", t_us) + frame for t_us, frame in RECORDS)
        assert _write(tmp_path / "a.tlog", RECORDS) == expected

    @pytest.mark.parametrize("count", [0, 1, 3000])
    def test_what_was_written_is_read_back(self, tmp_path: Path, count: int) -> None:
        # 3000 records are several times what is gathered before a write.
        records = _records(count)
        _write(tmp_path / "a.tlog", records)
        assert _read(tmp_path / "a.tlog") == records

    def test_pymavlink_reads_the_same_frames_with_the_same_stamps(self, tmp_path: Path, mavutil: Any) -> None:
        # Stamps of a real day and of simulation time, both to the microsecond.
        day_us = 1_700_000_000_000_000
        records = [(day_us + t_us, frame) for t_us, frame in RECORDS]
        for name, expected in (("day.tlog", records), ("simulation.tlog", RECORDS)):
            _write(tmp_path / name, expected)
            assert _read_by_pymavlink(mavutil, tmp_path / name) == expected

    def test_equal_stamps_keep_their_order(self, tmp_path: Path) -> None:
        records = [(7, frame) for _, frame in RECORDS]
        _write(tmp_path / "a.tlog", records)
        assert _read(tmp_path / "a.tlog") == records

    def test_frames_are_decoded(self, tmp_path: Path) -> None:
        _write(tmp_path / "a.tlog", RECORDS)
        (_, first), *_ = read_tlog(tmp_path / "a.tlog")
        assert (first.message_id, first.sequence, first.system, first.component) == (0, 0, 1, 191)


class TestDamage:
    def test_a_record_cut_short_ends_the_reading(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tlog"
        data = _write(path, RECORDS)
        for cut in range(1, STAMP_BYTES + LAST + 1):
            path.write_bytes(data[:-cut])
            assert _read(path) == RECORDS[:-1], cut
        path.write_bytes(data[: -STAMP_BYTES - LAST - 1])
        assert _read(path) == RECORDS[:-2]

    @pytest.mark.parametrize("record", range(len(RECORDS) - len(STREAMS), len(RECORDS)))
    def test_a_damaged_record_ends_the_reading(self, tmp_path: Path, record: int) -> None:
        path = tmp_path / "a.tlog"
        data = _write(path, RECORDS)
        start = sum(STAMP_BYTES + len(frame) for _, frame in RECORDS[:record]) + STAMP_BYTES
        # Not the stamp, which nothing guards, nor the id, which may become one that the dialect lacks.
        for place in (0, 1, 2, 3, 4, 5, 6, *range(10, len(RECORDS[record][1]))):
            damaged = bytearray(data)
            damaged[start + place] ^= 0x04
            path.write_bytes(damaged)
            assert _read(path) == RECORDS[:record], place

    def test_a_length_that_reaches_over_the_next_record_does_not_lend_its_stamp_to_it(self, tmp_path: Path) -> None:
        (_, first), (_, second), *_ = RECORDS
        data = bytearray(_write(tmp_path / "a.tlog", RECORDS))
        data[STAMP_BYTES + 1] += STAMP_BYTES + len(second)
        assert first[1] + STAMP_BYTES + len(second) < 256
        (tmp_path / "a.tlog").write_bytes(data)
        assert _read(tmp_path / "a.tlog") == []

    @settings(max_examples=100)
    @given(st.integers(0, 2000), st.binary(min_size=1, max_size=40))
    def test_any_bytes_over_a_log_leave_what_is_before_them(self, folder: Path, at: int, noise: bytes) -> None:
        path = folder / "a.tlog"
        data = _write(path, RECORDS)
        path.write_bytes(data[:at] + noise + data[at + len(noise) :])
        whole, end = 0, 0
        for _, frame in RECORDS:
            end += STAMP_BYTES + len(frame)
            whole += end <= at
        assert _read(path)[:whole] == RECORDS[:whole]

    @settings(max_examples=60)
    @given(st.binary(max_size=100))
    def test_a_file_that_is_no_log_is_an_empty_one(self, folder: Path, noise: bytes) -> None:
        path = folder / "b.tlog"
        path.write_bytes(noise)
        assert _read(path) == []

    @pytest.mark.parametrize("name", ["missing.tlog", "."])
    def test_a_log_that_cannot_be_read_is_an_error_that_names_it(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(RunFolderError, match=f"cannot read the log {tmp_path / name}: "):
            _read(tmp_path / name)


class TestWriting:
    @pytest.mark.parametrize("name", ["no/such/folder/a.tlog", "."])
    def test_a_path_that_cannot_be_written_is_an_error_that_names_it(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(RunFolderError, match=f"cannot write the log {tmp_path / name}: "):
            TlogWriter(tmp_path / name)

    def test_a_full_disk_is_an_error_at_the_flush(self) -> None:
        log = TlogWriter(Path("/dev/full"))
        log.write(*RECORDS[0])
        with pytest.raises(RunFolderError, match="cannot write the log /dev/full: No space left"):
            log.flush()
        # Closing tells it once more, and closes all the same.
        with pytest.raises(RunFolderError):
            log.close()
        log.close()

    def test_a_full_disk_is_an_error_at_the_end_of_a_block_at_the_latest(self) -> None:
        log = TlogWriter(Path("/dev/full"))
        records = iter(_records(3000))
        with pytest.raises(RunFolderError):
            for record in records:
                log.write(*record)
        assert next(records, None) is not None
        with pytest.raises(RunFolderError):
            log.close()

    def test_a_disk_that_takes_only_a_part_is_an_error_too(self, tmp_path: Path) -> None:
        # The system then writes what fits and reports no error; only the next write fails.
        log = TlogWriter(tmp_path / "a.tlog")
        for record in RECORDS:
            log.write(*record)
        with small_disk(1000), pytest.raises(RunFolderError, match=r"a\.tlog: File too large"):
            log.flush()
        assert (tmp_path / "a.tlog").stat().st_size == 1000
        # Once there is room again, not a byte is missing.
        log.close()
        assert _read(tmp_path / "a.tlog") == RECORDS

    def test_flush_makes_all_of_it_readable(self, tmp_path: Path) -> None:
        with TlogWriter(tmp_path / "a.tlog") as log:
            for number, record in enumerate(RECORDS):
                log.write(*record)
                if number % 7 == 0:
                    log.flush()
                    assert _read(tmp_path / "a.tlog") == RECORDS[: number + 1]

    def test_a_with_block_closes_even_when_it_fails(self, tmp_path: Path) -> None:
        with pytest.raises(ZeroDivisionError), TlogWriter(tmp_path / "a.tlog") as log:
            log.write(*RECORDS[0])
            raise ZeroDivisionError
        assert _read(tmp_path / "a.tlog") == RECORDS[:1]
        log.close()

    def test_a_log_that_is_there_is_written_anew(self, tmp_path: Path) -> None:
        _write(tmp_path / "a.tlog", RECORDS)
        _write(tmp_path / "a.tlog", RECORDS[:2])
        assert _read(tmp_path / "a.tlog") == RECORDS[:2]


def test_mavlogdump_prints_every_record(tmp_path: Path) -> None:
    _write(tmp_path / "a.tlog", [(1_700_000_000_000_000 + t_us, frame) for t_us, frame in RECORDS])
    environment = {**os.environ, "MAVLINK20": "1", "TZ": "UTC"}
    command = [sys.executable, "-m", "pymavlink.tools.mavlogdump", "--dialect", "common", str(tmp_path / "a.tlog")]
    ended = subprocess.run(command, env=environment, capture_output=True, check=True)
    lines = ended.stdout.splitlines()
    names = [f.message_id for _, f in read_tlog(tmp_path / "a.tlog")]
    assert [line.split()[2].rstrip(b":").decode() for line in lines] == [layouts_by_id()[n].name for n in names]
    assert lines[0].startswith(b"2023-11-14 22:13:20.00: ")
