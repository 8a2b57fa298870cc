"""A CAN frame, independent of any interface, and how many bits it takes on the wire.

Bits of a classical frame (ISO 11898-1; Robert Bosch, CAN specification 2.0): start, identifier, control, data and a CRC of
15 bits are stuffed: one opposite bit after each five equal ones. Delimiters, acknowledge, end of frame and the three bits
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


class CanFrame(NamedTuple):
    """A classical CAN frame. `remote`: a remote transmission request, which has no data."""

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False

    def __str__(self) -> str:
        shown = f"{self.can_id:08X}" if self.extended else f"{self.can_id:03X}"
        return f"{shown}#{'R' if self.remote else self.data.hex().upper()}"


def nominal_bits(length: int, *, extended: bool) -> int:
    """Bits of a frame with `length` bytes of data without stuffing, including the gap to the next frame."""
    return (67 if extended else 47) + 8 * length


def worst_bits(length: int, *, extended: bool) -> int:
    """Bits of a frame with `length` bytes of data with the most stuffing that any content can cause."""
    stuffable = (54 if extended else 34) + 8 * length
    return nominal_bits(length, extended=extended) + (stuffable - 1) // 4
