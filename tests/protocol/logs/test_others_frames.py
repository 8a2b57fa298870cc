"""Frames that others write in ways of their own: checksums of frames whose zeros were cut off, numbers of another dialect."""

from __future__ import annotations

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as widest

from protocol.logs.dialect import layouts
from protocol.logs.records import untrimmed_length
from protocol.logs.scan import Scan, scan_tlog
from protocol.logs.tables import tables
from protocol.wire import framing
from protocol.wire.codec import FrameReader
from tests.cases import case
from tests.protocol.logs.log_records import DAY_US, Pen, Record

HEARTBEAT, DISTANCE_SENSOR, AHRS2 = 0, 132, 178
FOREIGN_SEED = 77


def table() -> framing.Table:
    from protocol.logs.records import IDS
    from protocol.logs.scan import _known_messages

    made = np.zeros(IDS, dtype=np.int32)
    numbers, entries = _known_messages()
    made[numbers] = entries
    return made


def trimmed(frame: bytes, zeros: int) -> bytes:
    """A frame of MAVLink 2 as QGroundControl's library leaves it, its `zeros` cut off, the checksum that of the whole."""
    length = frame[1]
    assert not any(frame[10 + length - zeros : 10 + length])
    return bytes([frame[0], length - zeros]) + frame[2 : 10 + length - zeros] + frame[10 + length :]


def whole_frame(number: int, content: bytes, length: int) -> bytes:
    """A frame with `content` and zeros up to `length`, none cut off."""
    body = bytes([length, 0, 0, 5, 1, 1]) + number.to_bytes(3, "little") + content.ljust(length, b"\0")
    crc = framing.checksum(body, 0, len(body), layouts()[number].crc_seed)
    return b"\xfd" + body + crc.to_bytes(2, "little")


def foreign(sequence: int, *, version_1: bool = False, length: int = 20, seed: int = FOREIGN_SEED) -> bytes:
    """A frame of number 178 of another dialect."""
    content = bytes([sequence, 1, 2, 3]) + bytes(length - 5) + b"\x07"
    body = bytes([length]) + (
        bytes([sequence, 1, 1, AHRS2]) if version_1 else bytes([0, 0, sequence, 1, 1, AHRS2, 0, 0])
    )
    body += content
    crc = framing.checksum(body, 0, len(body), seed)
    return (b"\xfe" if version_1 else b"\xfd") + body + crc.to_bytes(2, "little")


def log_of(frames: list[bytes]) -> bytes:
    return b"".join(Record(DAY_US + 10_000 * row, frame).data for row, frame in enumerate(frames))


def kept(scan: Scan) -> list[bytes]:
    return [scan.raw(row) for row in range(len(scan))]


class TestStaleChecksums:
    def test_what_qgroundcontrol_cut_is_read_and_marked(self) -> None:
        scan = scan_tlog(case("qgc-stale-crc/in.tlog"))
        made = tables(scan)
        assert made["DISTANCE_SENSOR"]["current_distance"].tolist() == [4000 - row for row in range(40)]
        assert len(made["HEARTBEAT"]) == 40
        assert scan.frames["stale_checksum"].tolist() == [1, 0] * 40
        amiss = {name: count for name, count in scan.counters.items() if count}
        assert amiss == {"stale_checksums": 40}

    @pytest.mark.parametrize("stamped", [True, False])
    @pytest.mark.parametrize("length", [23, 30, 39])
    def test_whatever_was_cut_off(self, stamped: bool, length: int) -> None:
        content = bytes(range(1, 23))
        stale, pen = trimmed(whole_frame(DISTANCE_SENSOR, content, length), length - 22), Pen()
        frames = [stale, *(pen.record(30).frame for _ in range(5)), stale, stale, stale]
        scan = scan_tlog(log_of(frames) if stamped else b"".join(frames))
        assert kept(scan) == frames
        assert scan.counters["stale_checksums"] == 4
        row = tables(scan)["DISTANCE_SENSOR"]
        assert row["time_boot_ms"].tolist() == [0x04030201] * 4

    def test_behind_damage_too(self) -> None:
        stale = trimmed(whole_frame(DISTANCE_SENSOR, bytes(range(1, 23)), 39), 17)
        data = log_of([stale, stale, stale])
        cut = len(data) // 3
        scan = scan_tlog(data[:cut] + b"noise" + data[cut:])
        assert kept(scan) == [stale] * 3
        assert scan.counters["damaged_bytes"] == 5

    def test_the_odds_of_a_false_one(self) -> None:
        chance, messages, count = np.random.default_rng(5), table(), 100_000
        content = chance.integers(1, 256, (count, 22), dtype=np.uint8)
        head = np.frombuffer(whole_frame(DISTANCE_SENSOR, b"\1", 22)[:10], dtype=np.uint8)
        frames = np.hstack([np.tile(head, (count, 1)), content, chance.integers(0, 256, (count, 2), dtype=np.uint8)])
        found = sum(untrimmed_length(frame, 0, messages) > 0 for frame in frames)
        expected = count * (layouts()[DISTANCE_SENSOR].size - 22) / 65_536
        assert abs(found - expected) < 5 * np.sqrt(expected)

    @pytest.mark.parametrize("frame", [1, 2])
    def test_damage_is_damage(self, frame: int) -> None:
        stale = bytearray(trimmed(whole_frame(DISTANCE_SENSOR, bytes(range(1, 23)), 39), 17))
        stale[12] ^= frame
        scan = scan_tlog(log_of([bytes(stale), Pen().record(HEARTBEAT).frame]))
        assert (len(scan), scan.counters["stale_checksums"]) == (1, 0)

    def test_a_link_never_takes_such_a_frame(self) -> None:
        scan = scan_tlog(case("qgc-stale-crc/in.tlog"))
        for is_datagram in (True, False):
            reader = FrameReader(is_datagram=is_datagram, keep_mavlink1=True)
            taken = [frame for raw in kept(scan) for frame in reader.read(raw)]
            assert {frame.message_id for frame in taken} == {HEARTBEAT}
            assert len(taken) == 40


class TestClashingNumbers:
    @pytest.mark.parametrize(("name", "known"), [("in", 50), ("alone", 0)])
    def test_a_block_or_nothing_else(self, name: str, known: int) -> None:
        scan = scan_tlog(case(f"tlog-clashing-block/{name}.tlog"))
        assert len(scan) == 100
        assert np.count_nonzero(scan.frames["known"]) == known
        assert scan.counters["damaged_bytes"] == scan.counters["crc_failures"] == 0

    @pytest.mark.parametrize("stamped", [True, False])
    @pytest.mark.parametrize("form", [{}, {"version_1": True}, {"version_1": True, "length": 40}, {"length": 60}])
    @pytest.mark.parametrize("count", [3, 10])
    def test_three_in_a_row_are_enough(self, stamped: bool, form: dict[str, int], count: int) -> None:
        frames = [foreign(row, **form) for row in range(count)]  # type: ignore[arg-type]
        pen = Pen()
        frames += [pen.record(30).frame for _ in range(5)]
        scan = scan_tlog(log_of(frames) if stamped else b"".join(frames))
        assert kept(scan) == frames
        assert scan.counters["damaged_bytes"] == 0
        assert scan.frames["known"].tolist() == [0] * count + [1] * 5

    def test_among_the_dialects_own_of_that_number(self) -> None:
        pen = Pen()
        own = [pen.record(AHRS2).frame for _ in range(5)]
        frames = [frame for row in range(5) for frame in (own[row], foreign(row))]
        scan = scan_tlog(log_of(frames))
        assert kept(scan) == frames
        assert scan.frames["known"].tolist() == [1, 0] * 5

    def test_one_alone_is_damage(self) -> None:
        pen = Pen()
        frames = [pen.record(30).frame, foreign(1), *(pen.record(30).frame for _ in range(5))]
        scan = scan_tlog(log_of(frames))
        assert len(scan) == 6
        assert scan.counters["crc_failures"] == 1

    def test_seeds_that_do_not_agree_are_damage(self) -> None:
        pen = Pen()
        frames = [foreign(row, seed=row) for row in range(1, 30)] + [pen.record(30).frame for _ in range(5)]
        scan = scan_tlog(log_of(frames))
        assert kept(scan) == frames[-5:]


def test_the_dialect_knows_the_numbers_used_here() -> None:
    assert {widest.mavlink_map[number].msgname for number in (HEARTBEAT, DISTANCE_SENSOR, AHRS2)} == {
        "HEARTBEAT", "DISTANCE_SENSOR", "AHRS2",
    }  # fmt: skip
