"""What of a log a command is to show, export, replay or compare: messages, systems, a stretch of time."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import numpy.typing as npt

from fwav_hil.logs.working import Working
from protocol.errors import LogError, UsageError
from protocol.kernel_cache import kernels_are_warm, mark_warm
from protocol.logs.dialect import layouts_by_name
from protocol.logs.files import Log, Sender, chosen_rows, open_log
from protocol.logs.scan import Scan

_DAY_US = 86_400_000_000
_TIME_OF_DAY = re.compile(r"(\d{1,2}):([0-5]\d):([0-5]\d(?:\.\d+)?)")
_SENDER = re.compile(r"(\d{1,3})(?:/(\d{1,3}))?")
_UNKNOWN = "UNKNOWN_"


@dataclass(frozen=True)
class Choice:
    """Messages by name, senders and times (us, both ends included); None is all."""

    names: list[str] | None = None
    senders: list[Sender] | None = None
    between_us: tuple[int, int] | None = None


def log_file(path: Path) -> Path:
    """The log that a user means: the file itself, or that of a run folder."""
    return path / "run.tlog" if path.is_dir() else path


def open_with_progress(path: Path) -> Log:
    """`open_log` of a log or of a run folder's, telling how far it is. Raises LogError."""
    if not kernels_are_warm("protocol.logs"):
        click.echo("compiling the log reader (after an installation or an edit of it, some ten seconds) ...", err=True)
    with Working(f"reading {log_file(path).name}") as working:
        log = open_log(log_file(path), progress=working)
    mark_warm("protocol.logs")
    return log


def open_telemetry(path: Path) -> tuple[Log, Scan]:
    """A MAVLink log (or a run folder's) and its frames. Raises LogError, also for what an autopilot wrote of itself."""
    log = open_with_progress(path)
    if log.scan is None:
        raise LogError(
            f"{log.path} holds no MAVLink frames, it is of the kind {log.kind}: `fwav-hil log` shows its tables"
        )
    return log, log.scan


def choose(log: Log, types: Sequence[str], systems: Sequence[str], start: str | None, end: str | None) -> Choice:
    """What the options of a command say. Raises UsageError for what the log does not hold."""
    names = held_names(types, names_in(log), log.path)
    if systems and log.scan is None:
        raise UsageError(f"--system: {log.path} is of the kind {log.kind}, which names no systems")
    first, last = log.span_us()
    between = None
    if start is not None or end is not None:
        between = (
            first if start is None else moment_us(start, first, "--from"),
            last if end is None else moment_us(end, first, "--to"),
        )
        if between[0] > between[1]:
            raise UsageError(
                f"no time of {log.path} is left between --from and --to: it is {(last - first) * 1e-6:g} s long"
            )
    return Choice(names or None, [_sender(text) for text in systems] or None, between)


def choose_frames(log: Log, scan: Scan, choice: Choice) -> npt.NDArray[np.bool_]:
    """A truth value for each frame of the log's scan. Raises UsageError where nothing is left."""
    rows = chosen_rows(scan, choice.between_us, choice.senders)
    chosen = np.ones(len(scan), dtype=np.bool_) if rows is None else rows
    if choice.names is not None:
        unknown = [int(name.removeprefix(_UNKNOWN)) for name in choice.names if name.startswith(_UNKNOWN)]
        known = [layouts_by_name()[name].message_id for name in choice.names if not name.startswith(_UNKNOWN)]
        numbers, is_known = scan.frames["message_id"], scan.frames["known"] == 1
        chosen &= (is_known & np.isin(numbers, known)) | (~is_known & np.isin(numbers, unknown))
    if not chosen.any():
        first, last = log.span_us()
        senders = sorted(set(zip(scan.frames["system"].tolist(), scan.frames["component"].tolist(), strict=True)))
        raise UsageError(
            f"no frame of {log.path} is left: it is {(last - first) * 1e-6:.1f} s long, begins at {time_of_day(first)}, "
            f"holds {', '.join(names_in(log))}, from {', '.join(f'{s}/{c}' for s, c in senders)}: choose among these"
        )
    return chosen


def names_in(log: Log) -> list[str]:
    """The messages of a log by name, those the dialect lacks as UNKNOWN_ and their number."""
    if log.scan is None:
        return log.names()
    frames = log.scan.frames
    return log.names() + [f"{_UNKNOWN}{number}" for number in np.unique(frames["message_id"][frames["known"] == 0])]


def held_names(types: Sequence[str], held: Collection[str], where: object) -> list[str]:
    """The names of an option that may be repeated and may hold several, in any case. Raises UsageError for one not held."""
    by_upper = {name.upper(): name for name in held} | {name: name for name in held}
    names = []
    for name in (name.strip() for item in types for name in item.split(",") if name.strip()):
        found = by_upper.get(name) or by_upper.get(name.upper())
        if found is None:
            raise UsageError(f"--types {name}: {where} holds no such message{near_matches(name, held)}")
        names.append(found)
    return names


def moment_us(text: str, first_us: int, option: str) -> int:
    """The time (us) that a text means in a log that begins at first_us. Raises UsageError.

    Seconds since the log's beginning, such as 12.5, or a time of day (UTC) as HH:MM:SS; one that is hours before the
    beginning is of the day after.
    """
    if clock := _TIME_OF_DAY.fullmatch(text):
        seconds = int(clock[1]) * 3600 + int(clock[2]) * 60 + float(clock[3])
        moment = first_us - first_us % _DAY_US + round(seconds * 1e6)
        return moment + _DAY_US if first_us - moment > _DAY_US // 2 else moment
    try:
        return first_us + round(float(text) * 1e6)
    except (ValueError, OverflowError):
        raise UsageError(
            f"{option} {text} is no time: write seconds since the log began, such as 12.5, or a time of day HH:MM:SS"
        ) from None


def time_of_day(stamp_us: int) -> str:
    """The time of day (UTC) of a stamp, HH:MM:SS.t; of simulation time, the time since its beginning."""
    tenths = stamp_us % _DAY_US // 100_000
    return f"{tenths // 36_000:02d}:{tenths // 600 % 60:02d}:{tenths // 10 % 60:02d}.{tenths % 10}"


def duration(t_s: float) -> str:
    """A time in the unit in which one thinks of it."""
    for unit, size in (("years", 31_557_600.0), ("days", 86_400.0), ("hours", 3600.0)):
        if t_s >= 2.0 * size:
            return f"{t_s / size:.1f} {unit}"
    return f"{t_s:.1f} s"


def _sender(text: str) -> Sender:
    if (found := _SENDER.fullmatch(text)) and all(int(part) < 256 for part in found.groups(default="0")):
        return int(found[1]), int(found[2]) if found[2] else None
    raise UsageError(f"--system {text} is no system: write its id, such as 1, or id/component, such as 1/191")


def near_matches(name: str, held: Iterable[str]) -> str:
    """The end of a sentence that says what of `held` looks like `name`."""
    candidates = list(held)
    lower = {candidate.lower(): candidate for candidate in candidates}
    found = [lower[match] for match in difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.5)]
    if found:
        return f"; did you mean {', '.join(found)}?"
    return f"; it holds {', '.join(candidates)}" if len(candidates) <= 12 else ""
