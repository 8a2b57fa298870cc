"""A log as MCAP: JSON messages with a JSON Schema, a topic for each message of each sender.

Foxglove and PlotJuggler read the message encoding `json`; both want a schema (Foxglove one of type object). JSON has no NaN and
no infinity: NaN is null, infinity the text "Infinity" or "-Infinity".
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from fwav_hil.logs.choice import Choice
from fwav_hil.logs.mcap_writer import McapWriter
from fwav_hil.logs.working import Working
from protocol.logs.files import Log, Part, fields_of, parts, plain
from protocol.logs.record_table import Unit


def write_mcap(log: Log, path: Path, choice: Choice, working: Working) -> dict[str, int]:
    """Write the chosen messages; returns how many of each. Unknown ones are left out: nothing says what is in them."""
    counts = log.counts(choice.names, between_us=choice.between_us, senders=choice.senders)
    total, done = sum(counts.values()), 0
    with path.open("wb") as file, McapWriter(file, "fwav-hil") as writer:
        topics = _Topics(log, writer)
        for part in parts(log, choice.names, between_us=choice.between_us, senders=choice.senders, unknown=False):
            topics.write(part)
            done += len(part.order)
            working(done, total)
        writer.finish()
    return counts


class _Topics:
    """The topics written so far, and the way to write messages to them."""

    def __init__(self, log: Log, writer: McapWriter) -> None:
        self._log = log
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, int], int] = {}
        self._encode = msgspec.json.Encoder().encode

    def write(self, part: Part) -> None:
        """Write the messages of a part of the log, in its order."""
        count = len(part.order)
        channels, times, sequences = (np.zeros(count, dtype=np.int64) for _ in range(3))
        bodies = np.empty(count, dtype=object)
        for at, (name, table) in enumerate(part.tables.items()):
            rows = np.flatnonzero(part.order == at)
            if not len(rows):
                continue
            channels[rows] = self._channels_of(name, table)
            times[rows] = table["t_us"]
            if "frame_sequence" in (table.dtype.names or ()):
                sequences[rows] = table["frame_sequence"]
            bodies[rows] = self._bodies(table)
        if count:
            self._writer.add_messages(channels, 1000 * times, sequences, bodies.tolist())

    def _bodies(self, table: npt.NDArray[np.void]) -> list[bytes]:
        """Each row as a JSON object."""
        fields = fields_of(table)
        columns = [plain(table[field], for_json=True) for field in fields]
        if not columns:
            return [b"{}"] * len(table)
        names = {
            f"field_{at}": field for at, field in enumerate(fields)
        }  # a structure is written far sooner than a dict
        row = msgspec.defstruct("Row", list(names), rename=names, gc=False)
        return list(map(self._encode, itertools.starmap(row, zip(*columns, strict=True))))

    def _channels_of(self, name: str, table: npt.NDArray[np.void]) -> npt.NDArray[np.int64]:
        """The channel of each row, registered where it is met for the first time."""
        if "frame_sequence" not in (table.dtype.names or ()):
            return np.full(len(table), self._channel(name, table, -1, f"/{name}"))
        senders = table["system"].astype(np.int64) << 8 | table["component"]
        found, which = np.unique(senders, return_inverse=True)
        numbers = [
            self._channel(name, table, sender, f"/system{sender >> 8}/component{sender & 0xFF}/{name}")
            for sender in found.tolist()
        ]
        return np.array(numbers)[which]

    def _channel(self, name: str, table: npt.NDArray[np.void], sender: int, topic: str) -> int:
        if (name, sender) not in self._channels:
            if name not in self._schemas:
                self._schemas[name] = self._writer.add_schema(name, self._encode(schema(self._log, name, table)))
            self._channels[name, sender] = self._writer.add_channel(topic, self._schemas[name])
        return self._channels[name, sender]


def schema(log: Log, name: str, table: npt.NDArray[np.void]) -> dict[str, Any]:
    """The JSON Schema of a message, units as descriptions."""
    return {
        "title": name,
        "type": "object",
        "properties": {field: _property(log.unit(name, field), table.dtype[field]) for field in fields_of(table)},
    }


def _property(unit: Unit, kind: np.dtype[Any]) -> dict[str, Any]:
    base, shape = kind.subdtype or (kind, ())
    of = {
        "type": {"S": "string", "O": "string", "V": "string", "f": "number", "b": "boolean"}.get(base.kind, "integer")
    }
    if base.kind == "V":
        of["contentEncoding"] = "base16"
    described = {"description": str(unit)} if unit.name else {}
    return ({"type": "array", "items": of} if shape else of) | described
