"""A log as MCAP: JSON messages with a JSON Schema, a topic for each message of each sender.

Foxglove and PlotJuggler read the message encoding `json`; both want a schema (Foxglove one of type object), and JSON has no
NaN, so what is no finite number is null there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from mcap.writer import Writer

from fwav_hil.logs.choice import Choice
from fwav_hil.logs.working import Working
from protocol.logs.dialect import unit
from protocol.logs.files import Log, Message, fields_of, messages

_TELL_EVERY = 4096


def write_mcap(log: Log, path: Path, choice: Choice, working: Working) -> dict[str, int]:
    """Write the chosen messages; returns how many of each. Unknown ones are left out: nothing says what is in them."""
    made = log.tables(choice.names, between_us=choice.between_us, senders=choice.senders)
    total = sum(map(len, made.values()))
    counts = dict.fromkeys(made, 0)
    encode = msgspec.json.Encoder().encode
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="fwav-hil")
        schemas = {
            name: writer.register_schema(name=name, encoding="jsonschema", data=encode(schema(name, table)))
            for name, table in made.items()
        }
        del made
        channels: dict[str, int] = {}
        chosen = messages(log, choice.names, between_us=choice.between_us, senders=choice.senders, unknown=False)
        for number, message in enumerate(chosen):
            topic = topic_of(message)
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic=topic, message_encoding="json", schema_id=schemas[message.name]
                )
            counts[message.name] += 1
            writer.add_message(
                channel_id=channels[topic],
                log_time=1000 * message.t_us,
                publish_time=1000 * message.t_us,
                sequence=message.sequence or 0,
                data=encode(message.fields),
            )
            if number % _TELL_EVERY == 0:
                working(number, total)
        writer.finish()  # type: ignore[no-untyped-call]
    return counts


def topic_of(message: Message) -> str:
    """`/system1/component191/HIL_SENSOR`; `/IMU` for a log without systems."""
    if message.system is None:
        return f"/{message.name}"
    return f"/system{message.system}/component{message.component}/{message.name}"


def schema(name: str, table: npt.NDArray[np.void]) -> dict[str, Any]:
    """The JSON Schema of a message, units as descriptions."""
    return {
        "title": name,
        "type": "object",
        "properties": {field: _property(name, field, table.dtype[field]) for field in fields_of(table)},
    }


def _property(name: str, field: str, kind: np.dtype[Any]) -> dict[str, Any]:
    base, shape = kind.subdtype or (kind, ())
    of = {"type": {"S": "string", "f": "number"}.get(base.kind, "integer")}
    described = {"description": unit(name, field)} if unit(name, field) else {}
    return ({"type": "array", "items": of} if shape else of) | described
