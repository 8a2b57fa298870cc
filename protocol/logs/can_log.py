"""Logs of a CAN bus by other programs, through python-can's readers: candump's .log, Vector's .asc and .blf, PEAK's .trc.

Each identifier has a table: `ID_123`, extended ones with eight digits. Frames that no reader makes sense of are counted: of
candump's lines each one; behind a bad place in another format nothing more is read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.can_frame import CanFrame
from protocol.logs.clock import LATEST_US
from protocol.logs.record_table import RecordTable

_FRAME = np.dtype(
    [("t_us", "<i8"), ("id", "<u4"), ("flags", "u1"), ("channel", "<u2"), ("size", "u1"), ("data", "V64")]
)
EXTENDED, REMOTE, ERROR, FD, SENT = 1, 2, 4, 8, 16
_ROW = np.dtype(
    [("t_us", "<i8"), ("channel", "O"), ("data", "O"), ("remote", "?"), ("error", "?"), ("fd", "?"), ("sent", "?")]
)
_AT_ONCE = 1 << 14
_CANDUMP = re.compile(rb"\s*\(\d+\.\d+\)\s+\S+\s+[0-9A-Fa-f]{3,8}#")
_ASC = re.compile(rb"(?i)\s*(date |base (hex|dec)|// ?version|begin triggerblock)")


class CanLog(NamedTuple):
    """What `read_can_log` gives: frames, one row each (`_FRAME`), channels by number, what was amiss, counted."""

    frames: npt.NDArray[np.void]
    channels: list[str]
    counters: dict[str, int]


def format_of(first: bytes) -> str | None:
    """The format of a CAN log that begins with these bytes, by its suffix; None where it is none."""
    if first.startswith(b"LOGG"):
        return ".blf"
    if first.startswith(b";$FILEVERSION"):
        return ".trc"
    if _CANDUMP.match(first):
        return ".log"
    return ".asc" if _ASC.match(first) else None


def read_can_log(path: Path, suffix: str) -> CanLog:
    """Read a log of that format (see `format_of`). Raises OSError where it cannot be read."""
    channels: dict[str, int] = {}
    counters = {"unreadable_lines" if suffix == ".log" else "unreadable_rest": 0}
    parts, waiting = [], []
    for message in _messages(path, suffix, counters):
        if not 0 <= message.timestamp * 1e6 < LATEST_US:
            counters["impossible_times"] = counters.get("impossible_times", 0) + 1
            continue
        channel = channels.setdefault(str(message.channel), len(channels) & 0xFFFF)
        waiting.append(_row(message, channel))
        if len(waiting) == _AT_ONCE:
            parts.append(np.array(waiting, dtype=_FRAME))
            waiting = []
    parts.append(np.array(waiting, dtype=_FRAME))
    return CanLog(np.concatenate(parts), list(channels), counters)


def _messages(path: Path, suffix: str, counters: dict[str, int]) -> Iterator[Any]:
    import can

    kinds: dict[str, Callable[[Any], Any]] = {
        ".blf": can.BLFReader, ".trc": can.TRCReader, ".asc": can.ASCReader, ".log": can.CanutilsLogReader,
    }  # fmt: skip
    opened = path.open("rb") if suffix == ".blf" else path.open(encoding="utf-8", errors="replace")
    with opened as file:
        name = next(iter(counters))
        goes_on = True
        while goes_on:
            goes_on = False
            try:
                yield from kinds[suffix](file)
            except Exception as error:
                if isinstance(error, OSError):
                    raise
                counters[name] += 1
                goes_on = (
                    suffix == ".log"
                )  # a line of candump's is a whole frame; elsewhere the header would be missing


def _row(message: Any, channel: int) -> tuple[Any, ...]:
    flags = (
        EXTENDED * message.is_extended_id
        | REMOTE * message.is_remote_frame
        | ERROR * message.is_error_frame
        | FD * message.is_fd
        | SENT * (not message.is_rx)
    )
    data = b"" if message.is_remote_frame else bytes(message.data)[:64]
    t_us = 0 if math.isnan(message.timestamp) else round(1e6 * message.timestamp)
    return t_us, message.arbitration_id & 0x1FFFFFFF, flags, channel, len(data), data.ljust(64, b"\0")


def can_tables(log: CanLog) -> dict[str, RecordTable]:
    """The table of each identifier, by name: channel, data in hexadecimal, and what kind of frame it is."""
    frames = log.frames
    if not len(frames):
        return {}
    key = frames["id"].astype(np.int64) << 1 | (frames["flags"] & EXTENDED)
    order = np.argsort(key, kind="stable")
    found, starts = np.unique(key[order], return_index=True)
    made = {}
    for number, start, stop in zip(found.tolist(), starts, [*starts[1:], len(order)], strict=True):
        name = f"ID_{number >> 1:08X}" if number & EXTENDED else f"ID_{number >> 1:03X}"
        rows = order[start:stop]
        made[name] = RecordTable(frames["t_us"][rows], _ROW, _maker(log, rows))
    return made


def _maker(log: CanLog, rows: npt.NDArray[np.int64]) -> Callable[[npt.NDArray[np.int64]], npt.NDArray[np.void]]:
    def make(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
        frames = log.frames[rows[numbers]]
        made = np.zeros(len(frames), dtype=_ROW)
        made["channel"] = [log.channels[number] for number in frames["channel"].tolist()]
        sizes, data = frames["size"].tolist(), frames["data"].tolist()
        made["data"] = [content[:size].hex() for content, size in zip(data, sizes, strict=True)]
        for name, flag in (("remote", REMOTE), ("error", ERROR), ("fd", FD), ("sent", SENT)):
            made[name] = frames["flags"] & flag != 0
        return made

    return make


def classical_frames(log: CanLog) -> tuple[npt.NDArray[np.int64], list[CanFrame]]:
    """Times (us) and frames of those that a classical bus carries: neither CAN FD nor reports of errors."""
    kept = log.frames[(log.frames["flags"] & (ERROR | FD)) == 0]
    columns = (kept[name].tolist() for name in ("id", "data", "size", "flags"))
    frames = [
        CanFrame(number, data[:size], bool(flags & EXTENDED), bool(flags & REMOTE))
        for number, data, size, flags in zip(*columns, strict=True)
    ]
    times: npt.NDArray[np.int64] = kept["t_us"].copy()
    return times, frames
