"""Open-loop probes on a virtual clock, where every delay is known."""

from __future__ import annotations

import heapq
from collections.abc import Callable

import pytest

from bridge.latency.probes import ProbeResult, probe
from bridge.links.link import Link
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from protocol.errors import Interrupted, LinkClosedError

US = 1_000
MS = 1_000_000
PERIOD_NS = 2 * MS


class Answering(Link):
    """A link on a virtual clock: `answers` gives what comes of question k, as (ns later, number).

    stamped: the kernel says when an answer came, whenever it is fetched. stall: before question k is sent, so much time goes
    by without anybody having a look.
    """

    is_datagram = True
    peer = "the script"

    def __init__(
        self,
        clock: VirtualClock,
        answers: Callable[[int], list[tuple[int, int]]],
        *,
        stamped: bool = True,
        stall: dict[int, int] | None = None,
    ) -> None:
        super().__init__("mem://answering")
        self._clock = clock
        self._answers = answers
        self._stamped = stamped
        self.stall = stall or {}
        self._coming: list[tuple[int, int]] = []
        self.sent_ns: list[int] = []

    def send(self, data: bytes | bytearray | memoryview) -> None:
        number = int.from_bytes(data, "little")
        self.sent_ns.append(self._clock.now_ns())
        for later_ns, answer in self._answers(number):
            heapq.heappush(self._coming, (self._clock.now_ns() + later_ns, answer))
        self._clock.advance_ns(self.stall.get(number, 0))

    def recv(self, timeout_s: float) -> bytes | None:
        until_ns = self._clock.now_ns() + max(100, round(timeout_s * 1e9))
        if not self._coming or self._coming[0][0] > until_ns:
            self._clock.sleep_until_ns(until_ns)
            return None
        came_ns, number = heapq.heappop(self._coming)
        self._clock.sleep_until_ns(came_ns)
        self.received_ns = came_ns if self._stamped else 0
        return number.to_bytes(8, "little")

    def close(self) -> None:
        pass


def ask(
    answers: Callable[[int], list[tuple[int, int]]], count: int = 20, **options: object
) -> tuple[ProbeResult, Answering, VirtualClock]:
    clock = VirtualClock(10**12)
    link = Answering(clock, answers, **options)  # type: ignore[arg-type]
    result = probe(
        link,
        clock,
        StopFlag(),
        period_ns=PERIOD_NS,
        count=count,
        question=lambda number: number.to_bytes(8, "little"),
        answered=lambda data: [int.from_bytes(data, "little")],
    )
    return result, link, clock


def test_every_answer_is_timed_from_its_question() -> None:
    result, link, _ = ask(lambda number: [((50 + number) * US, number)])
    assert result.from_sent_ns.tolist() == [(50 + number) * US for number in range(20)]
    late = result.from_due_ns - result.from_sent_ns
    assert late.min() >= 0
    assert late.max() <= 1 * US
    assert (result.lost, result.duplicates, result.out_of_order, result.unknown) == (0, 0, 0, 0)
    assert [
        round(gap / PERIOD_NS) for gap in (b - a for a, b in zip(link.sent_ns, link.sent_ns[1:], strict=False))
    ] == [1] * 19


def test_a_stall_of_the_sender_counts_for_all_questions_that_were_due_meanwhile() -> None:
    """Coordinated omission: 20 ms without a question are ten questions that came late, not one."""
    result, link, _ = ask(lambda number: [(50 * US, number)], 40, stall={5: 20 * MS})
    assert result.from_sent_ns.max() == 50 * US, "by when each left, nothing ever happened"
    late = sorted(result.from_due_ns.tolist(), reverse=True)
    # Question 6 was due 2 ms after 5 and left 20 ms after it; 7 two ms less late, and so on.
    assert late[:9] == pytest.approx([(18 - 2 * number) * MS + 50 * US for number in range(9)], abs=5 * US)
    assert late[9] < 100 * US
    assert len(link.sent_ns) == 40


def test_answers_that_are_slower_than_the_period_do_not_hold_up_the_questions() -> None:
    result, link, _ = ask(lambda number: [(15 * MS, number)])
    assert result.from_sent_ns.tolist() == [15 * MS] * 20
    assert link.sent_ns[-1] - link.sent_ns[0] == pytest.approx(19 * PERIOD_NS, abs=US)


def test_lost_ones_are_counted_and_waited_for_only_a_while() -> None:
    result, _, clock = ask(lambda number: [] if number % 5 == 0 else [(50 * US, number)])
    assert result.lost == 4
    assert result.from_due_ns[::5].tolist() == result.from_sent_ns[::5].tolist() == [-1] * 4
    assert (result.from_sent_ns[1::5] == 50 * US).all()
    assert clock.now_ns() - 10**12 == pytest.approx(21 * PERIOD_NS + 500 * MS, abs=2 * MS)


def test_without_losses_nobody_lingers() -> None:
    _, _, clock = ask(lambda number: [(50 * US, number)])
    assert clock.now_ns() - 10**12 < 21 * PERIOD_NS


def test_what_came_again_or_late_or_unasked_is_told_apart() -> None:
    def answers(number: int) -> list[tuple[int, int]]:
        return {
            3: [(50 * US, 3), (60 * US, 3)],
            5: [(PERIOD_NS + 100 * US, 5)],  # after the answer to 6
            8: [(50 * US, 8), (70 * US, 10**9), (80 * US, 15)],  # 15 was not asked yet
        }.get(number, [(50 * US, number)])

    result, _, _ = ask(answers)
    assert (result.lost, result.duplicates, result.out_of_order, result.unknown) == (0, 1, 1, 2)
    assert result.from_sent_ns[3] == 50 * US, "the first one counts"


def test_without_stamps_the_time_of_fetching_counts() -> None:
    assert ask(lambda number: [(50 * US, number)], stamped=False)[0].from_sent_ns.tolist() == [50 * US] * 20


def test_however_late_it_is_every_question_is_asked() -> None:
    result, link, _ = ask(lambda number: [(50 * US, number)], stall={17: 60_000 * MS})
    assert len(link.sent_ns) == 20
    assert result.lost == 0


def test_an_answer_stamped_before_its_question_is_not_a_lost_one() -> None:
    """The kernel stamps with the wall clock, which may be set meanwhile."""

    class SetBack(Answering):
        def recv(self, timeout_s: float) -> bytes | None:
            data = super().recv(timeout_s)
            self.received_ns -= 3_600_000 * MS
            return data

    clock = VirtualClock(10**16)
    result = probe(
        SetBack(clock, lambda number: [(50 * US, number)]), clock, StopFlag(), period_ns=PERIOD_NS, count=5,
        question=lambda number: number.to_bytes(8, "little"), answered=lambda data: [int.from_bytes(data, "little")],
    )  # fmt: skip
    assert result.lost == 0
    assert result.from_due_ns.tolist() == result.from_sent_ns.tolist() == [0] * 5


def test_no_question_is_no_result() -> None:
    result, link, _ = ask(lambda number: [], 0)
    assert len(result.from_due_ns) == result.lost == 0
    assert link.sent_ns == []


def test_a_stop_ends_it() -> None:
    stop = StopFlag()
    clock = VirtualClock(10**12)

    def question(number: int) -> bytes:
        stop.requested = number == 3
        return number.to_bytes(8, "little")

    with pytest.raises(Interrupted):
        probe(
            Answering(clock, lambda number: []), clock, stop, period_ns=PERIOD_NS, count=20, question=question,
            answered=lambda data: [],
        )  # fmt: skip


def test_a_link_that_closes_ends_it() -> None:
    class Closing(Answering):
        def recv(self, timeout_s: float) -> bytes | None:
            raise LinkClosedError("mem://answering is closed")

    clock = VirtualClock(10**12)
    with pytest.raises(LinkClosedError):
        probe(
            Closing(clock, lambda number: []), clock, StopFlag(), period_ns=PERIOD_NS, count=5,
            question=lambda number: b"", answered=lambda data: [],
        )  # fmt: skip


def test_progress_is_told() -> None:
    clock, told = VirtualClock(10**12), list[int]()
    probe(
        Answering(clock, lambda number: [(US, number)]), clock, StopFlag(), period_ns=PERIOD_NS, count=200,
        question=lambda number: number.to_bytes(8, "little"), answered=lambda data: [int.from_bytes(data, "little")],
        progress=told.append,
    )  # fmt: skip
    assert told == [64, 128, 192]
