"""What of a log a command is to show: messages, systems, a stretch of time."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from fwav_hil.logs.working import Working
from protocol.errors import UsageError
from protocol.kernel_cache import cache_folder
from protocol.log_files import Log, Sender, open_log

_DAY_US = 86_400_000_000
_TIME_OF_DAY = re.compile(r"(\d{1,2}):([0-5]\d):([0-5]\d(?:\.\d+)?)")
_SENDER = re.compile(r"(\d{1,3})(?:/(\d{1,3}))?")


@dataclass(frozen=True)
class Choice:
    """Messages by name, senders and times (us, both ends included); None is all."""

    names: list[str] | None = None
    senders: list[Sender] | None = None
    between_us: tuple[int, int] | None = None


def open_with_progress(path: Path) -> Log:
    """`open_log` of a log or of a run folder's, telling how far it is. Raises LogError."""
    warm = cache_folder() / "warm-logs"
    if not warm.exists():
        click.echo("compiling the log reader (once after each installation, some ten seconds) ...", err=True)
    log_path = path / "run.tlog" if path.is_dir() else path
    with Working(f"reading {log_path.name}") as working:
        log = open_log(log_path, progress=working)
    warm.touch()
    return log


def choose(log: Log, types: Sequence[str], systems: Sequence[str], start: str | None, end: str | None) -> Choice:
    """What the options of a command say. Raises UsageError for what the log does not hold."""
    held = {name.upper(): name for name in log.names()}
    names = []
    for name in (name.strip() for item in types for name in item.split(",") if name.strip()):
        if name.upper() not in held and not name.startswith("UNKNOWN_"):
            raise UsageError(f"--types {name}: {log.path} holds no such message{near_matches(name, held.values())}")
        names.append(held.get(name.upper(), name))
    if systems and log.scan is None:
        raise UsageError(f"--system: {log.path} is a log that an autopilot wrote of itself, it names no systems")
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
