"""LinkContract: what every transport must do. Inherit it as `class TestMyLink(LinkContract)` and give the `pair`."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence

import pytest

from bridge.links.link import Link
from bridge.timing.clock import MonotonicClock
from protocol.errors import LinkClosedError

PATIENCE_S = 10.0
"""How long a test waits for what must come: far longer than it takes, so that only a fault runs into it."""

LARGE_FRAME_BYTES = 280  # the longest MAVLink 2 frame, signature included
BURST = 100

Pair = tuple[Link, Link]


def receive(link: Link) -> bytes:
    """The next datagram or chunk."""
    data = link.recv(PATIENCE_S)
    assert data is not None, f"nothing came at {link.uri} within {PATIENCE_S} s"
    return data


def receive_all(link: Link, frames: Sequence[bytes]) -> None:
    """Receive just these frames: one by one where bounds are kept, as one run of bytes where they are not."""
    if link.is_datagram:
        assert [receive(link) for _ in frames] == list(frames)
        return
    expected = b"".join(frames)
    came = b""
    while len(came) < len(expected):
        came += receive(link)
    assert came == expected


@contextlib.contextmanager
def sending(link: Link, frames: Sequence[bytes]) -> Iterator[None]:
    """Send in another thread meanwhile: a stream may have room for a part only until the other end reads."""

    def send_each() -> None:
        for frame in frames:
            link.send(frame)

    thread = threading.Thread(target=send_each)
    thread.start()
    try:
        yield
    finally:
        thread.join(PATIENCE_S)
    assert not thread.is_alive()


class LinkContract:
    """The tests; `pair` gives two connected ends that have already heard of each other, and closes them."""

    @pytest.fixture
    def pair(self) -> Iterator[Pair]:
        raise NotImplementedError("a test class of a transport gives its own pair")

    def test_bytes_arrive_whole_and_in_order_both_ways(self, pair: Pair) -> None:
        frames = [b"\x00", bytes(range(256)), b"\r\n\x03\x04\x11\x13\x7f", b"last"]
        for sender, receiver in (pair, pair[::-1]):
            with sending(sender, frames):
                receive_all(receiver, frames)

    @pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
    def test_every_kind_of_bytes_can_be_sent(self, pair: Pair, kind: type) -> None:
        pair[0].send(kind(b"fling"))
        receive_all(pair[1], [b"fling"])

    def test_what_was_sent_may_be_changed_afterwards(self, pair: Pair) -> None:
        frame = bytearray(b"before")
        pair[0].send(frame)
        frame[:] = b"after!"
        receive_all(pair[1], [b"before"])

    def test_a_burst_of_large_frames_arrives(self, pair: Pair) -> None:
        frames = [bytes([i]) * LARGE_FRAME_BYTES for i in range(BURST)]
        with sending(pair[0], frames):
            receive_all(pair[1], frames)

    @pytest.mark.parametrize("timeout_s", [0.002, 0.05])
    def test_recv_waits_its_timeout_and_returns_none(self, pair: Pair, timeout_s: float) -> None:
        clock = MonotonicClock()
        for link in pair:
            started_ns = clock.now_ns()
            assert link.recv(timeout_s) is None
            assert (clock.now_ns() - started_ns) * 1e-9 >= 0.99 * timeout_s

    @pytest.mark.parametrize("timeout_s", [0, 0.0, 1e-7, -1.0])
    def test_recv_without_timeout_only_looks(self, pair: Pair, timeout_s: float) -> None:
        clock = MonotonicClock()
        polls = 1000
        started_ns = clock.now_ns()
        assert [pair[0].recv(timeout_s) for _ in range(polls)] == [None] * polls
        # One jiffy each would be 4 s or more at 250 Hz; a look takes microseconds.
        assert (clock.now_ns() - started_ns) * 1e-9 < 0.003 * polls

    def test_recv_without_timeout_finds_what_is_there(self, pair: Pair) -> None:
        pair[0].send(b"one")
        clock = MonotonicClock()
        deadline_ns = clock.now_ns() + int(PATIENCE_S * 1e9)
        came = b""
        while came != b"one" and clock.now_ns() < deadline_ns:
            came += pair[1].recv(0) or b""
        assert came == b"one"

    def test_recv_ends_its_wait_when_something_comes(self, pair: Pair) -> None:
        clock = MonotonicClock()
        timer = threading.Timer(0.03, pair[0].send, [b"late"])
        started_ns = clock.now_ns()
        timer.start()
        try:
            assert pair[1].recv(PATIENCE_S) is not None
        finally:
            timer.join()
        assert (clock.now_ns() - started_ns) * 1e-9 < PATIENCE_S

    def test_traffic_is_counted(self, pair: Pair) -> None:
        sender, receiver = pair
        sent_before, received_before = sender.stats.as_dict(), receiver.stats.as_dict()
        with sending(sender, [b"four", b"seven__"]):
            receive_all(receiver, [b"four", b"seven__"])
        sent = {name: count - sent_before[name] for name, count in sender.stats.as_dict().items()}
        received = {name: count - received_before[name] for name, count in receiver.stats.as_dict().items()}
        assert {name: count for name, count in sent.items() if count} == {"sent": 2, "sent_bytes": 11}
        chunks = received.pop("received")
        assert chunks == 2 if receiver.is_datagram else chunks in (1, 2)
        assert {name: count for name, count in received.items() if count} == {"received_bytes": 11}

    def test_nothing_received_is_not_counted(self, pair: Pair) -> None:
        before = pair[0].stats.as_dict()
        assert pair[0].recv(0) is None
        assert pair[0].stats.as_dict() == before

    def test_close_twice_is_close_once(self, pair: Pair) -> None:
        for link in pair:
            link.close()
            link.close()

    @pytest.mark.parametrize("end", [0, 1])
    def test_use_after_close_is_an_error_that_names_the_link(self, pair: Pair, end: int) -> None:
        link = pair[end]
        link.close()
        scheme = link.uri.partition("://")[0]
        for timeout_s in (0, 0.001, 0.02):
            with pytest.raises(LinkClosedError, match=scheme):
                link.recv(timeout_s)
        with pytest.raises(LinkClosedError, match=scheme):
            link.send(b"too late")

    @pytest.mark.parametrize("end", [0, 1])
    def test_close_by_another_thread_ends_a_wait(self, pair: Pair, end: int) -> None:
        outcome: list[object] = []

        def wait() -> None:
            try:
                outcome.append(pair[end].recv(0.1))
            except LinkClosedError as error:
                outcome.append(error)

        thread = threading.Thread(target=wait)
        thread.start()
        MonotonicClock().sleep_until_ns(MonotonicClock().now_ns() + 20_000_000)
        pair[end].close()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        assert outcome[0] is None or isinstance(outcome[0], LinkClosedError)

    def test_a_with_block_closes(self, pair: Pair) -> None:
        with pair[0] as link:
            assert link is pair[0]
        with pytest.raises(LinkClosedError):
            link.recv(0)

    def test_names_say_who_is_who(self, pair: Pair) -> None:
        for link in pair:
            assert "://" in link.uri
            assert link.peer
            assert "nobody" not in link.peer
