"""A frame in the bytes of a log, in compiled code: header, checksum, stamp, and the table of messages it is held against."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled
from protocol.wire.framing import (
    KNOWN,
    MAGIC_V1,
    MAGIC_V2,
    SIZE_SHIFT,
    Bytes,
    Table,
    byte,
    crc_of,
    frame_end,
    message_of,
    seed_that_explains,
    seeded,
    signature_size,
    uint16_at,
)

State = npt.NDArray[np.int64]

FRAME = np.dtype(
    [
        ("stamp_us", "<i8"),
        ("offset", "<i8"),
        ("message_id", "<u4"),
        ("length", "<u2"),
        ("system", "u1"),
        ("component", "u1"),
        ("sequence", "u1"),
        ("version", "u1"),
        ("signed", "u1"),
        ("flags", "u1"),
        ("known", "u1"),
        ("stamp_ok", "u1"),
        ("stale_checksum", "u1"),
    ]
)
"""One row a frame; `protocol.logs.scan` says what each column means."""

IDS = 1 << 24
# An entry of the table of messages, beyond what `framing` says of it: a seed learned, whether learned.
LEARNED = 1 << 25
LEARNED_SHIFT = 17
OWN = KNOWN | 0xFFFF

_DAY_US = 86_400_000_000
SIMULATION_OR_DATE_US = 1 << 52  # the year 2112; simulation times begin at 0


@compiled
def checksum_verdict(data: Bytes, at: int, table: Table) -> int:
    """What the checksum says of a frame at `at`.

    1: it is one of a known message; 2: of a message whose seed was learned; 0: no frame begins here, or it is not whole;
    -1 - seed: only that seed would explain it; -257: nothing explains it.
    """
    end = frame_end(data, at)
    if end < 0 or end + 2 + signature_size(data, at) > len(data):
        return 0
    entry = int(table[message_of(data, at)])
    seed = seed_that_explains(crc_of(data, at + 1, end), uint16_at(data, end))
    if seed < 0:
        return -257
    too_long = data[at] == MAGIC_V1 and byte(data, at + 1) > (entry >> SIZE_SHIFT & 0xFF)  # then of another dialect
    if entry & KNOWN and seed == (entry & 0xFF) and not too_long:
        return 1
    if entry & LEARNED and seed == (entry >> LEARNED_SHIFT & 0xFF):
        return 2
    return -1 - seed


@compiled
def untrimmed_length(data: Bytes, at: int, table: Table) -> int:
    """The length of payload with which the checksum of the frame at `at` holds, once zeros are put back; 0: none, or several.

    QGroundControl's library cuts trailing zeros off frames of MAVLink 2 and leaves checksum and all as they were with them.
    Any length up to the message's own is tried, so a damaged frame is taken for such a one by chance with a probability of
    (lengths tried) / 65 536: 17 / 65 536 for a DISTANCE_SENSOR cut to 22 of its 39 bytes.
    """
    end = frame_end(data, at)
    if end < 0 or data[at] != MAGIC_V2 or end + 2 + signature_size(data, at) > len(data):
        return 0
    entry, length = int(table[message_of(data, at)]), byte(data, at + 1)
    if not entry & KNOWN or (length > 1 and data[end - 1] == 0):
        return 0
    found, wanted = 0, uint16_at(data, end)
    for whole in range(length + 1, (entry >> SIZE_SHIFT & 0xFF) + 1):
        crc = seeded(0xFFFF, whole)
        for i in range(at + 2, end):
            crc = seeded(crc, byte(data, i))
        for _ in range(whole - length):
            crc = seeded(crc, 0)
        if seeded(crc, entry & 0xFF) == wanted:
            if found:
                return 0
            found = whole
    return found


@compiled
def stamp_at(data: Bytes, at: int) -> int:
    """The stamp at `at`, as a signed integer; -1 where none fits."""
    if at < 0 or at + 8 > len(data):
        return -1
    stamp = 0
    for i in range(8):
        stamp = stamp << 8 | byte(data, at + i)
    return stamp


@compiled
def near(one: int, other: int) -> bool:
    """Whether two stamps are of the same day or so; before there is one to compare with, whether it is a date at all."""
    if one < 0 or one >= SIMULATION_OR_DATE_US:
        return False
    return other < 0 or abs(one - other) < _DAY_US
