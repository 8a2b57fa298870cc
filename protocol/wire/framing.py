"""MAVLink frames in compiled code: the only place where frames are parsed, checked and built, for links and logs.

    MAVLink 2   FD | length | incompat | compat | sequence | system | component | id (3 bytes) | payload | CRC | [signature 13]
    MAVLink 1   FE | length | sequence | system | component | id | payload | CRC

`next_frame` finds frames in received data. In a datagram a bad frame is skipped by its length field without searching inside
it; a byte that does not begin a frame ends the datagram. In a stream the search continues after the bad start byte.
`data` is `bytes`, or an array of bytes. Source: the MAVLink serialization guide.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from protocol.compiled import Packed, compiled, inlined, pack

Bytes: TypeAlias = "npt.NDArray[np.uint8] | bytes"
Output: TypeAlias = npt.NDArray[np.uint8]
Table = npt.NDArray[np.int32]

MAGIC_V2 = 0xFD
MAGIC_V1 = 0xFE
HEADER_V2 = 10
HEADER_V1 = 6
CRC_SIZE = 2
SIGNATURE_SIZE = 13
SIGNED = 0x01
LONGEST_FRAME = HEADER_V2 + 255 + CRC_SIZE + SIGNATURE_SIZE
HALF_SEQUENCE = 128

# An entry of a table of messages, by message id: checksum seed (crc_extra), size of the payload, whether it is known.
KNOWN = 1 << 16
SIZE_SHIFT = 8

CAUSES = (
    "bad_crc",
    "garbage_bytes",
    "unknown_message",
    "unknown_flags",
    "truncated",
    "mavlink1",
    "sequence_gaps",
    "out_of_order",
)
BAD_CRC, GARBAGE_BYTES, UNKNOWN_MESSAGE, UNKNOWN_FLAGS, TRUNCATED, MAVLINK1, SEQUENCE_GAPS, OUT_OF_ORDER = range(8)

ROW = np.dtype(
    [
        ("message_id", "<i8"),
        ("offset", "<i8"),
        ("end", "<i8"),
        ("payload", "<i8"),
        ("length", "<i8"),
        ("sequence", "<i8"),
        ("system", "<i8"),
        ("component", "<i8"),
    ]
)
"""One frame in the given bytes: begin and end (including the signature) of the frame, begin and length of its payload."""


def new_reading(*, is_datagram: bool, follow_sequence: bool, keep_mavlink1: bool) -> Packed:
    """State of the reader of one link, for `next_frame`.

    counters  by CAUSES            next   by system << 8 | component: the expected sequence number, -1: unknown
    rest      begin of an unfinished frame at the end of a stream's bytes
    """
    return pack(
        {
            "counters": np.zeros(len(CAUSES), dtype=np.int64),
            "is_datagram": is_datagram,
            "follow": follow_sequence,
            "keep_mavlink1": keep_mavlink1,
            "rest": 0,
            "next": np.full(1 << 16, -1, dtype=np.int16),
        }
    )


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


@inlined
def byte(data: Bytes, at: int) -> int:
    """data[at] as a signed number; both casts are needed for speed and because of numba's type rules.

    numba makes a float of unsigned and signed operands, and checks the sign of a signed index.
    """
    return int(np.int64(data[np.uint64(at)]))


@compiled
def table_entry(row: int, number: int) -> int:
    """One value of the checksum tables."""
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
def seeded(crc: int, seed: int) -> int:
    """The checksum with a message's seed (crc_extra) as its last byte."""
    return (crc >> 8) ^ table_entry(0, (crc ^ seed) & 0xFF)


@compiled
def seed_that_explains(crc: int, found: int) -> int:
    """The seed that turns `crc` into the checksum found in a frame; -1 if no seed does."""
    rest = found ^ (crc >> 8)
    seed = int(_BY_HIGH_BYTE[rest >> 8])
    return (seed ^ crc & 0xFF) if table_entry(0, seed) == rest else -1


@compiled
def uint16_at(data: Bytes, at: int) -> int:
    """The little-endian number of two bytes at `at`."""
    return byte(data, at) | byte(data, at + 1) << 8


@compiled
def frame_end(data: Bytes, at: int) -> int:
    """Offset of the checksum of the frame at `at`, from its header; -1 where no frame begins."""
    if at + HEADER_V1 + CRC_SIZE > len(data):
        return -1
    if byte(data, at) == MAGIC_V2 and at + HEADER_V2 + CRC_SIZE <= len(data):
        return at + HEADER_V2 + byte(data, at + 1)
    if byte(data, at) == MAGIC_V1:
        return at + HEADER_V1 + byte(data, at + 1)
    return -1


@compiled
def message_of(data: Bytes, at: int) -> int:
    """The message id of the frame at `at`."""
    if byte(data, at) == MAGIC_V1:
        return byte(data, at + 5)
    return byte(data, at + 7) | byte(data, at + 8) << 8 | byte(data, at + 9) << 16


@compiled
def signature_size(data: Bytes, at: int) -> int:
    """Bytes of signature after the checksum of the frame at `at`, from its header."""
    return SIGNATURE_SIZE if byte(data, at) == MAGIC_V2 and byte(data, at + 2) & SIGNED else 0


@compiled
def _announced_end(data: Bytes, at: int) -> int:
    """End of the frame at `at` by its header, including the signature; -1: the header is incomplete."""
    if at + 3 > len(data):
        return -1
    header = HEADER_V2 if byte(data, at) == MAGIC_V2 else HEADER_V1
    return at + header + byte(data, at + 1) + CRC_SIZE + signature_size(data, at)


@compiled
def _follow(reading: Any, key: int, sequence: int) -> None:
    """Count lost frames, or a late frame, by the sequence number of a frame."""
    expected = int(reading.next[key])
    ahead = (sequence - expected) & 0xFF if expected >= 0 else 0
    if ahead < HALF_SEQUENCE:
        reading.counters[SEQUENCE_GAPS] += ahead
        reading.next[key] = (sequence + 1) & 0xFF
    else:
        reading.counters[OUT_OF_ORDER] += 1


@compiled
def _refusal(data: Bytes, at: int, end: int, table: Table) -> int:
    """Why the frame between `at` and `end` is rejected: BAD_CRC or UNKNOWN_FLAGS; -1: it is intact; -2: unknown message.

    The checksum of a message that is not in the table cannot be verified: its length is accepted only where another frame,
    or nothing, follows it.
    """
    message = message_of(data, at)
    stop = end - signature_size(data, at) - CRC_SIZE
    entry = int(table[message]) if message < len(table) else 0
    if not entry & KNOWN:
        if end < len(data) and byte(data, end) != MAGIC_V2 and byte(data, end) != MAGIC_V1:
            return BAD_CRC
    elif seeded(crc_of(data, at + 1, stop), entry & 0xFF) != uint16_at(data, stop):
        return BAD_CRC
    if byte(data, at) == MAGIC_V2 and byte(data, at + 2) & ~SIGNED:
        return UNKNOWN_FLAGS
    return -1 if entry & KNOWN else -2


@compiled
def next_frame(data: Bytes, at: int, reading: Any, table: Table, row: Any) -> int:
    """Describe the next intact frame from `at` on in `row`, and return where it ends; -1 where no further frame is found.

    Rejected data is counted by cause; a frame of a message that is not in the table is counted and also described.
    """
    counters, size = reading.counters, len(data)
    reading.rest = size
    while at < size:
        magic = byte(data, at)
        if magic not in (MAGIC_V2, MAGIC_V1):
            skipped = size - at if reading.is_datagram else 1
            counters[GARBAGE_BYTES] += skipped
            at += skipped
            continue
        end = _announced_end(data, at)
        if end < 0 or end > size:
            if reading.is_datagram:
                counters[TRUNCATED] += 1
            else:
                reading.rest = at
            return -1
        refusal = _refusal(data, at, end, table)
        if refusal >= 0:
            counters[refusal] += 1
            at = end if reading.is_datagram else at + 1
            continue
        if refusal == -2:
            counters[UNKNOWN_MESSAGE] += 1
        first = at + 4 if magic == MAGIC_V2 else at + 2
        row.message_id = message_of(data, at)
        row.offset, row.end = at, end
        row.payload = at + (HEADER_V2 if magic == MAGIC_V2 else HEADER_V1)
        row.length = byte(data, at + 1)
        row.sequence, row.system, row.component = byte(data, first), byte(data, first + 1), byte(data, first + 2)
        if magic == MAGIC_V1:
            counters[MAVLINK1] += 1
            if not reading.keep_mavlink1:
                at = end
                continue
        elif reading.follow:
            _follow(reading, row.system << 8 | row.component, row.sequence)
        return end
    return -1


@compiled
def read_frames(data: Bytes, at: int, reading: Packed, table: Table, rows: Any) -> tuple[int, int]:
    """Describe frames from `at` on in `rows`; returns their number, and where to continue, -1 where all is read."""
    count = 0
    while count < len(rows):
        at = next_frame(data, at, reading[0], table, rows[count])
        if at < 0:
            break
        count += 1
    return count, at


@compiled
def take_payload(data: Bytes, row: Any, payload: Output) -> None:
    """Fill `payload`, the memory of a message, from the frame described by `row`; zeros that were cut off are restored."""
    length = min(int(row.length), len(payload))
    for i in range(length):
        payload[i] = data[np.uint64(row.payload + i)]
    for i in range(length, len(payload)):
        payload[i] = 0


@compiled
def seal_frame(
    out: Output, at: int, payload: Bytes, flags: int, sequence: int, system: int, component: int, message_id: int, seed: int
) -> int:  # fmt: skip
    """Write a MAVLink 2 frame into out[at:], without trailing zeros of the payload; returns where its checksum ends."""
    length = len(payload)
    while length > 1 and byte(payload, length - 1) == 0:
        length -= 1
    out[at] = MAGIC_V2
    out[at + 1] = length
    out[at + 2] = flags
    out[at + 3] = 0
    out[at + 4] = sequence & 0xFF
    out[at + 5] = system
    out[at + 6] = component
    out[at + 7] = message_id & 0xFF
    out[at + 8] = message_id >> 8 & 0xFF
    out[at + 9] = message_id >> 16
    for i in range(length):
        out[at + HEADER_V2 + i] = byte(payload, i)
    stop = at + HEADER_V2 + length
    crc = seeded(crc_of(out, at + 1, stop), seed)
    out[stop] = crc & 0xFF
    out[stop + 1] = crc >> 8
    return stop + CRC_SIZE


@compiled
def checksum(data: Bytes, start: int, stop: int, seed: int) -> int:
    """The checksum of data[start:stop] with a message's seed."""
    return seeded(crc_of(data, start, stop), seed)
