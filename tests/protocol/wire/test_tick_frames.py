"""The compiled frames of a tick against the plain writer and mapping: the same bytes."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.compiled import Packed, compiled, pack
from protocol.messages import FloatArray
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from protocol.wire.framing import LONGEST_FRAME
from protocol.wire.tick_frames import write_command, write_tick
from tests.frames import EMULATOR, command_frame, tick_frames, vehicle_writer

SCALE = np.array([0.04, 0.04, 0.12, 3e-4, 3e-4, 3e-4])
numbers = st.floats(-1.0, 1.0, width=32)
vectors = st.lists(numbers, min_size=6, max_size=6).map(np.array)
times = st.integers(0, 2**40).map(lambda t_us: t_us * 1000)
TICK = pack({"out": np.zeros(2 * LONGEST_FRAME, np.uint8)}, {"pose": mapping.POSE.dtype, "tick": mapping.TICK.dtype})


@compiled
def _tick(memory: Packed, t_us: int, q: FloatArray, readings: FloatArray, sequence: int) -> tuple[int, int]:
    return write_tick(memory[0], t_us, q, readings, sequence, 1, 191)


@compiled
def _command(memory: Packed, t_us: int, tau: FloatArray, scale: FloatArray, armed: bool) -> int:
    return write_command(memory[0], t_us, tau, scale, armed, 0, 1, 1)


@settings(max_examples=60)
@given(
    t_ns=times, q=vectors, readings=st.lists(numbers, min_size=13, max_size=13).map(np.array), start=st.integers(0, 255)
)
def test_the_frames_of_a_tick(t_ns: int, q: FloatArray, readings: FloatArray, start: int) -> None:
    writer = FrameWriter(*EMULATOR)
    writer.sequence = start
    expected = tick_frames(writer, t_ns, q, readings)
    middle, end = _tick(TICK, t_ns // 1000, q, readings, start)
    assert TICK["out"][0, :end].tobytes() == expected
    assert middle == 12 + expected[1]


@settings(max_examples=60)
@given(t_ns=times, tau=vectors, armed=st.booleans(), lockstep=st.booleans())
def test_the_frame_of_a_command(t_ns: int, tau: FloatArray, armed: bool, lockstep: bool) -> None:
    memory = pack({"lockstep": lockstep, "out": np.zeros(LONGEST_FRAME, np.uint8)}, {"command": mapping.COMMAND.dtype})
    end = _command(memory, t_ns // 1000, tau * SCALE, SCALE, armed)
    expected = command_frame(vehicle_writer(), t_ns, tau * SCALE, SCALE, armed=armed, lockstep=lockstep)
    assert memory["out"][0, :end].tobytes() == expected
