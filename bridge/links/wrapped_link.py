"""Base of links that wrap another link."""

from __future__ import annotations

from bridge.links.link import Link


class WrappedLink(Link):
    """A link in front of another one: a subclass defines `recv`; all else is passed on unless it is overridden."""

    def __init__(self, link: Link) -> None:
        super().__init__(link.uri)
        self.stats = link.stats
        self._link = link

    @property
    def is_datagram(self) -> bool:
        """The link's."""
        return self._link.is_datagram

    @property
    def spin_s(self) -> float:
        """The link's."""
        return self._link.spin_s

    @spin_s.setter
    def spin_s(self, value: float) -> None:
        self._link.spin_s = value

    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Send without delay."""
        self._link.send(data)

    def stamp_receives(self) -> bool:
        """As the link does."""
        return self._link.stamp_receives()

    def dropped_by_system(self) -> int:
        """The link's."""
        return self._link.dropped_by_system()

    def close(self) -> None:
        """Close the link; data still held is lost."""
        self._closed = True
        self._link.close()

    @property
    def peer(self) -> str:
        """The link's."""
        return self._link.peer

    def release_peer(self) -> None:
        """As the link does."""
        self._link.release_peer()
