"""A link in memory that says it is a stream: what was sent together need not come together."""

from __future__ import annotations

from bridge.links.wrapped_link import WrappedLink


class AsStream(WrappedLink):
    """A datagram link as a stream."""

    @property
    def is_datagram(self) -> bool:
        return False

    def recv(self, timeout_s: float) -> bytes | None:
        return self._link.recv(timeout_s)
