"""What a recorder keeps of a link: every intact frame of either version, whatever its message.

A log is read long after, with more dialects than the link's own, so this is more lenient than `codec.FrameReader`, and is
for recorders only. A frame counts as intact where the checksum of its message in pymavlink's `all` dialect holds; or where
any of the 256 seeds explains the checksum and another frame, or nothing, follows: a frame of a dialect that is not known.
"""

from __future__ import annotations

from typing import NamedTuple

from protocol.logs.dialect import layouts
from protocol.wire import framing
from protocol.wire.framing import (
    CRC_SIZE,
    HALF_SEQUENCE,
    HEADER_V1,
    HEADER_V2,
    MAGIC_V1,
    MAGIC_V2,
    SIGNATURE_SIZE,
    SIGNED,
)

_MAGICS = (MAGIC_V1, MAGIC_V2)


class Kept(NamedTuple):
    """A frame: its message by name, UNKNOWN_ and the number where the dialect has another or none; and its bytes."""

    name: str
    raw: bytes


class FrameKeeper:
    """Finds the intact frames in what a link delivers, and counts the rest.

    counters   bad_crc, garbage_bytes, truncated, sequence_gaps, out_of_order   as in `codec.FrameReader`
               unknown_message, unknown_flags, mavlink1   frames of that kind; they are kept all the same
    """

    def __init__(self, *, is_datagram: bool) -> None:
        self._is_datagram = is_datagram
        self._rest = b""
        self._next: dict[tuple[int, int], int] = {}
        self._seeds: dict[int, int] = {}
        self.counters: dict[str, int] = dict.fromkeys(framing.CAUSES, 0)

    def read(self, data: bytes) -> list[Kept]:
        """The intact frames in `data`; on a stream, a frame begun in one call is completed in the next."""
        data, self._rest = self._rest + data, b""
        kept: list[Kept] = []
        at = 0
        while at < len(data):
            if data[at] not in _MAGICS:
                self.counters["garbage_bytes"] += 1
                at += 1
                continue
            end = _end(data, at)
            if end > len(data):
                if not self._is_datagram:
                    self._rest = data[at:]
                    break
                self.counters["truncated"] += 1
                at += 1
            elif (name := self._name(data, at, end)) is None:
                self.counters["bad_crc"] += 1
                at += 1
            else:
                self._count(data, at, name)
                kept.append(Kept(name, data[at:end]))
                at = end
        return kept

    def _name(self, data: bytes, at: int, end: int) -> str | None:
        """The message of the frame between `at` and `end`, None where it is not intact."""
        number = int.from_bytes(data[at + 7 : at + 10], "little") if data[at] == MAGIC_V2 else data[at + 5]
        stop = end - CRC_SIZE - (SIGNATURE_SIZE if data[at] == MAGIC_V2 and data[at + 2] & SIGNED else 0)
        found = data[stop] | data[stop + 1] << 8
        known = layouts().get(number)
        if known is not None and framing.checksum(data, at + 1, stop, known.crc_seed) == found:
            return known.name
        if end < len(data) and data[end] not in _MAGICS:
            return None
        learned = self._seeds.get(number)
        for seed in range(256) if learned is None else (learned, *range(256)):
            if framing.checksum(data, at + 1, stop, seed) == found:
                self._seeds[number] = seed
                return f"UNKNOWN_{number}"
        return None

    def _count(self, data: bytes, at: int, name: str) -> None:
        first = at + (4 if data[at] == MAGIC_V2 else 2)
        self.counters["mavlink1"] += data[at] == MAGIC_V1
        self.counters["unknown_message"] += name.startswith("UNKNOWN_")
        self.counters["unknown_flags"] += data[at] == MAGIC_V2 and data[at + 2] & ~SIGNED != 0
        sequence, sender = data[first], (data[first + 1], data[first + 2])
        ahead = (sequence - self._next.get(sender, sequence)) & 0xFF
        if ahead < HALF_SEQUENCE:
            self.counters["sequence_gaps"] += ahead
            self._next[sender] = (sequence + 1) & 0xFF
        else:
            self.counters["out_of_order"] += 1


def _end(data: bytes, at: int) -> int:
    """Where the frame at `at` says that it ends; behind the end of the data where its header is not whole."""
    if at + 3 > len(data):
        return len(data) + 1
    if data[at] == MAGIC_V1:
        return at + HEADER_V1 + data[at + 1] + CRC_SIZE
    return at + HEADER_V2 + data[at + 1] + CRC_SIZE + (SIGNATURE_SIZE if data[at + 2] & SIGNED else 0)
