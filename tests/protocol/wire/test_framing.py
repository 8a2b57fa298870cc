"""The reader's rules on bytes made by hand: one frame at a time, each cause by itself, each boundary on both sides.

Against pymavlink, and on whatever a link may deliver, see test_codec.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from protocol.compiled import Packed, compiled
from protocol.wire import framing
from protocol.wire.framing import CAUSES, KNOWN, LONGEST_FRAME, ROW, Output, Table, new_reading, next_frame

SEED, OTHER_SEED = 77, 200
NUMBER, SIZE = 300, 20  # an id of two bytes
SHORT, SHORT_SIZE = 33, 4  # one that MAVLink 1 can say too
FAR = 0x012345


def crc(data: bytes, seed: int) -> int:
    return int(common.x25crc(data + bytes([seed])).crc)


def frame(
    payload: bytes = b"\1\2\3\4",
    *,
    number: int = NUMBER,
    sequence: int = 9,
    sender: tuple[int, int] = (3, 4),
    flags: int = 0,
    compat: int = 0,
    seed: int = SEED,
) -> bytes:
    """A MAVLink 2 frame; with the signed flag 13 bytes of signature follow it."""
    body = (
        struct.pack("<BBBBBB", len(payload), flags, compat, sequence, *sender) + number.to_bytes(3, "little") + payload
    )
    signature = bytes(range(1, 14)) if flags & 1 else b""
    return b"\xfd" + body + struct.pack("<H", crc(body, seed)) + signature


def old_frame(payload: bytes = b"\1\2\3\4", *, number: int = SHORT, sequence: int = 9, seed: int = OTHER_SEED) -> bytes:
    """A MAVLink 1 frame of (3, 4)."""
    body = struct.pack("<BBBBB", len(payload), sequence, 3, 4, number) + payload
    return b"\xfe" + body + struct.pack("<H", crc(body, seed))


def table() -> Table:
    known = np.zeros(1000, dtype=np.int32)
    known[NUMBER] = KNOWN | SIZE << framing.SIZE_SHIFT | SEED
    known[SHORT] = KNOWN | SHORT_SIZE << framing.SIZE_SHIFT | OTHER_SEED
    return known


TABLE = table()


@compiled
def _next(data: bytes, at: int, reading: Packed, known: Table, rows: Packed) -> int:
    return next_frame(data, at, reading[0], known, rows[0])


class Read(NamedTuple):
    """What was found in some bytes: where each frame begins and ends, its row, the counters, where an unfinished one begins."""

    places: list[tuple[int, int]]
    rows: list[dict[str, int]]
    counted: dict[str, int]
    rest: int


def read(
    data: bytes, *, is_datagram: bool = True, follow: bool = True, keep_mavlink1: bool = False, at: int = 0
) -> Read:
    reading = new_reading(is_datagram=is_datagram, follow_sequence=follow, keep_mavlink1=keep_mavlink1)
    rows, found = np.zeros(1, dtype=ROW), []
    while (at := _next(data, at, reading, TABLE, rows)) >= 0:
        found.append(dict(zip(ROW.names or (), rows[0].item(), strict=True)))
        assert at == found[-1]["end"]
    counted = {cause: count for cause, count in zip(CAUSES, reading["counters"][0].tolist(), strict=True) if count}
    return Read([(row["offset"], row["end"]) for row in found], found, counted, int(reading["rest"][0]))


class TestOneFrame:
    @pytest.mark.parametrize("length", [0, 1, 7, 8, 9, 15, 16, 17, 20, 255])
    @pytest.mark.parametrize("lead", [b"", b"\0\1\2"])
    def test_its_row_says_all_of_it(self, length: int, lead: bytes) -> None:
        payload = bytes((7 * i + 1) % 250 for i in range(length))
        data = lead + frame(payload, sequence=250, sender=(255, 254))
        (row,) = read(data, at=len(lead)).rows
        assert row == {
            "message_id": NUMBER, "offset": len(lead), "end": len(data), "payload": len(lead) + 10, "length": length,
            "sequence": 250, "system": 255, "component": 254,
        }  # fmt: skip

    def test_an_old_one_too_where_those_are_kept(self) -> None:
        found = read(old_frame(b"\1\2\3", sequence=5), keep_mavlink1=True)
        assert found.rows == [
            {"message_id": SHORT, "offset": 0, "end": 11, "payload": 6, "length": 3, "sequence": 5, "system": 3,
             "component": 4}
        ]  # fmt: skip
        assert found.counted == {"mavlink1": 1}

    def test_else_it_is_counted_and_passed_over(self) -> None:
        data = old_frame() + frame()
        assert read(data).places == [(len(old_frame()), len(data))]
        assert read(data).counted == {"mavlink1": 1}

    def test_a_signature_belongs_to_its_frame(self) -> None:
        signed = frame(flags=1)
        found = read(signed + frame(sequence=10))
        assert found.places == [(0, len(signed)), (len(signed), len(signed) + len(frame()))]
        assert found.rows[0]["length"] == 4
        assert found.counted == {}

    def test_an_old_one_has_none_whatever_its_number(self) -> None:
        """The byte where MAVLink 2 has its flags is the number of an old frame."""
        assert read(old_frame(sequence=1), keep_mavlink1=True).places == [(0, len(old_frame()))]

    @pytest.mark.parametrize("flags", [0x02, 0x80, 0x03, 0xFE])
    def test_a_flag_of_unknown_meaning_costs_the_frame(self, flags: int) -> None:
        odd = frame(flags=flags)
        found = read(odd + frame())
        assert found.places == [(len(odd), len(odd) + len(frame()))]
        assert found.counted == {"unknown_flags": 1}

    def test_a_flag_that_may_be_ignored_does_not(self) -> None:
        assert len(read(frame(compat=0xFF)).places) == 1

    @pytest.mark.parametrize("at", [1, 2, 3, 4, 5, 6, 10, 13, -2, -1])
    def test_any_changed_byte_but_its_id_costs_it(self, at: int) -> None:
        damaged = bytearray(frame())
        damaged[at] ^= 0x10
        found = read(bytes(damaged) + frame())
        assert (0, len(frame())) not in found.places
        assert sum(found.counted.values()) >= 1

    def test_the_seed_of_another_message_does_not_fit(self) -> None:
        assert read(frame(seed=SEED + 1)).counted == {"bad_crc": 1}
        assert read(old_frame(seed=SEED)).counted == {"bad_crc": 1}


class TestUnknownMessages:
    @pytest.mark.parametrize("number", [FAR, 999, 1000, 2])
    @pytest.mark.parametrize("follower", ["nothing", "a frame", "an old frame"])
    def test_one_that_a_frame_or_nothing_follows_is_counted_and_handed_on(self, number: int, follower: str) -> None:
        strange = frame(number=number, seed=5)
        data = strange + {"nothing": b"", "a frame": frame(sequence=10), "an old frame": old_frame()}[follower]
        found = read(data)
        assert found.places[0] == (0, len(strange))
        assert found.rows[0]["message_id"] == number
        assert found.counted["unknown_message"] == 1
        assert "bad_crc" not in found.counted

    def test_one_that_anything_else_follows_is_not_believed(self) -> None:
        found = read(frame(number=FAR, seed=5) + b"\0")
        assert found.places == []
        assert found.counted == {"bad_crc": 1, "garbage_bytes": 1}

    def test_one_with_a_flag_of_unknown_meaning_is_dropped_too(self) -> None:
        assert read(frame(number=FAR, flags=0x02)).counted == {"unknown_flags": 1}

    def test_message_0_is_unknown_where_the_table_lacks_it(self) -> None:
        assert read(frame(number=0, seed=5)).counted == {"unknown_message": 1}


class TestDatagrams:
    def test_what_does_not_begin_a_frame_ends_it(self) -> None:
        found = read(frame() + b"\1\2\3" + frame())
        assert found.places == [(0, len(frame()))]
        assert found.counted == {"garbage_bytes": 3 + len(frame())}

    @pytest.mark.parametrize("kept", range(1, 16))
    def test_a_frame_cut_short_is_counted_once(self, kept: int) -> None:
        assert len(frame()) == 16
        found = read(frame() + frame(sequence=10)[:kept])
        assert found.places == [(0, 16)]
        assert found.counted == {"truncated": 1}

    @pytest.mark.parametrize("kept", [1, 12, 13])
    def test_so_is_one_whose_signature_is_cut(self, kept: int) -> None:
        signed = frame(flags=1)
        found = read(signed[: len(signed) - kept])
        assert (found.places, found.counted) == ([], {"truncated": 1})

    @pytest.mark.parametrize("kept", range(1, 12))
    def test_so_is_an_old_one(self, kept: int) -> None:
        assert read(old_frame()[:kept], keep_mavlink1=True).counted == {"truncated": 1}

    def test_a_bad_frame_ends_where_it_says_and_nothing_within_it_is_looked_at(self) -> None:
        outer = bytearray(frame(bytes(3) + frame() + bytes(5)))
        outer[-1] ^= 1
        found = read(bytes(outer) + frame())
        assert found.places == [(len(outer), len(outer) + len(frame()))]
        assert found.counted == {"bad_crc": 1}

    def test_nothing_is_left_of_one(self) -> None:
        for data in (frame(), frame()[:5], b"\1", b""):
            assert read(data).rest == len(data)


class TestStreams:
    def test_the_search_goes_on_byte_by_byte(self) -> None:
        found = read(b"\1\2\3" + frame() + b"\4", is_datagram=False)
        assert found.places == [(3, 3 + len(frame()))]
        assert found.counted == {"garbage_bytes": 4}

    @pytest.mark.parametrize("kept", range(16))
    def test_an_unfinished_frame_is_left_for_the_next_bytes(self, kept: int) -> None:
        found = read(b"\1" + frame() + frame()[:kept], is_datagram=False)
        assert found.places == [(1, 17)]
        assert found.rest == 17
        assert found.counted == {"garbage_bytes": 1}

    @pytest.mark.parametrize("kept", [1, 13])
    def test_so_is_one_whose_signature_is_not_whole(self, kept: int) -> None:
        signed = frame(flags=1)
        found = read(signed[: len(signed) - kept], is_datagram=False)
        assert (found.places, found.counted, found.rest) == ([], {}, 0)

    def test_behind_a_bad_start_it_is_looked_for_within_it(self) -> None:
        outer = bytearray(frame(bytes(3) + frame() + bytes(5)))
        outer[-1] ^= 1
        found = read(bytes(outer) + frame(sequence=10), is_datagram=False)
        assert found.places == [(13, 13 + len(frame())), (len(outer), len(outer) + len(frame()))]
        assert found.counted["bad_crc"] == 1

    def test_all_read_leaves_nothing(self) -> None:
        assert read(frame(), is_datagram=False).rest == len(frame())


class TestSequence:
    @pytest.mark.parametrize(
        ("numbers", "gaps", "late"),
        [
            ((7, 8), 0, 0), ((255, 0), 0, 0), ((7, 10), 2, 0), ((7, 7), 0, 1), ((7, 6, 8), 0, 1), ((0, 128), 127, 0),
            ((0, 129), 0, 1), ((0, 129, 1), 0, 1), ((200, 72), 127, 0),
        ],
    )  # fmt: skip
    def test_what_is_missing_and_what_comes_late(self, numbers: tuple[int, ...], gaps: int, late: int) -> None:
        found = read(b"".join(frame(sequence=number) for number in numbers))
        assert (found.counted.get("sequence_gaps", 0), found.counted.get("out_of_order", 0)) == (gaps, late)

    @pytest.mark.parametrize("other", [(3, 5), (4, 4), (4, 3), (0, 4), (3, 0)])
    def test_each_sender_counts_for_itself(self, other: tuple[int, int]) -> None:
        assert read(frame(sequence=1) + frame(sequence=90, sender=other) + frame(sequence=2)).counted == {}

    def test_it_can_be_left_alone(self) -> None:
        assert read(frame(sequence=1) + frame(sequence=90), follow=False).counted == {}

    def test_old_frames_are_not_followed(self) -> None:
        data = frame(sequence=1) + old_frame(sequence=90) + frame(sequence=2)
        assert read(data, keep_mavlink1=True).counted == {"mavlink1": 1}


class TestSeals:
    @pytest.mark.parametrize(
        ("payload", "kept"),
        [(b"\1\2\0\0", 2), (b"\0\0", 1), (b"\0", 1), (b"\5", 1), (b"\0\0\1", 3), (bytes(8) + b"\1", 9)],
    )
    def test_zeros_at_the_end_are_cut_off_but_for_the_first_byte(self, payload: bytes, kept: int) -> None:
        out = np.zeros(LONGEST_FRAME + 5, dtype=np.uint8)
        end = framing.seal_frame(out, 5, payload, 0, 9, 3, 4, NUMBER, SEED)
        assert out[5:end].tobytes() == frame(payload[:kept])
        assert not out[:5].any()

    def test_numbers_of_every_size_fit(self) -> None:
        out = np.zeros(LONGEST_FRAME, dtype=np.uint8)
        end = framing.seal_frame(out, 0, b"\1", 1, 256 + 7, 255, 254, FAR, SEED)
        assert out[:end].tobytes() == frame(b"\1", number=FAR, sequence=7, sender=(255, 254), flags=1)[:-13]

    @pytest.mark.parametrize("length", [*range(20), 255])
    def test_the_checksum_is_pymavlinks(self, length: int) -> None:
        data = bytes((37 * i + 11) & 0xFF for i in range(length))
        assert framing.checksum(b"??" + data, 2, 2 + length, SEED) == crc(data, SEED)


class TestParts:
    def test_a_payload_cut_short_gets_its_zeros_back_and_a_long_one_is_cut(self) -> None:
        rows, payload = np.zeros(1, dtype=ROW), np.full(6, 9, dtype=np.uint8)
        reading = new_reading(is_datagram=True, follow_sequence=False, keep_mavlink1=False)
        for sent, expected in (
            (b"\1\2\3", b"\1\2\3\0\0\0"),
            (bytes(range(1, 11)), b"\1\2\3\4\5\6"),
            (b"\7" * 6, b"\7" * 6),
        ):
            data = b"\0" + frame(sent)
            _next(data, 1, reading, TABLE, rows)
            _take(data, rows, payload)
            assert payload.tobytes() == expected

    @pytest.mark.parametrize("seed", [0, 1, 77, 255])
    def test_the_seed_of_a_message_that_is_not_known_is_found_from_its_checksum(self, seed: int) -> None:
        data = b"any body of a frame"
        assert framing.seed_that_explains(unseeded(data), crc(data, seed)) == seed

    def test_where_no_seed_explains_it_there_is_none(self) -> None:
        data = b"any body of a frame"
        right = {crc(data, seed) for seed in range(256)}
        wrong = next(found for found in range(1 << 16) if found not in right)
        assert framing.seed_that_explains(unseeded(data), wrong) == -1

    @pytest.mark.parametrize(("made", "stop"), [(frame(), 14), (old_frame(), 10), (frame(flags=1), 14)])
    def test_where_a_checksum_begins_by_the_header(self, made: bytes, stop: int) -> None:
        assert framing.frame_end(made, 0) == stop
        assert framing.frame_end(b"\0" + made, 1) == stop + 1
        assert framing.frame_end(b"\0" + made, 0) == -1

    @pytest.mark.parametrize(("made", "least"), [(frame(), 12), (old_frame(), 8)])
    def test_a_header_cut_short_tells_nothing(self, made: bytes, least: int) -> None:
        assert framing.frame_end(made[:least], 0) > 0
        assert framing.frame_end(made[: least - 1], 0) == -1

    @pytest.mark.parametrize(("made", "number"), [(frame(number=FAR), FAR), (old_frame(), SHORT), (frame(), NUMBER)])
    def test_which_message_it_is(self, made: bytes, number: int) -> None:
        assert framing.message_of(b"\0\0" + made, 2) == number

    @pytest.mark.parametrize("count", [1, 3, 4, 5, 9])
    def test_rows_are_filled_as_far_as_they_go_and_reading_goes_on_there(self, count: int) -> None:
        data = b"".join(frame(sequence=number) for number in range(count))
        reading = new_reading(is_datagram=True, follow_sequence=True, keep_mavlink1=False)
        rows = np.zeros(4, dtype=ROW)
        numbers: list[int] = []
        at = 0
        while at >= 0:
            found, at = framing.read_frames(data, at, reading, TABLE, rows)
            numbers += rows["sequence"][:found].tolist()
            assert found == 4 or at < 0
        assert numbers == list(range(count))


@compiled
def _take(data: bytes, rows: Packed, payload: Output) -> None:
    framing.take_payload(data, rows[0], payload)


@compiled
def unseeded(data: bytes) -> int:
    """The checksum before a seed."""
    return framing.crc_of(data, 0, len(data))
