"""ArduPilot's log as text (.log), the same records as in a .BIN, a line each: `GPS, 1000, 3, ...`.

Formats are lines `FMT, type, length, name, letters, labels`. Numbers are written with their scale; a line that does not
agree with its format is counted and passed over.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.logs.ardupilot_clock import Timed, record_times
from protocol.logs.ardupilot_formats import Layout, layout_of
from protocol.logs.ardupilot_units import field_units
from protocol.logs.names import distinct, readable
from protocol.logs.record_table import RESERVED, RecordTable, by_name

_BEGIN = re.compile(rb"(?m)^FMT,( ?)\s*\d+, ?\d+, ?")
_BEGINS_WITHIN = 8192
_LINES_AT_ONCE = 4096
_TEXTS = "nNZaM"
_FMT = layout_of("FMT", "BBnNZ", "Type,Length,Name,Format,Columns")


def is_ardupilot_text(first: bytes) -> bool:
    """Whether a file that begins with these bytes is such a log."""
    return b"\0" not in first[:256] and _BEGIN.search(first[:_BEGINS_WITHIN]) is not None


class _Lines:
    """The lines of one format, gathered as text and made into columns some thousand at a time."""

    def __init__(self, layout: Layout, letters: str) -> None:
        self.layout = layout
        self.letters = letters
        names = distinct([column.name for column in layout.columns], RESERVED)
        self.dtype = np.dtype([("t_us", "<i8"), *zip(names, map(_kind, letters), strict=True)])
        self.numbers: list[int] = []
        self._waiting: list[tuple[Any, ...]] = []
        self._made: list[npt.NDArray[np.void]] = []

    def take(self, number: int, values: list[str], delimiter: str) -> bool:
        """Take the values of a line; False where they are not what the format says."""
        more = len(values) - len(self.letters)
        if more > 0 and self.letters and self.letters[-1] in _TEXTS:
            values = [*values[: -more - 1], delimiter.join(values[-more - 1 :])]
        if len(values) != len(self.letters):
            return False
        try:
            row = tuple(_value(letter, value) for letter, value in zip(self.letters, values, strict=True))
        except ValueError:
            return False
        self.numbers.append(number)
        self._waiting.append((0, *row))
        if len(self._waiting) == _LINES_AT_ONCE:
            self._make()
        return True

    def _make(self) -> None:
        self._made.append(np.array(self._waiting, dtype=self.dtype))
        self._waiting = []

    def rows(self) -> npt.NDArray[np.void]:
        """All rows; their times are not filled in."""
        if self._waiting:
            self._make()
        return np.concatenate(self._made)


def read_ardupilot_text(
    path: Path, progress: Callable[[int, int], None] | None = None
) -> tuple[dict[str, RecordTable], dict[str, int]]:
    """The table of each message, by name, and what was counted: unreadable_lines. Raises OSError."""
    assert _FMT is not None
    data = path.read_bytes()
    begin = _BEGIN.search(data)
    at, delimiter = (begin.start(), "," + begin[1].decode()) if begin else (len(data), ",")
    kinds = {("FMT", "BBnNZ", ""): _Lines(_FMT, "BBnNZ")}
    current = {"FMT": kinds["FMT", "BBnNZ", ""]}
    types: dict[int, Layout] = {}
    count = unreadable = 0
    while at < len(data):
        end = data.find(b"\n", at)
        end = len(data) if end < 0 else end
        line = data[at:end].decode("utf-8", "replace").strip(" \r\t\0")
        at = end + 1
        name, *values = line.split(delimiter)
        if not line:
            continue
        lines = current.get(name)
        if lines is None or not lines.take(count, values, delimiter):
            unreadable += 1
        else:
            count += 1
            if name == "FMT":
                _define(values, delimiter, kinds, current, types)
        if progress and count % _LINES_AT_ONCE == 0:
            progress(at, len(data))
    found = [lines for lines in kinds.values() if lines.numbers]
    made = [(lines, np.array(lines.numbers), lines.rows()) for lines in found]
    times = record_times(count, [_timed(*kind) for kind in made])
    parts: dict[str, list[tuple[RecordTable, npt.NDArray[np.int64]]]] = {}
    for lines, numbers, rows in made:
        table = RecordTable(times[numbers], lines.dtype, rows.__getitem__)
        parts.setdefault(lines.layout.name, []).append((table, numbers))
    tables = by_name(parts.items())
    units = field_units(tables, types)
    for name, table in tables.items():
        tables[name] = RecordTable(table.t_us, table.dtype, table.make, units.get(name, {}))
    return tables, {"unreadable_lines": unreadable}


def _define(
    values: list[str],
    delimiter: str,
    kinds: dict[tuple[str, str, str], _Lines],
    current: dict[str, _Lines],
    types: dict[int, Layout],
) -> None:
    """Take the values of a line FMT."""
    name, letters, labels = readable(values[2], ""), values[3].strip(), ",".join(values[4:])
    if not name or name == "FMT":
        return
    layout = layout_of(name, letters, labels)
    if layout is None:
        current.pop(name, None)
        return
    key = name, letters, labels
    if key not in kinds:
        kinds[key] = _Lines(layout, letters)
    current[name] = kinds[key]
    types[int(values[0])] = layout


def _timed(lines: _Lines, numbers: npt.NDArray[np.int64], rows: npt.NDArray[np.void]) -> Timed:
    def field(name: str) -> npt.NDArray[Any] | None:
        return rows[name] if name in (rows.dtype.names or ())[1:] and rows.dtype[name].kind in "iu" else None

    first = lines.layout.columns[0].name if lines.layout.columns else ""
    return Timed(lines.layout.name, first, numbers, field)


def _kind(letter: str) -> str:
    if letter in _TEXTS:
        return "O"
    return "<f8" if letter in "gfdcCeEL" else "<u8" if letter == "Q" else "<i8"


def _value(letter: str, text: str) -> Any:
    """A value of a line. Raises ValueError where it is none of its letter's kind."""
    if letter in _TEXTS:
        return text.strip()
    if letter in "gfdcCeEL":
        return float(text)
    value = int(text)
    least, most = (0, 1 << 64) if letter == "Q" else (-(1 << 63), 1 << 63)
    if not least <= value < most:
        raise ValueError
    return value
