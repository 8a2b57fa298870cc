"""A signed link: what a key's owner says arrives plain, what anybody else says does not, and each cause is counted."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from bridge.links.link import open_link
from bridge.links.memory import MemoryLink, memory_pair
from bridge.links.signed_link import SignedLink, signed
from bridge.links.udp import UdpIn
from bridge.timing.clock import MonotonicClock, unix_time_us
from fwav_hil.simulate import simulate
from plant_emulator.plant.truth import load_truth
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter
from protocol.wire.signing import Signatures
from tests.loop import fly_both, scenario_of
from tests.plant_emulator.pacing.test_lockstep import Faulty
from tests.streams import AsStream

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


class TestRefusals:
    """Each cause by itself, on datagrams and on a stream."""

    @pytest.mark.parametrize("is_datagram", [True, False])
    @pytest.mark.parametrize("cause", ["unsigned", "bad_signature", "old_signature", "unsealed"])
    def test_only_the_frame_in_question_is_dropped(self, cause: str, is_datagram: bool) -> None:
        near, end = memory_pair()
        far = end if is_datagram else AsStream(end)
        now_us, signer = unix_time_us(), Signatures(KEY)
        unknown = b"\xfd\x01\x01\x00\x09\x01\x01\xff\xff\xfe\x07\x11\x22"
        refused = {
            "unsigned": BEAT,
            "bad_signature": Signatures(OTHER).sign(BEAT, now_us),
            "old_signature": signer.sign(BEAT, now_us - 120_000_000),
            "unsealed": unknown + signature_of(unknown, now_us),
        }[cause]
        link = SignedLink(far, KEY)
        near.send(Signatures(KEY, 1).sign(BEAT, now_us) + refused + Signatures(KEY, 2).sign(BEAT, now_us))
        assert link.recv(1.0) == BEAT + BEAT
        counters = link.counters()
        causes = ("unsigned", "bad_signature", "old_signature", "unsealed")
        assert {name: counters[name] for name in causes} == {name: int(name == cause) for name in causes}

    @pytest.mark.parametrize("spoil", ["checksum", "cut short", "flags", "version 1"])
    def test_what_is_no_intact_frame_is_counted_as_unsealed(self, spoil: str) -> None:
        near, far = memory_pair()
        link = SignedLink(far, KEY)
        signed = Signatures(KEY).sign(BEAT, unix_time_us())
        near.send(
            {
                "checksum": signed[:12] + bytes([signed[12] ^ 1]) + signed[13:],
                "cut short": signed[:-1],
                "flags": with_flags(BEAT, 0x02),
                "version 1": bytes(common.MAVLink_heartbeat_message(0, 8, 0, 0, 4, 3).pack(common.MAVLink(None), True)),
            }[spoil]
        )
        assert link.recv(0.0) is None
        assert link.counters()["unsealed"] == 1

    def test_a_frame_cut_in_two_by_a_stream_is_believed_when_it_is_whole(self) -> None:
        near, far = memory_pair()
        link = SignedLink(AsStream(far), KEY)
        signed = Signatures(KEY).sign(BEAT, unix_time_us())
        near.send(signed[:20])
        assert link.recv(0.0) is None
        near.send(signed[20:])
        assert link.recv(0.0) == BEAT

    def test_each_frame_sent_has_a_signature_of_its_own_time(self) -> None:
        near, far = memory_pair()
        SignedLink(near, KEY).send(BEAT + BEAT)
        data = far.recv(0.0)
        assert data is not None
        stamps = [int.from_bytes(frame.raw[-12:-6], "little") for frame in FrameReader(is_datagram=True).read(data)]
        assert stamps[1] == stamps[0] + 1


class Held(MemoryLink):
    """A link that keeps an account of what is done to it."""

    released = 0

    def release_peer(self) -> None:
        self.released += 1

    def recv(self, timeout_s: float) -> bytes | None:
        self.received_ns += 7
        return super().recv(timeout_s)


class TestPlace:
    """Who came first to a link that serves one peer keeps the place only where its words are believed."""

    @pytest.fixture
    def ends(self) -> tuple[MemoryLink, Held, SignedLink]:
        near, far = memory_pair()
        held = Held(far._wire, 1)
        return near, held, SignedLink(held, KEY)

    def test_it_is_given_up_after_each_datagram_until_one_is_believed(
        self, ends: tuple[MemoryLink, Held, SignedLink]
    ) -> None:
        near, held, link = ends
        near.send(BEAT)
        near.send(BEAT)
        assert link.recv(0.01) is None
        assert held.released == 2
        near.send(Signatures(KEY).sign(BEAT, unix_time_us()))
        assert link.recv(0.0) == BEAT
        near.send(BEAT)
        assert link.recv(0.0) is None
        assert held.released == 2, "a believed peer keeps it, whatever a stranger says"

    def test_whoever_releases_it_has_the_next_one_believed_anew(
        self, ends: tuple[MemoryLink, Held, SignedLink]
    ) -> None:
        near, held, link = ends
        near.send(Signatures(KEY).sign(BEAT, unix_time_us()))
        assert link.recv(0.0) == BEAT
        link.release_peer()
        assert held.released == 1
        near.send(BEAT)
        link.recv(0.0)
        assert held.released == 2

    def test_a_stream_has_its_peer_by_its_connection(self, ends: tuple[MemoryLink, Held, SignedLink]) -> None:
        near, held, _ = ends
        near.send(BEAT)
        assert SignedLink(AsStream(held), KEY).recv(0.0) is None
        assert held.released == 0

    def test_what_is_received_keeps_the_stamp_of_its_link(self, ends: tuple[MemoryLink, Held, SignedLink]) -> None:
        near, held, link = ends
        near.send(BEAT)
        near.send(Signatures(KEY).sign(BEAT, unix_time_us()))
        assert link.recv(1.0) == BEAT
        assert link.received_ns == held.received_ns == 14

    def test_a_strangers_words_do_not_end_a_wait(self, ends: tuple[MemoryLink, Held, SignedLink]) -> None:
        near, _, link = ends
        for _ in range(5):
            near.send(BEAT)
        begun_ns = MonotonicClock().now_ns()
        assert link.recv(0.05) is None
        assert MonotonicClock().now_ns() - begun_ns > 40_000_000


def with_flags(raw: bytes, flags: int) -> bytes:
    """A frame with other incompatibility flags, its checksum made to fit."""
    body = raw[1:2] + bytes([flags]) + raw[3:-2]
    checksum: int = common.x25crc(body + bytes([mapping.HEARTBEAT.crc_seed])).crc
    return b"\xfd" + body + checksum.to_bytes(2, "little")


def signature_of(raw: bytes, now_us: int) -> bytes:
    """A good signature behind any bytes."""
    stamp = b"\0" + ((now_us - 1_420_070_400_000_000) // 10).to_bytes(6, "little")
    return stamp + hashlib.sha256(KEY + raw + stamp).digest()[:6]
