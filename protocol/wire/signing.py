"""Signatures of MAVLink 2 frames, made and verified. Source: the MAVLink 2 guide on message signing.

    signature   link id | timestamp (6 bytes, 10 us since 2015) | digest (6 bytes)
    digest      the first of SHA-256(key | frame to its checksum | link id | timestamp)

Timestamps of one stream (system, component, link id) only grow; the first may be a minute older than this machine's clock.
"""

from __future__ import annotations

import enum
import hashlib
import hmac

import fastcrc

from protocol.wire.codec import CRC_SIZE, HEADER_V2, SIGNATURE_SIZE, SIGNED, Frame, layouts_by_id

_crc = fastcrc.crc16.mcrf4xx
_EPOCH_2015_US = 1_420_070_400_000_000
_TICK_US = 10
_MINUTE = 60_000_000 // _TICK_US
_STAMP = 6
_DIGEST = 6


class Verdict(enum.Enum):
    """What a signature is worth; all but the first are causes to drop the frame."""

    GOOD = "signed"
    MISSING = "unsigned"
    BAD = "bad_signature"
    OLD = "old_signature"


def strip(frame: Frame) -> bytes | None:
    """The frame without its signature; None where its message is not known, so that no checksum can be made for it."""
    message = layouts_by_id().get(frame.message_id)
    if message is None:
        return None
    raw = frame.raw
    body = bytes((raw[1], raw[2] & ~SIGNED)) + raw[3 : HEADER_V2 + raw[1]]
    checksum: int = _crc(body + message.crc_seed)
    return raw[:1] + body + checksum.to_bytes(CRC_SIZE, "little")


class Signatures:
    """Signs what one end of a link says, and verifies what it hears, with the key of both.

    now_us is the time since 1970.
    """

    def __init__(self, key: bytes, link_id: int = 0) -> None:
        self._key = key
        self._link_id = link_id
        self._stamp = 0
        self._newest: dict[tuple[int, int, int], int] = {}

    def sign(self, frame: Frame, now_us: int) -> bytes:
        """The frame, signed; a message that is not known goes as it is."""
        plain = strip(frame)
        if plain is None:
            return frame.raw
        message = layouts_by_id()[frame.message_id]
        self._stamp = max(self._stamp + 1, (now_us - _EPOCH_2015_US) // _TICK_US)
        body = bytes((plain[1], plain[2] | SIGNED)) + plain[3:-CRC_SIZE]
        checksum: int = _crc(body + message.crc_seed)
        signed = plain[:1] + body + checksum.to_bytes(CRC_SIZE, "little")
        stamped = signed + bytes((self._link_id,)) + self._stamp.to_bytes(_STAMP, "little")
        return stamped + hashlib.sha256(self._key + stamped).digest()[:_DIGEST]

    def verify(self, frame: Frame, now_us: int) -> Verdict:
        """Whether a frame that was received may be believed; a good one's time becomes its stream's newest."""
        raw = frame.raw
        if not raw[2] & SIGNED or len(raw) != HEADER_V2 + raw[1] + CRC_SIZE + SIGNATURE_SIZE:
            return Verdict.MISSING
        digest = hashlib.sha256(self._key + raw[:-_DIGEST]).digest()[:_DIGEST]
        if not hmac.compare_digest(digest, raw[-_DIGEST:]):
            return Verdict.BAD
        stream = (frame.system, frame.component, raw[-SIGNATURE_SIZE])
        stamp = int.from_bytes(raw[-_DIGEST - _STAMP : -_DIGEST], "little")
        newest = self._newest.get(stream, (now_us - _EPOCH_2015_US) // _TICK_US - _MINUTE)
        if stamp <= newest:
            return Verdict.OLD
        self._newest[stream] = stamp
        return Verdict.GOOD
