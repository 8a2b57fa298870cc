"""TIMESYNC: how far the other end's clock is ahead of ours, and how sure that is.

A question carries our time (ts1) and tc1 = 0; the answer gives ts1 back beside the answerer's time (tc1). The offset is
tc1 - (ts1 + arrival) / 2, wrong by half the round trip at most; of the newest answers the one with the shortest round trip
is believed. Clocks drift, so that holds for the time of the answer: who needs other times has all answers.

Source: the MAVLink time synchronisation service (v2), of which the released dialect has the fields tc1 and ts1 only: whose
question an answer belongs to is told by its ts1.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from bridge.timing.clock import Clock
from protocol.wire import mapping
from protocol.wire.codec import Frame, Layout

BURST = 10
BURST_PERIOD_NS = 50_000_000
PERIOD_NS = 1_000_000_000
_REMEMBERED = 16
"""Answers among which the best is chosen, and questions whose answers are still awaited."""


class Estimate(NamedTuple):
    """offset_ns: the other clock less ours, then; round_trip_ns: twice the bound of its error; answers: how many came."""

    offset_ns: int
    round_trip_ns: int
    answers: int

    @property
    def error_ns(self) -> int:
        """The bound of the offset's error."""
        return (self.round_trip_ns + 1) // 2


class TimeSync:
    """Asks and answers at one end of a link: a burst at the start, then once a second.

    seal: makes a frame of a message and its payload.

    answers   of each that came: our time half way between question and answer, the offset then, the round trip; ns
    """

    def __init__(self, seal: Callable[[Layout, bytes], bytes], clock: Clock) -> None:
        self._seal = seal
        self._clock = clock
        self._asked: deque[int] = deque(maxlen=_REMEMBERED)
        self.answers: list[tuple[int, int, int]] = []
        self._questions = 0
        self.next_ns = 0
        """When the next question is due, on the clock."""

    def question(self) -> bytes:
        """The frame of a question asked now."""
        now_ns = self._clock.now_ns()
        self._questions += 1
        self.next_ns = now_ns + (BURST_PERIOD_NS if self._questions < BURST else PERIOD_NS)
        self._asked.append(now_ns)
        return self._seal(mapping.TIMESYNC, mapping.encode_timesync(0, now_ns))

    def handle(self, frame: Frame, arrived_ns: int) -> bytes | None:
        """Take a TIMESYNC that came at arrived_ns (0: now); the frame to answer a question with, else None."""
        arrived_ns = arrived_ns or self._clock.now_ns()
        answer_ns, asked_ns = mapping.decode_timesync(frame.payload)
        if answer_ns == 0:
            payload = mapping.encode_timesync(self._clock.now_ns(), asked_ns)
            return self._seal(mapping.TIMESYNC, payload)
        if asked_ns in self._asked and arrived_ns >= asked_ns:
            self._asked.remove(asked_ns)
            middle_ns = (asked_ns + arrived_ns) // 2
            self.answers.append((middle_ns, answer_ns - middle_ns, arrived_ns - asked_ns))
        return None

    @property
    def estimate(self) -> Estimate | None:
        """The offset by the best of the newest answers; None where none came yet."""
        if not self.answers:
            return None
        _, offset_ns, round_trip_ns = min(self.answers[-_REMEMBERED:], key=lambda answer: answer[2])
        return Estimate(offset_ns, round_trip_ns, len(self.answers))
