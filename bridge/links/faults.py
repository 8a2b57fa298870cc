"""Fault injection on a link. A fault is injected on purpose; an error is not."""

from __future__ import annotations

from collections import deque

from bridge.links.link import Link
from bridge.links.wrapped_link import WrappedLink
from bridge.timing.clock import Clock
from protocol.errors import LinkClosedError

_SPIN_NS = 200_000
"""This last part of a delay is polled: a sleep could end this much too late and so add to the delay."""

_FETCHED_AT_ONCE = 1000
"""A bound, so that `recv` returns even where a peer floods the link."""


class DelayedLink(WrappedLink):
    """A link whose receiving end gets all data later by a fixed wall time, in order.

    The delay counts from the kernel's receive time where the link provides it, else from when the datagram was fetched.
    `stats` counts what the link itself received and sent; `received_ns` is the time of arrival, before the delay.
    """

    def __init__(self, link: Link, delay_ns: int, clock: Clock) -> None:
        super().__init__(link)
        self._clock = clock
        self._delay_ns = delay_ns
        self._held: deque[tuple[int, int, bytes]] = deque()
        self._ended_by: LinkClosedError | None = None

    def recv(self, timeout_s: float) -> bytes | None:
        """The next datagram whose delay has passed, or None; see `Link.recv`."""
        if timeout_s <= 0.0:
            return self._take_stock()
        give_up_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            if self._closed:
                raise LinkClosedError(f"{self.uri} is closed on this end")
            now_ns = self._clock.now_ns()
            if self._held and self._held[0][0] <= now_ns:
                _, self.received_ns, data = self._held.popleft()
                return data
            if self._ended_by and not self._held:
                raise self._ended_by
            due_ns = self._held[0][0] if self._held else give_up_ns + 1
            if self._ended_by:  # data that the link delivered before it closed is still delayed
                self._clock.sleep_until_ns(min(due_ns, give_up_ns))
            else:
                until_ns = due_ns - _SPIN_NS if due_ns <= give_up_ns else give_up_ns
                self._fetch(max(0, until_ns - now_ns) * 1e-9)
            if now_ns >= give_up_ns:
                return None

    def _take_stock(self) -> bytes | None:
        """Fetch all received data without waiting; return the first datagram that is due, or None."""
        if self._closed:
            raise LinkClosedError(f"{self.uri} is closed on this end")
        for _ in range(_FETCHED_AT_ONCE):
            if self._ended_by or not self._fetch(0.0):
                break
        if self._held and self._held[0][0] <= self._clock.now_ns():
            _, self.received_ns, data = self._held.popleft()
            return data
        if self._ended_by and not self._held:
            raise self._ended_by
        return None

    def _fetch(self, timeout_s: float) -> bool:
        """Fetch the link's next datagram into the delay queue; whether one was received."""
        try:
            data = self._link.recv(timeout_s)
        except LinkClosedError as error:
            self._ended_by = error
            return False
        if data is None:
            return False
        came_ns = self._link.received_ns or self._clock.now_ns()
        self._held.append((came_ns + self._delay_ns, self._link.received_ns, data))
        return True

    def release_peer(self) -> None:
        """As the link does; delayed data of the last peer, and its close, are discarded too."""
        self._held.clear()
        self._ended_by = None
        super().release_peer()
