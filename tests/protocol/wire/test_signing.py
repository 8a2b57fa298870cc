"""Signatures against pymavlink's, both ways; and what is not believed."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import common

from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader, FrameWriter
from protocol.wire.signing import Signatures, Verdict, strip

KEY = bytes(range(32))
NOW_US = 1_800_000_000_000_000
PLAIN = FrameWriter(1, 191).seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat())


def read(data: bytes) -> Frame:
    (frame,) = FrameReader(is_datagram=True).read(data)
    return frame


def theirs(key: bytes = KEY, *, now_us: int = NOW_US) -> Any:
    mavlink = common.MAVLink(None, 1, 191)
    mavlink.signing.secret_key = key
    mavlink.signing.sign_outgoing = True
    mavlink.signing.link_id = 3
    mavlink.signing.timestamp = (now_us - 1_420_070_400_000_000) // 10
    return mavlink


def test_pymavlink_believes_ours_and_only_with_the_same_key() -> None:
    data = Signatures(KEY).sign(read(PLAIN), NOW_US)
    (message,) = theirs().parse_buffer(data)
    assert message.get_signed()
    assert message.get_msgbuf() == data
    with pytest.raises(common.MAVError, match="signature"):
        theirs(KEY[::-1]).parse_buffer(data)


def test_ours_believes_pymavlinks_and_strips_it_to_the_plain_frame() -> None:
    sender = theirs()
    frame = read(common.MAVLink_heartbeat_message(0, 8, 0, 0, 4, 3).pack(sender))
    assert Signatures(KEY).verify(frame, NOW_US) is Verdict.GOOD
    assert Signatures(KEY[::-1]).verify(frame, NOW_US) is Verdict.BAD
    assert strip(frame) == PLAIN


def test_what_is_signed_is_stripped_to_what_it_was() -> None:
    signer = Signatures(KEY)
    signed = signer.sign(read(PLAIN), NOW_US)
    assert len(signed) == len(PLAIN) + 13
    assert strip(read(signed)) == PLAIN
    again = signer.sign(read(signed), NOW_US)  # an old signature is replaced
    assert len(again) == len(signed)
    assert Signatures(KEY).verify(read(again), NOW_US) is Verdict.GOOD


def test_a_changed_byte_a_missing_signature_and_a_repetition_are_told_apart() -> None:
    signer, judge = Signatures(KEY), Signatures(KEY)
    signed = signer.sign(read(PLAIN), NOW_US)
    for at in (-1, -8, -13):
        changed = bytearray(signed)
        changed[at] ^= 1
        assert judge.verify(read(bytes(changed)), NOW_US) is Verdict.BAD
    assert judge.verify(read(PLAIN), NOW_US) is Verdict.MISSING
    assert judge.verify(read(signed), NOW_US) is Verdict.GOOD
    assert judge.verify(read(signed), NOW_US) is Verdict.OLD
    following = signer.sign(read(PLAIN), NOW_US)  # within the same 10 us, and still newer
    assert judge.verify(read(following), NOW_US) is Verdict.GOOD


def test_a_clock_may_be_a_minute_behind_at_first() -> None:
    for behind_s, verdict in ((59, Verdict.GOOD), (61, Verdict.OLD), (-3600, Verdict.GOOD)):
        signed = Signatures(KEY).sign(read(PLAIN), NOW_US - behind_s * 1_000_000)
        assert Signatures(KEY).verify(read(signed), NOW_US) is verdict
