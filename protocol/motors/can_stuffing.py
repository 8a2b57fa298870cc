"""Exact number of bits of one frame on the wire, with stuffing: see `can_frame` for the layout."""

from __future__ import annotations

from protocol.can_frame import LONGEST_DATA, CanFrame
from protocol.compiled import compiled

_CRC_POLYNOMIAL = 0x4599  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
_UNSTUFFED_TAIL = 13  # CRC delimiter, acknowledge slot and its delimiter, end of frame (7), intermission (3)
_RUN = 5


def exact_bits(frame: CanFrame) -> int:
    """Bits of this frame, including stuffing and the gap to the next frame."""
    data = frame.data.ljust(LONGEST_DATA, b"\0")
    high, low = int.from_bytes(data[:4], "big"), int.from_bytes(data[4:], "big")
    return int(_bits_on_the_wire(frame.can_id, frame.extended, frame.remote, len(frame.data), high, low))


@compiled
def _bits_on_the_wire(can_id: int, extended: bool, remote: bool, length: int, high: int, low: int) -> int:
    """`exact_bits` with the data as two 32-bit halves, first byte highest. Checksum and stuffing are computed bit by bit."""
    header = 39 if extended else 19
    total = header + 8 * length + 15
    crc = 0
    last, run, stuffed = -1, 0, 0
    for at in range(total):
        if at < header:
            bit = _extended_bit(can_id, remote, length, at) if extended else _standard_bit(can_id, remote, length, at)
        elif at < total - 15:
            place = at - header
            bit = (high >> (31 - place) if place < 32 else low >> (63 - place)) & 1
        else:
            bit = crc >> (total - 1 - at) & 1
        if at < total - 15:
            feedback = (crc >> 14 & 1) != bit
            crc = crc << 1 & 0x7FFF
            if feedback:
                crc ^= _CRC_POLYNOMIAL
        run = run + 1 if bit == last else 1
        last = bit
        if run == _RUN:  # the stuff bit itself begins the next run
            stuffed += 1
            last, run = 1 - bit, 1
    return total + stuffed + _UNSTUFFED_TAIL


@compiled
def _standard_bit(can_id: int, remote: bool, length: int, at: int) -> int:
    """Start, identifier (11), remote, two zeros, length (4)."""
    if 1 <= at < 12:
        return can_id >> (11 - at) & 1
    if at == 12:
        return 1 if remote else 0
    if at >= 15:
        return length >> (18 - at) & 1
    return 0


@compiled
def _extended_bit(can_id: int, remote: bool, length: int, at: int) -> int:
    """Start, identifier (11), two ones, identifier (18), remote, two zeros, length (4)."""
    if 1 <= at < 12:
        return can_id >> (29 - at) & 1
    if at in (12, 13):
        return 1
    if 14 <= at < 32:
        return can_id >> (31 - at) & 1
    if at == 32:
        return 1 if remote else 0
    if at >= 35:
        return length >> (38 - at) & 1
    return 0
