"""The compiled frames of a tick against the codec: the same bytes out, and only the plain case in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.messages import ActuatorCommand, FloatArray
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from protocol.wire.tick_frames import CommandWriter, TickWriter, parse_command, parse_tick

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


def read_tick(datagram: bytes, sender: tuple[int, int] = EMULATOR) -> tuple[int, int, FloatArray]:
    """Time in us, number of the first frame and q; the time is -1 where the datagram is not plain."""
    q = np.empty(6)
    return *parse_tick(np.frombuffer(datagram, np.uint8), *sender, q), q


def read_command(datagram: bytes, sender: tuple[int, int] = VEHICLE) -> tuple[int, int, int, FloatArray]:
    """Time in us, number, mode and tau; the time is -1 where the datagram is not plain."""
    tau = np.empty(6)
    return *parse_command(np.frombuffer(datagram, np.uint8), *sender, SCALE, tau), tau


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
        slow.seal(mapping.POSE, mapping.encode_pose(t_ns, q)),
        slow.seal(mapping.TICK, mapping.encode_tick(t_ns, readings)),
    )
    assert TickWriter(fast).frames(t_ns, q, readings) == expected
    assert fast.sequence == slow.sequence
    t_us, number, read = read_tick(b"".join(expected))
    slow_sample = mapping.decode_pose(mapping.encode_pose(t_ns, q))
    assert slow_sample is not None
    assert (t_us * 1000, number) == (slow_sample.t_ns, start)
    assert np.array_equal(read, slow_sample.q)


@settings(max_examples=60)
@given(t_ns=times, tau=vectors, armed=st.booleans(), lockstep=st.booleans())
def test_the_frame_of_a_command_is_the_codec_s_to_the_byte(
    t_ns: int, tau: np.ndarray, armed: bool, lockstep: bool
) -> None:
    command = ActuatorCommand(t_ns, tau * SCALE, armed)
    payload = mapping.encode_command(command, SCALE, lockstep=lockstep)
    expected = FrameWriter(*VEHICLE).seal(mapping.COMMAND, payload)
    assert CommandWriter(FrameWriter(*VEHICLE), SCALE, lockstep=lockstep).frame(command) == expected
    slow = mapping.decode_command(payload, SCALE)
    t_us, number, mode, read = read_command(expected)
    assert slow is not None
    assert (t_us * 1000, number, mode & mapping.ARMED != 0) == (slow.t_ns, 0, slow.armed)
    assert np.array_equal(read, slow.tau)


def test_a_datagram_cut_short_or_followed_by_more_is_left_to_the_codec() -> None:
    tick, command = tick_datagram(), command_datagram()
    for size in range(len(tick)):
        assert read_tick(tick[:size])[0] == -1
    for size in range(len(command)):
        assert read_command(command[:size])[0] == -1
    assert read_tick(tick + b"\xfd")[0] == -1
    assert read_command(command + command)[0] == -1


def test_a_flipped_bit_anywhere_is_left_to_the_codec() -> None:
    tick, command = tick_datagram(), command_datagram()
    for at in range(len(tick)):
        assert read_tick(tick[:at] + bytes([tick[at] ^ 4]) + tick[at + 1 :])[0] == -1
    for at in range(len(command)):
        assert read_command(command[:at] + bytes([command[at] ^ 4]) + command[at + 1 :])[0] == -1


def test_another_sender_is_left_to_the_codec() -> None:
    assert read_tick(tick_datagram())[0] == 5000
    assert read_tick(tick_datagram(), VEHICLE)[0] == -1
    assert read_command(command_datagram())[0] == 5000
    assert read_command(command_datagram(), EMULATOR)[0] == -1


def test_a_pose_and_a_tick_that_do_not_belong_together_are_left_to_the_codec() -> None:
    first, second = tick_datagram(t_ns=5_000_000, sequence=3), tick_datagram(t_ns=6_000_000, sequence=3)
    skipped = tick_datagram(t_ns=5_000_000, sequence=4)
    pose_size = 12 + first[1]
    assert read_tick(first[:pose_size] + second[pose_size:])[0] == -1
    assert read_tick(first[:pose_size] + skipped[pose_size:])[0] == -1


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_bad_numbers_are_left_to_the_codec_which_counts_them(bad: float) -> None:
    writer = FrameWriter(*EMULATOR)
    q = np.array([bad, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert read_tick(b"".join(TickWriter(writer).frames(0, q, np.ones(13))))[0] == -1
    frame = CommandWriter(FrameWriter(*VEHICLE), SCALE, lockstep=True).frame(ActuatorCommand(0, q, armed=True))
    assert read_command(frame)[0] == -1
