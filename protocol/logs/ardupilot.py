"""ArduPilot's dataflash log (.BIN) as tables: a reader of its own, for speed, and since damage must cost no more than it hits.

Fields have the names and the scale that pymavlink's DFReader gives them (a latitude in degrees, say). Each table begins
with t_us: microseconds of Unix time where the log holds a GPS time, else since the autopilot's start. A record without a
time of its own, or with one that cannot be, has that of the record before it in the file.

Types of one name share a table, also where their fields differ: what a record lacks is NaN there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.logs.ardupilot_clock import Timed, record_times
from protocol.logs.ardupilot_formats import Layout, layout_of
from protocol.logs.ardupilot_kernels import (
    ALTERNATIVES,
    DAMAGED,
    DEFINITION,
    DONE,
    FMT,
    HEADER,
    POSITION,
    RESYNCHRONISATIONS,
    ROWS,
    STATE_SIZE,
    TAIL,
    count_hidden,
    walk,
)
from protocol.logs.ardupilot_units import field_units
from protocol.logs.names import readable
from protocol.logs.record_table import Column, RecordTable, by_name, of_records

MAGIC = b"\xa3\x95"
_FMT_LENGTH = 89
_BINARY = {("FILE", "Data")}
_RARELY = 1 / 8
"""Text with bytes behind its end more often than that is no text; less often, it is damaged."""
_FMT_LAYOUT = layout_of("FMT", "BBnNZ", "Type,Length,Name,Format,Columns")


class Found(NamedTuple):
    """The records of one layout: where their bodies are, and their numbers in the order of the file."""

    layout: Layout
    places: npt.NDArray[np.int64]
    numbers: npt.NDArray[np.int64]


def read_ardupilot(
    path: Path, progress: Callable[[int, int], None] | None = None
) -> tuple[dict[str, RecordTable], dict[str, int]]:
    """The table of each message, by name, and what was counted. Raises OSError where the file cannot be read.

    Counted are damaged_bytes, resynchronisations and truncated_tail, as in `scan`, and unreadable_records: those of types
    whose format means nothing, or does not agree with their length.
    """
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    formats = _Formats()
    state = np.zeros(STATE_SIZE, dtype=np.int64)
    places = np.empty(len(data) // 48 + 1024, dtype=np.int64)
    layouts = np.empty(len(places), dtype=np.int32)
    ended = DEFINITION
    while ended != DONE:
        ended = walk(data, formats.lengths, formats.current, state, places, layouts)
        if ended == DEFINITION:
            at = int(places[state[ROWS] - 1])
            formats.define(data[at : at + _FMT_LENGTH - HEADER].tobytes())
        elif ended != DONE:
            places.resize(len(places) * 3 // 2, refcheck=False)
            layouts.resize(len(layouts) * 3 // 2, refcheck=False)
        if progress:
            progress(int(state[POSITION]), len(data))
    count, unreadable = int(state[ROWS]), int(np.count_nonzero(layouts[: state[ROWS]] < 0))
    found = _sorted_out(formats.layouts, places[:count], layouts[:count])
    del places, layouts
    times = record_times(count, [_timed(data, kind) for kind in found])
    parts: dict[str, list[tuple[RecordTable, npt.NDArray[np.int64]]]] = {}
    for kind in found:
        columns = _with_binaries(data, kind)
        table = of_records(data, kind.places, times[kind.numbers], columns, kind.layout.size)
        parts.setdefault(kind.layout.name, []).append((table, kind.numbers))
    tables = by_name(parts.items())
    units = field_units(tables, formats.by_type())
    tables = {name: replace(table, units=units.get(name, {})) for name, table in tables.items()}
    return tables, {
        "damaged_bytes": int(state[DAMAGED]),
        "resynchronisations": int(state[RESYNCHRONISATIONS]),
        "truncated_tail": int(state[TAIL]),
        "unreadable_records": unreadable,
    }


class _Formats:
    """The formats that a log has defined so far.

    layouts   each that can be read, once
    lengths   of records, by type, the latest first; 0 where there is none
    current   the layouts of those, -1 where it means nothing
    """

    def __init__(self) -> None:
        assert _FMT_LAYOUT is not None
        self.layouts: list[Layout] = [_FMT_LAYOUT]
        self.lengths = np.zeros((256, ALTERNATIVES), dtype=np.int32)
        self.current = np.full((256, ALTERNATIVES), -1, dtype=np.int32)
        self.lengths[FMT, 0], self.current[FMT, 0] = _FMT_LENGTH, 0
        self._numbers: dict[tuple[str, str, str], int] = {}

    def by_type(self) -> dict[int, Layout]:
        """What each type stands for at the end."""
        return {kind: self.layouts[number] for kind, number in enumerate(self.current[:, 0].tolist()) if number >= 0}

    def define(self, body: bytes) -> None:
        """Take the body of a FMT record. That of FMT itself is known and stays."""
        kind, length = body[0], body[1]
        if kind == FMT or length < HEADER:
            return
        name, letters, labels = (readable(part, "") for part in (body[2:6], body[6:22].rstrip(b"\0 "), body[22:]))
        key = name or f"TYPE_{kind}", letters, labels
        number = self._numbers.get(key, -1)
        if number < 0:
            layout = layout_of(*key)
            if layout is not None and layout.size + HEADER == length:
                number = len(self.layouts)
                self.layouts.append(layout)
                self._numbers[key] = number
        elif self.layouts[number].size + HEADER != length:
            number = -1
        if (self.lengths[kind, 0], self.current[kind, 0]) != (length, number):
            self.lengths[kind, 1:], self.current[kind, 1:] = self.lengths[kind, :-1], self.current[kind, :-1]
            self.lengths[kind, 0], self.current[kind, 0] = length, number


def _sorted_out(layouts: list[Layout], places: npt.NDArray[np.int64], of: npt.NDArray[np.int32]) -> list[Found]:
    """The records of each layout that has some."""
    order = np.argsort(of, kind="stable")
    starts = np.searchsorted(of[order], np.arange(len(layouts) + 1))
    parts = [order[start:end] for start, end in itertools.pairwise(starts)]
    return [
        Found(layout, places[numbers], numbers) for layout, numbers in zip(layouts, parts, strict=True) if len(numbers)
    ]


def _timed(data: npt.NDArray[np.uint8], kind: Found) -> Timed:
    columns = {
        c.name: c._replace(name="value", divisor=1) for c in kind.layout.columns if c.kind[1] in "iu" and not c.shape
    }

    def field(name: str) -> npt.NDArray[Any] | None:
        if name not in columns:
            return None
        column = columns[name]
        at, size = kind.places + column.offset, np.dtype(column.kind).itemsize
        table = of_records(data, at, kind.numbers, [column._replace(offset=0)], size)
        values: npt.NDArray[Any] = table.rows()["value"]
        return values

    first = kind.layout.columns[0].name if kind.layout.columns else ""
    return Timed(kind.layout.name, first, kind.numbers, field)


def _with_binaries(data: npt.NDArray[np.uint8], kind: Found) -> list[Column]:
    """The columns, those that are text by their format but hold other bytes as such (kind V): no byte is lost then."""
    columns = []
    for column in kind.layout.columns:
        if column.kind[0] == "S":
            told, hidden = count_hidden(data, kind.places + column.offset, int(column.kind[1:]))
            if (kind.layout.name, column.name) in _BINARY or hidden > _RARELY * told:
                column = column._replace(kind=f"V{column.kind[1:]}")  # noqa: PLW2901
        columns.append(column)
    return columns
