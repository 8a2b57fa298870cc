"""How far a piece of work is: a bar on a terminal, a line every two seconds elsewhere; nothing where it is done sooner."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from bridge.timing.clock import MonotonicClock

_PERIOD_NS = 2_000_000_000


class Working:
    """Shows, on standard error, how much of how much is done. Call it with both numbers as often as you like."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._clock = MonotonicClock()
        self._next_ns = self._clock.now_ns() + _PERIOD_NS
        self._bar: Progress | None = None

    def __call__(self, done: int, total: int) -> None:
        """Take note that `done` of `total` is done."""
        if self._bar is None and (done >= total or self._clock.now_ns() < self._next_ns):
            return
        if not sys.stderr.isatty():
            self._next_ns = self._clock.now_ns() + _PERIOD_NS
            sys.stderr.write(f"{self._what}: {100 * done // max(1, total)} %\n")
            sys.stderr.flush()
            return
        if self._bar is None:
            columns = TextColumn("{task.description}", markup=False), BarColumn(bar_width=24), TimeRemainingColumn()
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task(self._what, total=total)
            self._bar.start()
        self._bar.update(self._task, completed=done, total=total)

    def __enter__(self) -> Working:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar:
            self._bar.stop()
