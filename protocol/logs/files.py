"""A log of any kind that is read, told apart by its first bytes.

MAVLink telemetry, ArduPilot's .BIN and .log, PX4's .ulg, logs of a CAN bus.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.errors import LogError
from protocol.logs.dialect import layouts, layouts_by_name, unit
from protocol.logs.record_table import RecordTable, Unit
from protocol.logs.scan import Progress, Scan, scan_tlog
from protocol.logs.tables import HEAD, Tables, row_counts, tables

TELEMETRY, RAW = "MAVLink telemetry log", "raw MAVLink stream (no time stamps)"
ARDUPILOT, ARDUPILOT_TEXT, PX4 = "ArduPilot dataflash log", "ArduPilot dataflash log as text", "PX4 log"
CAN = "CAN log"
_CHUNK = 1 << 15
_FIRST_BYTES = 8192

Sender = tuple[int, int | None]
"""A system and one component of it; None is all of them."""


@dataclass(frozen=True)
class Log:
    """A log.

    scan      the frames, of MAVLink logs only
    counters  what was amiss
    records   the tables of logs that autopilots wrote of themselves
    said      what such a log says of itself (PX4: topics, logged_messages, parameters ... counted, information)
    """

    path: Path
    kind: str
    scan: Scan | None
    counters: Mapping[str, int]
    records: Mapping[str, RecordTable] = field(default_factory=dict)
    said: Mapping[str, Any] = field(default_factory=dict)

    def names(self) -> list[str]:
        """The messages that the log holds, unknown ones apart."""
        if self.scan is None:
            return list(self.records)
        known = self.scan.frames[self.scan.frames["known"] == 1]
        return [layouts()[int(number)].name for number in np.unique(known["message_id"])]

    def span_us(self) -> tuple[int, int]:
        """The first time and the last (us)."""
        if self.scan is not None:
            stamps = [self.scan.frames["stamp_us"]]
        else:
            stamps = [table.t_us for table in self.records.values() if len(table)]
        return int(min(column.min() for column in stamps)), int(max(column.max() for column in stamps))

    def tables(
        self,
        names: Collection[str] | None = None,
        *,
        between_us: tuple[int, int] | None = None,
        senders: Collection[Sender] | None = None,
    ) -> Tables:
        """The tables of those messages, times (both ends included) and senders; None is all.

        Logs that autopilots write of themselves name no systems: there `senders` has no effect.
        """
        if self.scan is not None:
            return tables(self.scan, names, chosen_rows(self.scan, between_us, senders))
        chosen = self._chosen(names, between_us)
        return {name: self.records[name].rows(numbers) for name, numbers in chosen.items()}

    def counts(
        self,
        names: Collection[str] | None = None,
        *,
        between_us: tuple[int, int] | None = None,
        senders: Collection[Sender] | None = None,
    ) -> dict[str, int]:
        """How many rows each of the tables has that `tables` gives, without making them."""
        if self.scan is not None:
            return row_counts(self.scan, names, chosen_rows(self.scan, between_us, senders))
        return {name: len(numbers) for name, numbers in self._chosen(names, between_us).items()}

    def pieces(
        self,
        name: str,
        rows: int,
        *,
        between_us: tuple[int, int] | None = None,
        senders: Collection[Sender] | None = None,
    ) -> Iterator[npt.NDArray[np.void]]:
        """The table of a message piece by piece, `rows` at once: no more of it is in memory."""
        if self.scan is None:
            numbers = self._chosen([name], between_us).get(name, np.zeros(0, dtype=np.int64))
            for start in range(0, len(numbers), rows):
                yield self.records[name].rows(numbers[start : start + rows])
            return
        chosen = self.scan.frames["message_id"] == layouts_by_name()[name].message_id
        if (mask := chosen_rows(self.scan, between_us, senders)) is not None:
            chosen &= mask
        numbers = np.flatnonzero(chosen)
        for start in range(0, len(numbers), rows):
            part = self.scan.part(numbers[start : start + rows])
            yield from tables(part, [name]).values()

    def unit(self, message: str, name: str) -> Unit:
        """The unit of a field, and what its values are to be multiplied by; empty where nothing says it."""
        if self.scan is not None:
            return Unit(unit(message, name))
        table = self.records.get(message)
        return table.units.get(name, Unit("")) if table else Unit("")

    def _chosen(
        self, names: Collection[str] | None, between_us: tuple[int, int] | None
    ) -> dict[str, npt.NDArray[np.int64]]:
        """Of the chosen tables that have rows, the numbers of the chosen ones."""
        found = {}
        for name, table in self.records.items():
            if names is None or name in names:
                numbers = np.arange(len(table)) if between_us is None else table.between(*between_us)
                if len(numbers):
                    found[name] = numbers
        return found


def chosen_rows(
    scan: Scan, between_us: tuple[int, int] | None, senders: Collection[Sender] | None
) -> npt.NDArray[np.bool_] | None:
    """A truth value for each row of a scan; None where all are chosen."""
    if between_us is None and senders is None:
        return None
    chosen = np.ones(len(scan), dtype=np.bool_)
    if between_us is not None:
        chosen &= (scan.frames["stamp_us"] >= between_us[0]) & (scan.frames["stamp_us"] <= between_us[1])
    if senders is not None:
        wanted = np.zeros(len(scan), dtype=np.bool_)
        for system, component in senders:
            wanted |= (scan.frames["system"] == system) & (
                (component is None) | (scan.frames["component"] == component)
            )
        chosen &= wanted
    return chosen


def open_log(path: Path, *, progress: Progress | None = None) -> Log:
    """Read a log of any of the kinds above. Raises LogError where it cannot be read, or is none."""
    try:
        with path.open("rb") as file:
            first = file.read(_FIRST_BYTES)
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from None
    from protocol.logs import ardupilot, ardupilot_text, can_log, px4  # they load what only such logs need

    try:
        if first.startswith(px4.MAGIC) or first.startswith(px4.ENCRYPTED):
            read = px4.read_px4(path, progress)
            return _not_empty(Log(path, PX4, None, read.counters, read.tables, read.said))
        if first.startswith(ardupilot.MAGIC):
            made, counters = ardupilot.read_ardupilot(path, progress)
            return _not_empty(Log(path, ARDUPILOT, None, counters, made))
        if ardupilot_text.is_ardupilot_text(first):
            made, counters = ardupilot_text.read_ardupilot_text(path, progress)
            return _not_empty(Log(path, ARDUPILOT_TEXT, None, counters, made))
        if suffix := can_log.format_of(first):
            read_can = can_log.read_can_log(path, suffix)
            return _not_empty(Log(path, CAN, None, read_can.counters, can_log.can_tables(read_can)))
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from None
    scan = scan_tlog(path, progress=progress)
    return _not_empty(Log(path, TELEMETRY if scan.stamp_size else RAW, scan, scan.counters))


def _not_empty(log: Log) -> Log:
    if (len(log.scan) if log.scan is not None else sum(map(len, log.records.values()))) == 0:
        raise LogError(
            f"{log.path} holds no message: it is neither MAVLink telemetry (.tlog, raw) nor a log of ArduPilot (.BIN, "
            ".log) or PX4 (.ulg), nor of a CAN bus (.log, .asc, .blf, .trc)"
        )
    return log


@dataclass(frozen=True)
class Message:
    """One message of a log: `fields` by name, arrays as lists, strings as text."""

    t_us: int
    name: str
    system: int | None
    component: int | None
    sequence: int | None
    fields: dict[str, Any]


class Part(NamedTuple):
    """Some messages of a log, as tables and in their order.

    order    of each message, which of the tables (by its place among them) holds it, as its next row; -1: `unknown` does
    unknown  messages that the dialect lacks
    """

    tables: Tables
    order: npt.NDArray[np.int64]
    unknown: list[Message]


def messages(
    log: Log,
    names: Collection[str] | None = None,
    *,
    between_us: tuple[int, int] | None = None,
    senders: Collection[Sender] | None = None,
    unknown: bool = True,
    for_json: bool = False,
) -> Iterator[Message]:
    """Message by message: in the order of the file, or of time where the log is one that an autopilot wrote itself.

    A message the dialect lacks is called UNKNOWN_ and its number, and has its payload in hexadecimal; `unknown` False
    leaves it out. `for_json`: see `plain`.
    """
    for part in parts(log, names, between_us=between_us, senders=senders, unknown=unknown):
        queues = [_rows(name, table, for_json=for_json) for name, table in part.tables.items()]
        queues.append(iter(part.unknown))
        for at in part.order.tolist():
            yield next(queues[at])


def parts(
    log: Log,
    names: Collection[str] | None = None,
    *,
    between_us: tuple[int, int] | None = None,
    senders: Collection[Sender] | None = None,
    unknown: bool = True,
) -> Iterator[Part]:
    """The messages that `messages` gives, some thousand at once, as tables."""
    if log.scan is None:
        yield from _parts_by_time(log, names, between_us)
        return
    scan = log.scan
    chosen = chosen_rows(scan, between_us, senders)
    for start in range(0, len(scan), _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, len(scan)))
        yield _part_of_scan(scan.part(rows if chosen is None else rows[chosen[rows]]), names, unknown=unknown)


def _part_of_scan(part: Scan, names: Collection[str] | None, *, unknown: bool) -> Part:
    made = tables(part, names)
    frames = part.frames
    order = np.full(len(part), -2, dtype=np.int64)
    readable = (frames["known"] == 1) & (frames["flags"] & 0xFE == 0)
    for at, name in enumerate(made):
        order[readable & (frames["message_id"] == layouts_by_name()[name].message_id)] = at
    others = []
    for row in np.flatnonzero(frames["known"] == 0).tolist() if unknown else ():
        frame = frames[row]
        name = f"UNKNOWN_{frame['message_id']}"
        if names is None or name in names:
            sender = int(frame["system"]), int(frame["component"]), int(frame["sequence"])
            others.append(Message(int(frame["stamp_us"]), name, *sender, {"payload": part.payload(row).hex()}))
            order[row] = -1
    return Part(made, order[order > -2], others)


def _parts_by_time(log: Log, names: Collection[str] | None, between_us: tuple[int, int] | None) -> Iterator[Part]:
    chosen = log._chosen(names, between_us)
    if not chosen:
        return
    sources = np.concatenate([np.full(len(numbers), at) for at, numbers in enumerate(chosen.values())])
    every = np.concatenate(list(chosen.values()))
    times = np.concatenate([log.records[name].t_us[numbers] for name, numbers in chosen.items()])
    by_time = np.argsort(times, kind="stable")
    del times
    for start in range(0, len(by_time), _CHUNK):
        some = by_time[start : start + _CHUNK]
        order = sources[some]
        made = {name: log.records[name].rows(every[some[order == at]]) for at, name in enumerate(chosen)}
        yield Part(made, order, [])


def _rows(name: str, table: npt.NDArray[np.void], *, for_json: bool) -> Iterator[Message]:
    """The rows of a table as messages."""
    has_head = "frame_sequence" in (table.dtype.names or ())
    fields = fields_of(table)
    columns = [plain(table[field], for_json=for_json) for field in fields]
    times = table["t_us"].tolist()
    none = [None] * len(table)
    senders = [table[head].tolist() if has_head else none for head in ("system", "component", "frame_sequence")]
    for t_us, system, component, sequence, *values in zip(times, *senders, *columns, strict=True):
        yield Message(t_us, name, system, component, sequence, dict(zip(fields, values, strict=True)))


def fields_of(table: npt.NDArray[np.void]) -> list[str]:
    """The columns of a table that are the message's own."""
    names = list(table.dtype.names or ())
    return names[len(HEAD) :] if "frame_sequence" in names else names[1:]


def plain(column: npt.NDArray[Any], *, for_json: bool = False) -> list[Any]:
    """A column as Python's own values: text up to its first zero byte, other bytes in hexadecimal, arrays as lists.

    for_json: infinities as the texts "Infinity" and "-Infinity"; what JSON is made with then writes NaN as null.
    """
    if column.dtype.kind == "S":
        return [value.split(b"\0")[0].decode("utf-8", "replace") for value in column.tolist()]
    if column.dtype.kind == "V":
        return [value.hex() for value in column.tolist()]
    values: list[Any] = column.tolist()
    if for_json and column.dtype.kind == "f" and np.isinf(column).any():
        return [_spelled(value) for value in values]
    return values


def _spelled(value: Any) -> Any:
    if isinstance(value, list):
        return [_spelled(element) for element in value]
    return ("Infinity" if value > 0 else "-Infinity") if math.isinf(value) else value
