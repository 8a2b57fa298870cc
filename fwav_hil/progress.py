"""Progress of a run: a bar on a terminal, a line every two seconds elsewhere."""

from __future__ import annotations

import math
import sys
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from bridge.timing.clock import MonotonicClock

_LINE_PERIOD_NS = 2_000_000_000


class Progress:
    """Shows elapsed time, simulation time, speed and the current tracking error, on standard error."""

    def __init__(self, duration_s: float) -> None:
        self._duration_s = duration_s
        self._clock = MonotonicClock()
        self._begun_ns = 0
        self._line_ns = 0
        self._bar: Bar | None = None
        if sys.stderr.isatty():
            self._bar = Bar(
                TextColumn("flying"),
                BarColumn(bar_width=24),
                TextColumn("{task.description}"),
                TimeElapsedColumn(),
                console=Console(stderr=True),
            )
            self._task = self._bar.add_task("starting", total=duration_s)

    def update(self, t_s: float, error: tuple[float, float]) -> None:
        """Show simulation time t_s and the current largest position (m) and attitude (rad) error."""
        now_ns = self._clock.now_ns()
        if not self._begun_ns:
            self._begun_ns, self._line_ns, self._first_s = now_ns, now_ns, t_s
            return
        speed = (t_s - self._first_s) / max(1e-9, (now_ns - self._begun_ns) * 1e-9)
        text = (
            f"t = {t_s:5.2f} of {self._duration_s:g} s, {speed:4.1f} x real time, "
            f"error {1e3 * error[0]:.1f} mm, {math.degrees(error[1]):.2f} deg"
        )
        if self._bar:
            self._bar.update(self._task, completed=t_s, description=text)
        elif now_ns - self._line_ns > _LINE_PERIOD_NS:
            self._line_ns = now_ns
            sys.stderr.write(text + "\n")
            sys.stderr.flush()

    def __enter__(self) -> Progress:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar:
            self._bar.stop()


class StatusLine:
    """One line of text on standard error: rewritten in place on a terminal, every two seconds elsewhere."""

    def __init__(self) -> None:
        self._clock = MonotonicClock()
        self._line_ns = self._clock.now_ns()
        self._in_place = sys.stderr.isatty()
        self._width = 0

    def show(self, text: str) -> None:
        """Show the current state; call it several times a second."""
        if self._in_place:
            sys.stderr.write("\r" + text.ljust(self._width))
            self._width = len(text)
        elif self._clock.now_ns() - self._line_ns > _LINE_PERIOD_NS:
            self._line_ns = self._clock.now_ns()
            sys.stderr.write(text + "\n")
        sys.stderr.flush()

    def end(self) -> None:
        """End the line, so that the next output begins on a new one."""
        if self._in_place and self._width:
            sys.stderr.write("\n")
            sys.stderr.flush()
        self._width = 0
