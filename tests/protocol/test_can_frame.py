"""Bits of a frame, by hand, by the standard's formula and by another way of counting."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.can_frame import CanFrame, crc15, exact_bits, nominal_bits, worst_bits

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
    then, since each stuff bit breaks the run, after each five more: 6. So 47 + 6."""
    assert crc15([0] * 19) == 0
    assert exact_bits(CanFrame(0)) == 47 + 6


@given(st.lists(st.integers(0, 1), max_size=90))
def test_the_checksum_is_the_remainder_of_the_polynomial(bits: list[int]) -> None:
    """Long division of the message times x^15 by x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1."""
    generator = sum(1 << power for power in (15, 14, 10, 8, 7, 4, 3, 0))
    value = int("".join(map(str, bits)) or "0", 2) << 15
    while value.bit_length() > 15:
        value ^= generator << (value.bit_length() - 16)
    assert crc15(bits) == value


def test_a_frame_is_written_as_candump_does() -> None:
    assert str(CanFrame(0x2A, b"\x01\xff")) == "02A#01FF"
    assert str(CanFrame(0x1F, b"", extended=True)) == "0000001F#"
    assert str(CanFrame(0x1F, b"", remote=True)) == "01F#R"
