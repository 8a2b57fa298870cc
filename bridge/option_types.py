"""What an option of a command line can be given, beside plain texts and numbers; and the speed of a run."""

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
"""Of wall time: an end that hears nothing for 3 s takes the other for gone, and drives their host after 2 s."""


class FiniteRange(click.FloatRange):
    """A `FloatRange` that takes numbers only: click's own lets `nan` pass, and `inf` where there is no upper end."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number, or fail with the sentence that names the remedy."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is no number to reckon with: write one such as 0.5 or 20", param, ctx)
        return number


class DurationNs(click.ParamType[int]):
    """A time with its unit, such as 5ms, 250us or 0.1s, up to a second as a scenario's delay; gives whole nanoseconds."""

    name = "time"
    _UNITS: ClassVar[dict[str, float]] = {"ns": 1.0, "us": 1e3, "ms": 1e6, "s": 1e9}
    _LONGEST_NS = 1_000_000_000

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Nanoseconds of a text, or fail with the sentence that names the remedy."""
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"(\d+\.?\d*|\.\d+)(ns|us|ms|s)", value.strip(), re.ASCII)
        if not match:
            self.fail(f"{value!r} is no time: write a number and its unit, such as 5ms, 250us or 0.1s", param, ctx)
        time_ns = float(match[1]) * self._UNITS[match[2]]
        if time_ns > self._LONGEST_NS:
            self.fail(f"{value!r} is more than a second, with which nothing flies: write a shorter time", param, ctx)
        return round(time_ns)


class MicrosecondsAsS(click.IntRange):
    """Whole microseconds, not negative; gives seconds."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Seconds of a text, or fail."""
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
    """Raise UsageError for a speed in real time, and for one that would leave an end in silence for too long."""
    if speed and clock == "realtime":
        raise UsageError(
            "--speed paces lockstep, and --clock realtime has wall time for its pace: leave one of them out"
        )
    if speed and rate_hz * speed < 1.0 / SLOWEST_TICK_S:
        raise UsageError(
            f"--speed {speed:g} at {rate_hz:g} Hz is a tick every {1.0 / (rate_hz * speed):.3g} s, for which no end waits: "
            f"choose --speed {1.0 / (rate_hz * SLOWEST_TICK_S):g} or more"
        )
