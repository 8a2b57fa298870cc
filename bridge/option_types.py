"""Value types of command-line options beyond plain strings and numbers; and the check of a run's speed."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, ClassVar

import click

from protocol.errors import UsageError

FILE = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
EXISTING = click.Path(exists=True, path_type=Path)
EXISTING_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)

SLOWEST_TICK_S = 1.0
"""Wall time: an end that receives nothing for 3 s considers its peer lost; drives do so with their host after 2 s."""


class FiniteRange(click.FloatRange):
    """A `FloatRange` that accepts finite numbers only: click's own accepts `nan`, and `inf` without an upper bound."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number; fails with a message that names the remedy."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number: write one such as 0.5 or 20", param, ctx)
        return number


class DurationNs(click.ParamType[int]):
    """A time with its unit, such as 5ms, 250us or 0.1s, at most one second; gives whole nanoseconds."""

    name = "time"
    _UNITS: ClassVar[dict[str, float]] = {"ns": 1.0, "us": 1e3, "ms": 1e6, "s": 1e9}
    _LONGEST_NS = 1_000_000_000

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """The time in nanoseconds; fails with a message that names the remedy."""
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"(\d+\.?\d*|\.\d+)(ns|us|ms|s)", value.strip(), re.ASCII)
        if not match:
            self.fail(f"{value!r} is not a time: write a number and its unit, such as 5ms, 250us or 0.1s", param, ctx)
        time_ns = float(match[1]) * self._UNITS[match[2]]
        if time_ns > self._LONGEST_NS:
            self.fail(f"{value!r} is longer than a second, the longest delay allowed: write a shorter time", param, ctx)
        return round(time_ns)


class MicrosecondsAsS(click.IntRange):
    """Whole microseconds, not negative; gives seconds."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The time in seconds; fails where the text is not a whole number."""
        return super().convert(value, param, ctx) * 1e-6


class KeyFile(click.Path):
    """A file with a signing key; gives the key. Raises UsageError where it holds none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The 32 bytes in the file."""
        from protocol.wire.signing import read_key

        return read_key(Path(str(super().convert(value, param, ctx))))


MICROSECONDS = MicrosecondsAsS(min=0)
KEY_FILE = KeyFile(dir_okay=False)


def check_speed(clock: str, speed: float | None, rate_hz: float) -> None:
    """Raise UsageError for a speed in real time, and for one so low that an end would time out between two ticks."""
    if speed and clock == "realtime":
        raise UsageError(
            "--speed sets the pace of lockstep, but --clock realtime always follows wall time: leave one of them out"
        )
    if speed and rate_hz * speed < 1.0 / SLOWEST_TICK_S:
        raise UsageError(
            f"--speed {speed:g} at {rate_hz:g} Hz is a tick every {1.0 / (rate_hz * speed):.3g} s, longer than the ends' "
            f"timeouts: choose --speed {1.0 / (rate_hz * SLOWEST_TICK_S):g} or more"
        )
