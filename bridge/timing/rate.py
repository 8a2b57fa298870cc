"""Rate keeping: an absolute schedule that does not drift, and an account of how late each tick was."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

from bridge.summary import percentiles_us
from bridge.timing.clock import Clock

LATE_BY_US = (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
"""Upper bounds of the classes that lateness is counted in."""

LARGEST_SHARE = 10
"""A tick is late, and a spin long enough, at the LARGEST_SHARE-th part of a period."""

_TRIAL_SLEEPS = 60
_TRIAL_PERIOD_NS = 1_000_000


class RateKeeper:
    """Deadlines at start + k periods. A tick that is late is counted; a late schedule is never caught up in a burst.

    Where a tick is a whole period late or more, the schedule moves on by the whole periods missed (`slipped` counts
    them), so that the next tick comes a period later and not at once.

    spin_ns      length of the wait's end that is polled instead of slept (see `measure_spin_ns`)
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
        """Go on with a schedule that nobody kept for a while: its next deadline is the first that has not passed."""
        behind_ns = self._clock.now_ns() - self.deadline_ns
        if behind_ns > 0:
            self.deadline_ns += -(-behind_ns // self.period_ns) * self.period_ns

    def sleep(self) -> None:
        """Wait for the deadline: sleep, then poll the last `spin_ns`."""
        self._clock.sleep_until_ns(self.deadline_ns - self.spin_ns)
        if self.spin_ns:
            self._clock.spin_until_ns(self.deadline_ns)

    def remaining_s(self) -> float | None:
        """How long (s) one may sleep, 0 where the spin has begun; None where the deadline has come."""
        remaining_ns = self.deadline_ns - self._clock.now_ns()
        if remaining_ns <= 0:
            return None
        return max(0, remaining_ns - self.spin_ns) * 1e-9

    def tick(self) -> int:
        """Account for the deadline just reached and set the next one; returns the lateness in ns."""
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
        """How late the ticks were, for a summary: percentiles (us), counts by class, and the spin (us)."""
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
    """How much sooner than a deadline to wake, so that nearly every wake-up is in time: takes 0.06 s.

    The 95th percentile of how late some sleeps end, and a quarter more; at most a tenth of the period, so that a poor
    machine costs jitter and not a core.
    """
    lateness_ns = []
    for _ in range(_TRIAL_SLEEPS):
        deadline_ns = clock.now_ns() + min(_TRIAL_PERIOD_NS, period_ns)
        clock.sleep_until_ns(deadline_ns)
        lateness_ns.append(clock.now_ns() - deadline_ns)
    lateness_ns.sort()
    return min(lateness_ns[_TRIAL_SLEEPS * 95 // 100] * 5 // 4, period_ns // LARGEST_SHARE)


def choose_spin_ns(clock: Clock, period_ns: int, wanted_s: float | None, *, measure: bool) -> int:
    """The spin of a loop: what the user wants, up to half the period; else as measured, or 0."""
    if wanted_s is not None:
        return min(round(wanted_s * 1e9), period_ns // 2)
    return measure_spin_ns(clock, period_ns) if measure else 0
