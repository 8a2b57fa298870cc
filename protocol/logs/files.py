"""A log of any kind that is read: MAVLink telemetry, ArduPilot's .BIN, PX4's .ulg; told apart by their first bytes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.errors import LogError
from protocol.logs.dialect import layouts
from protocol.logs.scan import Progress, Scan, scan_tlog
from protocol.logs.tables import HEAD, Tables, tables

TELEMETRY, RAW = "MAVLink telemetry log", "raw MAVLink stream (no time stamps)"
ARDUPILOT, PX4 = "ArduPilot dataflash log", "PX4 log"
_CHUNK = 1 << 15

Sender = tuple[int, int | None]
"""A system and one component of it; None is all of them."""


@dataclass(frozen=True)
class Log:
    """A log. `scan` is there for MAVLink logs only, `counters` say what was amiss."""

    path: Path
    kind: str
    scan: Scan | None
    counters: Mapping[str, int]
    _tables: Tables

    def names(self) -> list[str]:
        """The messages that the log holds, unknown ones apart."""
        if self.scan is None:
            return list(self._tables)
        known = self.scan.frames[self.scan.frames["known"] == 1]
        return [layouts()[int(number)].name for number in np.unique(known["message_id"])]

    def span_us(self) -> tuple[int, int]:
        """The first time and the last (us)."""
        if self.scan is not None:
            stamps = [self.scan.frames["stamp_us"]]
        else:
            stamps = [table["t_us"] for table in self._tables.values() if len(table)]
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
        made = {name: table for name, table in self._tables.items() if names is None or name in names}
        if between_us is None:
            return made
        cut = {n: t[(t["t_us"] >= between_us[0]) & (t["t_us"] <= between_us[1])] for n, t in made.items()}
        return {name: table for name, table in cut.items() if len(table)}


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
            first = file.read(8)
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from None
    from protocol.logs import (
        ardupilot,
        px4,  # they load what only such logs need
    )

    try:
        if first.startswith(px4.MAGIC):
            made, counters = px4.read_px4(path)
            return _not_empty(Log(path, PX4, None, counters, made))
        if first.startswith(ardupilot.MAGIC):
            made, counters = ardupilot.read_ardupilot(path)
            return _not_empty(Log(path, ARDUPILOT, None, counters, made))
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from None
    scan = scan_tlog(path, progress=progress)
    return _not_empty(Log(path, TELEMETRY if scan.stamp_size else RAW, scan, scan.counters, {}))


def _not_empty(log: Log) -> Log:
    if (len(log.scan) if log.scan is not None else sum(map(len, log._tables.values()))) == 0:
        raise LogError(
            f"{log.path} holds no message: it is neither MAVLink telemetry (.tlog, raw) nor a log of ArduPilot (.BIN) "
            "or PX4 (.ulg)"
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


def messages(
    log: Log,
    names: Collection[str] | None = None,
    *,
    between_us: tuple[int, int] | None = None,
    senders: Collection[Sender] | None = None,
    unknown: bool = True,
) -> Iterator[Message]:
    """Message by message: in the order of the file, or of time where the log is one that an autopilot wrote itself.

    A message the dialect lacks is called UNKNOWN_ and its number, and has its payload in hexadecimal; `unknown` False
    leaves it out.
    """
    if log.scan is None:
        yield from _by_time(log.tables(names, between_us=between_us, senders=senders))
        return
    scan = log.scan
    chosen = chosen_rows(scan, between_us, senders)
    for start in range(0, len(scan), _CHUNK):
        part = Scan(scan.path, scan.data, scan.frames[start : start + _CHUNK], scan.stamp_size, scan.counters)
        mask = None if chosen is None else chosen[start : start + _CHUNK]
        yield from _in_order(part, names, mask, unknown=unknown)


def _in_order(
    part: Scan, names: Collection[str] | None, mask: npt.NDArray[np.bool_] | None, *, unknown: bool
) -> Iterator[Message]:
    queues = {name: _rows(name, table) for name, table in tables(part, names, mask).items()}
    by_number = {number: queues.get(message.name) for number, message in layouts().items()}
    numbers, flags = part.frames["message_id"].tolist(), part.frames["flags"].tolist()
    for row, (number, known) in enumerate(zip(numbers, part.frames["known"].tolist(), strict=True)):
        if mask is not None and not mask[row]:
            continue
        if known:
            queue = by_number[number]
            if queue is not None and not flags[row] & 0xFE:
                yield next(queue)
        elif unknown and (names is None or f"UNKNOWN_{number}" in names):
            frame = part.frames[row]
            sender = int(frame["system"]), int(frame["component"]), int(frame["sequence"])
            fields = {"payload": part.payload(row).hex()}
            yield Message(int(frame["stamp_us"]), f"UNKNOWN_{number}", *sender, fields)


def _by_time(made: Tables) -> Iterator[Message]:
    queues = [_rows(name, table) for name, table in made.items()]
    if not queues:
        return
    source = np.concatenate([np.full(len(table), at) for at, table in enumerate(made.values())])
    times = np.concatenate([table["t_us"] for table in made.values()])
    for at in source[np.argsort(times, kind="stable")].tolist():
        yield next(queues[at])


def _rows(name: str, table: npt.NDArray[np.void]) -> Iterator[Message]:
    """The rows of a table as messages."""
    has_head = "frame_sequence" in (table.dtype.names or ())
    fields = fields_of(table)
    columns = [plain(table[field]) for field in fields]
    times = table["t_us"].tolist()
    none = [None] * len(table)
    senders = [table[head].tolist() if has_head else none for head in ("system", "component", "frame_sequence")]
    for t_us, system, component, sequence, *values in zip(times, *senders, *columns, strict=True):
        yield Message(t_us, name, system, component, sequence, dict(zip(fields, values, strict=True)))


def fields_of(table: npt.NDArray[np.void]) -> list[str]:
    """The columns of a table that are the message's own."""
    names = list(table.dtype.names or ())
    return names[len(HEAD) :] if "frame_sequence" in names else names[1:]


def plain(column: npt.NDArray[Any]) -> list[Any]:
    """A column as Python's own values: text up to its first zero byte, arrays as lists."""
    if column.dtype.kind == "S":
        return [value.split(b"\0")[0].decode("utf-8", "replace") for value in column.tolist()]
    values: list[Any] = column.tolist()
    return values
