"""ArduPilot's dataflash log (.BIN) as tables: pymavlink's DFReader finds formats, places and the clock, NumPy the values.

Fields have the names and the scale that DFReader gives them (a latitude in degrees, say). Each table begins with t_us:
microseconds of Unix time where the log holds a GPS time, else since the autopilot's start. A message without a time of
its own has that of the message before it in the file.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.errors import LogError
from protocol.logs.tables import Tables

MAGIC = b"\xa3\x95"
_HEADER = 3
_TIMES_US = {"TimeUS": 1, "TimeMS": 1000}
_KINDS = {"b": "i1", "B": "u1", "M": "u1", "g": "<f2", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "f": "<f4"}
_KINDS |= {"d": "<f8", "q": "<i8", "Q": "<u8", "n": "S4", "N": "S16", "Z": "S64"}
_KINDS |= {"c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4"}


def read_ardupilot(path: Path) -> tuple[Tables, dict[str, int]]:
    """The table of each message, by name, and what was counted: `damaged_bytes`, which belong to no message.

    Raises LogError where the file is not such a log.
    """
    from pymavlink.DFReader import DFReader_binary

    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    try:
        # It prints what it thinks of damage; here that is counted.
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            reader = DFReader_binary(str(path))
    except Exception as error:  # noqa: BLE001  (it raises plain Exception, and whatever damaged formats lead to)
        raise LogError(f"{path} is no ArduPilot log that can be read: {error}") from None
    try:
        return _tables(reader, data)
    finally:
        reader.close()


def _tables(reader: Any, data: npt.NDArray[np.uint8]) -> tuple[Tables, dict[str, int]]:
    raw: dict[str, tuple[npt.NDArray[np.int64], npt.NDArray[np.void], Any]] = {}
    taken = 0
    for number, layout in sorted(reader.formats.items()):
        places = np.asarray(reader.offsets[number], dtype=np.int64)
        places = places[places + layout.len <= len(data)]
        kind = _dtype(layout)
        if not len(places) or kind.itemsize + _HEADER != layout.len:
            continue
        taken += len(places) * layout.len
        body = data[places[:, None] + np.arange(_HEADER, layout.len)]
        raw[layout.name] = (places, np.ascontiguousarray(body).view(kind)[:, 0], layout)
    times = _times(raw, round(1e6 * getattr(reader.clock, "timebase", 0.0)))
    made = {name: _scaled(rows, layout, times[name]) for name, (_, rows, layout) in raw.items()}
    return made, {"damaged_bytes": len(data) - taken}


def _dtype(layout: Any) -> np.dtype[np.void]:
    """The body of a message as it is in the file."""
    kinds = [("<i2", (32,)) if letter == "a" else (_KINDS[letter],) for letter in layout.msg_fmts]
    return np.dtype([(name, *kind) for name, kind in zip(layout.columns, kinds, strict=False)])


def _times(
    raw: dict[str, tuple[npt.NDArray[np.int64], npt.NDArray[np.void], Any]], base_us: int
) -> dict[str, npt.NDArray[np.int64]]:
    """Microseconds of each row of each message."""
    times: dict[str, npt.NDArray[np.int64]] = {}
    for name, (_, rows, _layout) in raw.items():
        for column, factor in _TIMES_US.items():
            if column in (rows.dtype.names or ()):
                times[name] = base_us + rows[column].astype(np.int64) * factor
                break
    known = [(raw[name][0], stamps) for name, stamps in times.items()]
    places = np.concatenate([where for where, _ in known]) if known else np.zeros(0, dtype=np.int64)
    stamps = np.concatenate([when for _, when in known]) if known else np.zeros(0, dtype=np.int64)
    order = np.argsort(places, kind="stable")
    places, stamps = places[order], stamps[order]
    for name, (where, _, _layout) in raw.items():
        if name not in times:
            before = np.maximum(np.searchsorted(places, where) - 1, 0)
            times[name] = stamps[before] if len(stamps) else np.full(len(where), base_us)
    return times


def _scaled(rows: npt.NDArray[np.void], layout: Any, t_us: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
    """The table: time first, whole numbers with a factor as what they stand for."""
    names = rows.dtype.names or ()
    factors = dict(zip(layout.columns, layout.msg_mults, strict=False))
    kinds: list[Any] = [("t_us", "<i8")]
    kinds += [(name, "<f8") if factors[name] else (name, rows.dtype[name]) for name in names]
    table = np.zeros(len(rows), dtype=kinds)
    table["t_us"] = t_us
    for name in names:
        table[name] = rows[name] / round(1 / factors[name]) if factors[name] else rows[name]
    return table
