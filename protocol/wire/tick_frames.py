"""The frames of a tick, whole, in compiled code: pose and tick one way, the command the other.

The mapping is `mapping`'s, the frames are byte for byte those of `codec`. Reading takes the plain case only, a
datagram that holds just these frames, intact and from the sender expected; for anything else it says so (-1), and the
caller reads the datagram with the codec, which counts what is amiss. The kernels are called by those of either end, which
do all of their part of a tick in one call.
"""

from __future__ import annotations

import numpy as np

from protocol.compiled import Packed, compiled
from protocol.messages import ActuatorCommand, FloatArray
from protocol.wire.codec import LONGEST_FRAME, FrameWriter
from protocol.wire.framing import Bytes, plain_frame, read_uint64, seal_frame
from protocol.wire.mapping import (
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

_POSE_ID, _POSE_SEED = POSE.message_id, POSE.crc_seed[0]
_TICK_ID, _TICK_SEED = TICK.message_id, TICK.crc_seed[0]
_COMMAND_ID, _COMMAND_SEED = COMMAND.message_id, COMMAND.crc_seed[0]
_HEADER = 10


@compiled
def write_tick(
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
def write_command(
    command: Packed, payload: Bytes, out: Bytes, t_us: int, tau: FloatArray, scale: FloatArray, armed: bool,
    lockstep: bool, sequence: int, system: int, component: int,
) -> int:  # fmt: skip
    """The frame into `out`; returns where it ends."""
    fill_command(command[0], t_us, tau, scale, armed, lockstep)
    return seal_frame(out, 0, payload, sequence, system, component, _COMMAND_ID, _COMMAND_SEED)


@compiled
def parse_tick(data: Bytes, system: int, component: int, q: FloatArray) -> tuple[int, int]:
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
def parse_command(data: Bytes, system: int, component: int, scale: FloatArray, tau: FloatArray) -> tuple[int, int, int]:
    """(time in us, number, mode) of a datagram of one command, tau (6,) filled; (-1, 0, 0) if it is not one."""
    end = plain_frame(data, 0, system, component, _COMMAND_ID, COMMAND_MODE + 1, _COMMAND_SEED)
    if end != data.shape[0]:
        return -1, 0, 0
    if not tau_of_controls(data[_HEADER + 16 : _HEADER + 40].view(np.float32), scale, tau):
        return -1, 0, 0
    return read_uint64(data, _HEADER), int(data[4]), int(data[_HEADER + COMMAND_MODE])


class TickWriter:
    """Seals the two frames of a tick with a component's own `FrameWriter`.

    buffers   what `write_tick` takes first, for a kernel that measures and writes in one call
    """

    def __init__(self, writer: FrameWriter) -> None:
        self._writer = writer
        pose, tick = np.zeros(1, POSE.dtype), np.zeros(1, TICK.dtype)
        self._out = np.zeros(2 * LONGEST_FRAME, dtype=np.uint8)
        self.buffers = (pose, pose.view(np.uint8), tick, tick.view(np.uint8), self._out)

    def frames(self, t_ns: int, q: FloatArray, readings: FloatArray) -> tuple[bytes, bytes]:
        """ATT_POS_MOCAP and HIL_SENSOR of the measured q (6,) and the readings (13,) of `mapping.encode_tick`."""
        writer = self._writer
        middle, end = write_tick(
            *self.buffers, t_ns // 1000, q, readings, writer.sequence, writer.system, writer.component
        )
        sealed = self.taken(end)
        return sealed[:middle], sealed[middle:]

    def taken(self, end: int) -> bytes:
        """Both frames, which a kernel has written into the buffers with the writer's next two numbers."""
        self._writer.sequence = (self._writer.sequence + 2) & 0xFF
        return self._out[:end].tobytes()


class CommandWriter:
    """Seals the frame of a command with a component's own `FrameWriter`.

    buffers   what `write_command` takes first, for a kernel that computes and writes in one call
    """

    def __init__(self, writer: FrameWriter, scale: FloatArray, *, lockstep: bool) -> None:
        self._writer = writer
        self._scale = scale
        self._lockstep = lockstep
        command = np.zeros(1, COMMAND.dtype)
        self._out = np.zeros(LONGEST_FRAME, dtype=np.uint8)
        self.buffers = (command, command.view(np.uint8), self._out)

    def frame(self, command: ActuatorCommand) -> bytes:
        """HIL_ACTUATOR_CONTROLS of a command."""
        writer = self._writer
        return self.taken(
            write_command(
                *self.buffers, command.t_ns // 1000, command.tau, self._scale, command.armed, self._lockstep,
                writer.sequence, writer.system, writer.component,
            )
        )  # fmt: skip

    def taken(self, end: int) -> bytes:
        """The frame that a kernel has written into the buffers with the writer's next number, ending there."""
        self._writer.sequence = (self._writer.sequence + 1) & 0xFF
        return self._out[:end].tobytes()
