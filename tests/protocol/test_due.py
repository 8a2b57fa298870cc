"""When something periodic is due."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.due import Due

SECOND_NS = 1_000_000_000


def dues(rate_hz: float, times_ns: list[int]) -> list[int]:
    due = Due(rate_hz)
    return [t_ns for t_ns in times_ns if due.at(t_ns)]


class TestDue:
    @pytest.mark.parametrize("start_ns", [0, 1, 123_456_789, 99_999_999])
    def test_the_first_is_due_at_once_and_the_same_time_not_again(self, start_ns: int) -> None:
        due = Due(10.0)
        assert due.at(start_ns)
        assert not due.at(start_ns)

    @pytest.mark.parametrize(("rate_hz", "tick_ns"), [(10.0, 4_000_000), (50.0, 2_500_000), (1.0, 1_000_000)])
    def test_where_ticks_fit_it_is_due_at_each_multiple_of_its_period(self, rate_hz: float, tick_ns: int) -> None:
        period_ns = round(SECOND_NS / rate_hz)
        assert dues(rate_hz, list(range(0, 20 * SECOND_NS, tick_ns))) == list(range(0, 20 * SECOND_NS, period_ns))

    def test_where_ticks_do_not_fit_it_does_not_drift(self) -> None:
        # A timer restarted at each due tick would have a period of 102 ms and lose 11 of 600 in this minute.
        times = dues(10.0, list(range(0, 60 * SECOND_NS, 3_000_000)))
        assert len(times) == 600
        assert all(0 <= t_ns - 100_000_000 * number < 3_000_000 for number, t_ns in enumerate(times))

    @settings(max_examples=60)
    @given(st.sampled_from([1.0, 10.0, 50.0]), st.lists(st.integers(0, 3 * SECOND_NS), min_size=1, max_size=60))
    def test_it_is_due_once_for_each_period_in_which_it_is_asked(self, rate_hz: float, times: list[int]) -> None:
        period_ns = round(SECOND_NS / rate_hz)
        asked = sorted(times)
        firsts = {t_ns // period_ns: t_ns for t_ns in reversed(asked)}
        assert dues(rate_hz, asked) == sorted(firsts.values())

    def test_after_a_silence_it_is_due_once_and_catches_up_nothing(self) -> None:
        assert dues(10.0, [0, 10 * SECOND_NS, 10 * SECOND_NS + 1, 10 * SECOND_NS + 99_999_999]) == [0, 10 * SECOND_NS]

    def test_a_rate_above_the_ticks_is_due_at_each_tick(self) -> None:
        ticks = list(range(0, SECOND_NS, 4_000_000))
        assert dues(1000.0, ticks) == ticks
