"""Before the first tick: who lets the run begin, what is said meanwhile, and what a user is told where nobody comes."""

from __future__ import annotations

from itertools import pairwise

import pytest

from bridge.endpoint import Endpoint
from bridge.links.link import Link
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from plant_emulator.pacing.meeting import HELLO_PERIOD_S, meet_autopilot, meet_controller
from plant_emulator.tick import Emulator
from protocol.errors import Interrupted, PeerMissingError, ScenarioMismatchError
from protocol.messages import VEHICLE
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter
from tests.frames import EMULATOR
from tests.loop import scenario_of

SCENARIO = scenario_of("flapper")
DIGEST = SCENARIO.digest()
BEAT, VERSION, ACK = (one.message_id for one in (mapping.HEARTBEAT, mapping.VERSION, mapping.COMMAND_ACK))
STRANGERS = pytest.mark.parametrize("stranger", [(1, 2), (2, 1), (255, 190)])


class Script(Link):
    """What comes, one by one, None for nothing within the timeout; then nothing any more. Time passes while one waits."""

    is_datagram = True
    peer = "the script"

    def __init__(self, *coming: bytes | None) -> None:
        super().__init__("udpin://127.0.0.1:14560")
        self.clock = VirtualClock(5 * 10**9)
        self.coming = list(coming)
        self.sent: list[tuple[int, list[int]]] = []

    def recv(self, timeout_s: float) -> bytes | None:
        data = self.coming.pop(0) if self.coming else None
        self.clock.advance_ns(1_000_000 if data else round(timeout_s * 1e9))
        return data

    def send(self, data: bytes | bytearray | memoryview) -> None:
        frames = FrameReader(is_datagram=True, follow_sequence=False).read(bytes(data))
        assert {(frame.system, frame.component) for frame in frames} == {EMULATOR}
        self.sent.append((self.clock.now_ns() // 1_000_000 - 5000, [frame.message_id for frame in frames]))

    def close(self) -> None:
        pass


def version(sender: tuple[int, int] = VEHICLE, digest: bytes = DIGEST) -> bytes:
    return FrameWriter(*sender).seal(mapping.VERSION, mapping.encode_version(digest))


def beat(sender: tuple[int, int] = VEHICLE, *, armed: bool = True) -> bytes:
    return FrameWriter(*sender).seal(mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=armed))


@pytest.fixture
def stop() -> StopFlag:
    return StopFlag()


def meet(
    monkeypatch: pytest.MonkeyPatch,
    link: Script,
    *,
    stop: StopFlag | None = None,
    autopilot: bool = False,
    wait_s: float = 1.0,
) -> Endpoint:
    monkeypatch.setattr("plant_emulator.pacing.meeting.MonotonicClock", lambda: link.clock)
    endpoint = Endpoint(link, *EMULATOR)
    endpoint.writer.sequence = 200
    emulator = Emulator(SCENARIO, endpoint, None)
    if autopilot:
        meet_autopilot(wait_s, endpoint, stop or StopFlag(), emulator)
    else:
        meet_controller(SCENARIO, wait_s, endpoint, stop or StopFlag(), emulator)
    return endpoint


class TestController:
    def test_the_same_scenario_and_an_armed_heartbeat_begin_the_run(self, monkeypatch: pytest.MonkeyPatch) -> None:
        link = Script(version(), beat(), b"left for the run")
        endpoint = meet(monkeypatch, link)
        assert link.coming == [b"left for the run"]
        assert endpoint.writer.sequence == 0

    def test_both_may_come_in_one_datagram(self, monkeypatch: pytest.MonkeyPatch) -> None:
        meet(monkeypatch, Script(version() + beat()))

    @pytest.mark.parametrize(
        "coming",
        [(beat(), beat()), (version(), version()), (version(), beat(armed=False)), (beat(), version())],
        ids=["no version", "no heartbeat", "disarmed", "armed before it agreed"],
    )
    def test_nothing_less_does(self, monkeypatch: pytest.MonkeyPatch, coming: tuple[bytes, ...]) -> None:
        with pytest.raises(PeerMissingError, match="at the script did not arm within 1 s: start it with --arm"):
            meet(monkeypatch, Script(*coming))

    @STRANGERS
    def test_a_strangers_words_do_not(self, monkeypatch: pytest.MonkeyPatch, stranger: tuple[int, int]) -> None:
        with pytest.raises(PeerMissingError, match="did not arm"):
            meet(monkeypatch, Script(version(stranger), beat()))
        with pytest.raises(PeerMissingError, match="did not arm"):
            meet(monkeypatch, Script(version(), beat(stranger)))
        with pytest.raises(PeerMissingError, match="no controller connected"):
            meet(monkeypatch, Script(version(stranger), beat(stranger)))

    def test_another_scenario_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(ScenarioMismatchError, match="the controller runs another scenario"):
            meet(monkeypatch, Script(version(digest=b"another!"), beat()))

    @STRANGERS
    def test_a_strangers_other_scenario_is_no_matter(
        self, monkeypatch: pytest.MonkeyPatch, stranger: tuple[int, int]
    ) -> None:
        meet(monkeypatch, Script(version(stranger, b"another!"), version(), beat()))

    def test_it_is_silent_until_it_is_spoken_to_then_says_hello_ten_times_a_second(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        link = Script(None, None, beat(armed=False))
        with pytest.raises(PeerMissingError):
            meet(monkeypatch, link)
        assert HELLO_PERIOD_S == 0.1
        times = [t_ms for t_ms, _ in link.sent]
        assert times[0] == 201, "at once"
        assert {later - earlier for earlier, later in pairwise(times[1:])} == {100}
        assert len(times) in (9, 10)
        assert all(ids == [BEAT, VERSION] for _, ids in link.sent)

    @pytest.mark.parametrize("autopilot", [False, True])
    def test_traffic_does_not_make_it_say_hello_more_often(
        self, monkeypatch: pytest.MonkeyPatch, autopilot: bool
    ) -> None:
        chatter = beat((255, 190)) if autopilot else beat(armed=False)
        link = Script(*[chatter] * 500)
        with pytest.raises(PeerMissingError):
            meet(monkeypatch, link, autopilot=autopilot, wait_s=0.5)
        hellos = [t_ms for t_ms, _ in link.sent]
        assert hellos[-4:] == [100, 200, 300, 400]
        assert len(hellos) == (5 if autopilot else 6), "at once, and to whom it does not know yet once more"

    def test_requests_are_answered_meanwhile(self, monkeypatch: pytest.MonkeyPatch) -> None:
        asked = mapping.COMMAND_LONG.pack_fields(command=512, param1=115.0)
        link = Script(FrameWriter(255, 190).seal(mapping.COMMAND_LONG, asked))
        with pytest.raises(PeerMissingError, match="no controller connected"):
            meet(monkeypatch, link)
        assert link.sent == [(1, [ACK])]

    def test_nobody_is_said_with_what_to_start(self, monkeypatch: pytest.MonkeyPatch) -> None:
        link = Script()
        with pytest.raises(PeerMissingError, match=r"--link udpout://127\.0\.0\.1:14560`") as caught:
            meet(monkeypatch, link, wait_s=0.5)
        assert "within 0.5 s" in str(caught.value)
        assert link.clock.now_ns() == 5 * 10**9 + 500_000_000
        assert link.sent == []

    def test_a_stop_ends_it_at_once(self, monkeypatch: pytest.MonkeyPatch, stop: StopFlag) -> None:
        stop.requested = True
        link = Script(version(), beat())
        with pytest.raises(Interrupted):
            meet(monkeypatch, link, stop=stop)
        assert len(link.coming) == 2


class TestAutopilot:
    def test_whatever_it_says_begins_the_run(self, monkeypatch: pytest.MonkeyPatch) -> None:
        link = Script(None, beat(armed=False), b"left for the run")
        endpoint = meet(monkeypatch, link, autopilot=True)
        assert endpoint.writer.sequence == 0
        assert link.coming == [b"left for the run"]
        assert link.sent == [(0, [BEAT]), (100, [BEAT])]

    @STRANGERS
    def test_a_strangers_words_do_not(self, monkeypatch: pytest.MonkeyPatch, stranger: tuple[int, int]) -> None:
        link = Script(beat(stranger))
        with pytest.raises(PeerMissingError, match=r"no autopilot connected to udpin://.* within 1 s"):
            meet(monkeypatch, link, autopilot=True)
        assert link.clock.now_ns() >= 6 * 10**9
        assert [ids for _, ids in link.sent] == [[BEAT]] * len(link.sent)
        assert len(link.sent) in (10, 11)

    def test_what_it_asks_for_is_answered_with_the_first_tick(self, monkeypatch: pytest.MonkeyPatch) -> None:
        asked = mapping.COMMAND_LONG.pack_fields(command=511, param1=115.0, param2=5000.0)
        link = Script(FrameWriter(*VEHICLE).seal(mapping.COMMAND_LONG, asked))
        monkeypatch.setattr("plant_emulator.pacing.meeting.MonotonicClock", lambda: link.clock)
        endpoint = Endpoint(link, *EMULATOR)
        emulator = Emulator(SCENARIO, endpoint, None)
        meet_autopilot(1.0, endpoint, StopFlag(), emulator)
        assert [ids for _, ids in link.sent] == [[BEAT]]
        (first, *_) = FrameReader(is_datagram=True).read(emulator.sense(0))
        assert first.message_id == ACK

    def test_a_stop_ends_it_at_once(self, monkeypatch: pytest.MonkeyPatch, stop: StopFlag) -> None:
        stop.requested = True
        with pytest.raises(Interrupted):
            meet(monkeypatch, Script(beat()), stop=stop, autopilot=True)
