"""Rate keeping: an absolute schedule that does not drift, with statistics of how late each tick was."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

from bridge.summary import percentiles_us
from bridge.timing.clock import Clock

LATE_BY_US = (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
"""Upper bounds of the lateness classes."""

LARGEST_SHARE = 10
"""A tick counts as late beyond 1 / LARGEST_SHARE of a period, which is also the longest measured spin."""

_TRIAL_SLEEPS = 60
_TRIAL_PERIOD_NS = 1_000_000


class RateKeeper:
    """Deadlines at start + k periods. Late ticks are counted; missed periods are never caught up in a burst.

    Where a tick is a whole period late or more, the schedule moves on by the missed whole periods (counted as `slipped`),
    so that the next tick does not follow at once.

    spin_ns      last part of each wait, which is polled instead of slept (see `measure_spin_ns`)
    lateness_ns  how late each tick was
    counters     late     ticks that began after their deadline by more than a tenth of a period
                 slipped  periods by which the schedule was moved
    """

    def __init__(self, clock: Clock, period_ns: int, spin_ns: int = 0) -> None:
        self._clock = clock
        self.period_ns = period_ns
        self.spin_ns = spin_ns
        self.deadline_ns = clock.now_ns()
        self.latest_ns = 0
        self.lateness_ns: array[int] = array("q")
        self.counters = {"late": 0, "slipped": 0}

    def start(self) -> None:
        """Begin the schedule now: the next deadline is one period away."""
        self.deadline_ns = self._clock.now_ns() + self.period_ns

    def resume(self) -> None:
        """Continue the schedule after a pause: the next deadline is the first that has not passed."""
        behind_ns = self._clock.now_ns() - self.deadline_ns
        if behind_ns > 0:
            self.deadline_ns += -(-behind_ns // self.period_ns) * self.period_ns

    def sleep(self) -> None:
        """Wait for the deadline: sleep, then poll the last `spin_ns`."""
        self._clock.sleep_until_ns(self.deadline_ns - self.spin_ns)
        if self.spin_ns:
            self._clock.spin_until_ns(self.deadline_ns)

    def remaining_s(self) -> float | None:
        """How long (s) the caller may sleep; 0 once the spin has begun; None at or after the deadline."""
        remaining_ns = self.deadline_ns - self._clock.now_ns()
        if remaining_ns <= 0:
            return None
        return max(0, remaining_ns - self.spin_ns) * 1e-9

    def tick(self) -> int:
        """Record the lateness at the deadline just reached and set the next one; returns the lateness in ns."""
        lateness_ns = max(0, self._clock.now_ns() - self.deadline_ns)
        self.lateness_ns.append(lateness_ns)
        self.latest_ns = max(self.latest_ns, lateness_ns)
        if LARGEST_SHARE * lateness_ns > self.period_ns:
            self.counters["late"] += 1
        missed = lateness_ns // self.period_ns
        self.counters["slipped"] += missed
        self.deadline_ns += (1 + missed) * self.period_ns
        return lateness_ns

    def summary(self) -> dict[str, Any]:
        """Lateness of the ticks, for a summary: percentiles (us), counts by class, and the spin (us)."""
        return {
            **percentiles_us(self.lateness_ns),
            "late_by": count_by_lateness(self.lateness_ns),
            "spin": self.spin_ns / 1e3,
        }


def count_by_lateness(lateness_ns: Sequence[int]) -> dict[str, int]:
    """Ticks by how late they were: "5" counts those up to 5 us, "10" those from there up to 10 us ..., "more" the rest."""
    bounds_ns = [1000 * bound for bound in LATE_BY_US]
    counts = [0] * (len(bounds_ns) + 1)
    for lateness in lateness_ns:
        counts[bisect_left(bounds_ns, lateness)] += 1
    return dict(zip([*map(str, LATE_BY_US), "more"], counts, strict=True))


def measure_spin_ns(clock: Clock, period_ns: int) -> int:
    """How long before a deadline to wake so that nearly every wake-up is in time; the measurement takes 0.06 s.

    1.25 times the 95th percentile of the lateness of some sleeps; at most a tenth of the period, so that a slow machine
    causes jitter instead of a busy core.
    """
    lateness_ns = []
    for _ in range(_TRIAL_SLEEPS):
        deadline_ns = clock.now_ns() + min(_TRIAL_PERIOD_NS, period_ns)
        clock.sleep_until_ns(deadline_ns)
        lateness_ns.append(clock.now_ns() - deadline_ns)
    lateness_ns.sort()
    return min(lateness_ns[_TRIAL_SLEEPS * 95 // 100] * 5 // 4, period_ns // LARGEST_SHARE)


def choose_spin_ns(clock: Clock, period_ns: int, wanted_s: float | None, *, measure: bool) -> int:
    """The spin of a loop: the user's value, up to half the period; else as measured, or 0."""
    if wanted_s is not None:
        return min(round(wanted_s * 1e9), period_ns // 2)
    return measure_spin_ns(clock, period_ns) if measure else 0
