"""Which frames of a log: by time, message and system; the log itself, opened with the errors a user may meet."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from protocol.errors import LogError, UsageError
from protocol.log_dialect import layouts, layouts_by_name
from protocol.log_scan import Scan, scan_tlog

_DAY_S = 86_400
_TIME_OF_DAY = re.compile(r"(\d{1,2}):([0-5]\d):([0-5]\d(?:\.\d+)?)")

Rows = npt.NDArray[np.bool_]


class Choice(msgspec.Struct, frozen=True, kw_only=True):
    """What a user chose. begin, end: seconds since the log began, or HH:MM:SS; systems: "1" or "1/191"."""

    begin: str | None = None
    end: str | None = None
    types: tuple[str, ...] = ()
    systems: tuple[str, ...] = ()


def log_file(path: Path) -> Path:
    """The log that a user means: the file itself, or that of a run folder."""
    return path / "run.tlog" if path.is_dir() else path


def open_log(path: Path) -> Scan:
    """Every frame of a log. Raises LogError where it cannot be read or holds none."""
    scan = scan_tlog(log_file(path))
    if not len(scan):
        raise LogError(f"{log_file(path)} is no telemetry log: there is no MAVLink frame in it")
    return scan


def choose(scan: Scan, choice: Choice) -> Rows:
    """A truth value for each frame of the scan. Raises UsageError for what names nothing, or where nothing is left."""
    frames = scan.frames
    stamps_us = frames["stamp_us"]
    chosen: Rows = np.ones(len(frames), dtype=np.bool_)
    if choice.begin is not None:
        chosen &= stamps_us >= _moment_us(choice.begin, stamps_us, "--from")
    if choice.end is not None:
        chosen &= stamps_us <= _moment_us(choice.end, stamps_us, "--to")
    if choice.types:
        chosen &= np.isin(frames["message_id"], [_message_id(name) for name in choice.types])
    if choice.systems:
        wanted = np.zeros(len(frames), dtype=np.bool_)
        for text in choice.systems:
            system, component = _sender(text)
            wanted |= (frames["system"] == system) & ((component is None) | (frames["component"] == component))
        chosen &= wanted
    if not chosen.any():
        span_s = (int(stamps_us.max()) - int(stamps_us[0])) * 1e-6
        kinds = ", ".join(sorted({_name(int(number)) for number in np.unique(frames["message_id"])}))
        raise UsageError(
            f"no frame of {scan.path or 'the log'} is left: it is {span_s:.1f} s long, begins at "
            f"{time_of_day(int(stamps_us[0]))} and holds {kinds}: choose among these"
        )
    return chosen


def time_of_day(stamp_us: int) -> str:
    """The time of day (UTC) of a stamp, HH:MM:SS.t; of simulation time, the time since its beginning."""
    tenths = stamp_us // 100_000 % (_DAY_S * 10)
    return f"{tenths // 36_000:02d}:{tenths // 600 % 60:02d}:{tenths // 10 % 60:02d}.{tenths % 10}"


def _moment_us(text: str, stamps_us: npt.NDArray[np.int64], option: str) -> int:
    """The stamp that a time on the command line means."""
    first_us = int(stamps_us[0])
    if found := _TIME_OF_DAY.fullmatch(text):
        seconds = int(found[1]) * 3600 + int(found[2]) * 60 + float(found[3])
        midnight_us = first_us // (_DAY_S * 1_000_000) * _DAY_S * 1_000_000
        moment_us = midnight_us + round(seconds * 1e6)
        # A log over midnight: what is said to be hours before its beginning is meant to be the day after.
        return moment_us + _DAY_S * 1_000_000 if first_us - moment_us > _DAY_S // 2 * 1_000_000 else moment_us
    try:
        return first_us + round(float(text) * 1e6)
    except (ValueError, OverflowError):
        raise UsageError(
            f"{option} {text} is no time: write seconds since the log began, such as 12.5, or a time of day HH:MM:SS"
        ) from None


def _message_id(name: str) -> int:
    known = layouts_by_name()
    if name.upper() in known:
        return known[name.upper()].message_id
    near = difflib.get_close_matches(name.upper(), known, n=1)
    remedy = f"did you mean {near[0]}?" if near else "`fwav-hil log info` lists those of a log"
    raise UsageError(f"there is no message {name}: {remedy}")


def _name(number: int) -> str:
    return layouts()[number].name if number in layouts() else f"message {number}"


def _sender(text: str) -> tuple[int, int | None]:
    if found := re.fullmatch(r"(\d{1,3})(?:/(\d{1,3}))?", text):
        return int(found[1]), int(found[2]) if found[2] else None
    raise UsageError(f"--system {text} is no system: write its id, such as 1, or id/component, such as 1/191")


def split_names(texts: Sequence[str]) -> tuple[str, ...]:
    """Names from an option that may be repeated and may hold several, separated by commas."""
    return tuple(name.strip() for text in texts for name in text.split(",") if name.strip())
