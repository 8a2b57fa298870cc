"""Rate keeping: an absolute schedule that does not drift, counts what is late and is never caught up in a burst."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.timing.clock import VirtualClock
from bridge.timing.rate import LATE_BY_US, RateKeeper, choose_spin_ns, count_by_lateness, measure_spin_ns

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


class Oversleeping(VirtualClock):
    """A clock whose sleeps end late by a given time, and whose every look takes a moment; a spin ends in time."""

    def __init__(self, late_ns: int, look_ns: int = 0) -> None:
        super().__init__(START_NS)
        self.late_ns, self.look_ns = late_ns, look_ns
        self.spins = 0

    def now_ns(self) -> int:
        self.advance_ns(self.look_ns)
        return super().now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        if t_ns > super().now_ns():
            super().sleep_until_ns(t_ns + self.late_ns)

    def spin_until_ns(self, t_ns: int) -> None:
        self.spins += 1
        VirtualClock.sleep_until_ns(self, t_ns)


@pytest.mark.parametrize(("spin_ns", "lateness_ns"), [(0, 70), (30, 40), (70, 0), (200, 0)])
def test_a_spin_takes_up_what_the_sleep_is_late(spin_ns: int, lateness_ns: int) -> None:
    clock = Oversleeping(70)
    keeper = RateKeeper(clock, 1000, spin_ns)
    keeper.start()
    for _ in range(5):
        keeper.sleep()
        assert keeper.tick() == lateness_ns
    assert clock.spins == (5 if spin_ns else 0)


def test_what_remains_to_sleep_ends_where_the_spin_begins() -> None:
    clock = VirtualClock(START_NS)
    keeper = RateKeeper(clock, 1_000_000, 100_000)
    keeper.start()
    assert keeper.remaining_s() == pytest.approx(900e-6)
    clock.advance_ns(900_000)
    assert keeper.remaining_s() == 0.0
    clock.advance_ns(99_999)
    assert keeper.remaining_s() == 0.0
    clock.advance_ns(1)
    assert keeper.remaining_s() is None


@given(PERIODS_NS, st.floats(0.0, 20.0))
def test_a_schedule_taken_up_again_keeps_its_phase_and_counts_nothing(period_ns: int, periods: float) -> None:
    clock, keeper = started(period_ns)
    clock.advance_ns(int(periods * period_ns))
    keeper.resume()
    assert clock.now_ns() <= keeper.deadline_ns
    assert (keeper.deadline_ns - START_NS) % period_ns == 0
    assert keeper.deadline_ns - clock.now_ns() < period_ns or periods < 1
    assert keeper.counters == {"late": 0, "slipped": 0}


@given(st.lists(st.integers(0, 10**11)))
def test_each_lateness_is_in_one_class_and_in_the_right_one(lateness_ns: list[int]) -> None:
    counts = count_by_lateness(lateness_ns)
    assert sum(counts.values()) == len(lateness_ns)
    below = 0
    for bound in LATE_BY_US:
        below += counts[str(bound)]
        assert below == sum(lateness <= 1000 * bound for lateness in lateness_ns)


def test_the_summary_says_how_late_how_often_and_how_long_it_polled() -> None:
    clock = VirtualClock(START_NS)
    keeper = RateKeeper(clock, 1_000_000, 50_000)
    keeper.start()
    for lateness_ns in [0] * 8 + [30_000, 700_000]:
        keeper.sleep()
        clock.advance_ns(lateness_ns)
        keeper.tick()
    summary = keeper.summary()
    assert summary["spin"] == 50.0
    assert summary["max"] == 700.0
    assert {name: count for name, count in summary["late_by"].items() if count} == {"5": 8, "50": 1, "1000": 1}


@pytest.mark.parametrize(("late_ns", "spin_ns"), [(0, 0), (40_000, 50_000), (80_000, 100_000), (5_000_000, 100_000)])
def test_the_spin_is_as_long_as_sleeps_are_late_and_a_tenth_of_the_period_at_most(late_ns: int, spin_ns: int) -> None:
    assert measure_spin_ns(Oversleeping(late_ns), 1_000_000) == spin_ns


def test_who_asks_for_a_spin_gets_it_up_to_half_a_period() -> None:
    clock = Oversleeping(40_000)
    assert choose_spin_ns(clock, 1_000_000, None, measure=False) == 0
    assert choose_spin_ns(clock, 1_000_000, None, measure=True) == 50_000
    assert choose_spin_ns(clock, 1_000_000, 0.0, measure=True) == 0
    assert choose_spin_ns(clock, 1_000_000, 300e-6, measure=False) == 300_000
    assert choose_spin_ns(clock, 1_000_000, 0.1, measure=True) == 500_000
