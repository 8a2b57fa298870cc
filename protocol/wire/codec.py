"""MAVLink 2 frames: layout, checksum, sequence. The layouts are generated from pymavlink's `common` dialect.

    frame   FD | length | incompat | compat | sequence | system | component | id (3 bytes) | payload | CRC | [signature 13]

`FrameWriter` numbers and seals frames; `FrameReader` finds them in whatever bytes arrive. A frame that cannot be taken is
an event with a cause, counted in `FrameReader.counters`, never an exception. Source: the MAVLink 2 serialization guide.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import fastcrc
import numpy as np
from pymavlink.dialects.v20 import common

MAGIC_V2 = 0xFD
MAGIC_V1 = 0xFE
HEADER_V2 = 10
HEADER_V1 = 6
CRC_SIZE = 2
SIGNATURE_SIZE = 13
SIGNED = 0x01
LONGEST_FRAME = HEADER_V2 + 255 + CRC_SIZE + SIGNATURE_SIZE
HALF_SEQUENCE = 128
_SHORTEST_FRAME = HEADER_V2 + 1 + CRC_SIZE

_crc = fastcrc.crc16.mcrf4xx
_unpack_header = struct.Struct("<xBBxBBBHB").unpack_from  # without magic and compat; the id is 24 bits: 16 and 8
_MAGIC = bytes([MAGIC_V2])


_NUMBERS = {"uint8_t": "u1", "uint16_t": "<u2", "uint32_t": "<u4", "uint64_t": "<u8", "float": "<f4"}
_NUMBERS |= {"int8_t": "i1", "int16_t": "<i2", "int32_t": "<i4", "int64_t": "<i8", "double": "<f8"}


def _column(field: str, kind: str, length: int) -> tuple[str, str] | tuple[str, str, int]:
    if kind == "char":
        return field, f"S{max(1, length)}"
    return (field, _NUMBERS[kind], length) if length else (field, _NUMBERS[kind])


class Layout:
    """One message of the dialect: its id, name, checksum seed, and its fields in wire order.

    `dtype` is the payload as a packed NumPy structure, fields by name.
    `pack` takes the values in wire order, arrays flattened; `unpack` gives them back so. `pack_fields` and `unpack_fields`
    do the same by name, for messages off the hot path. Strings are bytes, as long as their field when unpacked.
    """

    def __init__(self, message: Any) -> None:
        self.message_id: int = message.id
        self.name: str = message.msgname
        self.fields: tuple[str, ...] = tuple(message.ordered_fieldnames)
        kinds = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        # A string is one value of the structure, not an array.
        self.array_lengths: tuple[int, ...] = tuple(
            0 if kinds[field] == "char" else length
            for field, length in zip(self.fields, message.array_lengths, strict=True)
        )
        self._strings = frozenset(field for field, kind in kinds.items() if kind == "char")
        self.structure: struct.Struct = message.unpacker
        self.size: int = self.structure.size
        self.id_bytes: bytes = self.message_id.to_bytes(3, "little")
        self.crc_seed = bytes([message.crc_extra])
        self.pack: Callable[..., bytes] = self.structure.pack
        self._unpack: Callable[[bytes], tuple[Any, ...]] = self.structure.unpack
        self.dtype = np.dtype([_column(field, kinds[field], length)
                               for field, length in zip(self.fields, message.array_lengths, strict=True)])  # fmt: skip

    def unpack(self, payload: bytes) -> tuple[Any, ...]:
        """Values in wire order; a payload shorter than the message had its trailing zeros cut off."""
        if len(payload) != self.size:
            payload = payload.ljust(self.size, b"\0")[: self.size]
        return self._unpack(payload)

    def pack_fields(self, **values: Any) -> bytes:
        """Payload from values by field name; a field left out is zero. Raises KeyError for a name the message lacks."""
        flat: list[Any] = []
        for field, length in zip(self.fields, self.array_lengths, strict=True):
            value = values.pop(field, None)
            if length:
                items = list(value) if value is not None else []
                flat += items + [0] * (length - len(items))
            else:
                flat.append(value if value is not None else b"" if field in self._strings else 0)
        if values:
            raise KeyError(f"{self.name} has no field {', '.join(values)}")
        return self.structure.pack(*flat)

    def unpack_fields(self, payload: bytes) -> dict[str, Any]:
        """Values by field name; arrays as tuples."""
        values = self.unpack(payload)
        named: dict[str, Any] = {}
        at = 0
        for field, length in zip(self.fields, self.array_lengths, strict=True):
            named[field] = values[at : at + length] if length else values[at]
            at += length or 1
        return named


@functools.cache
def layouts_by_id() -> dict[int, Layout]:
    """Every message of the dialect by its id."""
    return {number: Layout(message) for number, message in common.mavlink_map.items()}


@functools.cache
def layout(name: str) -> Layout:
    """The message called `name`, such as "HIL_SENSOR". Raises KeyError where the dialect has none."""
    for candidate in layouts_by_id().values():
        if candidate.name == name:
            return candidate
    raise KeyError(f"no message {name} in the dialect")


class Frame(NamedTuple):
    """A frame that passed its checksum. `payload` may lack trailing zeros; `raw` is the frame as it was on the wire."""

    message_id: int
    sequence: int
    system: int
    component: int
    payload: bytes
    raw: bytes


_new_frame: Callable[[type[Frame], tuple[Any, ...]], Frame] = tuple.__new__  # what Frame(...) does, in half the time


class FrameWriter:
    """Numbers and seals the frames of one component."""

    def __init__(self, system: int, component: int) -> None:
        self.system = system
        self.component = component
        self.sequence = 0

    def seal(self, message: Layout, payload: bytes) -> bytes:
        """One frame: trailing zeros of the payload cut off (one byte stays), header, checksum."""
        payload = payload.rstrip(b"\0") or b"\0"
        sequence = self.sequence
        body = bytes((len(payload), 0, 0, sequence, self.system, self.component)) + message.id_bytes + payload
        self.sequence = (sequence + 1) & 0xFF
        checksum: int = _crc(body + message.crc_seed)
        return _MAGIC + body + checksum.to_bytes(CRC_SIZE, "little")


def _frame_of_mavlink1(raw: bytes) -> Frame:
    return Frame(raw[5], raw[2], raw[3], raw[4], raw[HEADER_V1:-CRC_SIZE], raw)


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


class FrameReader:
    """Finds the frames in what a link delivers, and counts by cause what it cannot take.

    counters   bad_crc          frames whose checksum failed
               garbage_bytes    bytes that belong to no frame
               unknown_message  well-formed frames of a message the dialect lacks (handed on all the same)
               unknown_flags    frames with an incompatibility flag of unknown meaning, which must be dropped
               truncated        frames cut short by the end of their datagram
               mavlink1         MAVLink 1 frames, which this contract does not use
               sequence_gaps    frames lost, by the numbers of those that came
               out_of_order     frames that came again, or late

    With follow_sequence False the last two count from the first call of `restart_sequences` on. With keep_mavlink1 True
    MAVLink 1 frames of known messages are handed on too (for recorders), besides being counted.
    """

    def __init__(self, *, is_datagram: bool, follow_sequence: bool = True, keep_mavlink1: bool = False) -> None:
        self._is_datagram = is_datagram
        self._keep_mavlink1 = keep_mavlink1
        self._follow_sequence = follow_sequence
        self._rest = b""
        self._next: dict[tuple[int, int], int] = {}
        self._layouts = layouts_by_id()
        self.counters: dict[str, int] = dict.fromkeys(CAUSES, 0)

    def restart_sequences(self, expected: Iterable[tuple[int, int, int]] = ()) -> None:
        """Forget the numbers seen; `expected` gives (system, component, next number) where they are known."""
        self._follow_sequence = True
        self._next = {(system, component): number & 0xFF for system, component, number in expected}

    def read(self, data: bytes) -> list[Frame]:
        """The intact frames in `data`; on a stream link, a frame begun in one call is completed in the next."""
        if self._rest:
            data = self._rest + data
            self._rest = b""
        at, end = 0, len(data)
        if end >= _SHORTEST_FRAME and data[0] == MAGIC_V2 and data[1] == end - HEADER_V2 - CRC_SIZE and not data[2]:
            frame = self._check(data, 0, end)  # the plain case: just one frame, unsigned
            if frame is not None:
                return [frame]
            at = 1
        frames: list[Frame] = []
        while at < end:
            if data[at] != MAGIC_V2:
                if self._keep_mavlink1 and data[at] == MAGIC_V1:
                    if not self._is_datagram and (at + 2 > end or at + HEADER_V1 + data[at + 1] + CRC_SIZE > end):
                        self._rest = data[at:]
                        break
                    before, start = self.counters["mavlink1"], at
                    at = self._skip_garbage(data, at)
                    if self.counters["mavlink1"] > before:
                        frames.append(_frame_of_mavlink1(data[start:at]))
                    continue
                at = self._skip_garbage(data, at)
                continue
            size = self.frame_size(data, at)
            if size == 0 or at + size > end:
                if not self._is_datagram:
                    self._rest = data[at:]
                    break
                self.counters["truncated"] += 1
                at += 1
                continue
            frame = self._check(data, at, size)
            if frame is None:
                at += 1
            else:
                frames.append(frame)
                at += size
        return frames

    def frame_size(self, data: bytes, at: int) -> int:
        """Size of the frame that begins at `at`, 0 where its header is not complete."""
        if at + 3 > len(data):
            return 0
        return HEADER_V2 + data[at + 1] + CRC_SIZE + (SIGNATURE_SIZE if data[at + 2] & SIGNED else 0)

    def _check(self, data: bytes, at: int, size: int) -> Frame | None:
        """The frame of that size at `at`, or None (counted) where it is none."""
        length, flags, sequence, system, component, number, high = _unpack_header(data, at)
        if high:
            number |= high << 16
        message = self._layouts.get(number)
        stop = at + HEADER_V2 + length
        if message is None:
            # Its checksum cannot be verified: believe the length only where the next frame, or nothing, follows it.
            if at + size < len(data) and data[at + size] not in (MAGIC_V2, MAGIC_V1):
                self.counters["bad_crc"] += 1
                return None
            self.counters["unknown_message"] += 1
        elif _crc(data[at + 1 : stop] + message.crc_seed) != data[stop] | data[stop + 1] << 8:
            self.counters["bad_crc"] += 1
            return None
        if flags & ~SIGNED:
            self.counters["unknown_flags"] += 1
            return None
        if self._follow_sequence:
            key = (system, component)
            if self._next.get(key) == sequence:  # in line, as nearly always
                self._next[key] = (sequence + 1) & 0xFF
            else:
                self._follow(key, sequence)
        raw = data if size == len(data) else data[at : at + size]
        return _new_frame(Frame, (number, sequence, system, component, data[at + HEADER_V2 : stop], raw))

    def expected(self, sender: tuple[int, int]) -> int:
        """The number of the next frame of a (system, component); -1 where it is not followed, or a frame is half read."""
        return -1 if self._rest else self._next.get(sender, -1)

    def expect(self, sender: tuple[int, int], number: int) -> None:
        """Have `number` expected next of a sender whose frames were read elsewhere."""
        self._next[sender] = number & 0xFF

    def _follow(self, key: tuple[int, int], sequence: int) -> None:
        ahead = (sequence - self._next.get(key, sequence)) & 0xFF
        if ahead < HALF_SEQUENCE:
            self.counters["sequence_gaps"] += ahead
            self._next[key] = (sequence + 1) & 0xFF
        else:
            self.counters["out_of_order"] += 1

    def _skip_garbage(self, data: bytes, at: int) -> int:
        """Where the next frame may begin; MAVLink 1 frames are told from garbage by their checksum."""
        if data[at] == MAGIC_V1 and at + HEADER_V1 + CRC_SIZE <= len(data):
            stop = at + HEADER_V1 + data[at + 1]
            message = self._layouts.get(data[at + 5])
            if message and stop + CRC_SIZE <= len(data):
                crc = _crc(data[at + 1 : stop] + message.crc_seed)
                if crc == data[stop] | data[stop + 1] << 8:
                    self.counters["mavlink1"] += 1
                    return stop + CRC_SIZE
        self.counters["garbage_bytes"] += 1
        return at + 1
