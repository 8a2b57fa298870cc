"""PX4's log (.ulg, ULog) as tables: a reader of its own, since damage must cost no more than what it hits.

A table for each topic. Of several instances of a topic the first has the topic's name, the others `name_1` and so on; nested
fields are `esc[0].rpm`, `char[]` is text. What the log says besides has tables too: `logged_messages`, `parameters` (with
each change), `parameter_defaults`, `information`, `dropouts`.

Each table begins with t_us: microseconds since the autopilot's start, the record's own `timestamp` unless that cannot be
(see `clock.steady_times`; a topic that was published before the log began has stamps of long ago, or 0): then the time at
which it was logged.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.errors import LogError
from protocol.logs.clock import steady_times
from protocol.logs.names import distinct, readable
from protocol.logs.px4_formats import KINDS, Formats, Topic
from protocol.logs.px4_kernels import (
    DAMAGED,
    DEFINITION,
    DONE,
    OTHERS,
    POSITION,
    RESYNCHRONISATIONS,
    ROWS,
    STATE_SIZE,
    TAIL,
    read_stamps,
    walk,
)
from protocol.logs.record_table import RecordTable, by_name, of_records, of_values

MAGIC = b"ULog\x01\x12\x35"
ENCRYPTED = b"ULogEnc"
_HEADER = 16
_SLICE_ROWS = 1 << 16


class _Subscription(NamedTuple):
    name: str
    instance: int
    topic: Topic


class Px4Log(NamedTuple):
    """What `read_px4` gives: tables by name; what was amiss, counted; what the log says of itself."""

    tables: dict[str, RecordTable]
    counters: dict[str, int]
    said: dict[str, Any]


def read_px4(path: Path, progress: Callable[[int, int], None] | None = None) -> Px4Log:
    """Read such a log. Raises LogError where the file is not one, OSError where it cannot be read.

    Counted are damaged_bytes, resynchronisations and truncated_tail, as in `scan`, and dropouts of the logger.
    """
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    if data[: len(ENCRYPTED)].tobytes() == ENCRYPTED:
        raise LogError(
            f"{path} is an encrypted PX4 log: decrypt it first, with the private key, as PX4's documents say"
        )
    if len(data) < _HEADER:
        raise LogError(f"{path} is no PX4 log that can be read: it ends within its header")
    return _Reader(data, progress).read()


class _Reader:
    def __init__(self, data: npt.NDArray[np.uint8], progress: Callable[[int, int], None] | None) -> None:
        self._data = data
        self._progress = progress
        self._formats = Formats()
        self._subscriptions: list[_Subscription] = []
        self._least, self._most, self._current = (np.full(1 << 16, -1, dtype=np.int32) for _ in range(3))
        self._state = np.zeros(STATE_SIZE, dtype=np.int64)
        self._places = np.empty(_SLICE_ROWS, dtype=np.int64)
        self._of = np.empty(_SLICE_ROWS, dtype=np.int32)
        self._others = np.empty(_SLICE_ROWS, dtype=np.int64)

    def read(self) -> Px4Log:
        self._walk()
        rows, others = int(self._state[ROWS]), self._others[: self._state[OTHERS]]
        places, of = self._places[:rows], self._of[:rows]
        kinds = self._data[others + 2]
        spoken = others[(kinds == ord("L")) | (kinds == ord("C"))]
        times = self._times(places, of, spoken)
        tables = self._topics(places, of, times[:rows])
        order = np.append(self._header_us(), times[:rows])  # what stands before all data is of the log's beginning
        other_times = order[np.searchsorted(places, others)]
        other_times[np.isin(others, spoken)] = times[rows:]
        said = _Said(self._data)
        for at, t_us in zip(others.tolist(), other_times.tolist(), strict=True):
            said.take(at, t_us)
        more = said.tables()
        names = distinct([*tables, *more])
        counters = {
            "damaged_bytes": int(self._state[DAMAGED]),
            "resynchronisations": int(self._state[RESYNCHRONISATIONS]),
            "truncated_tail": int(self._state[TAIL]),
            "dropouts": len(more.get("dropouts", ())),
        }
        of_itself = {"topics": len(tables), **{name: len(table) for name, table in more.items()}}
        every = dict(zip(names, [*tables.values(), *more.values()], strict=True))
        return Px4Log(every, counters, of_itself | {"information": said.information()})

    def _header_us(self) -> int:
        stamp = int.from_bytes(self._data[8:_HEADER].tobytes(), "little")
        return stamp if stamp < 1 << 52 else 0

    def _walk(self) -> None:
        """Find all messages, of the parts one after the other where a crash has appended some."""
        self._state[POSITION] = _HEADER
        for end in self._parts():
            self._state[DAMAGED] += self._state[TAIL]  # what an appended part cuts short is no tail of the file
            self._state[TAIL] = 0
            part, ended = self._data[:end], DEFINITION
            while ended != DONE:
                ended = walk(
                    part, self._least, self._most, self._current, self._state, self._places, self._of, self._others
                )
                if ended == DEFINITION:
                    self._define(int(self._state[POSITION]))
                elif ended != DONE:
                    self._places.resize(len(self._places) * 3 // 2, refcheck=False)
                    self._of.resize(len(self._of) * 3 // 2, refcheck=False)
                    self._others.resize(len(self._others) * 3 // 2, refcheck=False)
                    if self._progress:
                        self._progress(int(self._state[POSITION]), len(self._data))

    def _parts(self) -> list[int]:
        """Where the data and each appended part ends."""
        ends = []
        if self._data[_HEADER + 2 : _HEADER + 3].tobytes() == b"B" and len(self._data) >= _HEADER + 3 + 40:
            flags = struct.unpack("<8x8B3Q", self._data[_HEADER + 3 : _HEADER + 43].tobytes())
            if flags[0] & 1:
                ends = [offset for offset in flags[8:] if _HEADER < offset < len(self._data)]
        return [*sorted(ends), len(self._data)]

    def _define(self, at: int) -> None:
        """Take the format, the subscription or its end at this place, and go on behind it."""
        kind, body = _message(self._data, at)
        self._state[POSITION] = at + 3 + len(body)
        if kind == ord("F"):
            self._formats.define(body.decode("ascii", "replace"))
        elif kind == ord("A"):
            instance, number = struct.unpack_from("<BH", body)
            name = body[3:].decode("ascii", "replace")
            topic = self._formats.topic(name)
            if topic is None:
                self._least[number] = -1
                return
            self._current[number] = len(self._subscriptions)
            self._least[number], self._most[number] = topic.least, topic.most
            self._subscriptions.append(_Subscription(name, instance, topic))

    def _times(
        self, places: npt.NDArray[np.int64], of: npt.NDArray[np.int32], spoken: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.int64]:
        """The time of each row, then of each logged message."""
        offsets = np.full(len(self._subscriptions) + 1, -1, dtype=np.int64)
        for number, (_, _, topic) in enumerate(self._subscriptions):
            for column in topic.columns:
                if column.name == "timestamp" and column[1:3] == ("<u8", ()):
                    offsets[number] = column.offset
        every = np.concatenate([places, spoken])
        spoken_offsets = np.where(self._data[spoken + 2] == ord("L"), 4, 6)
        stamps = read_stamps(self._data, every, np.concatenate([offsets[of], spoken_offsets]))
        order = np.argsort(every, kind="stable")
        header_us = self._header_us()
        if np.count_nonzero(stamps >= header_us) * 2 < np.count_nonzero(stamps >= 0):
            header_us = 0  # it is damaged
        times = np.empty(len(every), dtype=np.int64)
        times[order] = steady_times(stamps[order], header_us)
        return times

    def _topics(
        self, places: npt.NDArray[np.int64], of: npt.NDArray[np.int32], times: npt.NDArray[np.int64]
    ) -> dict[str, RecordTable]:
        """The table of each topic and instance."""
        groups: dict[tuple[int, str, str], list[int]] = {}
        for number, (name, instance, topic) in enumerate(self._subscriptions):
            groups.setdefault((instance, name, repr(topic)), []).append(number)
        order = np.argsort(of, kind="stable")
        starts = np.searchsorted(of[order], np.arange(len(self._subscriptions) + 1))
        found: dict[tuple[int, str, str], list[tuple[RecordTable, npt.NDArray[np.int64]]]] = {}
        for (instance, name, _), numbers in groups.items():
            rows = np.sort(np.concatenate([order[starts[n] : starts[n + 1]] for n in numbers]))
            if len(rows):
                topic = self._subscriptions[numbers[0]].topic
                table = of_records(self._data, places[rows], times[rows], topic.columns, topic.most)
                shown = readable(name) if not instance else f"{readable(name)}_{instance}"
                found.setdefault((min(instance, 1), shown, name), []).append((table, rows))
        return by_name([(shown, parts) for (_, shown, _), parts in sorted(found.items(), key=lambda item: item[0])])


class _Said:
    """What a log says besides its topics: texts, parameters, information, dropouts."""

    def __init__(self, data: npt.NDArray[np.uint8]) -> None:
        self._data = data
        self._rows: dict[str, list[tuple[Any, ...]]] = {}
        self._whole: dict[str, str] = {}

    def take(self, at: int, t_us: int) -> None:
        """Take the message at this place."""
        kind, body = _message(self._data, at)
        if kind == ord("L"):
            self._add("logged_messages", t_us, body[0] - ord("0"), 0, _text(body[9:]))
        elif kind == ord("C"):
            self._add("logged_messages", t_us, body[0] - ord("0"), body[1] | body[2] << 8, _text(body[11:]))
        elif kind == ord("O"):
            self._add("dropouts", t_us, body[0] | body[1] << 8)
        elif kind == ord("P"):
            self._parameter("parameters", t_us, body)
        elif kind == ord("Q"):
            self._parameter("parameter_defaults", t_us, body[1:], body[0])
        elif kind in b"IM":
            continued, body = (body[0] == 1, body[1:]) if kind == ord("M") else (False, body)
            name, value = _keyed(body)
            shown = value if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)
            self._add("information", t_us, name, shown)
            self._whole[name] = self._whole.get(name, "") + shown if continued else shown

    def _add(self, table: str, *row: Any) -> None:
        self._rows.setdefault(table, []).append(row)

    def _parameter(self, table: str, t_us: int, body: bytes, *more: int) -> None:
        name, value = _keyed(body)
        if isinstance(value, int | float):
            self._add(table, t_us, name, float(value), isinstance(value, int), *more)

    def information(self) -> dict[str, str]:
        """The log's own information by key; of several with one key the last, those in parts put together."""
        return self._whole

    def tables(self) -> dict[str, RecordTable]:
        """The tables by name, those that have rows."""
        number = {"name": "O", "value": "<f8", "is_integer": "?"}
        kinds = {
            "logged_messages": {"level": "u1", "tag": "<u2", "message": "O"},
            "parameters": number,
            "parameter_defaults": number | {"default_types": "u1"},
            "information": {"name": "O", "value": "O"},
            "dropouts": {"duration_ms": "<u2"},
        }
        made = {}
        for name, columns in kinds.items():
            if rows := self._rows.get(name):
                t_us, *values = zip(*rows, strict=True)
                pairs = zip(columns.items(), values, strict=True)
                made[name] = of_values(t_us, {column: (kind, list(given)) for (column, kind), given in pairs})
        return made


def _message(data: npt.NDArray[np.uint8], at: int) -> tuple[int, bytes]:
    """Type and body of the message at `at`."""
    size = int(data[at]) | int(data[at + 1]) << 8
    return int(data[at + 2]), data[at + 3 : at + 3 + size].tobytes()


def _keyed(body: bytes) -> tuple[str, str | int | float]:
    """The name of an information or parameter, and its value: text where it is of no plain kind."""
    length = body[0]
    kind, _, name = body[1 : 1 + length].decode("ascii", "replace").partition(" ")
    value, base = body[1 + length :], kind.partition("[")[0]
    if base == "char":
        return readable(name or kind), _text(value)
    if kind in KINDS and len(value) == int(KINDS[kind][-1]):
        return readable(name or kind), np.frombuffer(value, dtype=KINDS[kind])[0].item()
    return readable(name or kind), value.hex()


def _text(value: bytes) -> str:
    return value.rstrip(b"\0").decode("utf-8", "replace")
