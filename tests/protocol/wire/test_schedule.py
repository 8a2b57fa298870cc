"""What is said when: rates, once, answers first, the order of the table, and the time until which nothing is due."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.due import NEVER
from protocol.wire.codec import layout
from protocol.wire.schedule import Saying, Schedule
from protocol.wire.streams import STREAMS, stream

MS = 1_000_000
NAMES = [row.message for row in STREAMS]
ANSWER = (layout("COMMAND_ACK"), b"\1")


def number_of(name: str) -> int:
    return layout(name).message_id


def encoder(name: str, t_ns: int) -> list[Saying]:
    return [(layout(name), t_ns.to_bytes(8, "little"))]


def schedule(*names: str, **rates_hz: float | None) -> Schedule:
    return Schedule({name: functools.partial(encoder, name) for name in names}, rates_hz)


def said(one: Schedule, t_ms: float) -> list[str]:
    """Names of what is said at a time; what its encoder made says that very time."""
    t_ns = round(t_ms * MS)
    sayings = one.due(t_ns)
    assert all(saying == ANSWER or saying[1] == t_ns.to_bytes(8, "little") for saying in sayings)
    return [message.name for message, _ in sayings]


def times(one: Schedule, name: str, until_ms: int, step_ms: int = 4) -> list[int]:
    return [t_ms for t_ms in range(0, until_ms, step_ms) if name in said(one, t_ms)]


class TestRates:
    def test_those_of_the_table_hold_by_default(self) -> None:
        one = schedule("HEARTBEAT", "HIL_GPS", "ODOMETRY")
        assert (stream("HEARTBEAT").rate_hz, stream("HIL_GPS").rate_hz) == (1.0, 10.0)
        heard = [(t_ms, said(one, t_ms)) for t_ms in range(0, 2001, 4)]
        assert [t_ms for t_ms, names in heard if "HIL_GPS" in names] == list(range(0, 2001, 100))
        assert [t_ms for t_ms, names in heard if "HEARTBEAT" in names] == [0, 1000, 2000]
        assert all("ODOMETRY" not in names for _, names in heard)

    def test_others_may_be_given(self) -> None:
        one = schedule("HEARTBEAT", "ODOMETRY", HEARTBEAT=None, ODOMETRY=50.0)
        assert times(one, "ODOMETRY", 100) == [0, 20, 40, 60, 80]
        assert one.default_hz == {number_of("HEARTBEAT"): None, number_of("ODOMETRY"): 50.0}
        assert said(one, 5_000) == ["ODOMETRY"]

    def test_one_that_is_set_holds_from_the_next_occasion_on(self) -> None:
        one = schedule("ODOMETRY")
        assert times(one, "ODOMETRY", 40) == []
        one.set_rate(number_of("ODOMETRY"), 125.0)
        assert times(one, "ODOMETRY", 40) == [0, 8, 16, 24, 32]
        one.set_rate(number_of("ODOMETRY"), 1.0)
        assert said(one, 44) == ["ODOMETRY"], "at once, whatever was said before"
        assert said(one, 48) == []

    @pytest.mark.parametrize("rate_hz", [None, 0.0])
    def test_none_ends_it(self, rate_hz: float | None) -> None:
        one = schedule("HEARTBEAT")
        one.set_rate(number_of("HEARTBEAT"), rate_hz)
        assert times(one, "HEARTBEAT", 4000, 100) == []
        assert one.next_ns == NEVER

    @pytest.mark.parametrize("call", [lambda one: one.set_rate(331, 1.0), lambda one: one.ask_once(331)])
    def test_what_is_not_said_here_cannot_be_asked_for(self, call: object) -> None:
        one = schedule("HEARTBEAT")
        with pytest.raises(KeyError, match="message 331 has no encoder here"):
            call(one)  # type: ignore[operator]
        assert said(one, 0) == ["HEARTBEAT"]

    def test_what_the_table_lacks_cannot_be_scheduled(self) -> None:
        with pytest.raises(ValueError, match="GPS_RAW_INT"):
            schedule("GPS_RAW_INT")


class TestOnce:
    def test_once_is_once_and_at_the_next_occasion(self) -> None:
        one = schedule("HEARTBEAT", "ODOMETRY")
        said(one, 0)
        one.ask_once(number_of("ODOMETRY"))
        one.ask_once(number_of("ODOMETRY"))
        assert [said(one, t_ms) for t_ms in (4, 8, 1000)] == [["ODOMETRY"], [], ["HEARTBEAT"]]

    def test_it_leaves_the_rate_as_it_is(self) -> None:
        one = schedule("HIL_GPS")
        said(one, 0)
        one.ask_once(number_of("HIL_GPS"))
        assert times(one, "HIL_GPS", 300) == [0, 100, 200]

    def test_what_is_due_and_asked_for_is_said_once(self) -> None:
        one = schedule("HIL_GPS")
        one.ask_once(number_of("HIL_GPS"))
        assert said(one, 0) == ["HIL_GPS"]

    def test_what_an_encoder_asks_for_while_it_is_at_work_comes_next(self) -> None:
        def busy(_t_ns: int) -> Iterable[Saying]:
            one.ask_once(number_of("HEARTBEAT"))
            return []

        one = Schedule({"HEARTBEAT": functools.partial(encoder, "HEARTBEAT"), "HIL_GPS": busy}, {"HEARTBEAT": None})
        assert [said(one, t_ms) for t_ms in (0, 4, 8)] == [[], ["HEARTBEAT"], []]


class TestAnswers:
    def test_they_come_first_in_the_order_they_were_given(self) -> None:
        one = schedule("HEARTBEAT")
        other = (layout("PARAM_VALUE"), bytes(8))
        one.answer(ANSWER, other)
        one.answer(ANSWER)
        assert one.due(0) == [ANSWER, other, ANSWER, *encoder("HEARTBEAT", 0)]
        assert one.due(4 * MS) == []

    def test_they_are_said_where_nothing_else_is_due(self) -> None:
        one = schedule("HEARTBEAT")
        said(one, 0)
        one.answer(ANSWER)
        assert one.next_ns <= 4 * MS
        assert said(one, 4) == ["COMMAND_ACK"]

    def test_they_can_be_taken_alone(self) -> None:
        one = schedule("HEARTBEAT")
        one.answer(ANSWER)
        assert one.answers() == [ANSWER]
        assert one.answers() == []
        assert said(one, 0) == ["HEARTBEAT"]


@given(st.permutations(NAMES))
@settings(max_examples=20)
def test_the_order_is_the_tables_however_the_encoders_are_given(names: list[str]) -> None:
    one = schedule(*names)
    for name in names:
        one.ask_once(number_of(name))
    assert said(one, 0) == NAMES


SOME = ("HEARTBEAT", "HIL_GPS", "ODOMETRY", "RAW_RPM")
_events = st.one_of(
    st.tuples(st.just("wait"), st.integers(0, 1_500 * MS)),
    st.tuples(st.just("once"), st.sampled_from(SOME)),
    st.tuples(st.just("rate"), st.sampled_from(SOME), st.sampled_from([None, 0.5, 10.0, 250.0])),
    st.tuples(st.just("answer")),
)


@given(st.lists(_events, max_size=40))
@settings(max_examples=200)
def test_nothing_is_due_before_next_ns_and_who_waits_for_it_misses_nothing(events: list[tuple[object, ...]]) -> None:
    """One schedule is asked all the time, its twin only from `next_ns` on, as the loop does: both say the same."""
    eager, lazy = schedule(*SOME), schedule(*SOME)
    t_ns = 0
    for event in [*events, ("wait", 0)]:
        if event[0] == "wait":
            assert isinstance(event[1], int)
            t_ns += event[1]
            eager.next_ns = 0  # so that it looks
            expected = eager.due(t_ns)
            if t_ns >= lazy.next_ns:
                assert lazy.due(t_ns) == expected
            else:
                assert expected == []
            assert lazy.next_ns > t_ns
        for one in (eager, lazy):
            if event[0] == "once":
                one.ask_once(number_of(str(event[1])))
            elif event[0] == "rate":
                one.set_rate(number_of(str(event[1])), event[2])  # type: ignore[arg-type]
            elif event[0] == "answer":
                one.answer(ANSWER)
