"""Clocks: the only place in the project that reads the system time.

Everything that waits or measures takes a `Clock`; lockstep, real time, replay and tests use different ones.
"""

from __future__ import annotations

import abc
import time

LEAST_EARLY_NS = 100_000
MOST_EARLY_NS = 20_000_000
"""Bounds of how long before the requested time a `PunctualClock` wakes."""
_CLOSE_NS = 2_000
"""Readings of the two clocks within this time are close enough together."""


class Clock(abc.ABC):
    """Gives the time and waits until a time."""

    @abc.abstractmethod
    def now_ns(self) -> int:
        """Now, in ns since an arbitrary origin; never decreases."""

    @abc.abstractmethod
    def sleep_until_ns(self, t_ns: int) -> None:
        """Return when `now_ns` has reached t_ns, or a little later."""

    @abc.abstractmethod
    def spin_until_ns(self, t_ns: int) -> None:
        """The same by polling, without releasing the core: exact, but it takes processor time."""


class MonotonicClock(Clock):
    """The machine's CLOCK_MONOTONIC."""

    def now_ns(self) -> int:
        """Now, in ns."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep; returns at once where t_ns has passed."""
        remaining_ns = t_ns - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)

    def spin_until_ns(self, t_ns: int) -> None:
        """Poll the time."""
        now_ns = time.monotonic_ns
        while now_ns() < t_ns:
            pass


class PunctualClock(MonotonicClock):
    """The machine's clock with exact waits: it wakes early and polls for the rest.

    How early depends on how late recent sleeps ended: some 100 us on a quiet machine, up to 20 ms on a shared virtual one,
    where deadlines closer together than that keep a core busy.

    sleeps_half   sleep for at least half of each wait. For a real-time thread: the kernel stops one that never releases
                  its core, for 50 ms of each second (sched(7), sched_rt_runtime_us).
    """

    def __init__(self, *, sleeps_half: bool = False) -> None:
        self._early_ns = LEAST_EARLY_NS
        self._sleeps_half = sleeps_half

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep, then poll; returns within some microseconds of t_ns, unless the machine suspends this process."""
        now_ns = time.monotonic_ns()
        wake_ns = t_ns - self._early_ns
        if self._sleeps_half and t_ns - now_ns > LEAST_EARLY_NS:
            wake_ns = max(wake_ns, (now_ns + t_ns) // 2)
        if wake_ns > now_ns:
            super().sleep_until_ns(wake_ns)
            late_ns = time.monotonic_ns() - wake_ns
            slowly_less_ns = self._early_ns - self._early_ns // 256
            self._early_ns = min(MOST_EARLY_NS, max(LEAST_EARLY_NS, slowly_less_ns, 4 * late_ns))
        while time.monotonic_ns() < t_ns:
            pass


class VirtualClock(Clock):
    """A clock that stands still until it is advanced; sleeping advances it."""

    def __init__(self, t_ns: int = 0) -> None:
        self._t_ns = t_ns

    def now_ns(self) -> int:
        """The present time of this clock, ns."""
        return self._t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Jump to t_ns, never back."""
        self._t_ns = max(self._t_ns, t_ns)

    def spin_until_ns(self, t_ns: int) -> None:
        """Jump to t_ns, never back."""
        self.sleep_until_ns(t_ns)

    def advance_ns(self, step_ns: int) -> None:
        """Advance by step_ns."""
        self._t_ns += step_ns


def processor_time_ns() -> int:
    """Processor time that this process has used so far on all cores, ns."""
    return time.process_time_ns()


def unix_time_us() -> int:
    """Microseconds since 1970, for the stamps of a log written in real time."""
    return time.time_ns() // 1000


def unix_offset_ns() -> int:
    """CLOCK_REALTIME minus CLOCK_MONOTONIC now, ns: the kernel stamps received datagrams with the former.

    A preemption between the readings of the two clocks falsifies the offset: the closest of three pairs is used.
    """
    readings = []
    for _ in range(3):
        before_ns, unix_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns < _CLOSE_NS:
            return unix_ns - before_ns
        readings.append((after_ns - before_ns, unix_ns - before_ns))
    return min(readings)[1]


def local_stamp() -> str:
    """Date and time of day for the name of a folder, such as 2026-11-22T14-05-09."""
    return time.strftime("%Y-%m-%dT%H-%M-%S")
