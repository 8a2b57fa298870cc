"""Signatures against pymavlink's, both ways; and what is not believed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common

from protocol.errors import UsageError
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader, FrameWriter, layout
from protocol.wire.signing import Signatures, Verdict, read_key, strip

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
    data = Signatures(KEY).sign(PLAIN, NOW_US)
    (message,) = theirs().parse_buffer(data)
    assert message.get_signed()
    assert message.get_msgbuf() == data
    with pytest.raises(common.MAVError, match="signature"):
        theirs(KEY[::-1]).parse_buffer(data)


def test_ours_believes_pymavlinks_and_strips_it_to_the_plain_frame() -> None:
    sender = theirs()
    frame = read(common.MAVLink_heartbeat_message(0, 8, 0, 0, 4, 3).pack(sender))
    assert Signatures(KEY).verify(frame.raw, NOW_US) is Verdict.GOOD
    assert Signatures(KEY[::-1]).verify(frame.raw, NOW_US) is Verdict.BAD
    assert strip(frame.raw) == PLAIN


def test_what_is_signed_is_stripped_to_what_it_was() -> None:
    signer = Signatures(KEY)
    signed = signer.sign(PLAIN, NOW_US)
    assert len(signed) == len(PLAIN) + 13
    assert strip(signed) == PLAIN
    again = signer.sign(signed, NOW_US)  # an old signature is replaced
    assert len(again) == len(signed)
    assert Signatures(KEY).verify(again, NOW_US) is Verdict.GOOD


def test_a_changed_byte_a_missing_signature_and_a_repetition_are_told_apart() -> None:
    signer, judge = Signatures(KEY), Signatures(KEY)
    signed = signer.sign(PLAIN, NOW_US)
    for at in (-1, -8, -13):
        changed = bytearray(signed)
        changed[at] ^= 1
        assert judge.verify(bytes(changed), NOW_US) is Verdict.BAD
    assert judge.verify(PLAIN, NOW_US) is Verdict.MISSING
    assert judge.verify(signed, NOW_US) is Verdict.GOOD
    assert judge.verify(signed, NOW_US) is Verdict.OLD
    following = signer.sign(PLAIN, NOW_US)  # within the same 10 us, and still newer
    assert judge.verify(following, NOW_US) is Verdict.GOOD


def test_a_clock_may_be_a_minute_behind_at_first() -> None:
    for behind_s, verdict in ((59, Verdict.GOOD), (61, Verdict.OLD), (-3600, Verdict.GOOD)):
        signed = Signatures(KEY).sign(PLAIN, NOW_US - behind_s * 1_000_000)
        assert Signatures(KEY).verify(signed, NOW_US) is verdict


def attitude(**values: Any) -> bytes:
    message = layout("ATTITUDE")
    return FrameWriter(1, 1).seal(message, message.pack_fields(**values))


def read_by_pymavlink(frame: bytes, key: bytes) -> Any:
    reader = common.MAVLink(None)
    reader.signing.secret_key = key
    (message,) = reader.parse_buffer(frame)
    return message


def test_pymavlink_believes_them() -> None:
    signer = Signatures(KEY)
    first = signer.sign(attitude(time_boot_ms=3, roll=0.5), NOW_US)
    message = read_by_pymavlink(first, KEY)
    assert (message.time_boot_ms, message.roll) == (3, 0.5)
    assert signer.signed == 1


def test_another_key_is_refused() -> None:
    frame = Signatures(KEY).sign(attitude(), NOW_US)
    reader = common.MAVLink(None)
    reader.signing.secret_key = KEY[::-1]
    with pytest.raises(common.MAVError, match="signature"):
        reader.parse_char(frame)


def test_time_never_stands_still_nor_goes_back() -> None:
    signer = Signatures(KEY)
    stamps = [
        int.from_bytes(signer.sign(attitude(), now_us)[-12:-6], "little")
        for now_us in (NOW_US, NOW_US, NOW_US - 10**9, NOW_US + 50)
    ]
    assert stamps == sorted(set(stamps))
    assert stamps[0] == (NOW_US - 1_420_070_400_000_000) // 10  # 10 us units since 2015


def test_an_old_signature_is_replaced() -> None:
    old = Signatures(KEY[::-1]).sign(attitude(roll=0.5), NOW_US)
    new = Signatures(KEY).sign(old, NOW_US)
    assert len(new) == len(old)
    assert read_by_pymavlink(new, KEY).roll == 0.5


def test_what_cannot_be_signed_is_counted() -> None:
    signer = Signatures(KEY)
    old = bytes(
        common.MAVLink_attitude_message(7, 0.25, 0, 0, 0, 0, 0).pack(common.MAVLink(None, 1, 1), force_mavlink1=True)
    )
    foreign = b"\xfd\x01\x00\x00\x09\x01\x01\xff\xff\xfe\x07\x11\x22"
    assert signer.sign(old, NOW_US) == old
    assert signer.sign(foreign, NOW_US) == foreign
    assert (signer.signed, signer.unsigned) == (0, 2)


@pytest.mark.parametrize("content", [KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"])
def test_a_key_is_digits_or_bytes(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(content)
    assert read_key(tmp_path / "key") == KEY


@pytest.mark.parametrize("content", [b"", KEY[:-1], KEY.hex().encode()[:-1], b"passphrase"])
def test_anything_else_is_none(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(content)
    with pytest.raises(UsageError, match="holds no signing key"):
        read_key(tmp_path / "key")


def test_nor_is_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot read the signing key"):
        read_key(tmp_path / "key")
