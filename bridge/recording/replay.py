"""Timed playback of a log: each frame at its time, at any speed; with pause, single step and seek.

The schedule is absolute, so lateness never accumulates: a frame is due at the start plus its log time over the speed.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from bridge.timing.clock import Clock

LOOK_PERIOD_NS = 20_000_000
"""How often the keyboard, the link's other direction and stop requests are polled."""
LOOK_ROOM_NS = 1_000_000
"""A poll due this shortly before a frame is postponed until after that frame ..."""
LATEST_LOOK_NS = 80_000_000
"""... but no longer than this, however dense the frames are."""
LARGEST_MOMENT = 64
"""Largest number of frames with the same stamp that are prepared together."""

_DAY_NS = 86_400_000_000_000
_LATEST_US = 1 << 52
"""The longest log (142 years): more would not fit in ns, so several jumps of a clock by decades are cut."""

Times = npt.NDArray[np.int64]


def log_times_ns(stamps_us: Times, max_gap_s: float | None = None) -> Times:
    """Log time (n,) of each frame since the first, ns: gaps are limited to max_gap_s, steps back count as zero."""
    steps_ns = np.clip(np.diff(stamps_us, prepend=stamps_us[:1]), 0, _LATEST_US) * 1000
    if max_gap_s is not None:
        steps_ns = np.minimum(steps_ns, round(max_gap_s * 1e9))
    jumps = int(np.count_nonzero(steps_ns > _DAY_NS))
    times: Times = np.cumsum(np.minimum(steps_ns, 1000 * _LATEST_US // max(1, jumps)))
    return times


class Player:
    """Plays frames 0 .. n - 1 by their log times (n,), ns.

    prepare    gives what is to be sent of a frame in a pass (both counted from 0) ahead of time; send sends it when due
    look       called first, and then about 50 times per second, between frames and also while paused: may call `hold`,
               `step`, `seek`, `stop`
    speed      log time over clock time; None: as fast as possible

    at         number of the next frame               sent        frames sent
    passes     complete passes                        lateness_ns of each frame sent by schedule
    moved      whether it was paused, stepped or sought: its measured speed then has no meaning
    """

    def __init__(
        self,
        times_ns: Times,
        prepare: Callable[[int, int], Any],
        send: Callable[[Any], None],
        clock: Clock,
        *,
        speed: float | None,
        look: Callable[[Player], None] | None = None,
    ) -> None:
        self.times_ns = times_ns
        self.speed = speed
        self.at = 0
        self.sent = 0
        self.passes = 0
        self.held = self.moved = False
        self.lateness_ns = array("q")
        self._times: list[int] = times_ns.tolist()
        self._prepare = prepare
        self._send = send
        self._clock = clock
        self._look = look
        self._next_look_ns = clock.now_ns()
        self._steps = 0
        self._stopped = False
        self._anchor()

    def play(self, *, loop: bool = False) -> None:
        """Play to the end, or forever; returns early after `stop`. Raises what prepare, send and look raise."""
        self._look_now()
        self._anchor()
        while True:
            self._play_pass()
            if self.at < len(self._times):
                return
            self.passes += 1
            if not loop:
                return
            end_ns = self._due_ns(len(self._times) - 1)
            self.at = 0
            # The next pass begins when the last frame was due, not when it was sent: a loop keeps its schedule too.
            self._anchor(end_ns if self.speed and not self.held else None)

    def _play_pass(self) -> None:
        count = len(self._times)
        first, frames = 0, list[Any]()  # frames due at the same time, prepared ahead
        while self.at < count and not self._stopped:
            now_ns = self._clock.now_ns()
            if self._look and now_ns >= self._next_look_ns + self._putting_off_ns():
                self._look_now()
                continue
            if self.held and not self._steps:
                self._clock.sleep_until_ns(self._next_look_ns)
                continue
            due_ns = self._due_ns(self.at) if self.speed and not self._steps else None
            if self._look and due_ns and now_ns < self._next_look_ns < due_ns - LOOK_ROOM_NS:
                self._clock.sleep_until_ns(self._next_look_ns)
                continue
            if not first <= self.at < first + len(frames):
                first = self.at
                frames = [self._prepare(number, self.passes) for number in range(first, self._end_of_moment(first))]
            if due_ns is None:
                self._steps = max(0, self._steps - 1)
            else:
                self._clock.sleep_until_ns(due_ns)
                self.lateness_ns.append(max(0, self._clock.now_ns() - due_ns))
            self._send(frames[self.at - first])
            self.sent += 1
            self.at += 1

    def _look_now(self) -> None:
        self._next_look_ns = self._clock.now_ns() + LOOK_PERIOD_NS
        if self._look:
            self._look(self)

    def _putting_off_ns(self) -> int:
        """How long a due poll may be postponed now (ns)."""
        return LATEST_LOOK_NS if self.room_ns < LOOK_ROOM_NS else 0

    @property
    def room_ns(self) -> int:
        """Time until the next frame is due (ns); without a schedule, LOOK_PERIOD_NS."""
        if not self.speed or self.held or self.at >= len(self._times):
            return LOOK_PERIOD_NS
        return self._due_ns(self.at) - self._clock.now_ns()

    def hold(self) -> None:
        """Pause, or continue from the present position."""
        self.held, self.moved = not self.held, True
        self._steps = 0
        self._anchor()

    def step(self) -> None:
        """Send one frame and stay paused."""
        self.held = self.moved = True
        self._steps += 1

    def seek(self, by_s: float) -> None:
        """Move by `by_s` of log time, within the log; frames in between are not sent."""
        self.moved = True
        here_ns = self._times[min(self.at, len(self._times) - 1)]
        self.at = int(np.searchsorted(self.times_ns, here_ns + round(by_s * 1e9)))
        self.at = min(self.at, len(self._times) - 1)
        self._anchor()

    def stop(self) -> None:
        """End before the next frame."""
        self._stopped = True

    @property
    def log_ns(self) -> int:
        """Log time of the frame that is due next."""
        return self._times[min(self.at, len(self._times) - 1)] if self._times else 0

    def _end_of_moment(self, first: int) -> int:
        """The number after the last frame with the same time as this one, at most LARGEST_MOMENT further."""
        end, most = first + 1, min(len(self._times), first + LARGEST_MOMENT)
        while end < most and self._times[end] == self._times[first]:
            end += 1
        return end

    def _anchor(self, now_ns: int | None = None) -> None:
        self._anchor_ns = self._clock.now_ns() if now_ns is None else now_ns
        self._anchor_log_ns = self.log_ns

    def _due_ns(self, number: int) -> int:
        return self._anchor_ns + round((self._times[number] - self._anchor_log_ns) / (self.speed or 1.0))
