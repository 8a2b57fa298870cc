"""The delayed link: the contract with a delay that passes, and the delay itself on a virtual clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.links.faults import DelayedLink
from bridge.links.link import Link, counterpart, open_link
from bridge.links.memory import memory_pair
from bridge.links.udp import UdpIn
from bridge.timing.clock import MonotonicClock, VirtualClock
from protocol.errors import LinkClosedError, LinkError
from tests.contracts.link_contract import LinkContract, Pair, receive

MS = 1_000_000
START_NS = 10**12
LOOK_NS = 2_000
"""What a look at a link takes."""


class Arrivals(Link):
    """A link on a virtual clock at which datagrams arrive at given times; time passes while one waits.

    stamped: the kernel's stamps are known. After the last arrival the link is closed by the other end, if `ends`.
    """

    is_datagram = True
    peer = "the script"

    def __init__(
        self, clock: VirtualClock, arrivals: list[tuple[int, bytes]], *, stamped: bool = False, ends: bool = False
    ) -> None:
        super().__init__("mem://arrivals")
        self._clock = clock
        self._coming = deque(arrivals)
        self._stamped = stamped
        self._ends = ends
        self.waits_s: list[float] = []

    def recv(self, timeout_s: float) -> bytes | None:
        self.waits_s.append(timeout_s)
        until_ns = self._clock.now_ns() + max(LOOK_NS, round(timeout_s * 1e9))
        if not self._coming and self._ends:
            raise LinkClosedError("mem://arrivals is closed by the other end")
        if not self._coming or self._coming[0][0] > until_ns:
            self._clock.sleep_until_ns(until_ns)
            return None
        came_ns, data = self._coming.popleft()
        self._clock.sleep_until_ns(came_ns)
        self.received_ns = came_ns if self._stamped else 0
        return data

    def send(self, data: bytes | bytearray | memoryview) -> None:
        self.stats.sent += 1

    def close(self) -> None:
        self._closed = True


class TestDelayedMemoryContract(LinkContract):
    @pytest.fixture
    def pair(self) -> Iterator[Pair]:
        near, far = memory_pair()
        clock = MonotonicClock()
        with DelayedLink(near, MS, clock) as delayed, DelayedLink(far, MS, clock) as other:
            yield delayed, other


class TestDelayedUdpContract(LinkContract):
    @pytest.fixture
    def pair(self) -> Iterator[Pair]:
        with open_link("udpin://127.0.0.1:0") as near:
            assert isinstance(near, UdpIn)
            with (
                DelayedLink(near, MS, MonotonicClock()) as delayed,
                open_link(f"udpout://127.0.0.1:{near.port}") as far,
            ):
                assert delayed.stamp_receives()
                far.send(b"hello")
                assert receive(delayed) == b"hello"
                yield far, delayed


@given(
    gaps_ns=st.lists(st.integers(0, 3 * MS), min_size=1, max_size=20),
    delay_ns=st.integers(1, 10 * MS),
    timeout_s=st.sampled_from([0.0, 0.0003, 0.002, 0.05]),
)
def test_each_comes_later_by_the_delay_and_in_its_order(gaps_ns: list[int], delay_ns: int, timeout_s: float) -> None:
    clock = VirtualClock(START_NS)
    arrivals, t_ns = [], START_NS
    for number, gap_ns in enumerate(gaps_ns):
        t_ns += gap_ns
        arrivals.append((t_ns, bytes([number])))
    delayed = DelayedLink(Arrivals(clock, arrivals, stamped=True), delay_ns, clock)
    came: list[bytes] = []
    while len(came) < len(arrivals):
        begun_ns = clock.now_ns()
        data = delayed.recv(timeout_s)
        if data is None:
            waited_ns = clock.now_ns() - begun_ns
            assert waited_ns >= round(timeout_s * 1e9)
            clock.advance_ns(50_000)  # what else the caller does
            continue
        came.append(data)
        arrived_ns = arrivals[data[0]][0]
        assert clock.now_ns() >= arrived_ns + delay_ns
        assert delayed.received_ns == arrived_ns, "the stamp is that of the arrival"
    assert came == [data for _, data in arrivals]


def test_one_that_is_waited_for_is_punctual() -> None:
    """The last of the delay is polled through, so that no sleep adds to it."""
    clock = VirtualClock(START_NS)
    delayed = DelayedLink(Arrivals(clock, [(START_NS + MS, b"x")]), 5 * MS, clock)
    assert delayed.recv(1.0) == b"x"
    assert 0 <= clock.now_ns() - (START_NS + 6 * MS) <= LOOK_NS


def test_nothing_is_polled_for_where_nothing_is_on_its_way() -> None:
    clock = VirtualClock(START_NS)
    link = Arrivals(clock, [])
    assert DelayedLink(link, 5 * MS, clock).recv(0.002) is None
    assert len(link.waits_s) <= 2
    assert clock.now_ns() == pytest.approx(START_NS + 2 * MS, abs=2 * LOOK_NS)


def test_one_that_is_due_too_late_does_not_hold_the_wait() -> None:
    clock = VirtualClock(START_NS)
    delayed = DelayedLink(Arrivals(clock, [(START_NS, b"x")]), 50 * MS, clock)
    assert delayed.recv(0.002) is None
    assert clock.now_ns() == pytest.approx(START_NS + 2 * MS, abs=2 * LOOK_NS)


def test_without_stamps_the_delay_counts_from_the_fetching() -> None:
    clock = VirtualClock(START_NS)
    delayed = DelayedLink(Arrivals(clock, [(START_NS - 9 * MS, b"x")]), 5 * MS, clock)
    assert delayed.recv(1.0) == b"x"
    assert 0 <= clock.now_ns() - (START_NS + 5 * MS) <= LOOK_NS
    assert delayed.received_ns == 0


def test_with_stamps_what_waited_longer_than_the_delay_comes_at_once() -> None:
    clock = VirtualClock(START_NS)
    delayed = DelayedLink(Arrivals(clock, [(START_NS - 9 * MS, b"x")], stamped=True), 5 * MS, clock)
    assert delayed.recv(1.0) == b"x"
    assert clock.now_ns() == START_NS


def test_an_empty_datagram_is_delayed_like_any_other() -> None:
    clock = VirtualClock(START_NS)
    delayed = DelayedLink(Arrivals(clock, [(START_NS, b""), (START_NS, b"x")]), MS, clock)
    assert [delayed.recv(1.0), delayed.recv(1.0)] == [b"", b"x"]


def test_what_was_on_its_way_when_the_other_end_closed_still_comes() -> None:
    clock = VirtualClock(START_NS)
    delayed = DelayedLink(Arrivals(clock, [(START_NS, b"last")], ends=True), 5 * MS, clock)
    assert delayed.recv(0.0) is None
    assert delayed.recv(0.001) is None, "a wait ends by its timeout here too"
    assert clock.now_ns() == pytest.approx(START_NS + MS, abs=2 * LOOK_NS)
    assert delayed.recv(1.0) == b"last"
    for _ in range(2):
        with pytest.raises(LinkClosedError, match="other end"):
            delayed.recv(0.0)


def test_a_close_of_this_end_loses_what_is_on_its_way() -> None:
    clock = VirtualClock(START_NS)
    delayed = DelayedLink(Arrivals(clock, [(START_NS, b"x")]), MS, clock)
    assert delayed.recv(0.0) is None
    delayed.close()
    clock.advance_ns(2 * MS)
    with pytest.raises(LinkClosedError, match="mem://arrivals is closed on this end"):
        delayed.recv(0.0)


def test_a_link_that_breaks_says_so() -> None:
    class Broken(Arrivals):
        def recv(self, timeout_s: float) -> bytes | None:
            raise LinkError("mem://arrivals broke")

    clock = VirtualClock(START_NS)
    with pytest.raises(LinkError, match="broke"):
        DelayedLink(Broken(clock, []), MS, clock).recv(0.0)


def test_sends_are_not_delayed_and_the_rest_is_the_links() -> None:
    near, far = memory_pair()
    with far, DelayedLink(near, 10**9, VirtualClock()) as delayed:
        delayed.send(b"now")
        assert far.recv(0) == b"now"
        assert (delayed.uri, delayed.peer, delayed.is_datagram) == (near.uri, near.peer, near.is_datagram)
        assert delayed.stats is near.stats
        assert not delayed.stamp_receives(), "memory has no kernel to stamp"
        delayed.spin_s = 0.5
        assert near.spin_s == delayed.spin_s == 0.5


def test_a_stream_keeps_its_bytes_and_their_order() -> None:
    with open_link("tcpin://127.0.0.1:0") as server, open_link(counterpart(server.uri)) as client:
        delayed = DelayedLink(server, 2 * MS, MonotonicClock())
        sent = [bytes([number]) * 300 for number in range(50)]
        for frame in sent:
            client.send(frame)
        came = b""
        while len(came) < 50 * 300:
            came += receive(delayed)
        assert came == b"".join(sent)
        client.send(b"last")
        client.close()
        assert receive(delayed) == b"last"
        with pytest.raises(LinkClosedError):
            while True:
                receive(delayed)


def test_the_next_peer_may_come() -> None:
    with open_link("udpin://127.0.0.1:0") as link:
        assert isinstance(link, UdpIn)
        delayed = DelayedLink(link, MS, MonotonicClock())
        for word in (b"first", b"second"):
            with open_link(f"udpout://127.0.0.1:{link.port}") as peer:
                peer.send(word)
                assert receive(delayed) == word
                delayed.release_peer()


def test_on_a_stream_the_next_peer_may_come_after_one_that_hung_up() -> None:
    with open_link("tcpin://127.0.0.1:0") as server:
        delayed = DelayedLink(server, MS, MonotonicClock())
        for word in (b"first", b"second"):
            with open_link(counterpart(server.uri)) as client:
                client.send(word)
                assert receive(delayed) == word
                client.send(b"never taken")
            with pytest.raises(LinkClosedError):
                for _ in range(3):
                    receive(delayed)
            delayed.release_peer()
