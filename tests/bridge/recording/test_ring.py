"""The ring of bytes: what is put comes out, in order and whole, or is refused whole."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.recording.ring import HEADER_BYTES, ByteRing


@pytest.fixture
def ring() -> Iterator[ByteRing]:
    made = ByteRing.create(64)
    yield made
    made.close()


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.binary(max_size=70), st.booleans()), max_size=40))
def test_whatever_the_order_of_puts_and_takes_what_was_put_comes_out(steps: list[tuple[bytes, bool]]) -> None:
    ring = ByteRing.create(64)
    reader, writer = os.pipe()
    expected = b""
    try:
        for data, take in steps:
            fits = len(expected) - ring.taken_bytes + len(data) <= 64
            assert ring.put(data) == fits
            expected += data if fits else b""
            if take:
                ring.write_to(writer, ring.put_bytes)
        ring.write_to(writer, ring.put_bytes)
        os.close(writer)
        with os.fdopen(reader, "rb") as out:
            assert out.read() == expected
        assert ring.put_bytes == ring.taken_bytes == len(expected)
    finally:
        ring.close()


def test_only_what_was_put_before_the_byte_asked_for_is_taken(ring: ByteRing, tmp_path: Path) -> None:
    ring.put(b"abcdef")
    with (tmp_path / "out").open("wb", buffering=0) as file:
        ring.write_to(file.fileno(), 4)
    assert (tmp_path / "out").read_bytes() == b"abcd"
    assert (ring.put_bytes, ring.taken_bytes) == (6, 4)


def test_two_rings_on_one_memory_are_one(ring: ByteRing, tmp_path: Path) -> None:
    other = ByteRing(os.dup(ring.descriptor), ring.capacity)
    ring.put(b"hello")
    assert other.put_bytes == 5
    with (tmp_path / "out").open("wb", buffering=0) as file:
        other.write_to(file.fileno(), 5)
    assert ring.taken_bytes == 5
    other.close()


def test_a_file_that_refuses_is_noted_and_tried_again(ring: ByteRing, tmp_path: Path) -> None:
    ring.put(b"abc")
    reading = os.open(os.devnull, os.O_RDONLY)
    ring.write_to(reading, 3)
    os.close(reading)
    assert (ring.error, ring.taken_bytes) == (errno.EBADF, 0)
    with (tmp_path / "out").open("wb", buffering=0) as file:
        ring.write_to(file.fileno(), 3)
    assert (ring.error, ring.taken_bytes) == (0, 3)


def test_one_who_takes_over_goes_on_where_the_other_left_off(ring: ByteRing, tmp_path: Path) -> None:
    ring.put(b"abcdef")
    ring.take_over_at(2)
    with (tmp_path / "out").open("wb", buffering=0) as file:
        ring.write_to(file.fileno(), 6)
    assert (tmp_path / "out").read_bytes() == b"cdef"


def test_closing_lets_go_once() -> None:
    ring = ByteRing.create(16)
    assert os.fstat(ring.descriptor).st_size == HEADER_BYTES + 16
    ring.close()
    ring.close()
