"""The compiled frames of a tick against the codec: the same bytes out, and only the plain case in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import mavlink_map
from protocol.mavlink_codec import FrameReader, FrameWriter
from protocol.messages import ActuatorCommand
from protocol.tick_frames import CommandWriter, TickWriter, read_command, read_tick

EMULATOR, VEHICLE = (1, 191), (1, 1)
SCALE = np.array([0.04, 0.04, 0.12, 3e-4, 3e-4, 3e-4])
numbers = st.floats(-1.0, 1.0, width=32)
vectors = st.lists(numbers, min_size=6, max_size=6).map(np.array)
times = st.integers(0, 2**40).map(lambda t_us: t_us * 1000)


def tick_datagram(t_ns: int = 5_000_000, sequence: int = 3) -> bytes:
    writer = FrameWriter(*EMULATOR)
    writer.sequence = sequence
    return b"".join(TickWriter(writer).frames(t_ns, np.full(6, 0.1), np.ones(13)))


def command_datagram(t_ns: int = 5_000_000) -> bytes:
    return CommandWriter(FrameWriter(*VEHICLE), SCALE, lockstep=True).frame(
        ActuatorCommand(t_ns, 0.5 * SCALE, armed=True)
    )


def new_reader() -> FrameReader:
    return FrameReader(is_datagram=True, follow_sequence=False)


@settings(max_examples=60)
@given(
    t_ns=times, q=vectors, readings=st.lists(numbers, min_size=13, max_size=13).map(np.array), start=st.integers(0, 255)
)
def test_the_frames_of_a_tick_are_the_codec_s_to_the_byte(
    t_ns: int, q: np.ndarray, readings: np.ndarray, start: int
) -> None:
    fast, slow = FrameWriter(*EMULATOR), FrameWriter(*EMULATOR)
    fast.sequence = slow.sequence = start
    expected = (
        slow.seal(mavlink_map.POSE, mavlink_map.encode_pose(t_ns, q)),
        slow.seal(mavlink_map.TICK, mavlink_map.encode_tick(t_ns, readings)),
    )
    assert TickWriter(fast).frames(t_ns, q, readings) == expected
    assert fast.sequence == slow.sequence
    sample, slow_sample = (
        read_tick(b"".join(expected), EMULATOR, new_reader()),
        mavlink_map.decode_pose(mavlink_map.encode_pose(t_ns, q)),
    )
    assert sample is not None and slow_sample is not None  # noqa: PT018  (both for the type checker)
    assert sample.t_ns == slow_sample.t_ns
    assert np.array_equal(sample.q, slow_sample.q)


@settings(max_examples=60)
@given(t_ns=times, tau=vectors, armed=st.booleans(), lockstep=st.booleans())
def test_the_frame_of_a_command_is_the_codec_s_to_the_byte(
    t_ns: int, tau: np.ndarray, armed: bool, lockstep: bool
) -> None:
    command = ActuatorCommand(t_ns, tau * SCALE, armed)
    payload = mavlink_map.encode_command(command, SCALE, lockstep=lockstep)
    expected = FrameWriter(*VEHICLE).seal(mavlink_map.COMMAND, payload)
    assert CommandWriter(FrameWriter(*VEHICLE), SCALE, lockstep=lockstep).frame(command) == expected
    read, slow = read_command(expected, VEHICLE, new_reader(), SCALE, t_ns), mavlink_map.decode_command(payload, SCALE)
    assert read is not None and slow is not None  # noqa: PT018
    assert (read.t_ns, read.armed) == (slow.t_ns, slow.armed)
    assert np.array_equal(read.tau, slow.tau)


def test_a_datagram_cut_short_or_followed_by_more_is_left_to_the_codec() -> None:
    tick, command = tick_datagram(), command_datagram()
    for size in range(len(tick)):
        assert read_tick(tick[:size], EMULATOR, new_reader()) is None
    for size in range(len(command)):
        assert read_command(command[:size], VEHICLE, new_reader(), SCALE, 5_000_000) is None
    assert read_tick(tick + b"\xfd", EMULATOR, new_reader()) is None
    assert read_command(command + command, VEHICLE, new_reader(), SCALE, 5_000_000) is None


def test_a_flipped_bit_anywhere_is_left_to_the_codec() -> None:
    tick, command = tick_datagram(), command_datagram()
    for at in range(len(tick)):
        assert read_tick(tick[:at] + bytes([tick[at] ^ 4]) + tick[at + 1 :], EMULATOR, new_reader()) is None
    for at in range(len(command)):
        damaged = command[:at] + bytes([command[at] ^ 4]) + command[at + 1 :]
        assert read_command(damaged, VEHICLE, new_reader(), SCALE, 5_000_000) is None


def test_another_sender_another_time_or_another_number_is_left_to_the_codec() -> None:
    assert read_tick(tick_datagram(), VEHICLE, new_reader()) is None
    assert read_command(command_datagram(), EMULATOR, new_reader(), SCALE, 5_000_000) is None
    assert read_command(command_datagram(), VEHICLE, new_reader(), SCALE, 6_000_000) is None
    reader = new_reader()
    reader.restart_sequences([(*EMULATOR, 9)])
    assert read_tick(tick_datagram(sequence=3), EMULATOR, reader) is None
    assert read_tick(tick_datagram(sequence=9), EMULATOR, reader) is not None
    assert reader.counters["sequence_gaps"] == 0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_bad_numbers_are_left_to_the_codec_which_counts_them(bad: float) -> None:
    writer = FrameWriter(*EMULATOR)
    q = np.array([bad, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert read_tick(b"".join(TickWriter(writer).frames(0, q, np.ones(13))), EMULATOR, new_reader()) is None
    frame = CommandWriter(FrameWriter(*VEHICLE), SCALE, lockstep=True).frame(ActuatorCommand(0, q, armed=True))
    assert read_command(frame, VEHICLE, new_reader(), SCALE, 0) is None
