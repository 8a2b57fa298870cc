"""The records of one kind in a log, made into rows of a table only when they are asked for.

A log that an autopilot wrote of itself holds some hundred kinds. Where each record lies and when it was written is kept;
its columns are copied out of the file's bytes piece by piece, so that no more than a piece is in memory twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled
from protocol.logs.names import distinct

RESERVED = ("t_us", "time_s", "frame_sequence")
"""Columns that the readers and exports make themselves; a field of such a name gets a number."""

_ROWS_AT_ONCE = 1 << 14
_PREFIXES = {1e-1: "d", 1e-2: "c", 1e-3: "m", 1e-6: "µ", 1e-9: "n"}


class Column(NamedTuple):
    """A field of a record: its kind, shape and place in the record's body; `divisor` makes of it what it stands for."""

    name: str
    kind: str
    shape: tuple[int, ...] = ()
    offset: int = 0
    divisor: int = 1


class Unit(NamedTuple):
    """The unit of a field, and what its values are to be multiplied by to be in that unit."""

    name: str
    multiplier: float = 1.0

    def __str__(self) -> str:
        """The unit that the values are in: µs where they are to be multiplied by 1e-6 to be in s."""
        if not self.name or self.multiplier == 1.0:
            return self.name
        prefix = _PREFIXES.get(self.multiplier)
        return f"{prefix}{self.name}" if prefix else f"{self.multiplier:.4g} {self.name}"


@dataclass(frozen=True)
class RecordTable:
    """Records as rows.

    t_us    time of each (us), shape (rows,)
    dtype   of a row: t_us, then the fields
    make    the rows of these numbers, without their times
    units   of fields, by name, where the log says them
    """

    t_us: npt.NDArray[np.int64]
    dtype: np.dtype[np.void]
    make: Callable[[npt.NDArray[np.int64]], npt.NDArray[np.void]]
    units: Mapping[str, Unit] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.t_us)

    def rows(self, chosen: npt.NDArray[np.int64] | None = None) -> npt.NDArray[np.void]:
        """The rows of these numbers; None is all."""
        numbers = np.arange(len(self)) if chosen is None else chosen
        made = np.empty(len(numbers), dtype=self.dtype)
        for start in range(0, len(numbers), _ROWS_AT_ONCE):
            some = numbers[start : start + _ROWS_AT_ONCE]
            part = made[start : start + _ROWS_AT_ONCE]
            part[...] = self.make(some)
            part["t_us"] = self.t_us[some]
        return made

    def between(self, first_us: int, last_us: int) -> npt.NDArray[np.int64]:
        """The numbers of the rows of these times, both ends included."""
        return np.flatnonzero((self.t_us >= first_us) & (self.t_us <= last_us))


def of_records(
    data: npt.NDArray[np.uint8],
    places: npt.NDArray[np.int64],
    t_us: npt.NDArray[np.int64],
    columns: list[Column],
    size: int,
) -> RecordTable:
    """The table of records whose bodies, of `size` bytes, begin at `places` in `data`.

    Of a record at the end of the data that is shorter, what is missing is zero.
    """
    names = distinct([column.name for column in columns], RESERVED)
    formats: list[Any] = [(column.kind, column.shape) for column in columns]
    offsets = [column.offset for column in columns]
    raw = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": max(size, 1)})
    kinds: list[Any] = [(name, _kind(column), column.shape) for name, column in zip(names, columns, strict=True)]
    dtype = np.dtype([("t_us", "<i8"), *kinds])

    def make(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
        body = np.zeros(len(numbers) * raw.itemsize, dtype=np.uint8)
        copy_records(data, places[numbers], raw.itemsize, body)
        records, made = body.view(raw), np.empty(len(numbers), dtype=dtype)
        for name, column in zip(names, columns, strict=True):
            made[name] = records[name] if column.divisor == 1 else records[name] / column.divisor
        return made

    return RecordTable(t_us, dtype, make)


def _kind(column: Column) -> str:
    if column.divisor != 1:
        return "<f8"
    return "<f4" if column.kind == "<f2" else column.kind  # few programs know the short one


def joined(parts: Sequence[RecordTable], numbers: Sequence[npt.NDArray[np.int64]]) -> RecordTable | None:
    """One table of several whose fields differ; `numbers` say where each one's rows are in the order of all.

    What a part lacks is NaN, or empty text, there; whole numbers become floating ones for that. None where one table
    cannot hold them all: a field is text in one part and a number in the other, or would lose digits.
    """
    if len(parts) == 1:
        return parts[0]
    kinds: dict[str, list[np.dtype[Any]]] = {}
    for part in parts:
        for name in part.dtype.names or ():
            kinds.setdefault(name, []).append(part.dtype[name])
    types: dict[str, np.dtype[Any]] = {}
    for name, given in kinds.items():
        common = _common(given, is_everywhere=len(given) == len(parts))
        if common is None:
            return None
        types[name] = common
    dtype = np.dtype(list(types.items()))
    order = np.argsort(np.concatenate(numbers), kind="stable")
    part_of = np.repeat(np.arange(len(parts)), [len(part) for part in parts])[order]
    row_of = np.concatenate([np.arange(len(part)) for part in parts])[order]
    blank = np.zeros(1, dtype=dtype)
    for name in types:
        if blank[name].dtype.kind == "f":
            blank[name] = np.nan

    def make(chosen: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
        made = np.repeat(blank, len(chosen))
        for number, part in enumerate(parts):
            here = np.flatnonzero(part_of[chosen] == number)
            rows = part.make(row_of[chosen[here]])
            for name in part.dtype.names or ():
                made[name][here] = rows[name]
        return made

    units = {name: unit for part in parts for name, unit in part.units.items()}
    return RecordTable(np.concatenate([part.t_us for part in parts])[order], dtype, make, units)


def _common(kinds: list[np.dtype[Any]], *, is_everywhere: bool) -> np.dtype[Any] | None:
    """What holds values of all these kinds, and a gap where not every part has one; None where nothing does."""
    bases = [kind.subdtype[0] if kind.subdtype else kind for kind in kinds]
    shapes = {kind.shape for kind in kinds}
    if len(shapes) > 1 or any(base.kind in "VO" for base in bases):
        return kinds[0] if len(set(kinds)) == 1 and is_everywhere else None
    if len({base.kind == "S" for base in bases}) > 1:
        return None
    common = np.result_type(*bases) if is_everywhere or bases[0].kind == "S" else np.result_type(*bases, np.float32)
    if common.kind == "f" and any(base.kind in "iu" and base.itemsize == 8 for base in bases):
        return None
    return np.dtype((common, shapes.pop()))


def by_name(
    found: Iterable[tuple[str, Sequence[tuple[RecordTable, npt.NDArray[np.int64]]]]],
) -> dict[str, RecordTable]:
    """Tables by names of their own, in order of name, those of one entry joined; where they cannot be, kept apart."""
    tables: list[tuple[str, RecordTable]] = []
    for name, parts in found:
        one = joined([table for table, _ in parts], [numbers for _, numbers in parts])
        tables += [(name, one)] if one is not None else [(name, table) for table, _ in parts]
    names = distinct(name for name, _ in tables)
    return dict(sorted(zip(names, (table for _, table in tables), strict=True), key=lambda item: item[0]))


def of_values(t_us: Iterable[int], columns: Mapping[str, tuple[str, list[Any]]]) -> RecordTable:
    """A table of values that are there already: kind and values of each column by name. Kind "O" is text of any length."""
    times = np.fromiter(t_us, dtype=np.int64)
    dtype = np.dtype([("t_us", "<i8"), *((name, kind) for name, (kind, _) in columns.items())])
    rows = np.zeros(len(times), dtype=dtype)
    for name, (_, values) in columns.items():
        rows[name] = values
    return RecordTable(times, dtype, lambda numbers: rows[numbers])


@compiled
def copy_records(
    data: npt.NDArray[np.uint8], places: npt.NDArray[np.int64], size: int, rows: npt.NDArray[np.uint8]
) -> None:
    """Copy the `size` bytes at each place into `rows`, one behind the other."""
    for i in range(places.shape[0]):
        at, row = np.uint64(places[i]), np.uint64(i * size)  # unsigned: a signed index is first looked at for its sign
        for k in range(np.uint64(min(size, data.shape[0] - places[i]))):
            rows[row + k] = data[at + k]
