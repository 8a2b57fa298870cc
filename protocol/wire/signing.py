"""Signatures of MAVLink 2 frames, made and verified. Source: the MAVLink 2 guide on message signing.

    signature   link id | timestamp (6 bytes, 10 us since 2015) | digest (6 bytes)
    digest      first 6 bytes of SHA-256(key | frame to its checksum | link id | timestamp)

Timestamps of one stream (system, component, link id) must increase; the first may be a minute behind this machine's clock.
"""

from __future__ import annotations

import enum
import hashlib
import hmac
import re
from collections.abc import Mapping
from pathlib import Path

from protocol.errors import UsageError
from protocol.wire.codec import Layout, layouts_by_id
from protocol.wire.framing import CRC_SIZE, HEADER_V2, MAGIC_V2, SIGNATURE_SIZE, SIGNED, checksum, message_of

_EPOCH_2015_US = 1_420_070_400_000_000
_TICK_US = 10
_MINUTE = 60_000_000 // _TICK_US
_STAMP = 6
_DIGEST = 6


class Verdict(enum.Enum):
    """Result of checking a signature; all but the first are causes to drop the frame."""

    GOOD = "signed"
    MISSING = "unsigned"
    BAD = "bad_signature"
    OLD = "old_signature"


def read_key(path: Path) -> bytes:
    """The signing key in a file: 64 hexadecimal digits, or the 32 bytes themselves. Raises UsageError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"cannot read the signing key {path}: {error.strerror}") from None
    if re.fullmatch(rb"\s*[0-9a-fA-F]{64}\s*", data):
        return bytes.fromhex(data.decode())
    if len(data) == 32:
        return data
    raise UsageError(f"{path} holds no signing key: it must be 64 hexadecimal digits, or 32 bytes")


def _with_flags(raw: bytes, flags: int, message: Layout) -> bytes:
    """The MAVLink 2 frame with other incompatibility flags and a new checksum, without a signature."""
    stop = HEADER_V2 + raw[1]
    body = raw[:2] + bytes((flags,)) + raw[3:stop]
    return body + checksum(body, 1, stop, message.crc_seed).to_bytes(CRC_SIZE, "little")


def strip(raw: bytes) -> bytes | None:
    """The frame without its signature; None for an unknown message, whose checksum cannot be computed."""
    message = layouts_by_id().get(message_of(raw, 0))
    return _with_flags(raw, raw[2] & ~SIGNED, message) if message else None


class Signatures:
    """Signs the frames that one end of a link sends, and verifies those that it receives, with the shared key.

    now_us is the time since 1970; messages: those that can be signed, by default those of the links' dialect.

    signed, unsigned   number of frames signed, and of those that could not be: MAVLink 1 and other messages
    """

    def __init__(self, key: bytes, link_id: int = 0, messages: Mapping[int, Layout] | None = None) -> None:
        self.signed = self.unsigned = 0
        self._messages = layouts_by_id() if messages is None else messages
        self._key = key
        self._link_id = link_id
        self._stamp = 0
        self._newest: dict[tuple[int, int, int], int] = {}

    def sign(self, raw: bytes, now_us: int) -> bytes:
        """The signed frame, an earlier signature replaced; a frame that cannot be signed is returned unchanged."""
        message = self._messages.get(message_of(raw, 0)) if raw[0] == MAGIC_V2 else None
        if message is None:
            self.unsigned += 1
            return raw
        self.signed += 1
        self._stamp = max(self._stamp + 1, (now_us - _EPOCH_2015_US) // _TICK_US)
        stamp = bytes((self._link_id,)) + self._stamp.to_bytes(_STAMP, "little")
        stamped = _with_flags(raw, raw[2] | SIGNED, message) + stamp
        return stamped + self._digest(stamped)

    def verify(self, raw: bytes, now_us: int) -> Verdict:
        """Check the signature of an intact received frame; a good one's timestamp becomes the newest of its stream."""
        if raw[0] != MAGIC_V2 or not raw[2] & SIGNED or len(raw) != HEADER_V2 + raw[1] + CRC_SIZE + SIGNATURE_SIZE:
            return Verdict.MISSING
        if not hmac.compare_digest(self._digest(raw[:-_DIGEST]), raw[-_DIGEST:]):
            return Verdict.BAD
        stream = (raw[5], raw[6], raw[-SIGNATURE_SIZE])
        stamp = int.from_bytes(raw[-_DIGEST - _STAMP : -_DIGEST], "little")
        newest = self._newest.get(stream, (now_us - _EPOCH_2015_US) // _TICK_US - _MINUTE)
        if stamp <= newest:
            return Verdict.OLD
        self._newest[stream] = stamp
        return Verdict.GOOD

    def _digest(self, stamped: bytes) -> bytes:
        return hashlib.sha256(self._key + stamped).digest()[:_DIGEST]
