"""One MAVLink component on a link: what is sent together arrives together, and whatever is amiss is counted."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bridge.endpoint import Endpoint, refuse_other_scenario
from bridge.links.link import Link
from bridge.links.memory import MemoryLink, memory_pair
from protocol.errors import LinkClosedError, ScenarioMismatchError
from protocol.messages import VEHICLE
from protocol.wire.codec import layout
from protocol.wire.framing import CAUSES

EMULATOR = (1, 191)
HEARTBEAT, STATUSTEXT = layout("HEARTBEAT"), layout("STATUSTEXT")
BEAT = HEARTBEAT.pack_fields(type=16, autopilot=8, mavlink_version=3)
WORDS = STATUSTEXT.pack_fields(severity=6, text=b"a few words")


@pytest.fixture
def pair() -> Iterator[tuple[Endpoint, Endpoint]]:
    """A vehicle and an emulator."""
    near, far = memory_pair()
    with near, far:
        yield Endpoint(near, *VEHICLE), Endpoint(far, *EMULATOR)


def test_what_is_sent_together_travels_in_one_datagram(pair: tuple[Endpoint, Endpoint]) -> None:
    vehicle, emulator = pair
    vehicle.send([vehicle.seal(HEARTBEAT, BEAT), vehicle.seal(STATUSTEXT, WORDS)])
    frames = emulator.receive(0)
    assert [frame.message_id for frame in frames] == [HEARTBEAT.message_id, STATUSTEXT.message_id]
    assert [frame.sequence for frame in frames] == [0, 1]
    assert {(frame.system, frame.component) for frame in frames} == {VEHICLE}
    assert HEARTBEAT.unpack_fields(frames[0].payload)["type"] == 16
    assert STATUSTEXT.unpack_fields(frames[1].payload)["text"].rstrip(b"\0") == b"a few words"
    assert emulator.counters() | {"received": 0, "received_bytes": 0} == dict.fromkeys(emulator.counters(), 0)
    assert emulator.counters()["received"] == vehicle.counters()["sent"] == 1


def test_both_ways_at_once_and_each_by_its_own_name(pair: tuple[Endpoint, Endpoint]) -> None:
    vehicle, emulator = pair
    vehicle.send([vehicle.seal(HEARTBEAT, BEAT)])
    emulator.send([emulator.seal(HEARTBEAT, BEAT)])
    ((at_vehicle,), (at_emulator,)) = vehicle.receive(0), emulator.receive(0)
    assert (at_vehicle.system, at_vehicle.component) == EMULATOR
    assert (at_emulator.system, at_emulator.component) == VEHICLE


def test_one_datagram_is_one_receive(pair: tuple[Endpoint, Endpoint]) -> None:
    vehicle, emulator = pair
    for _ in range(3):
        vehicle.send([vehicle.seal(HEARTBEAT, BEAT)])
    assert [[frame.sequence for frame in emulator.receive(0)] for _ in range(4)] == [[0], [1], [2], []]


@pytest.mark.parametrize("timeout_s", [0.0, 0.01])
def test_nothing_within_the_timeout_is_no_frame(pair: tuple[Endpoint, Endpoint], timeout_s: float) -> None:
    vehicle, _ = pair
    assert vehicle.receive(timeout_s) == []


def test_an_empty_datagram_holds_no_frame_and_is_counted(pair: tuple[Endpoint, Endpoint]) -> None:
    vehicle, emulator = pair
    vehicle.send([])
    assert emulator.receive(0) == []
    assert emulator.counters()["received"] == 1


def test_a_bad_frame_is_counted_and_its_neighbour_stands(pair: tuple[Endpoint, Endpoint]) -> None:
    vehicle, emulator = pair
    broken = bytearray(vehicle.seal(HEARTBEAT, BEAT))
    broken[-1] ^= 0xFF
    vehicle.send([bytes(broken), vehicle.seal(STATUSTEXT, WORDS)])
    assert [frame.message_id for frame in emulator.receive(0)] == [STATUSTEXT.message_id]
    assert emulator.counters()["bad_crc"] == 1


def test_sequence_numbers_count_once_they_are_restarted(pair: tuple[Endpoint, Endpoint]) -> None:
    vehicle, emulator = pair

    def lose_two_and_send() -> None:
        vehicle.seal(HEARTBEAT, BEAT)
        vehicle.seal(HEARTBEAT, BEAT)
        vehicle.send([vehicle.seal(HEARTBEAT, BEAT)])
        assert len(emulator.receive(0)) == 1

    lose_two_and_send()
    lose_two_and_send()
    assert emulator.counters()["sequence_gaps"] == 0
    emulator.reader.restart_sequences([(*VEHICLE, vehicle.writer.sequence)])
    lose_two_and_send()
    assert emulator.counters()["sequence_gaps"] == 2


def test_a_frame_that_a_stream_cuts_in_two_is_put_together(monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = memory_pair()
    monkeypatch.setattr(MemoryLink, "is_datagram", False)
    with near, far:
        vehicle, emulator = Endpoint(near, *VEHICLE), Endpoint(far, *EMULATOR)
        frame = vehicle.seal(STATUSTEXT, WORDS)
        near.send(frame[:7])
        assert emulator.receive(0) == []
        near.send(frame[7:])
        assert [got.raw for got in emulator.receive(0)] == [frame]
        assert emulator.counters()["truncated"] == 0


def test_on_a_datagram_link_a_frame_cut_in_two_is_lost_and_counted(pair: tuple[Endpoint, Endpoint]) -> None:
    vehicle, emulator = pair
    frame = vehicle.seal(STATUSTEXT, WORDS)
    for part in (frame[:7], frame[7:]):
        vehicle.send([part])
        assert emulator.receive(0) == []
    assert emulator.counters()["truncated"] == 1


def test_the_counters_are_those_of_the_link_and_of_the_reader_and_none_hides_another() -> None:
    near, far = memory_pair()
    with near, far:
        endpoint = Endpoint(near, *VEHICLE)
        of_link: Link = near
        assert set(of_link.stats.as_dict()).isdisjoint(CAUSES)
        assert set(endpoint.counters()) == set(of_link.stats.as_dict()) | set(CAUSES)


def test_a_closed_link_says_so(pair: tuple[Endpoint, Endpoint]) -> None:
    vehicle, emulator = pair
    emulator.link.close()
    with pytest.raises(LinkClosedError):
        vehicle.receive(0)


def test_another_scenario_is_refused_and_both_digests_are_shown() -> None:
    refuse_other_scenario("emulator", b"12345678", b"12345678")
    with pytest.raises(ScenarioMismatchError, match="the emulator runs another scenario") as caught:
        refuse_other_scenario("emulator", bytes.fromhex("0011223344556677"), bytes.fromhex("8899aabbccddeeff"))
    assert "digest 0011223344556677, here 8899aabbccddeeff" in str(caught.value)
