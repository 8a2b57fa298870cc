"""A link with MAVLink signatures: sent frames are signed, received frames must carry a valid signature.

The ends of the loop and the log see unsigned frames: signatures are added and removed here, as a transport adds headers.
"""

from __future__ import annotations

from bridge.links.link import Link
from bridge.links.wrapped_link import WrappedLink
from bridge.timing.clock import MonotonicClock, unix_time_us
from protocol.wire.codec import FrameReader
from protocol.wire.signing import Signatures, Verdict, strip


class SignedLink(WrappedLink):
    """A link with a signing key (32 bytes). A peer whose first frames have no valid signature is released again.

    dropped   unsigned        frames without a signature
              bad_signature   frames signed with another key, or changed on the way
              old_signature   replayed or repeated frames, or a sender's clock that is a minute behind
              unsealed        damaged frames, or frames of an unknown message
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
        """The frames of the next datagram or chunk with valid signatures, which are removed; see `Link.recv`."""
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
            self._link.release_peer()  # an unknown sender that came first must not stay the peer
        return b"".join(plain)

    def counters(self) -> dict[str, int]:
        """Counters of the link, and dropped frames by cause; damaged frames are dropped here."""
        read = self._incoming.counters
        damaged = sum(read[cause] for cause in ("bad_crc", "truncated", "unknown_flags", "mavlink1"))
        return {**super().counters(), **self._dropped, "unsealed": self._dropped["unsealed"] + damaged}

    def send(self, data: bytes | bytearray | memoryview) -> None:
        """Sign each frame in `data` and send them."""
        now_us = unix_time_us()
        self._link.send(b"".join(self._signatures.sign(one.raw, now_us) for one in self._outgoing.read(bytes(data))))

    def release_peer(self) -> None:
        """As the link does; the next peer must show a valid signature first."""
        self._is_believed = False
        super().release_peer()


def signed(link: Link, key: bytes | None) -> Link:
    """The link with signatures, or the link itself where there is no key."""
    return SignedLink(link, key) if key else link
