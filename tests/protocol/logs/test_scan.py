"""The scanner: every intact frame of a log is found, whatever happened to the bytes around it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as widest
from pymavlink.dialects.v20 import matrixpilot

from protocol.errors import LogError
from protocol.logs.scan import COUNTERS, Scan, scan_tlog
from tests.protocol.logs.log_records import CLASHING, DAY_US, FOREIGN, KNOWN, Pen, Record, mixed_records

STAMP = 8
RECORDS = mixed_records()
ROW = 1 << 12  # a byte's tag is its record's number times this, plus its place in the record


def joined(records: list[Record]) -> bytes:
    return b"".join(record.data for record in records)


def raws(scan: Scan) -> list[bytes]:
    return [scan.raw(row) for row in range(len(scan))]


def undamaged(**others: int) -> dict[str, int]:
    return dict.fromkeys(COUNTERS, 0) | others


class TestWhole:
    @pytest.mark.parametrize("version_1", [False, True])
    def test_every_message_of_the_dialect_is_found(self, version_1: bool) -> None:
        pen = Pen()
        records = [pen.record(n, version_1=version_1) for n in KNOWN if n < 256 or not version_1]
        scan = scan_tlog(joined(records))
        assert raws(scan) == [record.frame for record in records]
        assert scan.counters == undamaged()
        assert scan.frames["message_id"].tolist() == [n for n in KNOWN if n < 256 or not version_1]
        assert scan.frames["stamp_us"].tolist() == [record.t_us for record in records]
        assert set(scan.frames["version"]) == {1 if version_1 else 2}
        assert scan.frames["sequence"].tolist() == [n % 256 for n in range(len(records))]
        assert (set(scan.frames["system"]), set(scan.frames["component"])) == ({1}, {191})
        assert scan.frames["known"].all()
        assert scan.frames["stamp_ok"].all()

    def test_the_columns_are_those_that_pymavlink_sees(self) -> None:
        scan = scan_tlog(joined(RECORDS))
        for row, record in zip(scan.frames, RECORDS, strict=True):
            parser = (matrixpilot if row["message_id"] in FOREIGN else widest).MAVLink(None)
            message = parser.decode(bytearray(record.frame))
            assert row["message_id"] == message.get_msgId()
            assert (row["system"], row["component"]) == (message.get_srcSystem(), message.get_srcComponent())
            assert row["sequence"] == message.get_seq()
            assert row["signed"] == (message.get_header().incompat_flags & 1)
            assert row["known"] == (row["message_id"] not in FOREIGN)
        assert scan.counters == undamaged(unknown_frames=30)

    @pytest.mark.parametrize("t_us", [0, DAY_US])
    def test_simulation_times_are_as_good_as_dates(self, t_us: int) -> None:
        records = mixed_records(t_us=t_us)
        scan = scan_tlog(joined(records))
        assert scan.frames["stamp_us"].tolist() == [record.t_us for record in records]
        assert scan.counters == undamaged(unknown_frames=30)

    def test_a_file_and_its_bytes_give_the_same(self, tmp_path: Path) -> None:
        (tmp_path / "a.tlog").write_bytes(joined(RECORDS))
        from_file, from_bytes = scan_tlog(tmp_path / "a.tlog"), scan_tlog(joined(RECORDS))
        assert np.array_equal(from_file.frames, from_bytes.frames)
        assert from_file.path == tmp_path / "a.tlog"

    def test_payload_and_ends(self) -> None:
        scan = scan_tlog(joined(RECORDS))
        assert scan.payload(3) == RECORDS[3].frame[10 : 10 + RECORDS[3].frame[1]]
        assert scan.payload(1) == RECORDS[1].frame[6 : 6 + RECORDS[1].frame[1]]
        assert scan.ends().tolist() == np.cumsum([len(record.data) for record in RECORDS]).tolist()

    def test_more_frames_than_there_was_room_for(self) -> None:
        pen = Pen()
        records = [pen.record(0) for _ in range(5000)]  # heartbeats are shorter than the frames reckoned with
        told: list[tuple[int, int]] = []
        scan = scan_tlog(joined(records), progress=lambda done, of: told.append((done, of)))
        assert raws(scan) == [record.frame for record in records]
        assert told == [(len(scan.data), len(scan.data))]

    @pytest.mark.parametrize(
        "content", [b"", b"\0", b"hello, this is no log\n" * 50, bytes(5000), b"\xfe" * 3000, b"\xfd" * 3000]
    )
    def test_what_is_no_log_has_no_frame(self, content: bytes) -> None:
        scan = scan_tlog(content)
        assert len(scan) == 0
        assert scan.counters["damaged_bytes"] + scan.counters["truncated_tail"] == len(content)

    @pytest.mark.parametrize("name", ["missing.tlog", "."])
    def test_a_file_that_cannot_be_read_is_named(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(LogError, match=f"cannot read the log {tmp_path / name}: "):
            scan_tlog(tmp_path / name)


class TestForms:
    """What other programs write."""

    def test_mavproxy_keeps_the_link_in_the_low_bits_of_the_stamp(self) -> None:
        pen = Pen()
        records = [Record(r.t_us & ~3 | n % 4, r.frame) for n in range(40) for r in [pen.record(KNOWN[n])]]
        scan = scan_tlog(joined(records))
        assert (scan.frames["stamp_us"] & 3).tolist() == [n % 4 for n in range(40)]

    def test_a_raw_stream_has_no_stamps(self) -> None:
        # MAVProxy's .tlog.raw, pymavlink's setup_logfile_raw.
        scan = scan_tlog(b"".join(record.frame for record in RECORDS))
        assert raws(scan) == [record.frame for record in RECORDS]
        assert scan.stamp_size == 0
        assert set(scan.frames["stamp_us"]) == {0}
        assert scan.counters == undamaged(unknown_frames=30)

    def test_one_raw_frame_alone(self) -> None:
        scan = scan_tlog(RECORDS[3].frame)
        assert (raws(scan), scan.stamp_size) == ([RECORDS[3].frame], 0)

    def test_several_frames_under_one_stamp_share_it(self) -> None:
        # QGroundControl logs what it sends as it hands it to the link.
        known = [record for row, record in enumerate(RECORDS) if row % 4]
        data = b"".join(one.data + other.frame for one, other in zip(known[::2], known[1::2], strict=True))
        scan = scan_tlog(data)
        assert raws(scan) == [record.frame for record in known]
        assert scan.counters == undamaged(unstamped_frames=len(known) // 2)
        assert scan.frames["stamp_us"].tolist() == [one.t_us for one in known[::2] for _ in range(2)]

    def test_a_log_that_was_gone_on_with_another_day(self) -> None:
        later = [Record(record.t_us + 5 * 86_400_000_000, record.frame) for record in RECORDS]
        scan = scan_tlog(joined(RECORDS + later))
        assert scan.frames["stamp_us"].tolist() == [record.t_us for record in RECORDS + later]
        assert scan.counters == undamaged(unknown_frames=60)

    def test_a_clock_that_was_set_in_flight(self) -> None:
        before = [Record(record.t_us - DAY_US, record.frame) for record in RECORDS[:50]]
        scan = scan_tlog(joined(before + RECORDS[50:]))
        assert scan.frames["stamp_us"].tolist() == [record.t_us for record in before + RECORDS[50:]]
        assert scan.counters["damaged_stamps"] == 0


class TestOtherDialects:
    def test_a_log_of_unknown_messages_only(self) -> None:
        pen = Pen(matrixpilot)
        records = [pen.record(number) for number in FOREIGN * 20]
        scan = scan_tlog(joined(records))
        assert raws(scan) == [record.frame for record in records]
        assert not scan.frames["known"].any()
        assert scan.counters == undamaged(unknown_frames=40)

    def test_one_unknown_frame_alone_among_others(self) -> None:
        pen, foreign = Pen(), Pen(matrixpilot)
        records = [pen.record(0), foreign.record(FOREIGN[0]), pen.record(0)]
        scan = scan_tlog(joined(records))
        assert raws(scan) == [record.frame for record in records]
        assert scan.frames["known"].tolist() == [1, 0, 1]

    def test_a_number_that_means_another_message_there(self) -> None:
        # Its checksum can never hold with the seed of ours; seen often enough, its own seed is learned.
        pen, foreign = Pen(), Pen(matrixpilot)
        records = [pen.record(0) if n % 2 else foreign.record(CLASHING) for n in range(20)]
        scan = scan_tlog(joined(records))
        assert raws(scan) == [record.frame for record in records]
        assert scan.frames["known"].tolist() == [0, 1] * 10
        assert scan.counters == undamaged(unknown_frames=10)

    def test_a_seed_once_learned_tells_damaged_frames_of_it(self) -> None:
        pen = Pen(matrixpilot)
        records = [pen.record(FOREIGN[0]) for _ in range(20)]
        data = bytearray(joined(records))
        data[len(records[0].data) * 0 + STAMP + 20] ^= 1  # the very first: before anything was learned
        scan = scan_tlog(bytes(data))
        assert raws(scan) == [record.frame for record in records[1:]]

    def test_a_changed_id_is_not_taken_for_an_unknown_message(self) -> None:
        pen = Pen()
        records = [pen.record(30) for _ in range(200)]
        data = bytearray(joined(records))
        size = len(records[0].data)
        assert {len(record.data) for record in records} == {size}
        for row in range(10, 190, 2):
            data[row * size + STAMP + 8] ^= 0x40  # an id the dialect lacks, the framing whole
        scan = scan_tlog(bytes(data))
        # One in 256 such checksums is explained by some seed, by chance.
        assert np.count_nonzero(scan.frames["known"]) == 110
        assert scan.counters["unknown_frames"] <= 2


def damage(data: bytes, edits: list[tuple[str, int, int, int]]) -> tuple[bytes, npt.NDArray[np.int64]]:
    """The bytes after the edits, and for each its tag; -1 where it is not the byte that was written."""
    content = np.frombuffer(data, dtype=np.uint8).copy()
    tags = np.concatenate([row * ROW + np.arange(len(record.data)) for row, record in enumerate(RECORDS)])
    for kind, place, length, seed in edits:
        at = place % len(content)
        chance = np.random.default_rng(seed)
        noise = chance.integers(0, 256, length, dtype=np.uint8)
        if kind == "insert":
            content = np.insert(content, at, noise)
            tags = np.insert(tags, at, np.full(length, -1))
        elif kind == "remove":
            content = np.delete(content, slice(at, at + length))
            tags = np.delete(tags, slice(at, at + length))
        else:
            where = slice(at, at + length)
            flips = noise[: len(content[where])] if kind == "overwrite" else 1 << noise[: len(content[where])] % 8
            chosen = chance.random(len(flips)) < (1.0 if kind == "overwrite" else 0.02)
            tags[where] = np.where(chosen & (flips != 0), -1, tags[where])
            content[where] ^= np.where(chosen, flips, 0).astype(np.uint8)
        if not len(content):
            break
    return content.tobytes(), tags


def intact(tags: npt.NDArray[np.int64]) -> list[tuple[int, int, bool]]:
    """(record, offset of its frame, whether its stamp is intact too) of each frame whose bytes are all in place."""
    found = []
    for row, record in enumerate(RECORDS):
        (starts,) = np.nonzero(tags == row * ROW + STAMP)
        for at in starts:
            size = len(record.frame)
            if np.array_equal(tags[at : at + size], row * ROW + STAMP + np.arange(size)):
                before = at >= STAMP and np.array_equal(tags[at - STAMP : at], row * ROW + np.arange(STAMP))
                found.append((row, int(at), bool(before)))
    return found


edits = st.lists(
    st.tuples(
        st.sampled_from(["insert", "remove", "overwrite", "flip"]),
        st.integers(0, 20_000),
        st.integers(1, 30) | st.integers(1, 500),
        st.integers(0, 2**32),
    ),
    min_size=1,
    max_size=8,
)
LOG = joined(RECORDS)


class TestDamage:
    @settings(max_examples=200)
    @given(edits)
    def test_every_intact_frame_is_found(self, changes: list[tuple[str, int, int, int]]) -> None:
        data, tags = damage(LOG, changes)
        scan = scan_tlog(data)
        rows = {int(offset): row for row, offset in enumerate(scan.frames["offset"])}
        for record, offset, has_stamp in intact(tags):
            assert offset in rows, f"record {record} at {offset} was not found"
            assert scan.raw(rows[offset]) == RECORDS[record].frame
            if has_stamp:
                assert scan.frames["stamp_us"][rows[offset]] == RECORDS[record].t_us
        # Nothing is taken twice, and every byte is accounted for.
        assert np.all(scan.frames["offset"][1:] >= scan.ends()[:-1])
        stamps = len(scan) - scan.counters["unstamped_frames"]
        assert len(data) - stamps * STAMP <= scan.frames["length"].sum() + sum(
            scan.counters[name] for name in ("damaged_bytes", "truncated_tail")
        )

    def test_flips_all_over_a_long_log(self) -> None:
        # One bit in 2000 bytes: about one frame in twenty five is lost, never a neighbour of it.
        chance = np.random.default_rng(3)
        content = np.frombuffer(LOG * 20, dtype=np.uint8).copy()
        hit = chance.random(len(content)) < 1 / 2000
        content[hit] ^= (1 << chance.integers(0, 8, np.count_nonzero(hit))).astype(np.uint8)
        scan = scan_tlog(content.tobytes())
        found = set(scan.frames["offset"].tolist())
        at = 0
        expected = set()
        for record in RECORDS * 20:
            if not hit[at + STAMP : at + len(record.data)].any():
                expected.add(at + STAMP)
            at += len(record.data)
        assert len(expected) < 2350
        assert expected <= found
        assert len(found - expected) <= 2  # a damaged frame whose checksum holds by chance, inside another

    def test_each_byte_of_a_record_changed_in_turn_costs_that_frame_at_most(self) -> None:
        rows = (2, 3, 4, 5)
        for row in rows:
            start = len(joined(RECORDS[:row]))
            for place in range(len(RECORDS[row].data)):
                data = bytearray(LOG)
                data[start + place] ^= 0x10
                found = raws(scan_tlog(bytes(data)))
                expected = [r.frame for n, r in enumerate(RECORDS) if n != row]
                assert [frame for frame in found if frame in expected] == expected, (row, place)

    def test_a_stamp_that_is_damaged_costs_the_stamp_only(self) -> None:
        start = len(joined(RECORDS[:10]))
        for place in range(4):  # further bytes are seconds and less, which nothing can tell from the truth
            data = bytearray(LOG)
            data[start + place] ^= 0x80
            scan = scan_tlog(bytes(data))
            assert raws(scan) == [record.frame for record in RECORDS]
            assert scan.counters == undamaged(unknown_frames=30, damaged_stamps=1)
            assert scan.frames["stamp_us"][10] == RECORDS[9].t_us
            assert np.flatnonzero(scan.frames["stamp_ok"] == 0).tolist() == [10]

    def test_the_first_stamp_damaged_takes_the_time_of_the_next(self) -> None:
        scan = scan_tlog(b"\xff" * 8 + LOG[8:])
        assert scan.frames["stamp_us"][:2].tolist() == [RECORDS[1].t_us] * 2
        assert scan.frames["stamp_ok"][:2].tolist() == [0, 1]

    @pytest.mark.parametrize("cut", range(1, 60))
    def test_a_tail_cut_short(self, cut: int) -> None:
        whole = RECORDS[:4]
        assert len(whole[-1].data) > 60
        scan = scan_tlog(joined(whole)[:-cut])
        assert raws(scan) == [record.frame for record in whole[:-1]]
        assert scan.counters == undamaged(unknown_frames=1, truncated_tail=len(whole[-1].data) - cut)

    def test_what_was_counted_of_a_changed_frame(self) -> None:
        data = bytearray(LOG)
        data[len(joined(RECORDS[:3])) + STAMP + 15] ^= 1
        scan = scan_tlog(bytes(data))
        assert scan.counters == undamaged(
            unknown_frames=30, crc_failures=1, resynchronisations=1, damaged_bytes=len(RECORDS[3].data)
        )

    def test_a_signature_cut_short_eats_no_frame(self) -> None:
        at = len(joined(RECORDS[:3]))  # the end of a signed record
        assert RECORDS[2].frame[2] & 1
        for cut in range(1, 14):
            scan = scan_tlog(LOG[: at - cut] + LOG[at:])
            assert raws(scan)[3:] == [record.frame for record in RECORDS[3:]]
            assert scan.counters["cut_signatures"] == 1

    def test_a_frame_that_seems_to_hold_an_intact_one_does_not_eat_it(self) -> None:
        # Bytes whose checksum holds by chance and which reach over an intact record: the record has a stamp, they do not.
        pen = Pen()
        inner = pen.record(24)
        outer_payload = bytearray(30) + inner.data + bytearray(60)
        fake = widest.MAVLink_logging_data_message(1, 1, 1, len(outer_payload), 0, outer_payload.ljust(249, b"\1"))
        frame = bytes(fake.pack(widest.MAVLink(None)))
        broken = b"\x42" * 5 + frame + b"\x17" * 9
        scan = scan_tlog(joined(RECORDS[:9]) + broken + joined(RECORDS[9:]))
        assert inner.frame in raws(scan)

    def test_a_frame_that_carries_frames_is_one_frame(self) -> None:
        pen = Pen()
        inner = b"".join(pen.record(24).data for _ in range(3))
        outer = widest.MAVLink_logging_data_message(1, 1, 1, len(inner), 0, bytearray(inner.ljust(249, b"\1")))
        record = Record(DAY_US + 9500, bytes(outer.pack(widest.MAVLink(None))))
        scan = scan_tlog(joined([*RECORDS[:9], record, *RECORDS[9:]]))
        assert raws(scan) == [r.frame for r in [*RECORDS[:9], record, *RECORDS[9:]]]

    def test_unknown_flags_are_counted_and_kept(self) -> None:
        frame = bytearray(Pen().record(0).frame)
        frame[2] = 0x80
        from fastcrc.crc16 import mcrf4xx

        frame[-2:] = struct.pack("<H", mcrf4xx(bytes(frame[1:-2]) + bytes([widest.mavlink_map[0].crc_extra])))
        scan = scan_tlog(Record(DAY_US, bytes(frame)).data)
        assert raws(scan) == [bytes(frame)]
        assert scan.counters == undamaged(unknown_flags=1)
