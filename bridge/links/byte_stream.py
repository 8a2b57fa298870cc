"""StreamLink: what TCP and serial links share: waiting on a non-blocking file descriptor."""

from __future__ import annotations

import abc
import select
from collections.abc import Sequence
from typing import Final

from bridge.links.link import SHORTEST_WAIT_S, Link
from bridge.timing.clock import MonotonicClock
from protocol.errors import LinkClosedError, LinkError

CHUNK_BYTES: Final = 65536
"""Largest number of bytes that one `recv` returns."""

SEND_TIMEOUT_S: Final = 1.0
"""How long a send waits in total for buffer space."""


class StreamLink(Link):
    """A link on a file descriptor in non-blocking mode.

    A transport defines how to read and write without blocking, and which descriptor to wait on.
    """

    def __init__(self, uri: str, *, send_timeout_s: float = SEND_TIMEOUT_S) -> None:
        """Set up the common state; `send_timeout_s` bounds each send."""
        super().__init__(uri)
        self._clock = MonotonicClock()
        self._send_timeout_s = send_timeout_s

    @abc.abstractmethod
    def _read(self) -> bytes:
        """Read available data: BlockingIOError where there is none, b"" or another OSError where the other end is gone."""

    @abc.abstractmethod
    def _write(self, data: memoryview) -> int:
        """Write as much as fits and return the number of bytes; BlockingIOError where nothing fits."""

    @abc.abstractmethod
    def _fileno(self) -> int:
        """The descriptor to wait on; negative once closed."""

    def recv(self, timeout_s: float) -> bytes | None:
        """Return the received data, waiting for its first byte; see `Link.recv`."""
        deadline_ns = self._deadline_ns(timeout_s)
        while True:
            try:
                data = self._read()
            except BlockingIOError:
                remaining_s = self._remaining_s(deadline_ns)
                if remaining_s < SHORTEST_WAIT_S:
                    return None
                self._wait(remaining_s, readable=(self._fileno(),))
            except OSError as error:
                raise self._ended(error) from error
            else:
                if not data:
                    raise self._ended(None)
                self.stats.received += 1
                self.stats.received_bytes += len(data)
                return data

    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Send all of `data`, waiting at most the link's send timeout for buffer space; see `Link.send`.

        After the LinkError of a timeout the other end has received a part of `data`: a reader that checks frames drops
        that frame and continues with the next.
        """
        rest = memoryview(data).cast("B")
        size = len(rest)
        deadline_ns = self._deadline_ns(self._send_timeout_s)
        while rest:
            try:
                rest = rest[self._write(rest) :]
            except BlockingIOError:
                remaining_s = self._remaining_s(deadline_ns)
                if remaining_s < SHORTEST_WAIT_S:
                    self.stats.send_failed += 1
                    taken = f"{self.peer} took {size - len(rest)} of {size} bytes in {self._send_timeout_s:g} s"
                    raise LinkError(f"{self.uri}: {taken}: check that the other end reads fast enough") from None
                self._wait(remaining_s, writable=(self._fileno(),))
            except OSError as error:
                self.stats.send_failed += 1
                raise self._ended(error) from error
        self.stats.sent += 1
        self.stats.sent_bytes += size

    def _deadline_ns(self, timeout_s: float) -> int:
        return self._clock.now_ns() + int(timeout_s * 1e9)

    def _remaining_s(self, deadline_ns: int) -> float:
        return (deadline_ns - self._clock.now_ns()) * 1e-9

    def _wait(self, timeout_s: float, *, readable: Sequence[int] = (), writable: Sequence[int] = ()) -> None:
        """Wait until one of the files is ready, for at most `timeout_s`."""
        try:
            select.select(readable, writable, (), timeout_s)
        except (OSError, ValueError) as error:  # closed by another thread
            raise self._ended(error) from error

    def _ended(self, cause: BaseException | None) -> LinkError:
        """The error to raise once this end or the other is closed."""
        if self._closed:
            return LinkClosedError(f"{self.uri} is closed on this end")
        return LinkClosedError(f"{self.uri}: {self.peer} closed the link" + (f" ({cause})" if cause else ""))
