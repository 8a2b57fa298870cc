"""Rate keeping: an absolute schedule that does not drift, and an account of how late each tick was."""

from __future__ import annotations

from bridge.clock import Clock


class RateKeeper:
    """Deadlines at start + k periods. A tick that is late is counted; a late schedule is never caught up in a burst.

    Where a tick is a whole period late or more, the schedule moves on by the whole periods missed (`slipped` counts
    them), so that the next tick comes a period later and not at once.

    counters   late     ticks that began after their deadline by more than a tenth of a period
               slipped  periods by which the schedule was moved
    """

    def __init__(self, clock: Clock, period_ns: int) -> None:
        self._clock = clock
        self.period_ns = period_ns
        self.deadline_ns = clock.now_ns()
        self.latest_ns = 0
        self.counters = {"late": 0, "slipped": 0}

    def start(self) -> None:
        """Begin the schedule now: the next deadline is one period away."""
        self.deadline_ns = self._clock.now_ns() + self.period_ns

    def sleep(self) -> None:
        """Wait for the deadline."""
        self._clock.sleep_until_ns(self.deadline_ns)

    def tick(self) -> int:
        """Account for the deadline just reached and set the next one; returns the lateness in ns."""
        lateness_ns = max(0, self._clock.now_ns() - self.deadline_ns)
        self.latest_ns = max(self.latest_ns, lateness_ns)
        if 10 * lateness_ns > self.period_ns:
            self.counters["late"] += 1
        missed = lateness_ns // self.period_ns
        self.counters["slipped"] += missed
        self.deadline_ns += (1 + missed) * self.period_ns
        return lateness_ns
