"""Bits of a frame, by hand, by the standard's formula and by another way of counting."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.can_frame import CanFrame, nominal_bits, worst_bits
from protocol.motors.can_stuffing import exact_bits

FRAMES = st.one_of(
    st.builds(CanFrame, st.integers(0, (1 << 11) - 1), st.binary(max_size=8)),
    st.builds(CanFrame, st.integers(0, (1 << 29) - 1), st.binary(max_size=8), extended=st.just(True)),
)


@pytest.mark.parametrize(
    ("length", "extended", "bits"), [(0, False, 47), (8, False, 111), (4, False, 79), (8, True, 131)]
)
def test_nominal_bits_are_the_standards(length: int, extended: bool, bits: int) -> None:
    assert nominal_bits(length, extended=extended) == bits


def test_worst_bits_are_those_of_the_published_analysis() -> None:
    """Davis et al. 2007: 55 + 10 s for 11 bits of identifier and 80 + 10 s for 29, of s bytes."""
    for s in range(9):
        assert worst_bits(s, extended=False) == 55 + 10 * s
        assert worst_bits(s, extended=True) == 80 + 10 * s


@given(FRAMES)
def test_exact_bits_lie_between(frame: CanFrame) -> None:
    length = len(frame.data)
    lowest, highest = nominal_bits(length, extended=frame.extended), worst_bits(length, extended=frame.extended)
    assert lowest <= exact_bits(frame) <= highest


def test_a_frame_counted_by_hand() -> None:
    """Identifier 0, no data: 19 zero bits and a CRC of 15 zeros: 34 equal bits get a stuff bit after the first five and
    then, since the stuff bit is a one and breaks the run, after each five more: 6. So 47 + 6."""
    assert exact_bits(CanFrame(0)) == 47 + 6


def written_out(frame: CanFrame) -> str:
    """The stuffable bits as text: the checksum is the remainder of the message times x^15, by long division by
    x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1."""
    if frame.extended:
        head = f"0{frame.can_id >> 18:011b}11{frame.can_id & 0x3FFFF:018b}{frame.remote:b}00"
    else:
        head = f"0{frame.can_id:011b}{frame.remote:b}00"
    text = head + f"{len(frame.data):04b}" + "".join(f"{byte:08b}" for byte in frame.data)
    generator = sum(1 << power for power in (15, 14, 10, 8, 7, 4, 3, 0))
    value = int(text, 2) << 15
    while value.bit_length() > 15:
        value ^= generator << (value.bit_length() - 16)
    return text + f"{value:015b}"


@given(FRAMES)
def test_stuffing_is_that_of_the_bits_written_out(frame: CanFrame) -> None:
    text = written_out(frame)
    stuffed = ""
    for bit in text:
        stuffed += bit
        if stuffed.endswith(("00000", "11111")):
            stuffed += "10"[int(bit)]
    assert exact_bits(frame) == len(stuffed) + 13


def test_a_frame_is_written_as_candump_does() -> None:
    assert str(CanFrame(0x2A, b"\x01\xff")) == "02A#01FF"
    assert str(CanFrame(0x1F, b"", extended=True)) == "0000001F#"
    assert str(CanFrame(0x1F, b"", remote=True)) == "01F#R"
