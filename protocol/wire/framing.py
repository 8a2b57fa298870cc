"""MAVLink 2 frames in compiled code: for the few messages that travel at every tick.

The same bytes as `codec` makes and takes (tests hold them equal), some ten times sooner. A kernel that meets
anything but the plain case says so, and the caller hands the bytes to the codec, which counts causes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled

Bytes = npt.NDArray[np.uint8]

_POLYNOMIAL = 0x8408  # CRC-16/MCRF4XX, reflected


def _crc_table() -> npt.NDArray[np.uint16]:
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ _POLYNOMIAL, table >> 1).astype(np.uint16)
    return table


_TABLE = _crc_table()


@compiled
def crc16(data: Bytes, start: int, stop: int, seed: int) -> int:
    """Checksum of data[start:stop] followed by the byte `seed` (a message's crc_extra)."""
    crc: int = 0xFFFF
    for i in range(start, stop):
        crc = (crc >> 8) ^ int(_TABLE[(crc ^ data[i]) & 0xFF])
    crc = (crc >> 8) ^ int(_TABLE[(crc ^ seed) & 0xFF])
    return crc  # noqa: RET504  (named, since the type of the table's items is not known to the checker)


@compiled
def seal_frame(
    out: Bytes, at: int, payload: Bytes, sequence: int, system: int, component: int, message_id: int, seed: int
) -> int:
    """Write a frame into out[at:], trailing zeros of the payload cut off; returns where it ends."""
    length: int = payload.shape[0]
    while length > 1 and payload[length - 1] == 0:
        length -= 1
    out[at] = 0xFD
    out[at + 1] = length
    out[at + 2] = 0
    out[at + 3] = 0
    out[at + 4] = sequence & 0xFF
    out[at + 5] = system
    out[at + 6] = component
    out[at + 7] = message_id & 0xFF
    out[at + 8] = message_id >> 8 & 0xFF
    out[at + 9] = message_id >> 16
    for i in range(length):
        out[at + 10 + i] = payload[i]
    stop = at + 10 + length
    crc = crc16(out, at + 1, stop, seed)
    out[stop] = crc & 0xFF
    out[stop + 1] = crc >> 8
    return stop + 2


@compiled
def plain_frame(data: Bytes, at: int, system: int, component: int, message_id: int, shortest: int, seed: int) -> int:
    """Where the frame at data[at:] ends, if it is an intact, unsigned one of that sender and message; else -1.

    `shortest` is the least payload length taken: what the caller reads must be there.
    """
    if at + 12 > data.shape[0] or data[at] != 0xFD or data[at + 2] != 0:
        return -1
    stop = at + 10 + int(data[at + 1])
    if data[at + 1] < shortest or stop + 2 > data.shape[0]:
        return -1
    if data[at + 5] != system or data[at + 6] != component:
        return -1
    if data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16 != message_id:
        return -1
    if crc16(data, at + 1, stop, seed) != (data[stop] | data[stop + 1] << 8):
        return -1
    return stop + 2


@compiled
def read_uint64(data: Bytes, at: int) -> int:
    """A little-endian integer of 8 bytes, as a signed one."""
    value = 0
    for i in range(8):
        value |= int(data[at + i]) << (8 * i)
    return value
