"""The frames of a tick, whole, in compiled code: pose and tick one way, the command the other.

The mapping is `mavlink_map`'s, the frames are byte for byte those of `mavlink_codec`. Reading takes the plain case only, a
datagram that holds just these frames, intact and from the sender expected; for anything else it says so (None), and the
caller reads the datagram with the codec, which counts what is amiss.
"""

from __future__ import annotations

import numpy as np

from protocol.compiled import Packed, compiled
from protocol.frame_kernels import Bytes, plain_frame, read_uint64, seal_frame
from protocol.mavlink_codec import LONGEST_FRAME, FrameReader, FrameWriter
from protocol.mavlink_map import (
    ARMED,
    COMMAND,
    COMMAND_MODE,
    POSE,
    POSE_READ,
    TICK,
    TICK_BASE,
    fill_command,
    fill_pose,
    fill_tick,
    pose_of_values,
    tau_of_controls,
)
from protocol.messages import ActuatorCommand, FloatArray, PositionSample

_POSE_ID, _POSE_SEED = POSE.message_id, POSE.crc_seed[0]
_TICK_ID, _TICK_SEED = TICK.message_id, TICK.crc_seed[0]
_COMMAND_ID, _COMMAND_SEED = COMMAND.message_id, COMMAND.crc_seed[0]
_HEADER = 10


@compiled
def _write_tick(
    pose: Packed, pose_payload: Bytes, tick: Packed, tick_payload: Bytes, out: Bytes, t_us: int, q: FloatArray,
    readings: FloatArray, sequence: int, system: int, component: int,
) -> tuple[int, int]:  # fmt: skip
    """Both frames into `out`; returns where each ends. The payloads are the structures' own memory."""
    fill_pose(pose[0], t_us, q)
    fill_tick(tick[0], t_us, readings)
    middle = seal_frame(out, 0, pose_payload, sequence, system, component, _POSE_ID, _POSE_SEED)
    end = seal_frame(out, middle, tick_payload, sequence + 1, system, component, _TICK_ID, _TICK_SEED)
    return middle, end


@compiled
def _write_command(
    command: Packed, payload: Bytes, out: Bytes, t_us: int, tau: FloatArray, scale: FloatArray, armed: bool,
    lockstep: bool, sequence: int, system: int, component: int,
) -> int:  # fmt: skip
    fill_command(command[0], t_us, tau, scale, armed, lockstep)
    return seal_frame(out, 0, payload, sequence, system, component, _COMMAND_ID, _COMMAND_SEED)


@compiled
def _read_tick(data: Bytes, system: int, component: int, q: FloatArray) -> tuple[int, int]:
    """(time in us, number of the first frame) of a datagram of pose and tick, q (6,) filled; (-1, 0) if it is not one."""
    middle = plain_frame(data, 0, system, component, _POSE_ID, POSE_READ, _POSE_SEED)
    if middle < 0:
        return -1, 0
    end = plain_frame(data, middle, system, component, _TICK_ID, 8, _TICK_SEED)
    if end != data.shape[0] or data[middle + 1] > TICK_BASE or (data[4] + 1) & 0xFF != data[middle + 4]:
        return -1, 0
    t_us = read_uint64(data, _HEADER)
    if t_us < 0 or read_uint64(data, middle + _HEADER) != t_us:
        return -1, 0
    if not pose_of_values(data[_HEADER + 8 : _HEADER + POSE_READ].view(np.float32), q):
        return -1, 0
    return t_us, int(data[4])


@compiled
def _read_command(data: Bytes, system: int, component: int, scale: FloatArray, tau: FloatArray) -> tuple[int, int, int]:
    """(time in us, number, mode) of a datagram of one command, tau (6,) filled; (-1, 0, 0) if it is not one."""
    end = plain_frame(data, 0, system, component, _COMMAND_ID, COMMAND_MODE + 1, _COMMAND_SEED)
    if end != data.shape[0]:
        return -1, 0, 0
    if not tau_of_controls(data[_HEADER + 16 : _HEADER + 40].view(np.float32), scale, tau):
        return -1, 0, 0
    return read_uint64(data, _HEADER), int(data[4]), int(data[_HEADER + COMMAND_MODE])


class TickWriter:
    """Seals the two frames of a tick with a component's own `FrameWriter`."""

    def __init__(self, writer: FrameWriter) -> None:
        self._writer = writer
        self._pose, self._tick = np.zeros(1, POSE.dtype), np.zeros(1, TICK.dtype)
        self._structures = (self._pose, self._pose.view(np.uint8), self._tick, self._tick.view(np.uint8))
        self._out = np.zeros(2 * LONGEST_FRAME, dtype=np.uint8)

    def frames(self, t_ns: int, q: FloatArray, readings: FloatArray) -> tuple[bytes, bytes]:
        """ATT_POS_MOCAP and HIL_SENSOR of the measured q (6,) and the readings (13,) of `mavlink_map.encode_tick`."""
        writer = self._writer
        middle, end = _write_tick(
            *self._structures, self._out, t_ns // 1000, q, readings, writer.sequence, writer.system, writer.component
        )
        writer.sequence = (writer.sequence + 2) & 0xFF
        sealed = self._out[:end].tobytes()
        return sealed[:middle], sealed[middle:]


class CommandWriter:
    """Seals the frame of a command with a component's own `FrameWriter`."""

    def __init__(self, writer: FrameWriter, scale: FloatArray, *, lockstep: bool) -> None:
        self._writer = writer
        self._scale = scale
        self._lockstep = lockstep
        self._command = np.zeros(1, COMMAND.dtype)
        self._payload = self._command.view(np.uint8)
        self._out = np.zeros(LONGEST_FRAME, dtype=np.uint8)

    def frame(self, command: ActuatorCommand) -> bytes:
        """HIL_ACTUATOR_CONTROLS of a command."""
        writer = self._writer
        end = _write_command(
            self._command, self._payload, self._out, command.t_ns // 1000, command.tau, self._scale, command.armed,
            self._lockstep, writer.sequence, writer.system, writer.component,
        )  # fmt: skip
        writer.sequence = (writer.sequence + 1) & 0xFF
        return self._out[:end].tobytes()


def read_tick(data: bytes, sender: tuple[int, int], reader: FrameReader) -> PositionSample | None:
    """The sample in a datagram of just a pose and its tick; None where it is anything else."""
    q = np.empty(6)
    t_us, sequence = _read_tick(np.frombuffer(data, np.uint8), *sender, q)
    if t_us < 0 or not reader.follows(*sender, sequence, 2):
        return None
    return PositionSample(t_us * 1000, q)


def read_command(
    data: bytes, sender: tuple[int, int], reader: FrameReader, scale: FloatArray, t_ns: int
) -> ActuatorCommand | None:
    """The command in a datagram of just the answer to the tick at t_ns; None where it is anything else."""
    tau = np.empty(6)
    t_us, sequence, mode = _read_command(np.frombuffer(data, np.uint8), *sender, scale, tau)
    if t_us < 0 or t_us * 1000 != t_ns or not reader.follows(*sender, sequence, 1):
        return None
    return ActuatorCommand(t_ns, tau, mode & ARMED != 0)
