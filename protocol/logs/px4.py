"""PX4's log (.ulg) as tables, read by pyulog.

Each table begins with t_us, the field `timestamp`: microseconds since the autopilot's start. Of several instances of a
topic the first has the topic's name, the others `name_1` and so on. Arrays are arrays again: `q[0]`, `q[1]` become `q`.
"""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.errors import LogError
from protocol.logs.tables import Tables

MAGIC = b"ULog\x01\x12\x35"
_ELEMENT = re.compile(r"(.+)\[(\d+)\]$")


def read_px4(path: Path) -> tuple[Tables, dict[str, int]]:
    """The table of each topic, by name, and what was counted: `dropouts` of the logger, `damaged` (0 or 1).

    Raises LogError where the file is not such a log.
    """
    from pyulog import ULog

    content = path.read_bytes()
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints what it thinks of damage
            log = ULog(io.BytesIO(content))  # not the path: it leaves files open
    except Exception as error:  # noqa: BLE001  (it raises whatever damaged definitions lead to)
        raise LogError(f"{path} is no PX4 log that can be read: {error}") from None
    made = {
        topic.name if not topic.multi_id else f"{topic.name}_{topic.multi_id}": _table(topic.data)
        for topic in sorted(log.data_list, key=lambda topic: (topic.name, topic.multi_id))
    }
    return made, {"dropouts": len(log.dropouts), "damaged": int(log.file_corruption)}


def _table(columns: dict[str, npt.NDArray[Any]]) -> npt.NDArray[np.void]:
    """Columns by name, `x[0]`, `x[1]` ... gathered into one."""
    gathered: dict[str, list[npt.NDArray[Any]]] = {}
    for name, column in columns.items():
        element = _ELEMENT.match(name)
        gathered.setdefault(element[1] if element else name, []).append(column)
    values = {name: parts[0] if f"{name}[0]" not in columns else np.stack(parts, 1) for name, parts in gathered.items()}
    times = values.get("timestamp", np.zeros(len(next(iter(values.values()))), dtype=np.int64))
    kinds: list[Any] = [("t_us", "<i8"), *((name, value.dtype, value.shape[1:]) for name, value in values.items())]
    table = np.zeros(len(times), dtype=kinds)
    table["t_us"] = times
    for name, value in values.items():
        table[name] = value
    return table
