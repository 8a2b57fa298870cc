"""One MAVLink component on a link: frames in, frames out, everything counted."""

from __future__ import annotations

from collections.abc import Iterable

from bridge.links.link import Link
from protocol.errors import ScenarioMismatchError
from protocol.wire.codec import Frame, FrameReader, FrameWriter, Layout


class Endpoint:
    """A link with a frame reader and a frame writer; what is sent together travels in one datagram.

    Sequence numbers are followed once the run has begun, where both ends restart theirs: `reader.restart_sequences`.
    """

    def __init__(self, link: Link, system: int, component: int) -> None:
        self.link = link
        self.reader = FrameReader(is_datagram=link.is_datagram, follow_sequence=False)
        self.writer = FrameWriter(system, component)

    def seal(self, message: Layout, payload: bytes) -> bytes:
        """A frame of this component, with its next sequence number."""
        return self.writer.seal(message, payload)

    def send(self, frames: Iterable[bytes]) -> None:
        """Send frames together."""
        self.link.send(b"".join(frames))

    def receive(self, timeout_s: float) -> list[Frame]:
        """The frames of the next datagram or chunk; empty where none came within the timeout."""
        data = self.link.recv(timeout_s)
        return self.reader.read(data) if data else []

    def counters(self) -> dict[str, int]:
        """What the link and the reader have counted, by name."""
        return {**self.link.counters(), **self.reader.counters}


def refuse_other_scenario(peer: str, theirs: bytes, ours: bytes) -> None:
    """Raise ScenarioMismatchError where the digest that a peer shows is not ours."""
    if theirs != ours:
        raise ScenarioMismatchError(
            f"the {peer} holds another scenario (digest {theirs.hex()}, here {ours.hex()}): "
            "start both ends with the same scenario file"
        )
