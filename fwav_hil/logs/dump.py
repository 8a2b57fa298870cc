"""A log message by message, as text or as one JSON object a line: `fwav-hil log dump`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import msgspec

from protocol.logs.files import Message

_DIGITS = 7  # of a float32


def text_lines(messages: Iterable[Message], start_us: int) -> Iterator[str]:
    """Seconds from the log's beginning, sender, message, fields."""
    for message in messages:
        sender = f" {message.system}.{message.component}" if message.system is not None else ""
        fields = ", ".join(f"{name}={_shown(value)}" for name, value in message.fields.items())
        yield f"{(message.t_us - start_us) / 1e6:.6f}{sender} {message.name} {fields}\n"


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.{_DIGITS}g}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_shown, value)) + "]"
    if isinstance(value, str):
        return msgspec.json.encode(value).decode()  # whatever is in it, it stays one line
    return str(value)


def json_lines(messages: Iterable[Message]) -> Iterator[str]:
    """`{"t_us", "type", "system", "component", "sequence", "fields"}`; NaN is null, infinities are text."""
    encode = msgspec.json.Encoder().encode
    for message in messages:
        record = {
            "t_us": message.t_us,
            "type": message.name,
            "system": message.system,
            "component": message.component,
            "sequence": message.sequence,
            "fields": message.fields,
        }
        yield encode(record).decode() + "\n"
