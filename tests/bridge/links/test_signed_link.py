"""A signed link: what a key's owner says arrives plain, what anybody else says does not, and each cause is counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bridge.links.link import open_link
from bridge.links.memory import memory_pair
from bridge.links.signed_link import SignedLink, signed
from bridge.links.udp import UdpIn
from fwav_hil.simulate import simulate
from plant_emulator.plant.truth import load_truth
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from protocol.wire.signing import Signatures
from tests.loop import fly_both, scenario_of
from tests.plant_emulator.pacing.test_lockstep import Faulty

KEY, OTHER = bytes(range(32)), bytes(32)
BEAT = FrameWriter(1, 191).seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat())
SHORT = scenario_of("flapper", duration_s=0.4)


def test_both_ends_see_plain_frames_and_the_way_carries_signed_ones() -> None:
    near, far = memory_pair()
    SignedLink(near, KEY).send(BEAT + BEAT)
    on_the_way = far.recv(1.0)
    assert on_the_way is not None
    assert len(on_the_way) == 2 * (len(BEAT) + 13)
    near.send(on_the_way)
    assert SignedLink(far, KEY).recv(1.0) == BEAT + BEAT


def test_what_is_not_believed_is_dropped_and_counted_by_cause() -> None:
    near, far = memory_pair()
    link = SignedLink(far, KEY)
    assert link.recv(0.0) is None
    near.send(BEAT)
    SignedLink(near, OTHER).send(BEAT)
    SignedLink(near, KEY).send(BEAT)
    assert link.recv(1.0) == BEAT  # the two before it are passed over within one wait
    near.send(BEAT[:-1] + bytes([BEAT[-1] ^ 1]))
    assert link.recv(0.05) is None
    counters = link.counters()
    assert (counters["unsigned"], counters["bad_signature"], counters["old_signature"]) == (1, 1, 0)
    assert counters["unsealed"] == 1
    assert counters["received"] == 4


def test_a_recording_played_again_is_not_believed() -> None:
    near, far = memory_pair()
    link = SignedLink(far, KEY)
    SignedLink(near, KEY).send(BEAT)
    said = far.recv(1.0)
    assert said is not None
    for _ in range(2):
        near.send(said)
    assert link.recv(1.0) == BEAT
    assert link.recv(0.05) is None
    assert link.counters()["old_signature"] == 1


def test_a_stranger_that_came_first_does_not_keep_the_place() -> None:
    with open_link("udpin://127.0.0.1:0") as near:
        assert isinstance(near, UdpIn)
        link = SignedLink(near, KEY)
        uri = f"udpout://127.0.0.1:{near.port}"
        with open_link(uri) as stranger, open_link(uri) as far:
            stranger.send(BEAT)
            assert link.recv(0.5) is None
            SignedLink(far, KEY).send(BEAT)
            assert link.recv(5.0) == BEAT
            link.send(BEAT)
            assert SignedLink(far, KEY).recv(5.0) == BEAT


def test_without_a_key_a_link_is_what_it_was() -> None:
    near, _ = memory_pair()
    assert signed(near, None) is near


def test_a_signed_flight_is_the_same_flight_to_the_byte_whatever_a_stranger_says(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        fly_both(SHORT, near, far, tmp_path / "plain")
    near, far = memory_pair()
    forged = Signatures(OTHER)
    command = FrameWriter(1, 1).seal(mapping.COMMAND, bytes(16) + b"\x00\x00\x80\x3f" * 16 + b"\x80")
    from protocol.wire.codec import FrameReader

    (frame,) = FrameReader(is_datagram=True).read(command)

    def with_a_stranger(count: int, data: bytes) -> list[bytes]:
        return [command, forged.sign(frame.raw, 1_800_000_000_000_000), data] if count % 5 == 0 else [data]

    with near, far:
        loud = Faulty(far, with_a_stranger)
        ends = fly_both(SHORT, SignedLink(near, KEY), SignedLink(loud, KEY), tmp_path / "signed")
    assert isinstance(ends.emulator, dict), ends
    counters = ends.emulator["counters"]
    assert counters["unsigned"] == counters["bad_signature"] > 10
    assert counters["resent"] == 0
    for name in ("run.tlog", "ground_truth.npy"):
        assert (tmp_path / "plain" / name).read_bytes() == (tmp_path / "signed" / name).read_bytes(), name
    assert np.array_equal(load_truth(tmp_path / "signed" / "ground_truth.npy")["q"], simulate(SHORT).q)
