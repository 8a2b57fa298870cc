"""A frame in the bytes of a log, in compiled code: header, checksum, stamp, and the table of messages it is held against."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled, inlined

Bytes = npt.NDArray[np.uint8]
Table = npt.NDArray[np.int32]
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
    ]
)
"""One row a frame; `protocol.logs.scan` says what each column means."""

IDS = 1 << 24
# An entry of the table of messages: seed, longest MAVLink 1 payload, whether known; a seed learned, whether learned.
KNOWN, LEARNED = 1 << 16, 1 << 25
SIZE_SHIFT, LEARNED_SHIFT = 8, 17
OWN = KNOWN | 0xFFFF

_DAY_US = 86_400_000_000
SIMULATION_OR_DATE_US = 1 << 52  # the year 2112; simulation times begin at 0


def _crc_tables() -> Table:
    """tables[k, x]: the checksum's change by byte x when k bytes follow it (CRC-16/MCRF4XX, reflected 0x8408)."""
    tables = np.zeros((8, 256), dtype=np.int32)
    first = np.arange(256, dtype=np.int32)
    for _ in range(8):
        first = np.where(first & 1, first >> 1 ^ 0x8408, first >> 1).astype(np.int32)
    tables[0] = first
    for k in range(1, 8):
        tables[k] = tables[k - 1] >> 8 ^ first[tables[k - 1] & 0xFF]
    return tables


_TABLES = _crc_tables()
_FLAT = _TABLES.reshape(-1)
_BY_HIGH_BYTE = np.zeros(256, dtype=np.int32)
_BY_HIGH_BYTE[_TABLES[0] >> 8] = np.arange(256, dtype=np.int32)  # the high bytes are a permutation


@compiled
def byte(data: Bytes, at: int) -> int:
    """data[at] as a signed number; both casts are for speed and for numba's rules of types.

    An unsigned number and a signed one together would be a float; a signed index is first looked at for its sign.
    """
    return int(np.int64(data[np.uint64(at)]))


@compiled
def table_entry(row: int, number: int) -> int:
    """One value of the checksum's tables."""
    return int(_FLAT[np.uint64(row << 8 | number)])


@inlined
def crc_of(data: Bytes, start: int, stop: int) -> int:
    """Checksum of data[start:stop], without a seed; eight bytes at a time."""
    crc = 0xFFFF
    i = start
    while i + 8 <= stop:
        crc ^= byte(data, i) | byte(data, i + 1) << 8
        crc = (
            table_entry(7, crc & 0xFF)
            ^ table_entry(6, crc >> 8)
            ^ table_entry(5, byte(data, i + 2))
            ^ table_entry(4, byte(data, i + 3))
            ^ table_entry(3, byte(data, i + 4))
            ^ table_entry(2, byte(data, i + 5))
            ^ table_entry(1, byte(data, i + 6))
            ^ table_entry(0, byte(data, i + 7))
        )
        i += 8
    while i < stop:
        crc = (crc >> 8) ^ table_entry(0, (crc ^ byte(data, i)) & 0xFF)
        i += 1
    return crc


@compiled
def frame_end(data: Bytes, at: int) -> int:
    """Where the checksum of the frame that begins at `at` begins, going by its header; -1 where no frame begins."""
    if at + 8 > data.shape[0]:
        return -1
    if data[at] == 0xFD and at + 12 <= data.shape[0]:
        return at + 10 + byte(data, at + 1)
    if data[at] == 0xFE:
        return at + 6 + byte(data, at + 1)
    return -1


@compiled
def message_of(data: Bytes, at: int) -> int:
    """The message id of the frame at `at`."""
    if data[at] == 0xFE:
        return byte(data, at + 5)
    return byte(data, at + 7) | byte(data, at + 8) << 8 | byte(data, at + 9) << 16


@compiled
def signature_size(data: Bytes, at: int) -> int:
    """Bytes of signature behind the checksum of the frame at `at`, going by its header."""
    return 13 if data[at] == 0xFD and data[at + 2] & 1 else 0


@compiled
def checksum_verdict(data: Bytes, at: int, table: Table) -> int:
    """What the checksum says of a frame at `at`.

    1: it is one of a known message; 2: of a message whose seed was learned; 0: no frame begins here, or it is not whole;
    -1 - seed: only that seed would explain it; -257: nothing explains it.
    """
    end = frame_end(data, at)
    if end < 0 or end + 2 + signature_size(data, at) > data.shape[0]:
        return 0
    entry = int(table[message_of(data, at)])
    if data[at] == 0xFE and entry & KNOWN and byte(data, at + 1) > (entry >> SIZE_SHIFT & 0xFF):
        return 0
    crc = crc_of(data, at + 1, end)
    rest = (byte(data, end) | byte(data, end + 1) << 8) ^ (crc >> 8)
    seed = int(_BY_HIGH_BYTE[rest >> 8])
    if table_entry(0, seed) != rest:
        return -257
    seed ^= crc & 0xFF
    if entry & KNOWN and seed == (entry & 0xFF):
        return 1
    if entry & LEARNED and seed == (entry >> LEARNED_SHIFT & 0xFF):
        return 2
    return -1 - seed


@compiled
def stamp_at(data: Bytes, at: int) -> int:
    """The stamp at `at`, as a signed integer; -1 where none fits."""
    if at < 0 or at + 8 > data.shape[0]:
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
