"""TCP: the contract from both sides, and what is TCP's own: a late server, one client at a time, hanging up."""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from bridge.links import tcp
from bridge.links.byte_stream import StreamLink
from bridge.links.link import NOBODY, open_link, parse_link_uri
from bridge.links.tcp import TcpIn, TcpOut
from bridge.timing.clock import MonotonicClock
from protocol.errors import LinkClosedError, LinkError, LinkInUseError, PeerMissingError
from tests.contracts.link_contract import PATIENCE_S, LinkContract, Pair, receive, receive_all, sending


def open_in(host: str = "127.0.0.1") -> TcpIn:
    link = open_link(f"tcpin://{host}:0")
    assert isinstance(link, TcpIn)
    return link


def open_out(port: int, host: str = "127.0.0.1") -> TcpOut:
    link = open_link(f"tcpout://{host}:{port}", connect_timeout_s=PATIENCE_S)
    assert isinstance(link, TcpOut)
    return link


def introduce(client: TcpOut, server: TcpIn) -> None:
    client.send(b"hello")
    receive_all(server, [b"hello"])


@pytest.fixture
def server() -> Iterator[TcpIn]:
    with open_in() as link:
        yield link


@pytest.fixture
def client(server: TcpIn) -> Iterator[TcpOut]:
    with open_out(server.port) as link:
        yield link


@pytest.fixture
def free_port() -> int:
    """A port nobody listens at, and that no connection leaves from by chance: below those the system hands out."""
    for port in range(20000, 30000):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise AssertionError("no free port")


class TestTcpContract(LinkContract):
    @pytest.fixture
    def pair(self, client: TcpOut, server: TcpIn) -> Iterator[Pair]:
        introduce(client, server)
        yield client, server


def test_ipv6_works_like_ipv4() -> None:
    try:
        server = open_in("[::1]")
    except LinkError as error:
        pytest.skip(f"no IPv6 here: {error}")
    with server, open_out(server.port, "[::1]") as client:
        introduce(client, server)
        assert server.peer.startswith("[::1]:")


def test_both_ends_send_at_once(client: TcpOut, server: TcpIn) -> None:
    introduce(client, server)
    for link in (client, server):
        assert link._connected().getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_the_port_chosen_is_told(server: TcpIn) -> None:
    assert server.port > 0
    assert server.uri == f"tcpin://127.0.0.1:{server.port}"


def test_a_taken_port_is_found_out_when_opened(server: TcpIn) -> None:
    with pytest.raises(LinkInUseError, match=f"port {server.port} on 127.0.0.1 is taken.*--link"):
        open_link(f"tcpin://127.0.0.1:{server.port}")


def test_a_foreign_address_cannot_be_bound() -> None:
    with pytest.raises(LinkError, match=r"192\.0\.2\.1 is not an address of this machine"):
        open_link("tcpin://192.0.2.1:0")


def test_a_port_without_permission_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket.socket, "bind", refuse)  # for real only where the tests do not run as root
    with pytest.raises(LinkError, match=r"no permission for port 80 on 127\.0\.0\.1: choose a port of 1024 or more"):
        open_link("tcpin://127.0.0.1:80")


def test_no_server_is_a_missing_peer(free_port: int) -> None:
    clock = MonotonicClock()
    started_ns = clock.now_ns()
    with pytest.raises(PeerMissingError, match=f"127.0.0.1:{free_port} for 0.12 s .*refused.*: start the server"):
        open_link(f"tcpout://127.0.0.1:{free_port}", connect_timeout_s=0.12)
    assert (clock.now_ns() - started_ns) * 1e-9 >= 0.12


def test_a_server_that_starts_later_is_found(free_port: int) -> None:
    servers = []

    def start() -> None:
        servers.append(open_link(f"tcpin://127.0.0.1:{free_port}"))

    timer = threading.Timer(0.15, start)
    timer.start()
    try:
        with open_out(free_port) as client:
            client.send(b"at last")
            timer.join()
            receive_all(servers[0], [b"at last"])
    finally:
        timer.join()
        for server in servers:
            server.close()


def test_a_connection_to_itself_is_no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]

    def leave_from_that_port(*_: object) -> socket.socket:
        connection = socket.socket()
        connection.bind(("127.0.0.1", port))
        return connection

    monkeypatch.setattr(tcp, "new_socket", leave_from_that_port)
    with pytest.raises(PeerMissingError, match="nobody listens"):
        open_link(f"tcpout://127.0.0.1:{port}", connect_timeout_s=0)


def test_before_a_client_sends_are_dropped_and_recv_waits(server: TcpIn) -> None:
    clock = MonotonicClock()
    assert server.peer == NOBODY
    server.send(b"anyone?")
    assert (server.stats.no_peer, server.stats.sent) == (1, 0)
    started_ns = clock.now_ns()
    assert server.recv(0) is None
    assert server.recv(0.02) is None
    assert (clock.now_ns() - started_ns) * 1e-9 >= 0.0198


def test_the_timeout_holds_when_a_client_comes_and_says_nothing(server: TcpIn, client: TcpOut) -> None:
    clock = MonotonicClock()
    started_ns = clock.now_ns()
    assert server.recv(0.03) is None
    assert (clock.now_ns() - started_ns) * 1e-9 >= 0.0297
    assert server.peer == client.peer.replace(str(server.port), str(client._connected().getsockname()[1]))


def test_what_is_spent_on_accepting_is_not_waited_again(server: TcpIn, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []

    def record(_: StreamLink, timeout_s: float) -> None:
        waits.append(timeout_s)

    monkeypatch.setattr(StreamLink, "recv", record)
    clients: list[TcpOut] = []
    connected_s: list[float] = []

    def connect() -> None:
        connected_s.append(time.monotonic())
        clients.append(open_out(server.port))

    timer = threading.Timer(0.05, connect)
    timer.start()
    begun_s = time.monotonic()
    try:
        server.recv(PATIENCE_S)
    finally:
        timer.join()
        clients[0].close()
    assert waits[0] <= PATIENCE_S - (connected_s[0] - begun_s)


def test_a_second_client_waits_until_the_first_is_released(server: TcpIn, client: TcpOut) -> None:
    introduce(client, server)
    with open_out(server.port) as second:
        second.send(b"second")
        assert server.recv(0.02) is None
        first_peer = server.peer
        server.release_peer()
        assert server.peer == NOBODY
        receive_all(server, [b"second"])
        assert server.peer not in (NOBODY, first_peer)
        with pytest.raises(LinkClosedError, match="closed the link"):
            client.recv(PATIENCE_S)


def test_a_client_that_closes_ends_recv_after_its_last_bytes(server: TcpIn, client: TcpOut) -> None:
    introduce(client, server)
    client.send(b"bye")
    client.close()
    receive_all(server, [b"bye"])
    for _ in range(2):
        with pytest.raises(LinkClosedError, match=f"{server.uri}: 127.0.0.1:.* closed the link"):
            server.recv(PATIENCE_S)
    server.release_peer()
    assert server.recv(0) is None
    with open_out(server.port) as another:
        introduce(another, server)


def test_a_server_that_closes_ends_recv_and_send(server: TcpIn, client: TcpOut) -> None:
    introduce(client, server)
    server.close()
    with pytest.raises(LinkClosedError, match=f"{client.uri}: {client.peer} closed the link"):
        client.recv(PATIENCE_S)

    def send_on() -> None:  # the first may still be taken: the answer that nobody is there comes back a moment later
        for _ in range(100):
            client.send(b"hello?")

    with pytest.raises(LinkClosedError, match="closed the link"):
        send_on()
    assert client.stats.send_failed == 1


def test_a_peer_that_does_not_read_is_an_error_in_bounded_time(server: TcpIn) -> None:
    with TcpOut(parse_link_uri(f"tcpout://127.0.0.1:{server.port}"), send_timeout_s=0.05) as client:
        with pytest.raises(LinkError, match=r"took \d+ of 50000000 bytes in 0.05 s: check that the other end reads"):
            client.send(bytes(50_000_000))
        assert (client.stats.sent, client.stats.send_failed) == (0, 1)


def test_more_than_the_buffers_hold_is_sent_as_the_peer_reads(server: TcpIn, client: TcpOut) -> None:
    introduce(client, server)
    much = bytes(range(256)) * 8_000
    with sending(client, [much]):
        receive_all(server, [much])


def test_data_that_is_there_is_returned_at_once(server: TcpIn, client: TcpOut) -> None:
    introduce(client, server)
    server.send(b"x")
    assert receive(client) == b"x"
