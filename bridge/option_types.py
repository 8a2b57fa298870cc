"""Numbers on a command line: finite ones, and the speed of a run."""

from __future__ import annotations

import math
from typing import Any

import click

from protocol.errors import UsageError

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


speed_option = click.option(
    "--speed", type=FiniteRange(min=0.001), metavar="X",
    help="Pace lockstep to X times real time; without it, as fast as it goes.",
)  # fmt: skip


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
