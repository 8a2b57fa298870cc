"""The trial of the machine, on a clock whose lateness is known."""

from __future__ import annotations

import pytest

from bridge.timing.clock import VirtualClock
from bridge.timing.wake_up import Trial, try_wake_ups


class Late(VirtualClock):
    """Every sleep ends late by the next of some times."""

    def __init__(self, *late_ns: int) -> None:
        super().__init__()
        self._late_ns = late_ns
        self._count = 0

    def sleep_until_ns(self, t_ns: int) -> None:
        super().sleep_until_ns(t_ns + self._late_ns[self._count % len(self._late_ns)])
        self._count += 1


def test_a_steady_machine_keeps_the_rate() -> None:
    trial, settings = try_wake_ups(Late(90_000), 1000.0, 0.5, None, realtime=False)
    assert settings == ()
    assert trial.wake_ups == 500
    assert trial.lateness_us["p50"] == trial.lateness_us["max"] == 90.0
    assert trial.missed == 0
    assert trial.keeps


@pytest.mark.parametrize(("late_ns", "missed"), [((0, 110_000), 0), ((0,) * 99 + (2_500_000,), 10)])
def test_a_late_or_a_stalling_one_does_not(late_ns: tuple[int, ...], missed: int) -> None:
    trial, _ = try_wake_ups(Late(*late_ns), 1000.0, 0.5, None, realtime=False)
    assert trial.missed == missed
    assert not trial.keeps


def test_the_real_time_settings_are_asked_for_and_told() -> None:
    trial, settings = try_wake_ups(VirtualClock(), 100.0, 0.05, None, realtime=True)
    assert settings
    assert trial.realtime
    assert isinstance(trial, Trial)
