"""Time sync (TIMESYNC): the offset of the other end's clock, and its error bound.

A request carries our time (ts1) and tc1 = 0; the response returns ts1 with the responder's time (tc1). The offset is
tc1 - (ts1 + arrival) / 2, with an error of at most half the round trip; the estimate uses the newest responses, and of these
the one with the shortest round trip. Clocks drift, so it holds for the time of that response; `answers` has them all.

Source: the MAVLink time synchronisation service (v2), of which the released dialect has only the fields tc1 and ts1: a
response is matched to its request by ts1.
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
"""Number of responses from which the best is chosen, and of requests whose responses are still awaited."""


class Estimate(NamedTuple):
    """offset_ns: the other clock minus ours; round_trip_ns: twice its error bound; answers: number of responses."""

    offset_ns: int
    round_trip_ns: int
    answers: int

    @property
    def error_ns(self) -> int:
        """The bound of the offset's error."""
        return (self.round_trip_ns + 1) // 2


class TimeSync:
    """Time sync at one end of a link: sends requests (a burst at the start, then one per second) and answers them.

    seal: makes a frame from a message and its payload.

    answers   for each response: our time half way between request and response, the offset, the round trip; ns
    """

    def __init__(self, seal: Callable[[Layout, bytes], bytes], clock: Clock) -> None:
        self._seal = seal
        self._clock = clock
        self._asked: deque[int] = deque(maxlen=_REMEMBERED)
        self.answers: list[tuple[int, int, int]] = []
        self._questions = 0
        self.next_ns = 0
        """When the next request is due, on the clock."""

    def question(self) -> bytes:
        """The frame of a request sent now."""
        now_ns = self._clock.now_ns()
        self._questions += 1
        self.next_ns = now_ns + (BURST_PERIOD_NS if self._questions < BURST else PERIOD_NS)
        self._asked.append(now_ns)
        return self._seal(mapping.TIMESYNC, mapping.encode_timesync(0, now_ns))

    def handle(self, frame: Frame, arrived_ns: int) -> bytes | None:
        """Handle a TIMESYNC received at arrived_ns (0: now); returns the response to a request, else None."""
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
        """The offset from the best of the newest responses; None without a response."""
        if not self.answers:
            return None
        _, offset_ns, round_trip_ns = min(self.answers[-_REMEMBERED:], key=lambda answer: answer[2])
        return Estimate(offset_ns, round_trip_ns, len(self.answers))
