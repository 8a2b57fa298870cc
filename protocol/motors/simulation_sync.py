"""Frames that exist in simulation only: they add lockstep to a bus that has no time.

Layout in simulation_sync.dbc, under the node SIMULATION_ONLY. All are classical frames with 11-bit identifiers, so that any
interface carries them, and DroneCAN, with 29-bit identifiers only, ignores them. ODrive nodes from 44 on and MIT drives from
0x580 on would use the same identifiers, and are refused by the scenario (`motor.first_node_id`).

    SYNC      0x580                      t_ns (56 bits), axes commanded since the last SYNC (6 bits), lockstep (bit 63)
    HELLO     0x581 host, 0x582 drives   the scenario's digest (8 bytes); the drives answer the host's, and send it before
                                         their first answers when they join a run in progress
    ENCODERS  0x590 + axis               shaft angles before and after the gear (rad, float32 each), quantised
    ANSWER    0x600 + 64 axis + 32 enabled + tick mod 32      u (float64): the exact force at the gear output

A 64-bit number fills a classical frame, so the tick of an ANSWER is in its identifier. Only one tick is in progress at a time
and frames keep their order, so five bits distinguish a late duplicate from the expected answer. SYNC repeats the set of
commanded axes, so that a drive that lost its command waits for the repetition and never answers with an old one. 7 bytes of
nanoseconds are 2.3 years.
"""

from __future__ import annotations

import math
import struct
from typing import Final, NamedTuple

from protocol.can_frame import CanFrame
from protocol.motors.motor_protocol import DRIVES

SYNC: Final = 0x580
HELLO_HOST: Final = 0x581
HELLO_DRIVES: Final = 0x582
ENCODERS: Final = 0x590
ANSWER: Final = 0x600
ANSWER_MASK: Final = 0x7C0
"""The bits of an ANSWER's identifier that are in its identifier in the DBC."""
ALL_AXES: Final = (1 << DRIVES) - 1
TICKS: Final = 32

_ENABLED, _AXIS_SHIFT = 32, 6
_DOUBLE, _TWO_FLOATS = struct.Struct("<d"), struct.Struct("<ff")
_DIGEST_BYTES = 8


class Sync(NamedTuple):
    """t_ns: simulation time. commanded: bit i set where axis i was commanded since the last SYNC.

    lockstep: simulation time stands still until all have answered.
    """

    t_ns: int
    commanded: int
    lockstep: bool


class SyncAnswer(NamedTuple):
    """tick: modulo TICKS. u: force at the gear output, N or N m. enabled: the drive follows commands."""

    axis: int
    tick: int
    enabled: bool
    u: float


def is_simulation_only(frame: CanFrame) -> bool:
    """Whether a frame's identifier is one of those here."""
    if frame.extended or frame.remote:
        return False
    can_id = frame.can_id
    return SYNC <= can_id <= HELLO_DRIVES or ENCODERS <= can_id < ENCODERS + DRIVES or _is_answer(can_id)


def encode_sync(t_ns: int, commanded: int = ALL_AXES, *, lockstep: bool = True) -> CanFrame:
    """The frame that sends the time to the drives."""
    return CanFrame(SYNC, (t_ns | commanded << 56 | lockstep << 63).to_bytes(8, "little"))


def decode_sync(frame: CanFrame) -> Sync | None:
    """The time of a SYNC; None for any other frame."""
    if frame.can_id != SYNC or frame.extended or len(frame.data) != 8:
        return None
    return Sync(int.from_bytes(frame.data[:7], "little"), frame.data[7] & ALL_AXES, bool(frame.data[7] >> 7))


def encode_answer(axis: int, tick: int, u: float, *, enabled: bool) -> CanFrame:
    """The frame with which a drive answers the SYNC of a tick."""
    can_id = ANSWER | axis << _AXIS_SHIFT | (_ENABLED if enabled else 0) | tick % TICKS
    return CanFrame(can_id, _DOUBLE.pack(u))


def decode_answer(frame: CanFrame) -> SyncAnswer | None:
    """The content of an ANSWER; None for any other frame, and for a u that is not finite."""
    can_id = frame.can_id
    if not _is_answer(can_id) or frame.extended or len(frame.data) != 8:
        return None
    (u,) = _DOUBLE.unpack(frame.data)
    if not math.isfinite(u):
        return None
    offset = can_id - ANSWER
    return SyncAnswer(offset >> _AXIS_SHIFT, offset % TICKS, bool(offset & _ENABLED), u)


def encode_hello(digest: bytes, *, drives: bool) -> CanFrame:
    """The frame with which an end sends the digest (8 bytes) of its scenario."""
    return CanFrame(HELLO_DRIVES if drives else HELLO_HOST, digest)


def decode_hello(frame: CanFrame, *, drives: bool) -> bytes | None:
    """The digest in a HELLO of the drives (or the host); None for any other frame."""
    if frame.can_id != (HELLO_DRIVES if drives else HELLO_HOST) or frame.extended or len(frame.data) != _DIGEST_BYTES:
        return None
    return frame.data


def encode_encoders(axis: int, motor_position: float, position: float) -> CanFrame:
    """Both shaft angles of an axis, rad."""
    return CanFrame(ENCODERS + axis, _TWO_FLOATS.pack(motor_position, position))


def decode_encoders(frame: CanFrame) -> tuple[int, float, float] | None:
    """(axis, angle before the gear, angle after it), rad; None for any other frame."""
    axis = frame.can_id - ENCODERS
    if not 0 <= axis < DRIVES or frame.extended or len(frame.data) != 8:
        return None
    motor_position, position = _TWO_FLOATS.unpack(frame.data)
    return axis, motor_position, position


def _is_answer(can_id: int) -> bool:
    return ANSWER <= can_id < ANSWER + (DRIVES << _AXIS_SHIFT)
