"""Rate keeping: an absolute schedule that does not drift, counts what is late and is never caught up in a burst."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.clock import VirtualClock
from bridge.rate import RateKeeper

PERIODS_NS = st.integers(1, 10**10)
PARTS = st.one_of(
    st.just(0.0), st.floats(0.0, 0.11), st.floats(0.9, 1.1), st.floats(0.0, 9.0), st.sampled_from([0.1, 1.0, 2.0, 7.0])
)
"""A lateness, or a time of work, in periods: nothing, around each limit, anything."""
START_NS = 12_345


def started(period_ns: int) -> tuple[VirtualClock, RateKeeper]:
    clock = VirtualClock(START_NS)
    keeper = RateKeeper(clock, period_ns)
    keeper.start()
    return clock, keeper


def test_the_first_deadline_is_one_period_after_the_start() -> None:
    clock = VirtualClock(START_NS)
    keeper = RateKeeper(clock, 1000)
    assert keeper.deadline_ns == START_NS
    clock.advance_ns(10**9)  # peers find each other: that is not lateness
    keeper.start()
    assert keeper.deadline_ns == START_NS + 10**9 + 1000
    keeper.sleep()
    assert clock.now_ns() == keeper.deadline_ns
    assert keeper.tick() == 0
    assert keeper.counters == {"late": 0, "slipped": 0}


def test_the_schedule_does_not_drift() -> None:
    """A hundred thousand ticks with work of any length below the period, and a period of no round number."""
    period_ns, count = 3_003_003, 100_000
    clock, keeper = started(period_ns)
    chance = random.Random(1)
    for k in range(1, count + 1):
        clock.advance_ns(chance.randrange(period_ns))
        keeper.sleep()
        assert clock.now_ns() == START_NS + k * period_ns
        assert keeper.tick() == 0
    assert keeper.counters == {"late": 0, "slipped": 0}
    assert keeper.latest_ns == 0


def test_lateness_of_single_ticks_does_not_add_up() -> None:
    """Every tick late by nearly a period: each one is, and the last no more than the first."""
    period_ns, count = 1_000_000, 100_000
    clock, keeper = started(period_ns)
    for k in range(1, count + 1):
        keeper.sleep()
        clock.sleep_until_ns(START_NS + k * period_ns + period_ns - 1)
        assert keeper.tick() == period_ns - 1
    assert keeper.deadline_ns == START_NS + (count + 1) * period_ns
    assert keeper.counters == {"late": count, "slipped": 0}


@pytest.mark.parametrize(
    ("period_ns", "lateness_ns", "late"),
    [(1000, 0, 0), (1000, 99, 0), (1000, 100, 0), (1000, 101, 1), (1005, 100, 0), (1005, 101, 1), (1, 0, 0)],
)
def test_above_a_tenth_of_a_period_a_tick_is_late(period_ns: int, lateness_ns: int, late: int) -> None:
    clock, keeper = started(period_ns)
    keeper.sleep()
    clock.advance_ns(lateness_ns)
    assert keeper.tick() == lateness_ns
    assert keeper.counters == {"late": late, "slipped": 0}


@pytest.mark.parametrize(
    ("lateness_ns", "slipped", "next_after_ns"),
    [(999, 0, 1), (1000, 1, 1000), (1001, 1, 999), (1999, 1, 1), (2000, 2, 1000), (7300, 7, 700)],
)
def test_a_whole_period_or_more_slips_the_schedule(lateness_ns: int, slipped: int, next_after_ns: int) -> None:
    clock, keeper = started(1000)
    keeper.sleep()
    clock.advance_ns(lateness_ns)
    keeper.tick()
    assert keeper.counters == {"late": 1, "slipped": slipped}
    assert keeper.deadline_ns == clock.now_ns() + next_after_ns


def test_the_latest_is_remembered() -> None:
    clock, keeper = started(1000)
    for lateness_ns in (10, 2500, 30):
        keeper.sleep()
        clock.advance_ns(lateness_ns)
        keeper.tick()
    assert keeper.latest_ns == 2500


@given(PERIODS_NS, st.lists(PARTS, max_size=50))
def test_every_lateness_is_accounted_for(period_ns: int, parts: list[float]) -> None:
    clock, keeper = started(period_ns)
    lateness = [int(part * period_ns) for part in parts]
    for lateness_ns in lateness:
        keeper.sleep()
        clock.advance_ns(lateness_ns)
        assert keeper.tick() == lateness_ns
    slipped = sum(lateness_ns // period_ns for lateness_ns in lateness)
    assert keeper.counters == {
        "late": sum(10 * lateness_ns > period_ns for lateness_ns in lateness),
        "slipped": slipped,
    }
    assert keeper.latest_ns == max(lateness, default=0)
    assert keeper.deadline_ns == START_NS + (1 + len(parts) + slipped) * period_ns


@given(PERIODS_NS, st.lists(st.tuples(PARTS, PARTS), max_size=50))
def test_whatever_happens_there_is_never_a_burst(period_ns: int, parts: list[tuple[float, float]]) -> None:
    """Work of any length, then a wake-up of any lateness: no tick before its time, and no two within one period's slot."""
    clock, keeper = started(period_ns)
    last_slot = 0
    for work, wake_up in parts:
        clock.advance_ns(int(work * period_ns))
        keeper.sleep()
        clock.advance_ns(int(wake_up * period_ns))
        keeper.tick()
        slot = (clock.now_ns() - START_NS) // period_ns
        assert slot > last_slot
        last_slot = slot
        assert keeper.deadline_ns == START_NS + (slot + 1) * period_ns
