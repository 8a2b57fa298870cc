"""Frames with their times moved and with new signatures, as pymavlink reads them."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from protocol.logs.retime import TIME_FIELDS, TimeMover, time_fields
from protocol.logs.scan import Scan, scan_tlog
from protocol.wire.codec import FrameWriter, layout
from protocol.wire.signing import Signatures

KEY = bytes(range(32))
NOW_US = 1_795_000_000_000_000
UNIX_US = 1_700_000_000_000_000
STAMP = struct.Struct(">Q")


def log_of(*frames: bytes) -> Scan:
    return scan_tlog(b"".join(STAMP.pack(UNIX_US + k) + frame for k, frame in enumerate(frames)))


def frame_of(name: str, system: int = 1, **values: Any) -> bytes:
    message = layout(name)
    return FrameWriter(system, 1).seal(message, message.pack_fields(**values))


def mavlink1_frame(message: Any) -> bytes:
    return bytes(message.pack(common.MAVLink(None, 1, 1), force_mavlink1=True))


def moved(*frames: bytes, extra_us: int = 0) -> list[Any]:
    """The frames after a move, as pymavlink decodes them (which checks every checksum)."""
    scan = log_of(*frames)
    mover = TimeMover(scan, np.ones(len(scan), dtype=np.bool_), NOW_US)
    return [decoded(mover.move(frame, extra_us)) for frame in frames]


def unsigned(frame: bytes) -> bool:
    return frame[0] == 0xFE or not frame[2] & 1


def decoded(frame: bytes, key: bytes | None = None) -> Any:
    reader = common.MAVLink(None)
    if key:
        reader.signing.secret_key = key
    message = reader.parse_char(frame)
    assert message is not None
    assert message.get_type() != "BAD_DATA", frame.hex()
    assert reader.parse_char(b"") is None
    return message


class TestTimes:
    def test_times_since_1970_begin_now(self) -> None:
        first, second = moved(
            frame_of("GPS_RAW_INT", time_usec=UNIX_US + 7, lat=5),
            frame_of("GPS_RAW_INT", time_usec=UNIX_US + 1007, lat=6),
        )
        assert (first.time_usec, second.time_usec) == (NOW_US, NOW_US + 1000)
        assert (first.lat, second.lat) == (5, 6)

    def test_times_since_boot_begin_at_zero_for_each_system(self) -> None:
        frames = [
            frame_of("ATTITUDE", time_boot_ms=5_000, roll=0.5),
            frame_of("HIL_SENSOR", time_usec=5_250_000),
            frame_of("ATTITUDE", system=2, time_boot_ms=90_000),
            frame_of("ATTITUDE", system=2, time_boot_ms=90_040),
        ]
        one, two, three, four = moved(*frames)
        assert (one.time_boot_ms, two.time_usec) == (0, 250_000)
        assert one.roll == 0.5
        assert (three.time_boot_ms, four.time_boot_ms) == (0, 40)

    def test_a_pass_further_on_is_later_by_what_is_asked(self) -> None:
        (one,) = moved(frame_of("ATTITUDE", time_boot_ms=5_000), extra_us=3_000_000)
        (two,) = moved(frame_of("GPS_RAW_INT", time_usec=UNIX_US), extra_us=3_000_000)
        assert (one.time_boot_ms, two.time_usec) == (3_000, NOW_US + 3_000_000)

    def test_both_times_of_one_message_and_an_unknown_one(self) -> None:
        known, unknown = moved(
            frame_of("SYSTEM_TIME", time_unix_usec=UNIX_US, time_boot_ms=8_000),
            frame_of("SYSTEM_TIME", time_unix_usec=0, time_boot_ms=9_000),
        )
        assert (known.time_unix_usec, known.time_boot_ms) == (NOW_US, 0)
        assert (unknown.time_unix_usec, unknown.time_boot_ms) == (0, 1_000)

    def test_a_log_that_begins_at_zero_stays(self) -> None:
        frames = [frame_of("HIL_SENSOR", time_usec=4000 * k, xacc=1.5) for k in range(3)]
        assert [message.time_usec for message in moved(*frames)] == [0, 4000, 8000]

    def test_mavlink_1_keeps_its_version(self) -> None:
        (message,) = moved(mavlink1_frame(common.MAVLink_attitude_message(7_000, 0.25, 0, 0, 0, 0, 0)))
        assert (message.time_boot_ms, message.roll) == (0, 0.25)
        assert message.get_msgbuf()[0] == 0xFE

    def test_what_has_no_time_is_left_as_it_is(self) -> None:
        heartbeat, foreign = frame_of("HEARTBEAT", type=2), b"\xfd\x01\x00\x00\x09\x01\x01\xff\xff\xfe\x07\x11\x22"
        scan = log_of(heartbeat)
        mover = TimeMover(scan, np.ones(1, dtype=np.bool_), NOW_US)
        assert mover.move(heartbeat, 5) == heartbeat
        assert mover.move(foreign, 5) == foreign
        assert mover.moved == 0

    def test_only_chosen_frames_say_when_it_began(self) -> None:
        early, late = frame_of("ATTITUDE", time_boot_ms=1_000), frame_of("ATTITUDE", time_boot_ms=6_000)
        mover = TimeMover(log_of(early, late), np.array([False, True]), NOW_US)
        assert decoded(mover.move(late, 0)).time_boot_ms == 0

    @settings(max_examples=50)
    @given(
        st.sampled_from(sorted(m for m in common.mavlink_map if time_fields(layout(common.mavlink_map[m].msgname)))),
        st.data(),
    )
    def test_every_message_with_a_time_stays_whole(self, number: int, data: st.DataObject) -> None:
        message = layout(common.mavlink_map[number].msgname)
        payload = data.draw(st.binary(min_size=message.size, max_size=message.size))
        frame = FrameWriter(1, 1).seal(message, payload)
        scan = log_of(frame)
        out = TimeMover(scan, np.ones(1, dtype=np.bool_), NOW_US).move(frame, 0)
        (again,) = scan_tlog(STAMP.pack(UNIX_US) + out).frames
        assert (again["message_id"], again["sequence"], again["known"]) == (number, 0, 1)
        before, after = (message.unpack_fields(f[10 : 10 + f[1]]) for f in (frame, out))
        for name, value in before.items():
            if name not in TIME_FIELDS:
                assert np.array_equal(value, after[name], equal_nan=not isinstance(value, bytes)), name


def test_moved_times_leave_no_signature_that_does_not_fit() -> None:
    frame = Signatures(KEY).sign(frame_of("ATTITUDE", time_boot_ms=5_000), NOW_US)
    mover = TimeMover(log_of(frame), np.ones(1, dtype=np.bool_), NOW_US)
    assert unsigned(mover.move(frame, 0))
    assert not unsigned(Signatures(KEY).sign(mover.move(frame, 0), NOW_US))
