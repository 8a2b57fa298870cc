"""TIMESYNC on virtual clocks: what an answer tells, and which answers are believed."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from bridge.timing.clock import VirtualClock
from bridge.timing.timesync import BURST, BURST_PERIOD_NS, PERIOD_NS, Estimate, TimeSync
from protocol.messages import VEHICLE
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader

MS = 1_000_000
START_NS = 10**12


@pytest.fixture
def endpoint() -> Iterator[Endpoint]:
    near, far = memory_pair()
    with near, far:
        yield Endpoint(near, *VEHICLE)


def read(raw: bytes) -> Frame:
    (frame,) = FrameReader(is_datagram=True).read(raw)
    return frame


def times_in(raw: bytes) -> tuple[int, int]:
    """(tc1, ts1) of a frame."""
    frame = read(raw)
    assert frame.message_id == mapping.TIMESYNC.message_id
    return mapping.decode_timesync(frame.payload)


def answer(endpoint: Endpoint, answer_ns: int, asked_ns: int) -> Frame:
    return read(endpoint.seal(mapping.TIMESYNC, mapping.encode_timesync(answer_ns, asked_ns)))


def test_a_question_holds_our_time_and_nothing_else(endpoint: Endpoint) -> None:
    assert times_in(TimeSync(endpoint.seal, VirtualClock(START_NS)).question()) == (0, START_NS)


def test_a_question_is_answered_with_its_own_time_beside_ours(endpoint: Endpoint) -> None:
    clock = VirtualClock(START_NS)
    reply = TimeSync(endpoint.seal, clock).handle(answer(endpoint, 0, 77), START_NS)
    assert reply is not None
    assert times_in(reply) == (START_NS, 77)


def test_nobody_answered_is_no_estimate(endpoint: Endpoint) -> None:
    sync = TimeSync(endpoint.seal, VirtualClock(START_NS))
    sync.question()
    assert sync.estimate is None


@given(
    offset_ns=st.integers(-(10**17), 10**17),
    there_ns=st.integers(0, 10**9),
    back_ns=st.integers(0, 10**9),
)
def test_the_offset_is_wrong_by_no_more_than_its_bound(offset_ns: int, there_ns: int, back_ns: int) -> None:
    """However the round trip divides into there and back, and it is exact where they are equal."""
    near, far = memory_pair()
    with near, far:
        endpoint = Endpoint(near, *VEHICLE)
        clock = VirtualClock(2 * 10**17)
        sync = TimeSync(endpoint.seal, clock)
        asked_ns = clock.now_ns()
        sync.question()
        said = answer(endpoint, asked_ns + there_ns + offset_ns, asked_ns)
        assert sync.handle(said, asked_ns + there_ns + back_ns) is None
        found = sync.estimate
    assert found is not None
    assert found.round_trip_ns == there_ns + back_ns
    assert abs(found.offset_ns - offset_ns) <= found.error_ns
    assert found.answers == 1
    if there_ns == back_ns:
        assert found.offset_ns == offset_ns


def test_the_quickest_answer_is_believed(endpoint: Endpoint) -> None:
    clock = VirtualClock(START_NS)
    sync = TimeSync(endpoint.seal, clock)
    for late_ns in (5 * MS, 1 * MS, 9 * MS):  # all of it on the way back: the offset seems off by half of it
        asked_ns = clock.now_ns()
        sync.question()
        clock.advance_ns(late_ns)
        sync.handle(answer(endpoint, asked_ns + 1000, asked_ns), clock.now_ns())
    assert sync.estimate == Estimate(1000 - MS // 2, MS, 3)


def test_an_old_quick_answer_does_not_stand_for_ever(endpoint: Endpoint) -> None:
    """Clocks drift: after 16 newer answers the quickest of those counts."""
    clock = VirtualClock(START_NS)
    sync = TimeSync(endpoint.seal, clock)
    for round_trip_ns in (2, *[MS] * 16):
        asked_ns = clock.now_ns()
        sync.question()
        clock.advance_ns(round_trip_ns)
        sync.handle(answer(endpoint, asked_ns + round_trip_ns // 2, asked_ns), clock.now_ns())
    assert sync.estimate == Estimate(0, MS, 17)


def test_an_answer_counts_once_and_only_to_a_question_of_ours(endpoint: Endpoint) -> None:
    clock = VirtualClock(START_NS)
    sync = TimeSync(endpoint.seal, clock)
    sync.question()
    clock.advance_ns(MS)
    assert sync.handle(answer(endpoint, 5, START_NS + 1), clock.now_ns()) is None, "never asked"
    assert sync.estimate is None
    for tc1 in (START_NS, START_NS + 999):
        sync.handle(answer(endpoint, tc1, START_NS), clock.now_ns())
    assert sync.estimate == Estimate(-MS // 2, MS, 1), "the second was said again"


def test_an_answer_from_before_its_question_is_not_believed(endpoint: Endpoint) -> None:
    """A kernel stamp may be off where the wall clock was set meanwhile."""
    sync = TimeSync(endpoint.seal, VirtualClock(START_NS))
    sync.question()
    sync.handle(answer(endpoint, START_NS, START_NS), START_NS - 1)
    assert sync.estimate is None


def test_another_clock_may_run_before_zero(endpoint: Endpoint) -> None:
    sync = TimeSync(endpoint.seal, VirtualClock(START_NS))
    sync.question()
    sync.handle(answer(endpoint, -5, START_NS), START_NS)
    assert sync.estimate == Estimate(-5 - START_NS, 0, 1)


def test_it_asks_in_a_burst_and_then_once_a_second(endpoint: Endpoint) -> None:
    clock = VirtualClock(START_NS)
    sync = TimeSync(endpoint.seal, clock)
    assert sync.next_ns <= clock.now_ns(), "the first at once"
    gaps = []
    for _ in range(BURST + 3):
        sync.question()
        gaps.append(sync.next_ns - clock.now_ns())
        clock.sleep_until_ns(sync.next_ns)
    assert gaps == [BURST_PERIOD_NS] * (BURST - 1) + [PERIOD_NS] * 4
