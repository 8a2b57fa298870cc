"""Formats of a PX4 log: what the bytes of a topic mean, nested formats laid flat."""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from protocol.logs.record_table import Column

KINDS: Mapping[str, str] = MappingProxyType(
    {
        **{"int8_t": "<i1", "uint8_t": "<u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4"},
        **{"int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8", "bool": "<i1", "char": "S1"},
    }
)
LARGEST = 0xFFFF
_DEEPEST = 8
_MOST_COLUMNS = 4096
_FIELD = re.compile(r"([^\s\[\];]+)(?:\[(\d{1,5})\])? ([^\s;]+)")


class Topic(NamedTuple):
    """What a data message of a topic holds; between `least` bytes and `most`, since padding at the end may be left out."""

    columns: list[Column]
    least: int
    most: int


class Formats:
    """The formats that a log defines, by name."""

    def __init__(self) -> None:
        self._fields: dict[str, list[tuple[str, int | None, str]]] = {}
        self._visits = 0

    def define(self, text: str) -> None:
        """Take a definition `name:type field;type[count] field;`. One that cannot be read is no format."""
        name, _, rest = text.partition(":")
        fields = []
        for part in filter(None, (part.strip() for part in rest.split(";"))):
            found = _FIELD.fullmatch(part)
            if found is None:
                return
            fields.append((found[1], int(found[2]) if found[2] else None, found[3]))
        self._fields[name] = fields

    def topic(self, name: str) -> Topic | None:
        """What a topic's data mean; None where its format is not there, or none that can be."""
        columns: list[Column] = []
        self._visits = 0
        size = self._lay_flat(name, "", 0, columns, 0)
        if size < 0:
            return None
        padding = 0
        if (fields := self._fields[name]) and fields[-1][2].startswith("_padding") and fields[-1][0] in KINDS:
            padding = int(KINDS[fields[-1][0]][-1]) * (1 if fields[-1][1] is None else fields[-1][1])
        return Topic(columns, size - padding, size)

    def _lay_flat(self, name: str, prefix: str, offset: int, columns: list[Column], depth: int) -> int:
        """Append the columns of a format that begins at `offset`; returns where it ends, -1 where no data can be so."""
        self._visits += 1
        if depth > _DEEPEST or name not in self._fields or self._visits > _MOST_COLUMNS:
            return -1
        for kind, count, field in self._fields[name]:
            shown = prefix + re.sub(r"\W", "_", field)
            if kind in KINDS:
                if not field.startswith("_padding") and count != 0:
                    columns.append(_column(shown, KINDS[kind], count, offset))
                offset += int(KINDS[kind][-1]) * (1 if count is None else count)
            else:
                for element in range(1 if count is None else count):
                    index = "" if count is None else f"[{element}]"
                    offset = self._lay_flat(kind, f"{shown}{index}.", offset, columns, depth + 1)
                    if offset < 0:
                        return -1
            if len(columns) > _MOST_COLUMNS or offset > LARGEST:
                return -1
        return offset


def _column(name: str, kind: str, count: int | None, offset: int) -> Column:
    if kind[0] == "S":
        return Column(name, f"S{count or 1}", (), offset)
    return Column(name, kind, () if count is None else (count,), offset)
