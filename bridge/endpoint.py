"""One MAVLink component on a link: sends and receives frames, with counters."""

from __future__ import annotations

from collections.abc import Iterable

from bridge.links.link import Link
from protocol.errors import ScenarioMismatchError
from protocol.wire.codec import Frame, FrameReader, FrameWriter, Layout


class Endpoint:
    """A link with a frame reader and a frame writer; frames sent together travel in one datagram.

    Sequence numbers are checked once the run has begun, when both ends restart theirs: `reader.restart_sequences`.
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
        """The frames of the next datagram or chunk; empty after the timeout."""
        data = self.link.recv(timeout_s)
        return self.reader.read(data) if data else []

    def counters(self) -> dict[str, int]:
        """Counters of the link and the reader, by name."""
        return {**self.link.counters(), **self.reader.counters}


def refuse_other_scenario(peer: str, theirs: bytes, ours: bytes) -> None:
    """Raise ScenarioMismatchError where the peer's scenario digest is not ours."""
    if theirs != ours:
        raise ScenarioMismatchError(
            f"the {peer} runs another scenario (digest {theirs.hex()}, here {ours.hex()}): "
            "start both ends with the same scenario file"
        )
