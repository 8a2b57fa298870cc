"""The frames of a tick, sealed in compiled code: pose and tick to the controller, the command to the emulator.

The kernels are called by the kernels of both ends. Each takes a packed structure (`protocol.compiled.pack`) with the
messages that it fills (`pose` and `tick`, or `command`) and the bytes `out` that it writes.
"""

from __future__ import annotations

from typing import Any

from protocol.compiled import compiled
from protocol.messages import FloatArray
from protocol.wire.framing import seal_frame
from protocol.wire.mapping import COMMAND, POSE, TICK, fill_command, fill_pose, fill_tick

_POSE_ID, _POSE_SEED = POSE.message_id, POSE.crc_seed
_TICK_ID, _TICK_SEED = TICK.message_id, TICK.crc_seed
_COMMAND_ID, _COMMAND_SEED = COMMAND.message_id, COMMAND.crc_seed


@compiled
def write_tick(
    memory: Any, t_us: int, q: FloatArray, readings: FloatArray, sequence: int, system: int, component: int
) -> tuple[int, int]:
    """ATT_POS_MOCAP of q (6,) and HIL_SENSOR of readings (13,) into `memory.out`; returns where each ends."""
    fill_pose(memory.pose, t_us, q)
    fill_tick(memory.tick, t_us, readings)
    middle = seal_frame(memory.out, 0, memory.pose_bytes, 0, sequence, system, component, _POSE_ID, _POSE_SEED)
    end = seal_frame(memory.out, middle, memory.tick_bytes, 0, sequence + 1, system, component, _TICK_ID, _TICK_SEED)
    return middle, end


@compiled
def write_command(
    memory: Any, t_us: int, tau: FloatArray, scale: FloatArray, armed: bool, sequence: int, system: int, component: int
) -> int:  # fmt: skip
    """HIL_ACTUATOR_CONTROLS of tau (6,) into `memory.out`, with the flag `memory.lockstep`; returns where it ends."""
    fill_command(memory.command, t_us, tau, scale, armed, memory.lockstep != 0)
    return seal_frame(
        memory.out, 0, memory.command_bytes, 0, sequence, system, component, _COMMAND_ID, _COMMAND_SEED
    )  # fmt: skip
