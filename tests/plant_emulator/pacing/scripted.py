"""The other end of a pacing's link as a script, in time that passes only while somebody waits."""

from __future__ import annotations

from collections.abc import Callable

from bridge.links.link import Link
from bridge.timing.clock import VirtualClock
from protocol.wire import mapping


class Scripted(Link):
    """A link on a virtual clock: `answers` says what comes 1 ms, 2 ms ... after each datagram sent; waiting takes time.

    sent, sent_ns   what was sent and when, but TIMESYNC, which is in questions and has no answer
    """

    is_datagram = True
    peer = "the script"

    def __init__(self, clock: VirtualClock, answers: Callable[[int], list[bytes]]) -> None:
        super().__init__("mem://script")
        self._clock = clock
        self._answers = answers
        self._coming: list[tuple[int, bytes]] = []
        self.sent: list[bytes] = []
        self.sent_ns: list[int] = []
        self.questions: list[bytes] = []

    def send(self, data: bytes | bytearray | memoryview) -> None:
        if data[7] == mapping.TIMESYNC.message_id:
            self.questions.append(bytes(data))
            return
        now_ns = self._clock.now_ns()
        for number, coming in enumerate(self._answers(len(self.sent)), 1):
            self._coming.append((now_ns + 1_000_000 * number, coming))
        self.sent.append(bytes(data))
        self.sent_ns.append(now_ns)

    def recv(self, timeout_s: float) -> bytes | None:
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if self._coming and self._coming[0][0] <= until_ns:
            self.received_ns, data = self._coming.pop(0)
            self._clock.sleep_until_ns(self.received_ns)
            return data
        self._clock.sleep_until_ns(until_ns)
        return None

    def close(self) -> None:
        pass
