"""UDP: the contract, and what is UDP's own: learning the peer, strangers, nobody there, signals."""

from __future__ import annotations

import select
import signal
import socket
import sys
from collections.abc import Callable, Iterator

import pytest

from bridge.links.link import NOBODY, Link, open_link
from bridge.links.udp import UdpIn, UdpOut
from bridge.timing.clock import MonotonicClock
from protocol.errors import LinkClosedError, LinkError, LinkInUseError
from tests.contracts.link_contract import PATIENCE_S, LinkContract, Pair, receive


def open_in(host: str = "127.0.0.1") -> UdpIn:
    link = open_link(f"udpin://{host}:0")
    assert isinstance(link, UdpIn)
    return link


def open_out(port: int, host: str = "127.0.0.1") -> UdpOut:
    link = open_link(f"udpout://{host}:{port}")
    assert isinstance(link, UdpOut)
    return link


def introduce(out_end: UdpOut, in_end: UdpIn) -> None:
    out_end.send(b"hello")
    assert receive(in_end) == b"hello"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for_answer(link: UdpOut) -> None:
    """Return when the system knows that nobody is there (ICMP), which on loopback is at once unless it is busy."""
    assert select.select([link._socket], [], [], PATIENCE_S)[0]


@pytest.fixture
def in_end() -> Iterator[UdpIn]:
    with open_in() as link:
        yield link


@pytest.fixture
def out_end(in_end: UdpIn) -> Iterator[UdpOut]:
    with open_out(in_end.port) as link:
        yield link


class TestUdpContract(LinkContract):
    @pytest.fixture
    def pair(self, in_end: UdpIn, out_end: UdpOut) -> Iterator[Pair]:
        introduce(out_end, in_end)
        yield out_end, in_end


def test_ipv6_works_like_ipv4() -> None:
    try:
        in_end = open_in("[::1]")
    except LinkError as error:
        pytest.skip(f"no IPv6 here: {error}")
    with in_end, open_out(in_end.port, "[::1]") as out_end:
        introduce(out_end, in_end)
        in_end.send(b"answer")
        assert receive(out_end) == b"answer"
        assert in_end.peer.startswith("[::1]:")


def test_a_host_with_both_addresses_is_ipv4(in_end: UdpIn, monkeypatch: pytest.MonkeyPatch) -> None:
    def both(_: str, port: int, **__: object) -> list[tuple[object, ...]]:
        kind = socket.SOCK_DGRAM
        return [
            (socket.AF_INET6, kind, 17, "", ("::1", port, 0, 0)),
            (socket.AF_INET, kind, 17, "", ("127.0.0.1", port)),
        ]

    monkeypatch.setattr(socket, "getaddrinfo", both)
    with open_out(in_end.port, "localhost") as out_end:
        assert out_end.peer == f"127.0.0.1:{in_end.port}"


def test_the_port_chosen_is_told(in_end: UdpIn) -> None:
    assert in_end.port > 0
    assert in_end.uri == f"udpin://127.0.0.1:{in_end.port}"


def test_an_empty_datagram_is_a_datagram(in_end: UdpIn, out_end: UdpOut) -> None:
    out_end.send(b"")
    assert receive(in_end) == b""


def test_the_largest_datagram_arrives_and_a_larger_one_is_dropped_whole(in_end: UdpIn, out_end: UdpOut) -> None:
    largest = bytes(65507)
    out_end.send(largest + b"x")
    assert out_end.stats.send_failed == 1
    assert in_end.recv(0) is None
    out_end.send(largest)
    assert receive(in_end) == largest


def test_the_buffer_granted_is_told(in_end: UdpIn, out_end: UdpOut) -> None:
    assert in_end.receive_buffer_bytes > 0
    assert out_end.receive_buffer_bytes > 0


def test_a_taken_port_is_found_out(in_end: UdpIn) -> None:
    with pytest.raises(LinkInUseError, match=f"port {in_end.port} on 127.0.0.1 is taken.*--link"):
        open_link(f"udpin://127.0.0.1:{in_end.port}")


def test_a_foreign_address_cannot_be_bound() -> None:
    with pytest.raises(LinkError, match=r"udpin://192\.0\.2\.1:0: 192\.0\.2\.1 is not an address of this machine"):
        open_link("udpin://192.0.2.1:0")


@pytest.mark.parametrize("refusal", [socket.gaierror(-2, "Name or service not known"), UnicodeError("label empty")])
def test_an_unknown_host_is_named(monkeypatch: pytest.MonkeyPatch, refusal: Exception) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise refusal

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    with pytest.raises(LinkError, match="udpout://nowhere:1: cannot resolve host 'nowhere'"):
        open_link("udpout://nowhere:1")


def test_an_address_that_udp_may_not_use_is_an_error() -> None:
    with pytest.raises(LinkError, match=r"udpout://255\.255\.255\.255:9: cannot reach"):  # broadcast, not asked for
        open_link("udpout://255.255.255.255:9")


def test_without_a_peer_a_send_is_dropped_and_counted(in_end: UdpIn) -> None:
    assert in_end.peer == NOBODY
    in_end.send(b"anyone?")
    assert in_end.stats.as_dict() | {"no_peer": 0} == dict.fromkeys(in_end.stats.as_dict(), 0)
    assert in_end.stats.no_peer == 1


def test_strangers_are_dropped_and_counted_until_the_peer_is_released(in_end: UdpIn, out_end: UdpOut) -> None:
    introduce(out_end, in_end)
    with open_out(in_end.port) as stranger:
        for _ in range(3):
            stranger.send(b"let me in")
        out_end.send(b"mine")
        assert receive(in_end) == b"mine"
        assert in_end.stats.unknown_peer == 3
        assert in_end.stats.received == 2

        first_peer = in_end.peer
        in_end.release_peer()
        assert in_end.peer == NOBODY
        stranger.send(b"now me")
        assert receive(in_end) == b"now me"
        assert in_end.peer != first_peer
        in_end.send(b"welcome")
        assert receive(stranger) == b"welcome"
        assert out_end.recv(0) is None


@pytest.mark.parametrize("timeout_s", [0, 0.002, 0.02])
def test_strangers_do_not_end_the_wait(in_end: UdpIn, out_end: UdpOut, timeout_s: float) -> None:
    clock = MonotonicClock()
    introduce(out_end, in_end)
    with open_out(in_end.port) as stranger:
        stranger.send(b"noise")
        started_ns = clock.now_ns()
        assert in_end.recv(timeout_s) is None
        assert (clock.now_ns() - started_ns) * 1e-9 >= 0.99 * timeout_s
        stranger.send(b"noise")
        out_end.send(b"signal")
        assert in_end.recv(PATIENCE_S) == b"signal"


def test_a_stranger_does_not_hide_the_peer_from_one_look(in_end: UdpIn, monkeypatch: pytest.MonkeyPatch) -> None:
    queue = iter([None, None, b"signal"])
    monkeypatch.setattr(in_end, "_take", lambda _: next(queue))
    assert in_end.recv(0) == b"signal"


def test_a_flood_of_strangers_cannot_hold_recv(in_end: UdpIn, out_end: UdpOut, monkeypatch: pytest.MonkeyPatch) -> None:
    introduce(out_end, in_end)

    def endless(_: int) -> None:
        in_end.stats.unknown_peer += 1

    monkeypatch.setattr(in_end, "_take", endless)
    assert in_end.recv(0) is None
    assert in_end.recv(0.01) is None
    assert in_end.stats.unknown_peer > 2000


def test_nobody_there_is_counted_once_a_datagram(out_end: UdpOut, in_end: UdpIn) -> None:
    in_end.close()
    clock = MonotonicClock()
    out_end.send(b"anyone?")
    wait_for_answer(out_end)
    started_ns = clock.now_ns()
    assert out_end.recv(0.03) is None
    assert (clock.now_ns() - started_ns) * 1e-9 >= 0.0297
    assert out_end.stats.refused == 1
    out_end.send(b"anyone?")
    wait_for_answer(out_end)
    out_end.send(b"anyone now?")
    assert (out_end.stats.sent, out_end.stats.send_failed) == (2, 1)
    assert out_end.recv(0) is None
    assert out_end.stats.refused == 1


def test_a_refusal_does_not_hide_a_datagram_from_one_look(out_end: UdpOut, monkeypatch: pytest.MonkeyPatch) -> None:
    class RefusedOnce:
        answers: Iterator[Exception | bytes] = iter([ConnectionRefusedError(), b"signal"])

        def recv(self, *_: object) -> bytes:
            answer = next(self.answers)
            if isinstance(answer, Exception):
                raise answer
            return answer

    with monkeypatch.context() as patch:
        patch.setattr(out_end, "_socket", RefusedOnce())
        assert out_end.recv(0) == b"signal"
    assert out_end.stats.refused == 1


def test_a_peer_that_starts_late_is_reached() -> None:
    port = free_port()
    with open_out(port) as out_end:
        out_end.send(b"too early")
        wait_for_answer(out_end)
        assert out_end.recv(0) is None
        with open_link(f"udpin://127.0.0.1:{port}") as in_end:
            out_end.send(b"again")
            assert receive(in_end) == b"again"


def test_a_full_buffer_drops_and_counts(out_end: UdpOut, monkeypatch: pytest.MonkeyPatch) -> None:
    class FullSocket:
        def send(self, *_: object) -> int:
            raise BlockingIOError

    whole = out_end._socket
    with monkeypatch.context() as patch:
        patch.setattr(out_end, "_socket", FullSocket())
        out_end.send(b"no room")
    assert out_end._socket is whole
    assert (out_end.stats.sent, out_end.stats.send_failed) == (0, 1)


def test_a_broken_link_says_so(out_end: UdpOut, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_down(_: int) -> bytes:
        raise OSError(100, "Network is down")

    monkeypatch.setattr(out_end, "_take", break_down)
    with pytest.raises(LinkError, match=r"udpout://.* broke: .*Network is down") as caught:
        out_end.recv(0)
    assert not isinstance(caught.value, LinkClosedError)


@pytest.fixture
def set_timer() -> Iterator[Callable[[float, float], list[int]]]:
    """Start SIGALRM after a delay, then at an interval; the list grows by one each time."""
    fired: list[int] = []
    previous = signal.signal(signal.SIGALRM, lambda *_: fired.append(len(fired)))

    def start(delay_s: float, interval_s: float) -> list[int]:
        signal.setitimer(signal.ITIMER_REAL, delay_s, interval_s)
        return fired

    yield start
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, previous)


@pytest.mark.parametrize("interval_s", [0.0, 0.03])
def test_a_signal_handler_runs_and_the_wait_still_ends(
    out_end: UdpOut, set_timer: Callable[[float, float], list[int]], interval_s: float
) -> None:
    clock = MonotonicClock()
    fired = set_timer(0.004, interval_s)
    started_ns = clock.now_ns()
    assert out_end.recv(0.1) is None
    assert (clock.now_ns() - started_ns) * 1e-9 >= 0.099
    assert fired


def test_a_signal_handler_that_raises_ends_the_wait(out_end: UdpOut) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGALRM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, 0.01)
            out_end.recv(10.0)
    finally:
        signal.signal(signal.SIGALRM, previous)


def begin_stamps(sender: Link, receiver: Link) -> None:
    """Ask for stamps, and wait until they come: the kernel turns them on a moment after it was asked to."""
    assert receiver.stamp_receives()
    clock = MonotonicClock()
    for _ in range(200):
        sender.send(b"stamped?")
        clock.sleep_until_ns(clock.now_ns() + 20_000_000)
        before_ns = clock.now_ns()
        assert receive(receiver) == b"stamped?"
        if receiver.received_ns < before_ns:
            return
    pytest.fail("each stamp was made when the datagram was fetched")


class TestStamps:
    @pytest.mark.skipif(sys.platform != "linux", reason="NOT TESTED: kernel receive stamps are asked for on Linux only")
    @pytest.mark.parametrize("spin_s", [0.0, 0.05], ids=["sleeping", "polling"])
    def test_the_kernel_says_when_a_datagram_came_however_late_it_is_fetched(
        self, in_end: UdpIn, out_end: UdpOut, spin_s: float
    ) -> None:
        clock = MonotonicClock()
        introduce(out_end, in_end)
        for sender, receiver in ((out_end, in_end), (in_end, out_end)):
            begin_stamps(sender, receiver)
            receiver.spin_s = spin_s
            before_ns = clock.now_ns()
            sender.send(b"early")
            sent_ns = clock.now_ns()
            clock.sleep_until_ns(sent_ns + 30_000_000)
            assert receive(receiver) == b"early"
            # Generous: the two clocks are read one after the other, and on loopback to send is to receive.
            assert before_ns - 100_000 <= receiver.received_ns <= sent_ns + 5_000_000

    def test_without_being_asked_for_they_are_unknown(self, in_end: UdpIn, out_end: UdpOut) -> None:
        introduce(out_end, in_end)
        assert in_end.received_ns == 0

    @pytest.mark.skipif(sys.platform != "linux", reason="NOT TESTED: kernel receive stamps are asked for on Linux only")
    def test_strangers_are_dropped_and_their_stamps_with_them(self, in_end: UdpIn, out_end: UdpOut) -> None:
        introduce(out_end, in_end)
        begin_stamps(out_end, in_end)
        with open_out(in_end.port) as stranger:
            out_end.send(b"mine")
            clock = MonotonicClock()
            after_ns = clock.now_ns()
            clock.sleep_until_ns(after_ns + 20_000_000)
            stranger.send(b"noise")
            assert receive(in_end) == b"mine"
            assert in_end.received_ns <= after_ns + 10_000_000
            assert in_end.recv(0.002) is None
            assert in_end.stats.unknown_peer == 1

    def test_nobody_there_is_counted_with_stamps_too(self, in_end: UdpIn, out_end: UdpOut) -> None:
        out_end.stamp_receives()
        in_end.close()
        out_end.send(b"anyone?")
        wait_for_answer(out_end)
        assert out_end.recv(0) is None
        assert out_end.stats.refused == 1

    def test_a_system_that_refuses_them_is_no_error(self, out_end: UdpOut, monkeypatch: pytest.MonkeyPatch) -> None:
        class Refusing:
            def setsockopt(self, *_: object) -> None:
                raise OSError(92, "Protocol not available")

        with monkeypatch.context() as patch:
            patch.setattr(out_end, "_socket", Refusing())
            assert not out_end.stamp_receives()

    def test_elsewhere_they_are_not_asked_for(self, out_end: UdpOut, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sys, "platform", "darwin")
        assert not out_end.stamp_receives()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says what it dropped")
def test_what_the_system_dropped_is_known() -> None:
    with open_link("udpin://127.0.0.1:0") as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        assert link.dropped_by_system() == 0
        address = ("127.0.0.1", int(link.uri.rpartition(":")[2]))
        sent = 2000
        for _ in range(sent):
            sender.sendto(bytes(4000), address)
        dropped = link.dropped_by_system()
        received = sum(1 for _ in iter(lambda: link.recv(0.0), None))
        assert received + dropped == sent
        assert dropped > 0
    assert link.dropped_by_system() == 0  # closed
