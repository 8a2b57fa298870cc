"""Status reports of a process: one event at a time, to the user or to the parent process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TextIO

import msgspec

Report = Callable[[dict[str, Any]], None]
"""Takes one event of a process: a dictionary with the key "event"."""


def report_json(stream: TextIO) -> Report:
    """A report that writes one JSON object a line, for a parent process to read."""

    def report(event: dict[str, Any]) -> None:
        stream.write(msgspec.json.encode(event).decode() + "\n")
        stream.flush()

    return report
