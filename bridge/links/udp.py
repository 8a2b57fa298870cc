"""UDP: UdpIn listens on a port and replies to the first sender; UdpOut sends to one address.

Waiting. A round trip inside one machine takes some ten microseconds, so each system call counts. A timeout of 8 ms or
more first blocks in the receive itself (one call), with a kernel timeout (SO_RCVTIMEO) set once, when the link is opened.
That timeout counts in jiffies: a request for one takes one to two, up to 8 ms at CONFIG_HZ=250 (2 ms at 1000, 20 ms at
100). The rest of the time, and every shorter timeout, is waited for with select: exact to the scheduler's delay, for one
more call. So no timeout is late by a jiffy (except one of 8 to 20 ms at CONFIG_HZ=100), and none needs a setsockopt.

Signals. Python runs the handler at once and then restarts the interrupted receive. A handler that only sets a flag delays
the end of `recv` by 8 ms at most. Signals that keep coming more often than that would extend a wait of 8 ms or more for
as long as they come; data still ends it at once.

Python's own socket timeout (settimeout) would poll before every receive and count in whole milliseconds.
"""

from __future__ import annotations

import abc
import contextlib
import os
import select
import socket
import struct
import sys
from pathlib import Path
from typing import Final

from bridge.links.addresses import Address, cannot_bind, name_of, new_socket, resolve
from bridge.links.link import NOBODY, SHORTEST_WAIT_S, Link, LinkUri, join_address
from bridge.timing.clock import MonotonicClock, unix_offset_ns
from protocol.errors import LinkClosedError, LinkError

LARGEST_DATAGRAM_BYTES: Final = 65535
WANTED_BUFFER_BYTES: Final = 1 << 20

_SOCKETS = ("/proc/net/udp", "/proc/net/udp6")
_INODE = 9
"""The field of a line there that tells the socket; the last one is what was dropped."""
_BLOCKING_WAIT_S = 0.008
_ONE_JIFFY = struct.pack("@ll", 0, 1000)  # struct timeval of 1 ms; the kernel rounds up to a jiffy
_SO_TIMESTAMPNS = 35  # socket option and type of its control message; Python's socket module does not define it
_TIMESPEC = struct.Struct("@ll")
_STAMP_SPACE = socket.CMSG_SPACE(_TIMESPEC.size)
_DROPS_PER_RECV = 1000  # datagrams of other senders that one recv drops after its timeout; the next recv continues


class _UdpLink(Link):
    def __init__(self, uri: LinkUri, family: socket.AddressFamily) -> None:
        super().__init__(uri.text)
        self._clock = MonotonicClock()
        self._socket = new_socket(uri, family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _ONE_JIFFY)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WANTED_BUFFER_BYTES)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WANTED_BUFFER_BYTES)
        self._is_stamped = False
        self.receive_buffer_bytes = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        """What the system granted of WANTED_BUFFER_BYTES; Linux reports twice what it counts as payload."""

    def stamp_receives(self) -> bool:
        """Ask for SO_TIMESTAMPNS (Linux). See `Link.stamp_receives`."""
        if sys.platform == "linux":
            with contextlib.suppress(OSError):  # a system that imitates Linux without it
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
                self._is_stamped = True
        return self._is_stamped

    def _receive_stamped(self, flags: int) -> tuple[bytes, Address]:
        """A datagram and its sender; sets `received_ns` to the kernel's stamp."""
        data, ancillary, _, sender = self._socket.recvmsg(LARGEST_DATAGRAM_BYTES, _STAMP_SPACE, flags)
        self.received_ns = 0
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                self.received_ns = seconds * 1_000_000_000 + nanoseconds - unix_offset_ns()
        return data, sender

    @abc.abstractmethod
    def _take(self, flags: int) -> bytes | None:
        """One receive: a datagram of the peer, or None where it was dropped and counted."""

    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next datagram of the peer, or None; see `Link.recv`."""
        started_ns = self._clock.now_ns()
        remaining_s = timeout_s
        dropped = 0
        spin_until_ns = started_ns + round(min(self.spin_s, timeout_s) * 1e9) if self.spin_s else 0
        while spin_until_ns:
            try:
                data = self._take(socket.MSG_DONTWAIT)
                if data is not None:
                    return self._count_received(data)
            except BlockingIOError:
                pass
            except OSError as error:
                raise self._broken(error) from error
            now_ns = self._clock.now_ns()
            if now_ns > spin_until_ns:
                remaining_s = timeout_s - (now_ns - started_ns) * 1e-9
                break
        while True:
            blocking = remaining_s >= _BLOCKING_WAIT_S
            try:
                data = self._take(0 if blocking else socket.MSG_DONTWAIT)
                if data is not None:
                    return self._count_received(data)
                dropped += 1
            except BlockingIOError:
                if not blocking:
                    if remaining_s < SHORTEST_WAIT_S:
                        return None
                    self._wait_readable(remaining_s)
            except OSError as error:
                raise self._broken(error) from error
            remaining_s = timeout_s - (self._clock.now_ns() - started_ns) * 1e-9
            if dropped > _DROPS_PER_RECV and remaining_s <= 0:
                return None

    def _wait_readable(self, timeout_s: float) -> None:
        try:
            select.select((self._socket,), (), (), timeout_s)
        except (OSError, ValueError) as error:  # closed by another thread
            raise self._broken(error) from error

    def dropped_by_system(self) -> int:
        """What Linux says of the socket in /proc/net; see `Link.dropped_by_system`."""
        try:
            inode = str(os.fstat(self._socket.fileno()).st_ino)
            tables = [Path(name).read_text(encoding="ascii") for name in _SOCKETS if Path(name).exists()]
        except OSError:  # closed, or not Linux
            return 0
        lines = [line.split() for table in tables for line in table.splitlines()]
        return next((int(fields[-1]) for fields in lines if len(fields) > _INODE and fields[_INODE] == inode), 0)

    def close(self) -> None:
        """Release the port."""
        self._closed = True
        self._socket.close()

    def _count_received(self, data: bytes) -> bytes:
        self.stats.received += 1
        self.stats.received_bytes += len(data)
        return data

    def _count_send(self, size: int) -> None:
        self.stats.sent += 1
        self.stats.sent_bytes += size

    def _count_failed_send(self, error: OSError) -> None:
        if self._closed:
            raise self._broken(error) from error
        self.stats.send_failed += 1


class UdpIn(_UdpLink):
    """Listens on a port; the sender of the first datagram is the peer until `release_peer`, and others are dropped.

    `port` is the port it listens on, also where the URI gave 0.

    Raises LinkInUseError where the port is in use, LinkError where the address is not this machine's or not permitted.
    """

    def __init__(self, uri: LinkUri, *, connect_timeout_s: float = 0.0) -> None:
        """Bind the port; `connect_timeout_s` is ignored."""
        family, address = resolve(uri, socket.SOCK_DGRAM)
        super().__init__(uri, family)
        self._peer: Address | None = None
        try:
            self._socket.bind(address)  # without SO_REUSEADDR: a second simulation on the same port must fail
        except OSError as error:
            self.close()
            raise cannot_bind(uri, error) from error
        self.port: int = self._socket.getsockname()[1]
        self.uri = f"{uri.scheme}://{join_address(uri.host, self.port)}"

    def _take(self, flags: int) -> bytes | None:
        if self._is_stamped:
            data, sender = self._receive_stamped(flags)
        else:
            data, sender = self._socket.recvfrom(LARGEST_DATAGRAM_BYTES, flags)
        if sender != self._peer:
            if self._peer is not None:
                self.stats.unknown_peer += 1
                return None
            self._peer = sender
        return data

    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Send to the peer; without one the datagram is dropped and counted. See `Link.send`."""
        if self._peer is None:
            if self._closed:
                raise LinkClosedError(f"{self.uri} is closed on this end")
            self.stats.no_peer += 1
            return
        try:
            self._count_send(self._socket.sendto(data, socket.MSG_DONTWAIT, self._peer))
        except OSError as error:
            self._count_failed_send(error)

    def release_peer(self) -> None:
        """Forget the peer: the sender of the next datagram becomes the peer."""
        self._peer = None

    @property
    def peer(self) -> str:
        """The peer as "host:port", or NOBODY."""
        return NOBODY if self._peer is None else name_of(self._peer)


class UdpOut(_UdpLink):
    """Sends to one address; datagrams of other senders do not reach it (the kernel drops them, uncounted).

    While nothing listens there, the system reports an error for each datagram sent: counted as `refused` where a receive
    gets it, or as `send_failed` where the next send does, which drops that datagram.

    Raises LinkError where the host cannot be resolved or reached.
    """

    def __init__(self, uri: LinkUri, *, connect_timeout_s: float = 0.0) -> None:
        """Set the address without sending anything; `connect_timeout_s` is ignored."""
        family, address = resolve(uri, socket.SOCK_DGRAM)
        super().__init__(uri, family)
        self._peer = name_of(address)
        try:
            self._socket.connect(address)
        except OSError as error:
            self.close()
            raise LinkError(f"{uri.text}: cannot reach {self._peer} ({error}): correct the address") from error

    def _take(self, flags: int) -> bytes | None:
        try:
            if self._is_stamped:
                return self._receive_stamped(flags)[0]
            return self._socket.recv(LARGEST_DATAGRAM_BYTES, flags)
        except ConnectionRefusedError:
            self.stats.refused += 1
            return None

    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Send to the address. See `Link.send`."""
        try:
            self._count_send(self._socket.send(data, socket.MSG_DONTWAIT))
        except OSError as error:
            self._count_failed_send(error)

    @property
    def peer(self) -> str:
        """The address as "host:port"."""
        return self._peer
