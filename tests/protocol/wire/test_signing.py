"""Signatures against pymavlink's, both ways; and what is not believed."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
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


class TestWhatIsBelieved:
    """Each way in which a signature is none, or an old one, by itself."""

    @pytest.mark.parametrize("spoil", [lambda raw: raw[:-1], lambda raw: raw + b"\0", lambda raw: raw[:-13]])
    def test_a_signature_of_another_length_is_none(self, spoil: Callable[[bytes], bytes]) -> None:
        assert Signatures(KEY).verify(spoil(Signatures(KEY).sign(PLAIN, NOW_US)), NOW_US) is Verdict.MISSING

    def test_without_the_flag_there_is_none_whatever_follows(self) -> None:
        signed = Signatures(KEY).sign(PLAIN, NOW_US)
        assert Signatures(KEY).verify(PLAIN + signed[-13:], NOW_US) is Verdict.MISSING

    def test_mavlink_1_has_none(self) -> None:
        old = bytes(common.MAVLink_heartbeat_message(0, 8, 0, 0, 4, 3).pack(common.MAVLink(None), force_mavlink1=True))
        assert Signatures(KEY).verify(old, NOW_US) is Verdict.MISSING
        assert Signatures(KEY).verify(b"\xfe" + Signatures(KEY).sign(PLAIN, NOW_US)[1:], NOW_US) is Verdict.MISSING

    @pytest.mark.parametrize("at", [3, 4, 5, 6, 9, 10, 18, -14, -13, -12, -7, -6, -1])
    def test_every_byte_is_signed(self, at: int) -> None:
        changed = bytearray(Signatures(KEY).sign(PLAIN, NOW_US))
        changed[at] ^= 1
        assert Signatures(KEY).verify(bytes(changed), NOW_US) is Verdict.BAD

    @pytest.mark.parametrize("sender", [(2, 191), (1, 190), (191, 1)])
    def test_each_sender_has_a_time_of_its_own(self, sender: tuple[int, int]) -> None:
        other = FrameWriter(*sender).seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat())
        judge = Signatures(KEY)
        assert judge.verify(Signatures(KEY).sign(PLAIN, NOW_US + 5_000_000), NOW_US) is Verdict.GOOD
        assert judge.verify(Signatures(KEY).sign(other, NOW_US), NOW_US) is Verdict.GOOD
        assert judge.verify(Signatures(KEY).sign(PLAIN, NOW_US), NOW_US) is Verdict.OLD

    def test_so_has_each_link(self) -> None:
        judge = Signatures(KEY)
        assert judge.verify(Signatures(KEY, 1).sign(PLAIN, NOW_US), NOW_US) is Verdict.GOOD
        assert judge.verify(Signatures(KEY, 2).sign(PLAIN, NOW_US), NOW_US) is Verdict.GOOD
        assert judge.verify(Signatures(KEY, 1).sign(PLAIN, NOW_US), NOW_US) is Verdict.OLD

    @pytest.mark.parametrize(("later_us", "verdict"), [(-10, Verdict.OLD), (0, Verdict.OLD), (10, Verdict.GOOD)])
    def test_a_tick_of_10_us_is_enough(self, later_us: int, verdict: Verdict) -> None:
        judge = Signatures(KEY)
        judge.verify(Signatures(KEY).sign(PLAIN, NOW_US), NOW_US)
        assert judge.verify(Signatures(KEY).sign(PLAIN, NOW_US + later_us), NOW_US) is verdict

    @pytest.mark.parametrize(("behind_us", "verdict"), [(59_999_990, Verdict.GOOD), (60_000_000, Verdict.OLD)])
    def test_the_first_is_younger_than_a_minute(self, behind_us: int, verdict: Verdict) -> None:
        assert Signatures(KEY).verify(Signatures(KEY).sign(PLAIN, NOW_US - behind_us), NOW_US) is verdict

    def test_what_is_not_believed_does_not_move_the_time(self) -> None:
        judge = Signatures(KEY)
        far = bytearray(Signatures(KEY).sign(PLAIN, NOW_US + 10**12))
        far[-1] ^= 1
        assert judge.verify(bytes(far), NOW_US) is Verdict.BAD
        assert judge.verify(Signatures(KEY).sign(PLAIN, NOW_US), NOW_US) is Verdict.GOOD


class TestWhatIsSigned:
    def test_a_signature_is_the_link_the_time_and_the_digest(self) -> None:
        signed = Signatures(KEY, 5).sign(PLAIN, NOW_US)
        stamp = bytes([5]) + ((NOW_US - 1_420_070_400_000_000) // 10).to_bytes(6, "little")
        assert signed[-13:-6] == stamp
        assert signed[-6:] == hashlib.sha256(KEY + signed[:-6]).digest()[:6]

    def test_other_flags_stay_as_they_are(self) -> None:
        odd = PLAIN[:2] + b"\x02" + PLAIN[3:]
        signed = Signatures(KEY).sign(odd, NOW_US)
        assert signed[2] == 0x03
        stripped = strip(signed)
        assert stripped is not None
        assert stripped[:-2] == odd[:-2]

    def test_what_is_not_known_cannot_be_stripped(self) -> None:
        assert strip(b"\xfd\x01\x01\x00\x09\x01\x01\xff\xff\xfe\x07\x11\x22" + bytes(13)) is None

    def test_messages_of_another_dialect_can_be_signed(self) -> None:
        signer = Signatures(KEY, messages={0: layout("HEARTBEAT")})
        assert len(signer.sign(PLAIN, NOW_US)) == len(PLAIN) + 13
        assert signer.sign(attitude(), NOW_US) == attitude()
        assert (signer.signed, signer.unsigned) == (1, 1)

    def test_before_its_first_the_clock_may_say_anything(self) -> None:
        """A machine that has just started may be in 1970."""
        signer = Signatures(KEY)
        assert signer.sign(PLAIN, 0)[-12:-6] == (1).to_bytes(6, "little")
        assert signer.sign(PLAIN, 0)[-12:-6] == (2).to_bytes(6, "little")
