"""Clocks: the machine's, and the one that stands still until it is told to go on."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.timing.clock import (
    MonotonicClock,
    PunctualClock,
    VirtualClock,
    local_stamp,
    processor_time_ns,
    unix_offset_ns,
    unix_time_us,
)


class TestMonotonicClock:
    def test_it_never_runs_backwards(self) -> None:
        clock = MonotonicClock()
        times = [clock.now_ns() for _ in range(1000)]
        assert times == sorted(times)

    def test_it_is_the_machines(self) -> None:
        before = time.monotonic_ns()
        now = MonotonicClock().now_ns()
        assert before <= now <= time.monotonic_ns()

    @pytest.mark.parametrize("wait_ns", [1, 999, 500_000, 20_000_000])
    def test_a_sleep_is_over_when_its_time_has_come_and_no_sooner(self, wait_ns: int) -> None:
        clock = MonotonicClock()
        deadline_ns = clock.now_ns() + wait_ns
        clock.sleep_until_ns(deadline_ns)
        assert clock.now_ns() >= deadline_ns

    @pytest.mark.parametrize("t_ns", [-1, 0, 1])
    def test_what_has_passed_is_not_waited_for(self, t_ns: int, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(_: float) -> None:
            raise AssertionError("slept")

        monkeypatch.setattr(time, "sleep", refuse)
        MonotonicClock().sleep_until_ns(t_ns)


class TestVirtualClock:
    def test_it_stands_still(self) -> None:
        clock = VirtualClock(7)
        assert [clock.now_ns() for _ in range(3)] == [7, 7, 7]
        assert VirtualClock().now_ns() == 0

    def test_sleeping_moves_it_and_never_back(self) -> None:
        clock = VirtualClock(100)
        clock.sleep_until_ns(250)
        assert clock.now_ns() == 250
        clock.sleep_until_ns(249)
        assert clock.now_ns() == 250

    def test_advancing_adds_up(self) -> None:
        clock = VirtualClock(100)
        clock.advance_ns(5)
        clock.advance_ns(6)
        assert clock.now_ns() == 111

    @given(st.integers(0, 10**18), st.lists(st.tuples(st.booleans(), st.integers(0, 10**18))))
    def test_it_is_to_the_nanosecond_at_any_time(self, start_ns: int, moves: list[tuple[bool, int]]) -> None:
        clock, expected_ns = VirtualClock(start_ns), start_ns
        for is_sleep, number_ns in moves:
            if is_sleep:
                clock.sleep_until_ns(number_ns)
                expected_ns = max(expected_ns, number_ns)
            else:
                clock.advance_ns(number_ns)
                expected_ns += number_ns
            assert clock.now_ns() == expected_ns


def test_unix_time_is_in_whole_microseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: 1_700_000_000_123_456_999)
    assert unix_time_us() == 1_700_000_000_123_456


def test_a_stamp_is_a_date_a_time_and_a_name_that_any_file_system_takes() -> None:
    stamp = local_stamp()
    time.strptime(stamp, "%Y-%m-%dT%H-%M-%S")
    assert len(stamp) == len("2026-11-22T14-05-09")
    assert set(stamp) <= set("0123456789-T")


class Machine:
    """A machine whose sleeps end too late by `overslept_ns`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = self.overslept_ns = self.slept_ns = 0
        monkeypatch.setattr(time, "sleep", self._sleep)
        monkeypatch.setattr(time, "monotonic_ns", self._read)

    def _sleep(self, wait_s: float) -> None:
        self.slept_ns += round(wait_s * 1e9)
        self.now_ns += round(wait_s * 1e9) + self.overslept_ns

    def _read(self) -> int:
        self.now_ns += 20_000  # a look at the clock takes its time
        return self.now_ns

    def lateness_ns(self, clock: PunctualClock, wait_ns: int = 50_000_000) -> int:
        """How late a wait ends."""
        deadline_ns = self.now_ns + wait_ns
        clock.sleep_until_ns(deadline_ns)
        return self.now_ns - deadline_ns


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


class TestPunctualClock:
    def test_it_is_on_time_and_never_early(self) -> None:
        clock = PunctualClock()
        for wait_ns in (-1, 0, 50_000, 300_000, 3_000_000):
            deadline_ns = clock.now_ns() + wait_ns
            clock.sleep_until_ns(deadline_ns)
            assert clock.now_ns() >= deadline_ns

    def test_the_later_the_machine_wakes_it_the_earlier_it_wakes(self, machine: Machine) -> None:
        clock = PunctualClock()
        assert machine.lateness_ns(clock) <= 40_000
        machine.overslept_ns = 3_000_000
        assert machine.lateness_ns(clock) > 2_000_000
        assert machine.lateness_ns(clock) <= 40_000
        machine.overslept_ns = 0
        for _ in range(1200):
            machine.lateness_ns(clock)
        machine.overslept_ns = 3_000_000
        assert machine.lateness_ns(clock) > 2_000_000, "it has come to trust the machine again"

    @pytest.mark.parametrize("wait_ns", [200_000, 4_000_000, 50_000_000])
    def test_a_real_time_thread_sleeps_through_half_of_each_wait(self, machine: Machine, wait_ns: int) -> None:
        clock = PunctualClock(sleeps_half=True)
        machine.overslept_ns = 15_000_000
        machine.lateness_ns(clock)
        machine.overslept_ns = 0
        machine.slept_ns = 0
        assert machine.lateness_ns(clock, wait_ns) <= 40_000
        # At most it wakes 20 ms early, so of a long wait it sleeps more.
        assert machine.slept_ns == pytest.approx(max(wait_ns / 2, wait_ns - 20e6), abs=200_000)
        assert machine.slept_ns >= wait_ns // 2 - 40_000


class TestUnixOffset:
    def test_it_leads_from_one_clock_to_the_other(self) -> None:
        before_ns = time.time_ns()
        told_ns = MonotonicClock().now_ns() + unix_offset_ns()
        after_ns = time.time_ns()
        assert before_ns - 1_000_000_000 < told_ns < after_ns + 1_000_000_000  # no measure: the machine may stall

    def test_a_pause_between_the_readings_does_not_count(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Each reading takes 100 ns; the first two times this process is put to sleep in between."""
        offset_ns, now_ns, pauses = 10**18, 10**12, [5_000_000, 3_000_000]

        def monotonic_ns() -> int:
            nonlocal now_ns
            now_ns += 100
            return now_ns

        def time_ns() -> int:
            nonlocal now_ns
            now_ns += pauses.pop() if pauses else 0
            return now_ns + offset_ns

        monkeypatch.setattr(time, "monotonic_ns", monotonic_ns)
        monkeypatch.setattr(time, "time_ns", time_ns)
        assert unix_offset_ns() == offset_ns
        assert not pauses


def test_a_spin_ends_when_its_time_has_come_and_no_sooner() -> None:
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + 2_000_000
    clock.spin_until_ns(deadline_ns)
    assert clock.now_ns() >= deadline_ns
    virtual = VirtualClock(5)
    virtual.spin_until_ns(9)
    assert virtual.now_ns() == 9


def test_processor_time_grows_with_work() -> None:
    before = processor_time_ns()
    sum(range(200_000))
    assert processor_time_ns() > before
