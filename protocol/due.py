"""When something periodic is due."""

from __future__ import annotations

NANOSECONDS = 1_000_000_000
NEVER = 1 << 62
"""A time in ns that is never reached."""


class Due:
    """Schedule of a periodic event, in the time passed to `at`: due at once, then every period.

    next_ns   when it is due next
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = max(1, round(NANOSECONDS / rate_hz))
        self.next_ns = 0

    def at(self, t_ns: int) -> bool:
        """Whether it is due at `t_ns`; if so, this also schedules the next one."""
        if t_ns < self.next_ns:
            return False
        self.next_ns = (t_ns // self._period_ns + 1) * self._period_ns
        return True
