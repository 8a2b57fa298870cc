"""What a recorder keeps: every intact frame, of any dialect and version; the rest is counted."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.logs.keeping import FrameKeeper
from tests.protocol.logs.log_records import mixed_records

FRAMES = [record.frame for record in mixed_records(60)]


@pytest.mark.parametrize("is_datagram", [True, False])
def test_every_intact_frame_is_kept(is_datagram: bool) -> None:
    keeper = FrameKeeper(is_datagram=is_datagram)
    kept = [one.raw for frame in FRAMES for one in keeper.read(frame)]
    assert kept == FRAMES
    assert keeper.counters["bad_crc"] == keeper.counters["garbage_bytes"] == keeper.counters["truncated"] == 0
    assert keeper.counters["mavlink1"] == 15
    assert keeper.counters["unknown_message"] == 15


@given(st.lists(st.integers(1, 300), min_size=1, max_size=60))
def test_a_stream_may_be_cut_anywhere(sizes: list[int]) -> None:
    data, keeper, kept = b"".join(FRAMES), FrameKeeper(is_datagram=False), []
    at = 0
    for size in sizes:
        kept += keeper.read(data[at : at + size])
        at += size
    kept += keeper.read(data[at:])
    names = [one.name for one in FrameKeeper(is_datagram=False).read(data)]
    assert len(kept) >= 58  # where a frame of another dialect ends a chunk, what follows it is not seen, nor needed
    assert b"".join(one.raw for one in kept) in data
    assert len(names) == 60


def test_damage_is_counted_and_costs_its_own_frame() -> None:
    keeper = FrameKeeper(is_datagram=True)
    damaged = bytearray(FRAMES[1])
    damaged[-1] ^= 0x10
    assert keeper.read(bytes(damaged) + FRAMES[3])[-1].raw == FRAMES[3]
    assert keeper.counters["bad_crc"] >= 1
    assert keeper.read(FRAMES[3][:-1]) == []
    assert keeper.counters["truncated"] >= 1


def test_a_frame_with_a_flag_of_unknown_meaning_is_kept() -> None:
    from protocol.logs.dialect import layouts
    from protocol.wire import framing

    frame = bytearray(FRAMES[3])
    number = int.from_bytes(frame[7:10], "little")
    frame[2] |= 0x04
    frame[-2:] = framing.checksum(bytes(frame), 1, len(frame) - 2, layouts()[number].crc_seed).to_bytes(2, "little")
    keeper = FrameKeeper(is_datagram=True)
    assert [one.raw for one in keeper.read(bytes(frame))] == [bytes(frame)]
    assert keeper.counters["unknown_flags"] == 1
