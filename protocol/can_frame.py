"""A frame of the CAN bus, free of any interface, and how many bits it takes on the wire.

Bits of a classical frame (ISO 11898-1; Robert Bosch, CAN specification 2.0): start, identifier, control, data and a CRC of
15 bits are stuffed, one opposite bit after each five equal ones; delimiters, acknowledge, end of frame and the three bits
between frames are not.

    standard    47 + 8 n bits, of which 34 + 8 n can be stuffed        extended    67 + 8 n, of which 54 + 8 n

Worst stuffing is one bit in four after the first: (stuffable - 1) // 4 (Davis, Burns, Bril, Lukkien, "Controller Area
Network (CAN) schedulability analysis: refuted, revisited and revised", Real-Time Systems 35, 2007, eq. 1).
"""

from __future__ import annotations

from typing import NamedTuple

LONGEST_DATA = 8
STANDARD_IDS = 1 << 11
EXTENDED_IDS = 1 << 29

_CRC_POLYNOMIAL = 0x4599
_UNSTUFFED_TAIL = 13  # CRC delimiter, acknowledge slot and its delimiter, end of frame (7), intermission (3)
_RUN = 5


class CanFrame(NamedTuple):
    """A classical CAN frame. `remote`: a remote transmission request, whose data are empty."""

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False

    def __str__(self) -> str:
        shown = f"{self.can_id:08X}" if self.extended else f"{self.can_id:03X}"
        return f"{shown}#{'R' if self.remote else self.data.hex().upper()}"


def nominal_bits(length: int, *, extended: bool) -> int:
    """Bits of a frame with `length` bytes of data without any stuffing, the gap to the next frame included."""
    return (67 if extended else 47) + 8 * length


def worst_bits(length: int, *, extended: bool) -> int:
    """Bits of a frame with `length` bytes of data at the most stuffing that any content can cause."""
    stuffable = (54 if extended else 34) + 8 * length
    return nominal_bits(length, extended=extended) + (stuffable - 1) // 4


def exact_bits(frame: CanFrame) -> int:
    """Bits that just this frame takes, stuffing counted, the gap to the next frame included."""
    bits = _header(frame) + [byte >> (7 - i) & 1 for byte in frame.data for i in range(8)]
    crc = crc15(bits)
    bits += [crc >> (14 - i) & 1 for i in range(15)]
    return len(bits) + _stuffing(bits) + _UNSTUFFED_TAIL


def crc15(bits: list[int]) -> int:
    """CRC of a sequence of bits as CAN computes it: x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1, start 0."""
    crc = 0
    for bit in bits:
        high = crc >> 14 & 1
        crc = crc << 1 & 0x7FFF
        if high != bit:
            crc ^= _CRC_POLYNOMIAL
    return crc


def _header(frame: CanFrame) -> list[int]:
    remote, length = int(frame.remote), len(frame.data)
    if frame.extended:
        base, rest = frame.can_id >> 18, frame.can_id & 0x3FFFF
        fields = [(0, 1), (base, 11), (0b11, 2), (rest, 18), (remote, 1), (0, 2), (length, 4)]
    else:
        fields = [(0, 1), (frame.can_id, 11), (remote, 1), (0, 2), (length, 4)]
    return [value >> (width - 1 - i) & 1 for value, width in fields for i in range(width)]


def _stuffing(bits: list[int]) -> int:
    """Stuff bits that a sequence gets; a stuff bit itself begins the next run."""
    stuffed, last, run = 0, -1, 0
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == _RUN:
            stuffed += 1
            last, run = 1 - bit, 1
    return stuffed
