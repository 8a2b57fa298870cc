"""A link inside one process, opened by name or as a pair. For tests, and to run both ends in one process."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Final

from bridge.links.link import NOBODY, SHORTEST_WAIT_S, Link, LinkUri
from protocol.errors import LinkClosedError, LinkInUseError

QUEUE_LIMIT: Final = 4096
"""Datagrams queued at one end; further ones are dropped, as by UDP, and counted by the sender."""

_PAIR = "pair"


@dataclass(slots=True)
class _Wire:
    """State shared by both ends. None in a queue means that the link is closed, and stays there."""

    name: str
    queues: tuple[SimpleQueue[bytes | None], SimpleQueue[bytes | None]] = field(
        default_factory=lambda: (SimpleQueue(), SimpleQueue())
    )
    opened: int = 0
    closed: int = 0


# The only module state in bridge/: two opens of one name must find each other, and have only the name in common. A
# name is kept from its first open until the last opened end is closed.
_wires: dict[str, _Wire] = {}
_wires_lock = threading.Lock()


def open_memory(uri: LinkUri, *, connect_timeout_s: float = 0.0) -> MemoryLink:
    """Open the next free end of the link of that name; `connect_timeout_s` is ignored.

    Raises:
        LinkInUseError: both ends have been opened, and not both closed.
    """
    with _wires_lock:
        wire = _wires.setdefault(uri.name, _Wire(uri.name))
        if wire.opened == len(wire.queues):
            raise LinkInUseError(
                f"{uri.text}: both ends of {uri.name} are taken: close them or choose another name with --link"
            )
        return _next_end(wire)


def memory_pair() -> tuple[MemoryLink, MemoryLink]:
    """Return both ends of a new link without a name, which nothing else can open."""
    wire = _Wire("")
    return _next_end(wire), _next_end(wire)


def _next_end(wire: _Wire) -> MemoryLink:
    end = MemoryLink(wire, wire.opened)
    wire.opened += 1
    return end


class MemoryLink(Link):
    """One end, from `open_memory` or `memory_pair`; every method may be called from any thread.

    Datagrams arrive in order and none is lost, with these exceptions: sends before the other end is open (counted as
    `no_peer`), with QUEUE_LIMIT datagrams queued, or after the other end was closed (`send_failed`) are dropped. After the
    other end was closed `recv` returns what is still queued, then raises LinkClosedError.
    """

    def __init__(self, wire: _Wire, end: int) -> None:
        """Take end 0 (opened first) or 1 of a wire."""
        super().__init__(f"mem://{wire.name or _PAIR}")
        self._wire = wire
        self._name = "AB"[end]
        self._other_name = "BA"[end]
        self._incoming = wire.queues[end]
        self._outgoing = wire.queues[1 - end]

    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next datagram, or None; see `Link.recv`."""
        if self._closed:
            raise self._ended()
        try:
            data = self._incoming.get(timeout_s >= SHORTEST_WAIT_S, max(timeout_s, 0.0))
        except Empty:
            return None
        if data is None:
            self._incoming.put(None)
            raise self._ended()
        self.stats.received += 1
        self.stats.received_bytes += len(data)
        return data

    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Hand a copy of `data` to the other end; see `Link.send`."""
        if self._closed:
            raise self._ended()
        if not self._joined:
            self.stats.no_peer += 1
        elif self._wire.closed or self._outgoing.qsize() >= QUEUE_LIMIT:
            self.stats.send_failed += 1
        else:
            datagram = bytes(data)
            self._outgoing.put(datagram)
            self.stats.sent += 1
            self.stats.sent_bytes += len(datagram)

    def close(self) -> None:
        """Close this end and tell the other; the name is free once every opened end is closed."""
        with _wires_lock:
            if self._closed:
                return
            self._closed = True
            self._wire.closed += 1
            if self._wire.closed == self._wire.opened and _wires.get(self._wire.name) is self._wire:
                del _wires[self._wire.name]
        self._outgoing.put(None)
        self._incoming.put(None)  # wakes a thread that waits in `recv`

    @property
    def peer(self) -> str:
        """The other end by URI and letter, or NOBODY."""
        return f"{self.uri} end {self._other_name}" if self._joined else NOBODY

    @property
    def _joined(self) -> bool:
        return self._wire.opened == len(self._wire.queues)

    def _ended(self) -> LinkClosedError:
        closer = "this end" if self._closed else f"end {self._other_name}"
        return LinkClosedError(f"{self.uri} is closed by {closer}")
