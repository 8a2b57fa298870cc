"""MAVLink frames for callers in Python: layouts, generated from pymavlink's `common` dialect, a writer and a reader.

`FrameWriter` numbers and seals frames; `FrameReader` finds them in received bytes. A bad frame is dropped and counted by
cause in `FrameReader.counters`; it never raises an exception. Source: the MAVLink 2 serialization guide.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common

from protocol.compiled import entry_point
from protocol.wire import framing
from protocol.wire.framing import CAUSES, CRC_SIZE, HEADER_V2, KNOWN, LONGEST_FRAME, MAGIC_V2, SIZE_SHIFT, Table

_unpack_header = struct.Struct("<xBBxBBBHB").unpack_from  # without magic and compat; the id is 24 bits: 16 and 8
_AT_ONCE = 256
"""Frames that one call describes; a datagram with more takes several calls."""

_NUMBERS = {"uint8_t": "u1", "uint16_t": "<u2", "uint32_t": "<u4", "uint64_t": "<u8", "float": "<f4"}
_NUMBERS |= {"int8_t": "i1", "int16_t": "<i2", "int32_t": "<i4", "int64_t": "<i8", "double": "<f8"}


def _column(field: str, kind: str, length: int) -> tuple[str, str] | tuple[str, str, int]:
    if kind == "char":
        return field, f"S{max(1, length)}"
    return (field, _NUMBERS[kind], length) if length else (field, _NUMBERS[kind])


class Layout:
    """One message of the dialect: its id, name, checksum seed, and its fields in wire order.

    `dtype` is the payload as a packed NumPy structure, fields by name.
    `pack` takes the values in wire order, arrays flattened; `unpack` returns them in this form. `pack_fields` and
    `unpack_fields` do the same by name, for messages off the fast path. Strings are bytes, unpacked with the full field length.
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
        self.crc_seed: int = message.crc_extra
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
        """Payload from values by field name; missing fields are zero. Raises KeyError for an unknown name."""
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
        """Values by field name, arrays as tuples."""
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
    """A frame with a valid checksum. `payload` may lack trailing zeros; `raw` is the frame as it was on the wire."""

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
        self._out = np.zeros(LONGEST_FRAME, dtype=np.uint8)
        self._seal_frame = entry_point(framing.seal_frame, self._out, 0, b"", 0, 0, system, component, 0, 0)

    def seal(self, message: Layout, payload: bytes) -> bytes:
        """One frame: header, payload without trailing zeros (at least one byte), checksum."""
        sequence, out = self.sequence, self._out
        end = self._seal_frame(
            out, 0, payload, 0, sequence, self.system, self.component, message.message_id, message.crc_seed
        )
        self.sequence = (sequence + 1) & 0xFF
        return out[:end].tobytes()


def table_of(messages: Iterable[Layout], ids: int) -> Table:
    """The table of messages (ids,) that frames are checked against."""
    table = np.zeros(ids, dtype=np.int32)
    for message in messages:
        table[message.message_id] = KNOWN | message.size << SIZE_SHIFT | message.crc_seed
    return table


@functools.cache
def link_table() -> Table:
    """The table of the dialect used on links."""
    return table_of(layouts_by_id().values(), 1 << 16)


class FrameReader:
    """Finds the frames in received data, and counts dropped ones by cause; see `framing.next_frame`.

    counters   bad_crc          frames with a wrong checksum
               garbage_bytes    bytes outside of any frame
               unknown_message  well-formed frames of a message not in the dialect (returned all the same)
               unknown_flags    frames with an unknown incompatibility flag, which must be dropped
               truncated        frames cut short by the end of their datagram
               mavlink1         MAVLink 1 frames, which the loop does not use
               sequence_gaps    lost frames, by the sequence numbers received
               out_of_order     repeated or late frames

    With follow_sequence False the last two count from the first call of `restart_sequences` on. With keep_mavlink1 True
    MAVLink 1 frames are counted and also returned (for recorders).

    reading, table, rows   arguments of `framing.next_frame` for a kernel that reads frames itself, between calls of `whole`
                           and `keep_rest`
    """

    def __init__(self, *, is_datagram: bool, follow_sequence: bool = True, keep_mavlink1: bool = False) -> None:
        self.reading = framing.new_reading(
            is_datagram=is_datagram, follow_sequence=follow_sequence, keep_mavlink1=keep_mavlink1
        )
        self.table = link_table()
        self.rows = np.zeros(_AT_ONCE, dtype=framing.ROW)
        self._offsets = self.rows["offset"]
        self._is_datagram = is_datagram
        self._rest = b""
        self._counted, self._next = self.reading["counters"][0], self.reading["next"][0]
        self._read_frames = entry_point(framing.read_frames, b"", 0, self.reading, self.table, self.rows)

    @property
    def counters(self) -> dict[str, int]:
        """Counters by cause."""
        return dict(zip(CAUSES, self._counted.tolist(), strict=True))

    def restart_sequences(self, expected: Iterable[tuple[int, int, int]] = ()) -> None:
        """Forget the sequence numbers; `expected` gives (system, component, next number) where known."""
        self.reading["follow"] = 1
        self._next[:] = -1
        for system, component, number in expected:
            self._next[system << 8 | component] = number & 0xFF

    def whole(self, data: bytes) -> bytes:
        """On a stream: `data` preceded by the unfinished frame of earlier data."""
        if self._rest:
            data, self._rest = self._rest + data, b""
        return data

    def keep_rest(self, data: bytes) -> None:
        """On a stream: keep the unfinished frame at the end of `data`, all of which has been read."""
        if not self._is_datagram:
            self._rest = data[self.reading["rest"].item() :]

    def read(self, data: bytes) -> list[Frame]:
        """The intact frames in `data`; on a stream link, a frame begun in one call is completed in the next."""
        data = self.whole(data)
        count, at = self._read_frames(data, 0, self.reading, self.table, self.rows)
        if (
            count == 1
            and data[0] == MAGIC_V2
            and len(data) == data[1] + HEADER_V2 + CRC_SIZE
            and not self._offsets.item(0)
        ):
            return [lone_frame(data)]  # as nearly always
        frames = [frame_of(data, row) for row in self.rows[:count].tolist()]
        while at >= 0:
            count, at = self._read_frames(data, at, self.reading, self.table, self.rows)
            frames += [frame_of(data, row) for row in self.rows[:count].tolist()]
        self.keep_rest(data)
        return frames


def lone_frame(data: bytes) -> Frame:
    """The frame in `data`, which is exactly one intact, unsigned MAVLink 2 frame."""
    length, _, sequence, system, component, number, high = _unpack_header(data, 0)
    number |= high << 16
    return _new_frame(Frame, (number, sequence, system, component, data[HEADER_V2 : HEADER_V2 + length], data))


def frame_of(data: bytes, row: tuple[int, ...]) -> Frame:
    """The frame in `data` that a row of `framing.ROW` describes."""
    number, offset, end, first, length, sequence, system, component = row
    return _new_frame(Frame, (number, sequence, system, component, data[first : first + length], data[offset:end]))
