"""A link whose frames are signed: what is sent gets a signature, what is received must have a good one.

The ends of the loop see plain frames, as the record does: a signature is of the way, like a header, and the loop's compiled
kernels take signed ticks as any others. A link without a key is not touched by any of this.
"""

from __future__ import annotations

from bridge.links.link import Link
from bridge.links.wrapped_link import WrappedLink
from bridge.timing.clock import MonotonicClock, unix_time_us
from protocol.wire.codec import FrameReader
from protocol.wire.signing import Signatures, Verdict, strip


class SignedLink(WrappedLink):
    """A link with a key (32 bytes). Its peer is forgotten again where its first words are not believed.

    dropped   unsigned        frames without a signature
              bad_signature   frames whose signature another key made, or that were changed on their way
              old_signature   frames that were said before (a recording, a late copy), or by a clock a minute behind
              unsealed        what was no intact frame, or of a message that is not known
    """

    def __init__(self, link: Link, key: bytes) -> None:
        super().__init__(link)
        self._clock = MonotonicClock()
        self._signatures = Signatures(key)
        self._incoming = FrameReader(is_datagram=link.is_datagram, follow_sequence=False)
        self._outgoing = FrameReader(is_datagram=True, follow_sequence=False)
        self._is_believed = False
        self._dropped = dict.fromkeys(("unsigned", "bad_signature", "old_signature", "unsealed"), 0)

    def recv(self, timeout_s: float) -> bytes | None:
        """The believed frames of the next datagram or chunk, without their signatures; see `Link.recv`."""
        give_up_ns = self._clock.now_ns() + round(max(0.0, timeout_s) * 1e9)
        while True:
            data = self._link.recv(timeout_s)
            if data is None:
                return None
            self.received_ns = self._link.received_ns
            believed = self._believed(data)
            if believed:
                return believed
            timeout_s = (give_up_ns - self._clock.now_ns()) * 1e-9
            if timeout_s <= 0.0:
                return None

    def _believed(self, data: bytes) -> bytes:
        plain: list[bytes] = []
        now_us = unix_time_us()
        for frame in self._incoming.read(data):
            verdict = self._signatures.verify(frame.raw, now_us)
            stripped = strip(frame.raw) if verdict is Verdict.GOOD else None
            if stripped is not None:
                plain.append(stripped)
            else:
                self._dropped["unsealed" if verdict is Verdict.GOOD else verdict.value] += 1
        if plain:
            self._is_believed = True
        elif not self._is_believed and self.is_datagram:
            self._link.release_peer()  # a stranger that came first must not keep the place
        return b"".join(plain)

    def counters(self) -> dict[str, int]:
        """What the link has counted, and by cause what was dropped; damaged frames get no further than here."""
        read = self._incoming.counters
        damaged = sum(read[cause] for cause in ("bad_crc", "truncated", "unknown_flags", "mavlink1"))
        return {**super().counters(), **self._dropped, "unsealed": self._dropped["unsealed"] + damaged}

    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Send the frames of `data`, each signed anew."""
        now_us = unix_time_us()
        self._link.send(b"".join(self._signatures.sign(one.raw, now_us) for one in self._outgoing.read(bytes(data))))

    def release_peer(self) -> None:
        """As the link does; whoever comes next must be believed anew."""
        self._is_believed = False
        super().release_peer()


def signed(link: Link, key: bytes | None) -> Link:
    """The link with signatures, or as it is where there is no key."""
    return SignedLink(link, key) if key else link
