"""The frames of the simulation: every bit of u, and the layout of the DBC."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.can_frame import CanFrame
from protocol.messages import AXES
from protocol.motors.simulation_sync import (
    ANSWER_MASK,
    decode_answer,
    decode_encoders,
    decode_hello,
    decode_sync,
    encode_answer,
    encode_encoders,
    encode_hello,
    encode_sync,
    is_simulation_only,
)
from tests.dbc import our_dbc

DATABASE = our_dbc("simulation_sync")


@given(st.integers(0, 5), st.integers(0, 10**9), st.floats(allow_nan=False, allow_infinity=False), st.booleans())
def test_an_answer_keeps_every_bit(axis: int, tick: int, u: float, enabled: bool) -> None:
    frame = encode_answer(axis, tick, u, enabled=enabled)
    assert decode_answer(frame) == (axis, tick % 32, enabled, u)
    assert is_simulation_only(frame)
    assert frame.can_id < 1 << 11
    message = DATABASE.get_message_by_frame_id(frame.can_id & ANSWER_MASK)
    assert message.name == f"Answer_{AXES[axis]}"
    assert message.encode({"u": u}) == frame.data


@given(st.integers(0, 4_000_000 * 10**9), st.integers(0, 63), st.booleans())
def test_a_sync_is_laid_out_as_the_dbc_says(t_ns: int, commanded: int, lockstep: bool) -> None:
    frame = encode_sync(t_ns, commanded, lockstep=lockstep)
    assert decode_sync(frame) == (t_ns, commanded, lockstep)
    values = {"t_ns": t_ns, "commanded": commanded, "lockstep": lockstep}
    assert frame.data == DATABASE.encode_message("Sync", values)


@given(st.binary(min_size=8, max_size=8))
def test_hellos_of_both_ends_are_told_apart(digest: bytes) -> None:
    for drives, name in ((True, "Hello_Drives"), (False, "Hello_Host")):
        frame = encode_hello(digest, drives=drives)
        assert decode_hello(frame, drives=drives) == digest
        assert decode_hello(frame, drives=not drives) is None
        assert frame.data == DATABASE.encode_message(name, {"digest": int.from_bytes(digest, "little")})
        assert frame.can_id == DATABASE.get_message_by_name(name).frame_id


@given(st.integers(0, 5), st.floats(width=32, allow_nan=False), st.floats(width=32, allow_nan=False))
def test_encoders_are_laid_out_as_the_dbc_says(axis: int, before: float, after: float) -> None:
    frame = encode_encoders(axis, before, after)
    assert decode_encoders(frame) == (axis, before, after)
    message = DATABASE.get_message_by_name(f"Encoders_{AXES[axis]}")
    assert message.frame_id == frame.can_id
    assert message.encode({"motor_position": before, "output_position": after}) == frame.data


def test_the_dbc_says_that_all_of_it_is_simulation_only() -> None:
    assert "SIMULATION_ONLY" in [node.name for node in DATABASE.nodes]
    for message in DATABASE.messages:
        users = set(message.senders) | message.receivers
        assert "SIMULATION_ONLY" in users, message.name


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x580, b"\0" * 7),
        CanFrame(0x600, b"\0" * 9),
        CanFrame(0x600, bytes.fromhex("000000000000F07F")),  # infinity
        CanFrame(0x600, b"\0" * 8, extended=True),
        CanFrame(0x780, b"\0" * 8),
        CanFrame(0x596, b"\0" * 8),
    ],
)
def test_what_is_none_of_them_is_none(frame: CanFrame) -> None:
    assert decode_sync(frame) is None
    assert decode_answer(frame) is None
    assert decode_encoders(frame) is None
    assert decode_hello(frame, drives=True) is None
