"""A test of the machine: the wake-up lateness of a process that only keeps a rate."""

from __future__ import annotations

from typing import Any

import msgspec

from bridge.timing.clock import Clock
from bridge.timing.rate import LARGEST_SHARE, RateKeeper, choose_spin_ns
from bridge.timing.realtime import Settings, has_own_core, maybe_real_time

NANOSECONDS = 1_000_000_000


class Trial(msgspec.Struct, frozen=True):
    """Result of a trial.

    lateness_us  percentiles, counts by class and the spin, as `RateKeeper.summary` gives them
    missed       whole periods missed
    """

    rate_hz: float
    realtime: bool
    wake_ups: int
    lateness_us: dict[str, Any]
    missed: int

    @property
    def keeps(self) -> bool:
        """Whether the rate is kept: p99.9 within a tenth of the period, and no period missed."""
        return not self.missed and bool(self.lateness_us["p999"] <= 1e6 / self.rate_hz / LARGEST_SHARE)


def try_wake_ups(
    clock: Clock, rate_hz: float, seconds: float, core: int | None, *, realtime: bool
) -> tuple[Trial, Settings]:
    """Keep a rate for some seconds, as an ordinary process or with the settings of `--realtime`."""
    period_ns = round(NANOSECONDS / rate_hz)
    with maybe_real_time(core, wanted=realtime) as settings:
        keeper = RateKeeper(clock, period_ns, choose_spin_ns(clock, period_ns, None, measure=has_own_core(settings)))
        wake_ups = max(1, round(rate_hz * seconds))
        keeper.start()
        for _ in range(wake_ups):
            keeper.sleep()
            keeper.tick()
    return Trial(rate_hz, realtime, wake_ups, keeper.summary(), keeper.counters["slipped"]), settings
