"""What of a log a command is to show: messages, systems, a stretch of time."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fwav_hil.logs.working import Working
from protocol.compiled import cache_folder
from protocol.errors import UsageError
from protocol.log_files import Log, open_log

_CLOCK = re.compile(r"(?:(\d+):)?(\d{1,2}):(\d{1,2}(?:\.\d*)?)$")


@dataclass(frozen=True)
class Choice:
    """Messages by name, systems and times (us, both ends included); None is all."""

    names: list[str] | None
    systems: list[int] | None
    between_us: tuple[int, int] | None


def open_with_progress(path: Path) -> Log:
    """`open_log`, telling how far it is. Raises LogError."""
    import click

    warm = cache_folder() / "warm-logs"
    if not warm.exists():
        click.echo("compiling the log reader (once after each installation, some ten seconds) ...", err=True)
    with Working(f"reading {path.name}") as working:
        log = open_log(path, progress=working)
    warm.touch()
    return log


def choose(log: Log, types: Sequence[str], systems: Sequence[int], start: str | None, end: str | None) -> Choice:
    """What the options of a command say. Raises UsageError for what the log does not hold."""
    names = [name.strip() for item in types for name in item.split(",") if name.strip()]
    held = log.names()
    for name in names:
        if name not in held and not name.startswith("UNKNOWN_"):
            raise UsageError(f"--types {name}: {log.path} holds no such message{near_matches(name, held)}")
    if systems and log.scan is None:
        raise UsageError(f"--system: {log.path} is a {log.kind}, which has no systems")
    first, last = log.span_us()
    between = None
    if start is not None or end is not None:
        between = (
            first + offset_us(start, "--from") if start is not None else first,
            first + offset_us(end, "--to") if end is not None else last,
        )
        if between[0] > between[1]:
            raise UsageError(f"--from {start} is after --to {end}")
    return Choice(names or None, list(systems) or None, between)


def offset_us(text: str, option: str) -> int:
    """Microseconds from the log's beginning: seconds (12.5), or MM:SS, or HH:MM:SS. Raises UsageError."""
    clock = _CLOCK.match(text)
    try:
        seconds = float(text) if clock is None else 60.0 * (60 * int(clock[1] or 0) + int(clock[2])) + float(clock[3])
        return round(1e6 * seconds)
    except (ValueError, OverflowError):
        raise UsageError(
            f"{option} {text} is no time: give seconds from the log's beginning, or HH:MM:SS from there"
        ) from None


def near_matches(name: str, held: Iterable[str]) -> str:
    """The end of a sentence that says what of `held` looks like `name`."""
    candidates = list(held)
    lower = {candidate.lower(): candidate for candidate in candidates}
    found = [lower[match] for match in difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.5)]
    if found:
        return f"; did you mean {', '.join(found)}?"
    return f"; it holds {', '.join(candidates)}" if len(candidates) <= 12 else ""
