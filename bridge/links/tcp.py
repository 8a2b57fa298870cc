"""TCP: TcpIn waits for one client, TcpOut connects to a server. Both send without delay (TCP_NODELAY)."""

from __future__ import annotations

import socket

from bridge.links.addresses import Address, cannot_bind, name_of, new_socket, resolve
from bridge.links.byte_stream import CHUNK_BYTES, SEND_TIMEOUT_S, StreamLink
from bridge.links.link import NOBODY, SHORTEST_WAIT_S, LinkUri, join_address
from protocol.errors import PeerMissingError

_RETRY_PERIOD_S = 0.05
_ATTEMPT_TIMEOUT_S = 1.0  # after an attempt without any response it tries again, in case the host has come up since


class _TcpLink(StreamLink):
    _connection: socket.socket | None = None

    def _adopt(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        self._connection = connection

    def _read(self) -> bytes:
        return self._connected().recv(CHUNK_BYTES)

    def _write(self, data: memoryview) -> int:
        return self._connected().send(data)

    def _fileno(self) -> int:
        return self._connected().fileno()

    def _connected(self) -> socket.socket:
        if self._connection is None:
            raise self._ended(None)
        return self._connection

    def _hang_up(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


class TcpOut(_TcpLink):
    """Connects to a server, which may start later: it retries until `connect_timeout_s` has passed.

    Raises PeerMissingError where no server has accepted by then, LinkError where the host cannot be resolved.
    """

    def __init__(
        self, uri: LinkUri, *, connect_timeout_s: float = 10.0, send_timeout_s: float = SEND_TIMEOUT_S
    ) -> None:
        """Connect, or raise."""
        super().__init__(uri.text, send_timeout_s=send_timeout_s)
        family, address = resolve(uri, socket.SOCK_STREAM)
        self._peer = name_of(address)
        deadline_ns = self._deadline_ns(connect_timeout_s)
        while True:
            attempt_s = min(max(self._remaining_s(deadline_ns), _RETRY_PERIOD_S), _ATTEMPT_TIMEOUT_S)
            connection = new_socket(uri, family, socket.SOCK_STREAM)
            reason = _failed_connect(connection, address, attempt_s)
            if reason is None:
                self._adopt(connection)
                return
            remaining_s = self._remaining_s(deadline_ns)
            if remaining_s <= 0:
                raise PeerMissingError(
                    f"{uri.text}: nothing answered at {self._peer} for {connect_timeout_s:g} s ({reason}): start the "
                    "server, or correct the address"
                )
            self._clock.sleep_until_ns(self._deadline_ns(min(_RETRY_PERIOD_S, remaining_s)))

    def close(self) -> None:
        """Close the connection."""
        self._closed = True
        self._hang_up()

    @property
    def peer(self) -> str:
        """The server as "host:port"."""
        return self._peer


def _failed_connect(connection: socket.socket, address: Address, timeout_s: float) -> str | None:
    """Connect within `timeout_s` and return None, or close the socket and return why not."""
    try:
        connection.settimeout(timeout_s)
        connection.connect(address)
        # Connecting to a free port of this machine may by chance use that same port as source, and so connect to itself.
        if connection.getsockname() != connection.getpeername():
            return None
        reason = "nobody listens"
    except OSError as error:
        reason = error.strerror or str(error)
    except BaseException:
        connection.close()
        raise
    connection.close()
    return reason


class TcpIn(_TcpLink):
    """Listens on a port for one client; others stay in the system's queue until `release_peer`.

    The client is accepted within `recv`: until then sends are dropped and counted. Once the client has closed, `recv`
    and `send` raise LinkClosedError until `release_peer`. `port` is the port it listens on, also where the URI gave 0.

    Raises LinkInUseError where the port is in use, LinkError where the address is not this machine's or not permitted.
    """

    def __init__(self, uri: LinkUri, *, connect_timeout_s: float = 0.0, send_timeout_s: float = SEND_TIMEOUT_S) -> None:
        """Listen; `connect_timeout_s` is ignored."""
        super().__init__(uri.text, send_timeout_s=send_timeout_s)
        family, address = resolve(uri, socket.SOCK_STREAM)
        self._peer = NOBODY
        self._listener = new_socket(uri, family, socket.SOCK_STREAM)
        try:
            # Lets a restart bind while old connections are in TIME_WAIT; a second listener still fails.
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.setblocking(False)
            self._listener.bind(address)
            self._listener.listen(1)
        except OSError as error:
            self.close()
            raise cannot_bind(uri, error) from error
        self.port: int = self._listener.getsockname()[1]
        self.uri = f"{uri.scheme}://{join_address(uri.host, self.port)}"

    def recv(self, timeout_s: float) -> bytes | None:
        """Accept a client if there is none, then return data from it, within `timeout_s` in total."""
        if self._connection is None:
            deadline_ns = self._deadline_ns(timeout_s)
            if not self._accept(deadline_ns):
                return None
            timeout_s = self._remaining_s(deadline_ns)
        return super().recv(timeout_s)

    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Send to the client; without one `data` is dropped and counted. See `Link.send`."""
        if self._connection is None:
            if self._closed:
                raise self._ended(None)
            self.stats.no_peer += 1
            return
        super().send(data)

    def _accept(self, deadline_ns: int) -> bool:
        while True:
            try:
                connection, address = self._listener.accept()
            except (BlockingIOError, ConnectionAbortedError):  # no client, or one that left before it was accepted
                remaining_s = self._remaining_s(deadline_ns)
                if remaining_s < SHORTEST_WAIT_S:
                    return False
                self._wait(remaining_s, readable=(self._listener.fileno(),))
            except OSError as error:
                raise self._broken(error) from error
            else:
                self._adopt(connection)
                self._peer = name_of(address)
                return True

    def release_peer(self) -> None:
        """Disconnect the client; the next `recv` accepts another."""
        self._hang_up()
        self._peer = NOBODY

    def close(self) -> None:
        """Disconnect the client and release the port."""
        self._closed = True
        self.release_peer()
        self._listener.close()

    @property
    def peer(self) -> str:
        """The client as "host:port", or NOBODY."""
        return self._peer
