"""Shifting of the time fields of frames, with new checksums.

Changed fields: time_usec, time_boot_ms, time_boot_us and time_unix_usec of the dialect's messages. Times since 1970 then
begin now; times since boot begin at zero for each system, as if it had booted now. Zero means unknown, and is kept.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from protocol.logs.dialect import layouts
from protocol.logs.scan import Scan
from protocol.logs.tables import tables
from protocol.wire.codec import Layout
from protocol.wire.framing import CRC_SIZE, HEADER_V1, HEADER_V2, MAGIC_V1, SIGNED, checksum, message_of

TIME_FIELDS = MappingProxyType({"time_usec": 1, "time_boot_us": 1, "time_unix_usec": 1, "time_boot_ms": 1000})
"""Names of the fields that are shifted, and their unit in us."""
UNIX_FROM_US = 10**15
"""Times from here on count from 1970 (this is September 2001); smaller ones count from boot (this is 31 years)."""


def time_fields(message: Layout) -> tuple[tuple[int, int, int], ...]:
    """(place in the payload, size, unit in us) of each time field of a message."""
    found = []
    for name in message.fields:
        kind, place = message.dtype.fields[name][:2] if message.dtype.fields else (np.dtype("u1"), 0)
        if name in TIME_FIELDS and kind.kind == "u" and kind.shape == ():
            found.append((int(place), kind.itemsize, TIME_FIELDS[name]))
    return tuple(found)


class TimeMover:
    """Shifts the time fields of a log's frames so that they begin now, at now_us since 1970.

    moved   number of changed frames
    """

    def __init__(self, scan: Scan, chosen: npt.NDArray[np.bool_], now_us: int) -> None:
        """Find the first times of the chosen frames (a boolean for each row of the scan)."""
        self.moved = 0
        self._fields = {number: time_fields(message) for number, message in layouts().items()}
        firsts: dict[int, int] = {}
        unix_us: int | None = None
        for name, table in tables(scan, None, chosen).items():
            for field, unit in TIME_FIELDS.items():
                if field not in (table.dtype.names or ()) or table.dtype[field].kind != "u":
                    continue
                times = table[field].astype(np.int64) * unit
                since_1970 = times[times >= UNIX_FROM_US]
                if len(since_1970):
                    unix_us = min(unix_us or int(since_1970.min()), int(since_1970.min()))
                for system in np.unique(table["system"]):
                    known = times[(table["system"] == system) & (times < UNIX_FROM_US)]
                    known = known[known > 0] if name == "SYSTEM_TIME" else known
                    if len(known):
                        firsts[int(system)] = min(firsts.get(int(system), UNIX_FROM_US), int(known.min()))
        self._boot_us = firsts
        self._unix_shift_us = now_us - unix_us if unix_us else 0

    def move(self, frame: bytes, extra_us: int) -> bytes:
        """The frame with its times shifted, and by extra_us more; its signature, no longer valid, is removed."""
        number = message_of(frame, 0)
        system, header = (frame[3], HEADER_V1) if frame[0] == MAGIC_V1 else (frame[5], HEADER_V2)
        fields = self._fields.get(number, ())
        if not fields:
            return frame
        message = layouts()[number]
        payload = bytearray(frame[header : header + frame[1]].ljust(message.size, b"\0"))
        for place, size, unit in fields:
            value = int.from_bytes(payload[place : place + size], "little") * unit
            if value >= UNIX_FROM_US:
                value += self._unix_shift_us + extra_us
            elif value or not self._boot_us.get(system):
                value += extra_us - self._boot_us.get(system, 0)
            else:
                continue
            payload[place : place + size] = (value // unit % (1 << 8 * size)).to_bytes(size, "little")
        self.moved += 1
        return _sealed(frame, header, payload, message)


def _sealed(frame: bytes, header: int, payload: bytearray, message: Layout) -> bytes:
    """The frame with a new payload: MAVLink 1 of the same length, MAVLink 2 without trailing zeros and signature."""
    if header == HEADER_V1:
        body = frame[1:header] + payload[: frame[1]]
    else:
        content = bytes(payload).rstrip(b"\0") or b"\0"
        body = bytes((len(content), frame[2] & ~SIGNED)) + frame[3:header] + content
    body = bytes(body)
    return frame[:1] + body + checksum(body, 0, len(body), message.crc_seed).to_bytes(CRC_SIZE, "little")
