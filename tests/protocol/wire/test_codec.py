"""Frames against pymavlink, byte for byte and both ways, and the reader on everything that a link may deliver.

pymavlink's own `pack` and parser are the reference; the codec shares with them only the tables of the dialect.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from protocol.wire.codec import Frame, FrameReader, FrameWriter, layout, layouts_by_id
from protocol.wire.framing import CAUSES, LONGEST_FRAME
from protocol.wire.streams import STREAMS

NAMES = sorted(message.msgname for message in common.mavlink_map.values())
ZEROS = dict.fromkeys(CAUSES, 0)
UNKNOWN_ID = 0x15ABCD

# Bits of a quiet NaN carry a payload through struct; a signalling one would be made quiet by the processor.
_QUIET_NANS = st.integers(0, 0x3FFFFF).map(lambda bits: struct.unpack("<f", struct.pack("<I", 0x7FC00000 | bits))[0])
_INTEGERS = {f"{sign}int{bits}_t": (sign, bits) for sign in ("", "u") for bits in (8, 16, 32, 64)}


def _numbers(kind: str) -> st.SearchStrategy[Any]:
    if kind == "float":
        return st.just(0.0) | st.floats(width=32) | _QUIET_NANS
    if kind == "double":
        return st.floats()
    sign, bits = _INTEGERS[kind]
    return st.just(0) | (st.integers(0, 2**bits - 1) if sign else st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1))


def _values(name: str) -> st.SearchStrategy[dict[str, Any]]:
    """Values of every field of a message, extensions included; the last ones often zero, as on the wire."""
    message = common.mavlink_map[layout(name).message_id]
    lengths = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True))
    fields: dict[str, st.SearchStrategy[Any]] = {}
    for field, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        length = lengths[field]
        if kind == "char":
            fields[field] = st.binary(max_size=length)
        elif length:
            fields[field] = st.lists(_numbers(kind), min_size=length, max_size=length)
        else:
            fields[field] = _numbers(kind)
    return st.fixed_dictionaries(fields)


def _pymavlink(sequence: int = 0, system: int = 1, component: int = 1) -> Any:
    sender = common.MAVLink(None, srcSystem=system, srcComponent=component)
    sender.seq = sequence
    return sender


def _packed(name: str, values: dict[str, Any], sender: Any) -> bytes:
    return bytes(common.mavlink_map[layout(name).message_id](**values).pack(sender))


def _writer(sequence: int = 0, system: int = 1, component: int = 1) -> FrameWriter:
    writer = FrameWriter(system, component)
    writer.sequence = sequence
    return writer


def _bits(value: Any) -> Any:
    """Something that is equal for equal numbers and for equal NaNs; strings without the zeros that fill their field."""
    if isinstance(value, bytes):
        return value.rstrip(b"\0")
    if isinstance(value, (list, tuple)):
        return [_bits(item) for item in value]
    return struct.pack("<d", value) if isinstance(value, float) else value


def _field(parsed: Any, field: str) -> Any:
    """A field of a message that pymavlink parsed; of a string, its bytes."""
    return getattr(parsed, f"_{field}_raw", getattr(parsed, field))


def _read(data: bytes, *, is_datagram: bool = True) -> tuple[list[Frame], dict[str, int]]:
    reader = FrameReader(is_datagram=is_datagram)
    return reader.read(data), {cause: count for cause, count in reader.counters.items() if count}


def _assert_both_ways(name: str, values: dict[str, Any], numbers: tuple[int, int, int]) -> None:
    theirs = _packed(name, values, _pymavlink(*numbers))
    message = layout(name)
    ours = _writer(*numbers).seal(message, message.pack_fields(**values))
    assert ours == theirs

    (frame,), counted = _read(theirs)
    assert counted == {}
    assert frame[:4] == (message.message_id, *numbers)
    assert frame.raw == theirs
    read = message.unpack_fields(frame.payload)
    parsed = _pymavlink().parse_char(ours)
    assert parsed.get_type() == name
    assert (parsed.get_seq(), parsed.get_srcSystem(), parsed.get_srcComponent()) == numbers
    for field, value in read.items():
        assert _bits(value) == _bits(_field(parsed, field)), field
        assert _bits(value) == _bits(values[field]), field


def _frames(count: int, seed: int = 0) -> list[bytes]:
    """`count` frames of many kinds, numbered from 0, whose bytes hold neither magic but at their start."""
    writer, chance = FrameWriter(1, 1), random.Random(seed)
    frames: list[bytes] = []
    while len(frames) < count:
        message = layout(chance.choice(NAMES))
        frame = writer.seal(message, bytes(chance.randrange(0xFD) for _ in range(chance.randint(1, message.size))))
        if max(frame[1:]) < 0xFD:
            frames.append(frame)
        else:  # an id, length or checksum with such a byte
            writer.sequence = len(frames)
    return frames


FRAMES = _frames(60)


class TestAgainstPymavlink:
    @pytest.mark.parametrize("name", [row.message for row in STREAMS])
    @settings(max_examples=20)
    @given(data=st.data(), numbers=st.tuples(*[st.integers(0, 255)] * 3))
    def test_every_message_of_the_link_agrees_both_ways(
        self, name: str, data: st.DataObject, numbers: tuple[int, int, int]
    ) -> None:
        _assert_both_ways(name, data.draw(_values(name)), numbers)

    @settings(max_examples=120)
    @given(data=st.data(), numbers=st.tuples(*[st.integers(0, 255)] * 3))
    def test_any_message_of_the_dialect_agrees_both_ways(
        self, data: st.DataObject, numbers: tuple[int, int, int]
    ) -> None:
        name = data.draw(st.sampled_from(NAMES))
        _assert_both_ways(name, data.draw(_values(name)), numbers)

    def test_arbitrary_payload_bits_pass_our_seal_and_their_parser(self) -> None:
        # Bytes, not values: signalling NaNs and every other pattern included.
        for message in layouts_by_id().values():
            payload = random.Random(message.name).randbytes(message.size)
            sealed = FrameWriter(7, 8).seal(message, payload)
            parsed = _pymavlink().parse_char(sealed)
            assert parsed.get_type() == message.name
            for field, value in message.unpack_fields(payload).items():
                assert _bits(value) == _bits(_field(parsed, field)), (message.name, field)
            (frame,), counted = _read(sealed)
            assert counted == {}
            assert frame.payload.ljust(message.size, b"\0") == payload

    def test_all_zeros_leave_one_byte(self) -> None:
        for message in layouts_by_id().values():
            sealed = FrameWriter(1, 1).seal(message, bytes(message.size))
            assert (len(sealed), sealed[1]) == (13, 1)
            assert _pymavlink().parse_char(sealed).get_type() == message.name
            (frame,), _ = _read(sealed)
            for value in message.unpack(frame.payload):
                assert not (value.rstrip(b"\0") if isinstance(value, bytes) else value)

    def test_zeros_are_cut_at_the_end_only(self) -> None:
        message = layout("ATTITUDE")
        payload = message.pack_fields(time_boot_ms=0, roll=0.0, pitch=1.0)
        sealed = FrameWriter(1, 1).seal(message, payload)
        # time_boot_ms and roll stay; of pitch 1.0 = 00 00 80 3f nothing is cut; the five floats after it are.
        assert sealed[10:-2] == bytes(10) + b"\x80\x3f"

    def test_extensions_left_out_by_an_old_sender_read_as_zero(self) -> None:
        message = layout("HIL_GPS")  # its extensions: id, yaw
        payload = message.pack_fields(lat=5, satellites_visible=9, id=3, yaw=1234)
        old_sender = _writer().seal(message, payload[:36])
        (frame,), _ = _read(old_sender)
        read = message.unpack_fields(frame.payload)
        assert (read["lat"], read["satellites_visible"], read["id"], read["yaw"]) == (5, 9, 0, 0)

    def test_extensions_unknown_to_us_are_ignored(self) -> None:
        message = layout("HEARTBEAT")
        newer = _writer().seal(message, message.pack_fields(custom_mode=77, mavlink_version=3) + b"new fields")
        (frame,), counted = _read(newer)
        assert counted == {}
        assert message.unpack_fields(frame.payload)["custom_mode"] == 77
        assert message.unpack_fields(frame.payload)["mavlink_version"] == 3

    @pytest.mark.parametrize("frame_count", [1, 3])
    def test_signed_frames_are_read(self, frame_count: int) -> None:
        sender = _pymavlink()
        sender.signing.secret_key = bytes(range(32))
        sender.signing.sign_outgoing = True
        sender.signing.link_id = 4
        signed = b""
        for sender.seq in range(frame_count):
            signed += _packed("ATTITUDE", dict.fromkeys(layout("ATTITUDE").fields, 1), sender)
        frames, counted = _read(signed)
        assert counted == {}
        assert len(frames) == frame_count
        for frame in frames:
            assert len(frame.raw) == 10 + 28 + 2 + 13
            assert layout("ATTITUDE").unpack_fields(frame.payload)["yawspeed"] == 1.0
        assert b"".join(frame.raw for frame in frames) == signed


class TestLayouts:
    def test_the_numpy_structure_is_the_payload_field_by_field(self) -> None:
        for message in layouts_by_id().values():
            payload = random.Random(message.name).randbytes(message.size)
            assert message.dtype.itemsize == message.size
            row = np.frombuffer(payload, message.dtype)[0]
            for field, value in message.unpack_fields(payload).items():
                assert _bits(row[field].tolist()) == _bits(value), (message.name, field)

    def test_the_longest_frame_is_that_of_a_full_signed_payload(self) -> None:
        assert LONGEST_FRAME == 280
        assert max(message.size for message in layouts_by_id().values()) <= 255

    def test_a_name_the_dialect_lacks_is_refused(self) -> None:
        with pytest.raises(KeyError, match="NO_SUCH_MESSAGE"):
            layout("NO_SUCH_MESSAGE")

    def test_a_field_the_message_lacks_is_refused(self) -> None:
        with pytest.raises(KeyError, match="HEARTBEAT has no field velocity"):
            layout("HEARTBEAT").pack_fields(velocity=1)

    def test_a_short_array_is_filled_with_zeros_and_a_long_one_is_refused(self) -> None:
        message = layout("HIL_ACTUATOR_CONTROLS")
        payload = message.pack_fields(controls=[0.5])
        assert message.unpack_fields(payload)["controls"] == (0.5,) + (0.0,) * 15
        with pytest.raises(struct.error):
            message.pack_fields(controls=[0.5] * 17)

    def test_strings_are_bytes(self) -> None:
        message = layout("STATUSTEXT")
        read = message.unpack_fields(message.pack_fields(severity=4, text=b"gear worn", id=513, chunk_seq=2))
        assert read == {"severity": 4, "text": b"gear worn".ljust(50, b"\0"), "id": 513, "chunk_seq": 2}

    def test_sequence_numbers_count_up_and_wrap(self) -> None:
        writer = FrameWriter(1, 1)
        numbers = [writer.seal(layout("HEARTBEAT"), b"\1")[4] for _ in range(258)]
        assert numbers == [*range(256), 0, 1]


class TestReaderOnAStream:
    @settings(max_examples=60)
    @given(st.data())
    def test_however_a_stream_is_cut_the_frames_are_the_same(self, data: st.DataObject) -> None:
        picked = FRAMES[: data.draw(st.integers(1, 8))]
        noise = st.binary(max_size=12).map(lambda noise: bytes(byte % 0xFD for byte in noise))
        parts = [part for frame in picked for part in (data.draw(noise), frame)]
        stream = b"".join(parts)
        cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
        reader = FrameReader(is_datagram=False)
        chunks = [stream[start:stop] for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
        found = [frame.raw for chunk in chunks for frame in reader.read(chunk)]
        assert found == picked
        assert reader.counters == ZEROS | {"garbage_bytes": sum(map(len, parts[::2]))}

    def test_byte_by_byte_works_too(self) -> None:
        reader = FrameReader(is_datagram=False)
        assert [f.raw for byte in b"".join(FRAMES) for f in reader.read(bytes([byte]))] == FRAMES
        assert reader.counters == ZEROS

    def test_a_frame_is_handed_on_with_its_last_byte_and_not_later(self) -> None:
        reader = FrameReader(is_datagram=False)
        assert reader.read(FRAMES[0][:-1]) == []
        assert [frame.raw for frame in reader.read(FRAMES[0][-1:])] == FRAMES[:1]

    def test_a_broken_length_holds_up_a_stream_no_longer_than_the_longest_frame(self) -> None:
        broken = FRAMES[0][:1] + b"\xfc" + FRAMES[0][2:]
        reader = FrameReader(is_datagram=False)
        sent = broken + b"".join(FRAMES[1:])
        found: list[Frame] = []
        read = 0
        while not found:
            found = reader.read(sent[read : read + 1])
            read += 1
        assert read <= LONGEST_FRAME
        found += reader.read(sent[read:])
        assert [frame.raw for frame in found] == FRAMES[1:]
        assert reader.counters["bad_crc"] == 1

    def test_a_frame_that_ends_a_bad_one_is_handed_on_and_the_bad_one_is_not(self) -> None:
        """The bad one says that it ends where the bytes do, and its checksum is that of the frame within it."""
        inner = FRAMES[3]
        payload = bytes(20) + inner[:-2]
        outer = b"\xfd" + struct.pack("<BBBBBBHB", len(payload), 0, 0, 0, 1, 1, 110, 0) + payload + inner[-2:]
        frames, counted = _read(outer, is_datagram=False)
        assert [frame.raw for frame in frames] == [inner]
        assert counted["bad_crc"] == 1


class TestReaderOnDatagrams:
    def test_several_frames_of_a_datagram_come_in_order(self) -> None:
        frames, counted = _read(b"".join(FRAMES))
        assert [frame.raw for frame in frames] == FRAMES
        assert counted == {}

    def test_nothing_is_kept_for_the_next_datagram(self) -> None:
        reader = FrameReader(is_datagram=True)
        half = len(FRAMES[0]) // 2
        assert reader.read(FRAMES[0][:half]) == []
        assert reader.read(FRAMES[0][half:]) == []
        assert [frame.raw for frame in reader.read(FRAMES[1])] == [FRAMES[1]]
        assert reader.counters == ZEROS | {"truncated": 1, "garbage_bytes": len(FRAMES[0]) - half}

    @pytest.mark.parametrize("kept", [1, 2, 3, 9, 11, -1])
    def test_a_frame_cut_short_is_counted_once_and_those_before_it_are_read(self, kept: int) -> None:
        frames, counted = _read(FRAMES[0] + FRAMES[1][:kept])
        assert [frame.raw for frame in frames] == FRAMES[:1]
        assert counted == {"truncated": 1}

    def test_an_empty_datagram_is_nothing(self) -> None:
        assert _read(b"") == ([], {})

    @given(st.binary(min_size=1, max_size=40).map(lambda noise: bytes(byte % 0xFD for byte in noise)))
    @settings(max_examples=40)
    def test_what_does_not_begin_a_frame_ends_the_datagram_and_is_counted(self, garbage: bytes) -> None:
        frames, counted = _read(FRAMES[0] + garbage + FRAMES[1])
        assert [frame.raw for frame in frames] == FRAMES[:1]
        assert counted == {"garbage_bytes": len(garbage) + len(FRAMES[1])}

    @pytest.mark.parametrize("spoiled", ["checksum", "flags", "length", "version 1", "start"])
    def test_a_frame_inside_a_bad_one_is_never_handed_on(self, spoiled: str) -> None:
        """A stranger who may spoil one frame must not speak through its payload; the frame behind it counts again."""
        inner = FRAMES[3]
        message = layout("FILE_TRANSFER_PROTOCOL")
        outer = bytearray(_writer().seal(message, bytes(5) + inner + bytes(20) + b"\1"))
        if spoiled == "checksum":
            outer[-1] ^= 1
        elif spoiled == "flags":
            outer = bytearray(_sealed_by_hand(0x02, message.message_id, bytes(outer[10:-2]), message.crc_seed))
        elif spoiled == "length":
            outer[1] = 5
        elif spoiled == "version 1":
            outer = bytearray(b"\xfe") + outer[1:2] + outer[4:7] + b"\x00" + outer[10:]
        else:
            outer[0] = 0
        frames, _ = _read(bytes(outer) + FRAMES[4])
        assert inner not in [frame.raw for frame in frames]
        if spoiled in ("checksum", "flags", "version 1"):
            assert [frame.raw for frame in frames] == [FRAMES[4]]


FIRST_PAYLOAD_BYTE = 10


class TestDamage:
    @pytest.mark.parametrize("is_datagram", [True, False])
    @settings(max_examples=100)
    @given(data=st.data())
    def test_a_damaged_byte_costs_its_frame_and_no_other(self, is_datagram: bool, data: st.DataObject) -> None:
        hit = data.draw(st.integers(0, 9))
        # Any byte of the frame but its start and length (their tests stand beside this one) and its id, which may
        # become one that the dialect lacks: such frames are handed on.
        flags = [] if is_datagram else [2]  # they may announce a signature, and with it another end
        at = data.draw(st.sampled_from([*flags, 3, 4, 5, 6, *range(FIRST_PAYLOAD_BYTE, len(FRAMES[hit]))]))
        damaged = bytearray(FRAMES[hit])
        damaged[at] ^= data.draw(st.integers(1, 255))
        sent = [*FRAMES[:hit], bytes(damaged), *FRAMES[hit + 1 :]]
        frames, counted = _read(b"".join(sent), is_datagram=is_datagram)
        assert [frame.raw for frame in frames] == FRAMES[:hit] + FRAMES[hit + 1 :]
        # At least one: the damaged byte may look like the start of a frame, too. A loss before the first goes unseen.
        assert counted["bad_crc"] >= 1
        assert counted.get("sequence_gaps", 0) == (1 if hit else 0)

    def test_a_flipped_bit_is_one_bad_checksum(self) -> None:
        damaged = bytearray(FRAMES[1])
        damaged[FIRST_PAYLOAD_BYTE] ^= 1
        assert max(damaged[1:]) < 0xFD
        for is_datagram, skipped in ((True, {}), (False, {"garbage_bytes": len(damaged) - 1})):
            frames, counted = _read(FRAMES[0] + damaged + FRAMES[2], is_datagram=is_datagram)
            assert [frame.raw for frame in frames] == [FRAMES[0], FRAMES[2]]
            assert counted == {"bad_crc": 1, "sequence_gaps": 1} | skipped

    def test_a_damaged_start_is_garbage(self) -> None:
        frames, counted = _read(FRAMES[0] + b"\0" + FRAMES[1][1:] + FRAMES[2], is_datagram=False)
        assert [frame.raw for frame in frames] == [FRAMES[0], FRAMES[2]]
        assert counted == {"garbage_bytes": len(FRAMES[1]), "sequence_gaps": 1}

    @pytest.mark.parametrize("length", [0, 1, 100, 200, 0xFC])
    def test_a_damaged_length_costs_its_frame_on_a_stream_and_the_rest_of_a_datagram(self, length: int) -> None:
        damaged = FRAMES[1][:1] + bytes([length]) + FRAMES[1][2:]
        assert length != FRAMES[1][1]
        data = FRAMES[0] + damaged + b"".join(FRAMES[2:])
        frames, _ = _read(data, is_datagram=False)
        assert [frame.raw for frame in frames] == FRAMES[:1] + FRAMES[2:]
        frames, counted = _read(data)
        found = [frame.raw for frame in frames]
        assert found[0] == FRAMES[0]
        assert set(found[1:]) <= set(FRAMES[2:])  # where the false end happens to be a true one, those behind it count
        assert counted["bad_crc"] >= 1

    @given(st.lists(st.binary(max_size=300) | st.sampled_from(FRAMES), max_size=6), st.booleans())
    @settings(max_examples=150)
    def test_arbitrary_bytes_never_raise_and_every_frame_found_was_there(
        self, chunks: list[bytes], is_datagram: bool
    ) -> None:
        reader = FrameReader(is_datagram=is_datagram)
        found = [frame for chunk in chunks for frame in reader.read(chunk)]
        sent = b"".join(chunks)
        for frame in found:
            assert frame.raw in sent
        assert all(count >= 0 for count in reader.counters.values())

    @given(st.lists(st.sampled_from([0xFD, 0xFE, 0, 1, 2, 9, 255]), max_size=400).map(bytes), st.booleans())
    @settings(max_examples=150)
    def test_bytes_full_of_false_starts_never_raise(self, data: bytes, is_datagram: bool) -> None:
        reader = FrameReader(is_datagram=is_datagram)
        reader.read(data)
        # The reader still works: after enough of the next frames it has found its feet.
        found = [frame.raw for _ in range(LONGEST_FRAME) for frame in reader.read(FRAMES[0])]
        assert FRAMES[0] in found


def _sealed_by_hand(flags: int, number: int, payload: bytes, seed: int, sequence: int = 0) -> bytes:
    body = struct.pack("<BBBBBBHB", len(payload), flags, 0, sequence, 1, 1, number & 0xFFFF, number >> 16) + payload
    checksum = common.x25crc(body + bytes([seed])).crc
    return b"\xfd" + body + struct.pack("<H", checksum)


class TestForeignFrames:
    def test_an_unknown_message_is_counted_and_handed_on(self) -> None:
        foreign = _sealed_by_hand(0, UNKNOWN_ID, b"abc", seed=0, sequence=1)
        assert UNKNOWN_ID not in common.mavlink_map
        frames, counted = _read(FRAMES[0] + foreign + FRAMES[2])
        assert [frame.raw for frame in frames] == [FRAMES[0], foreign, FRAMES[2]]
        assert (frames[1].message_id, frames[1].payload) == (UNKNOWN_ID, b"abc")
        # It has a sequence number like any other, so there is no gap.
        assert counted == {"unknown_message": 1}

    def test_an_unknown_message_that_nothing_plausible_follows_is_not_believed(self) -> None:
        # Its checksum cannot be verified, so a false start must not swallow the frames behind it.
        false_start = _sealed_by_hand(0, UNKNOWN_ID, bytes(20), seed=0)[:-10]
        frames, counted = _read(false_start + FRAMES[0], is_datagram=False)
        assert [frame.raw for frame in frames] == [FRAMES[0]]
        assert "unknown_message" not in counted

    def test_a_frame_with_a_flag_of_unknown_meaning_is_dropped_and_counted(self) -> None:
        # The MAVLink 2 guide: a packet whose incompatibility flags are not understood must be discarded.
        message = layout("HEARTBEAT")
        payload = message.pack_fields(mavlink_version=3)
        plain = _sealed_by_hand(0, 0, payload, common.mavlink_map[0].crc_extra)
        flagged = _sealed_by_hand(0x02, 0, payload, common.mavlink_map[0].crc_extra)
        assert [frame.raw for frame in _read(plain)[0]] == [plain]
        frames, counted = _read(flagged + plain)
        assert [frame.raw for frame in frames] == [plain]
        assert counted == {"unknown_flags": 1}

    def test_compatibility_flags_do_not_matter(self) -> None:
        frame = bytearray(_sealed_by_hand(0, 0, b"\1", common.mavlink_map[0].crc_extra))
        frame[3] = 0xFF
        body = bytes(frame[1:-2])
        frame[-2:] = struct.pack("<H", common.x25crc(body + bytes([common.mavlink_map[0].crc_extra])).crc)
        assert [found.raw for found in _read(bytes(frame))[0]] == [bytes(frame)]

    def test_a_mavlink_1_frame_is_counted_and_passed_over(self) -> None:
        values = {**dict.fromkeys(layout("ATTITUDE").fields, 1.0), "time_boot_ms": 0xFDFDFD}
        old = bytes(common.MAVLink_attitude_message(**values).pack(_pymavlink(), force_mavlink1=True))
        assert old[0] == 0xFE
        frames, counted = _read(FRAMES[0] + old + FRAMES[1] + old)
        assert [frame.raw for frame in frames] == FRAMES[:2]
        assert counted == {"mavlink1": 2}

    @pytest.mark.parametrize("damage", [(8, 1), (-1, 1)])
    def test_a_damaged_mavlink_1_frame_is_garbage(self, damage: tuple[int, int]) -> None:
        old = bytearray(common.MAVLink_heartbeat_message(1, 2, 3, 4, 5, 3).pack(_pymavlink(), force_mavlink1=True))
        at, bits = damage
        old[at] ^= bits
        assert max(old[1:]) < 0xFD
        frames, counted = _read(bytes(old) + FRAMES[0], is_datagram=False)
        assert [frame.raw for frame in frames] == FRAMES[:1]
        assert counted == {"bad_crc": 1, "garbage_bytes": len(old) - 1}

    def test_a_recorder_keeps_mavlink_1_frames_of_messages_that_the_dialect_lacks_too(self) -> None:
        known = bytes(common.MAVLink_heartbeat_message(1, 2, 3, 4, 5, 3).pack(_pymavlink(), force_mavlink1=True))
        foreign = known[:5] + b"\xc1" + known[6:]  # 193: none of `common`
        reader = FrameReader(is_datagram=True, keep_mavlink1=True)
        frames = reader.read(known + foreign + known)
        assert [frame.raw for frame in frames] == [known, foreign, known]
        assert [(frame.message_id, frame.system, frame.payload) for frame in frames][1] == (193, 1, known[6:-2])
        assert (reader.counters["mavlink1"], reader.counters["unknown_message"]) == (3, 1)


def _numbered(numbers: Iterable[int], component: int = 1) -> bytes:
    return b"".join(_writer(number & 0xFF, 1, component).seal(layout("HEARTBEAT"), b"\1") for number in numbers)


class TestSequence:
    @pytest.mark.parametrize(
        ("numbers", "gaps", "out_of_order"),
        [
            ([7, 8, 9], 0, 0),
            ([200], 0, 0),  # whatever comes first is the start
            ([254, 255, 256, 257], 0, 0),
            ([1, 3], 1, 0),
            ([250, 260], 9, 0),
            ([5, 5], 0, 1),
            ([5, 6, 7, 6, 8], 0, 1),
            ([1, 4, 2, 3, 5], 2, 2),
            ([0, 128], 127, 0),  # half a turn ahead is the farthest that counts as ahead
            ([0, 129], 0, 1),
        ],
    )
    def test_gaps_and_stragglers_are_counted(self, numbers: list[int], gaps: int, out_of_order: int) -> None:
        frames, counted = _read(_numbered(numbers))
        assert [frame.sequence for frame in frames] == [number & 0xFF for number in numbers]
        assert (counted.get("sequence_gaps", 0), counted.get("out_of_order", 0)) == (gaps, out_of_order)

    @given(st.integers(0, 255), st.sets(st.integers(1, 998), max_size=100))
    @settings(max_examples=30)
    def test_every_lost_frame_is_a_gap(self, start: int, lost: set[int]) -> None:
        kept = [start + number for number in range(1000) if number not in lost]
        _, counted = _read(_numbered(kept))
        assert counted == ({"sequence_gaps": len(lost)} if lost else {})

    def test_each_component_counts_for_itself(self) -> None:
        data = _numbered([1], 1) + _numbered([90], 2) + _numbered([2], 1) + _numbered([92], 2)
        assert _read(data)[1] == {"sequence_gaps": 1}

    def test_a_lost_frame_is_counted_across_datagrams(self) -> None:
        reader = FrameReader(is_datagram=True)
        reader.read(_numbered([1]))
        reader.read(_numbered([4]))
        assert reader.counters["sequence_gaps"] == 2

    def test_restart_forgets_what_was_seen(self) -> None:
        reader = FrameReader(is_datagram=True)
        reader.read(_numbered([40, 41]))
        reader.restart_sequences()
        reader.read(_numbered([0, 1]))
        assert reader.counters == ZEROS

    def test_restart_with_the_next_number_finds_the_very_first_loss(self) -> None:
        reader = FrameReader(is_datagram=True)
        reader.restart_sequences([(1, 1, 256), (1, 2, 5)])
        reader.read(_numbered([2]) + _numbered([5], 2))
        assert reader.counters == ZEROS | {"sequence_gaps": 2}

    def test_restart_keeps_the_counters(self) -> None:
        reader = FrameReader(is_datagram=True)
        reader.read(_numbered([1, 3]) + b"?")
        reader.restart_sequences()
        assert reader.counters == ZEROS | {"sequence_gaps": 1, "garbage_bytes": 1}

    def test_without_following_nothing_is_counted_until_a_restart(self) -> None:
        reader = FrameReader(is_datagram=True, follow_sequence=False)
        assert len(reader.read(_numbered([1, 9, 9, 4]))) == 4
        assert reader.counters == ZEROS
        reader.restart_sequences()
        reader.read(_numbered([20, 22, 20]))
        assert reader.counters == ZEROS | {"sequence_gaps": 1, "out_of_order": 1}

    def test_a_bad_frame_does_not_move_the_count(self) -> None:
        bad = bytearray(_numbered([50]))
        bad[-1] ^= 0xFF
        _, counted = _read(_numbered([1]) + bad + _numbered([2]))
        assert "sequence_gaps" not in counted
        assert "out_of_order" not in counted
