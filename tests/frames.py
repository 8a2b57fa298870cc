"""Frames as each end of the loop says them, sealed by the plain writer."""

from __future__ import annotations

import numpy as np

from protocol.messages import VEHICLE, ActuatorCommand, FloatArray
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter

EMULATOR = (1, 191)
NO_READINGS = np.zeros(13)


def tick_frames(writer: FrameWriter, t_ns: int, q: FloatArray, readings: FloatArray = NO_READINGS) -> bytes:
    """Pose and tick of one time, as one datagram."""
    pose = writer.seal(mapping.POSE, mapping.encode_pose(t_ns, q))
    return pose + writer.seal(mapping.TICK, mapping.encode_tick(t_ns, readings))


def command_frame(
    writer: FrameWriter, t_ns: int, tau: FloatArray, scale: FloatArray, *, armed: bool = True, lockstep: bool = True
) -> bytes:
    """The command that answers the tick of t_ns."""
    command = ActuatorCommand(t_ns, tau, armed)
    return writer.seal(mapping.COMMAND, mapping.encode_command(command, scale, lockstep=lockstep))


def emulator_writer() -> FrameWriter:
    """Who the emulator is."""
    return FrameWriter(*EMULATOR)


def vehicle_writer() -> FrameWriter:
    """Who the controller is."""
    return FrameWriter(*VEHICLE)
