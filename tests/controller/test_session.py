"""The session with the emulator: who is heard, who may arm and when, what is said, when the peer counts as lost."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import common

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from bridge.timing.timesync import TimeSync
from controller.parameters import Parameters
from controller.session import HELLO_PERIOD_S, HilSession
from protocol.errors import Interrupted, PeerLostError, PeerMissingError, ScenarioMismatchError
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader, FrameWriter, Layout
from protocol.wire.parameter_mapping import VALUE, decode_value
from protocol.wire.requests import ARM_DISARM, Result
from tests.loop import scenario_of

DIGEST, OTHER_DIGEST = b"12345678", b"87654321"
EMULATOR = (1, 191)
MS = 1_000_000
STRANGERS = pytest.mark.parametrize("stranger", [(2, 191), (1, 190), (1, 1), (255, 190)])
FLAPPER = scenario_of("flapper")


def frame(system: int, component: int, message: Layout, payload: bytes) -> Frame:
    (read,) = FrameReader(is_datagram=True).read(FrameWriter(system, component).seal(message, payload))
    return read


def request(param1: float, *, target: tuple[int, int] = (1, 1), command: int = ARM_DISARM) -> Frame:
    payload = mapping.COMMAND_LONG.pack_fields(
        command=command, param1=param1, param2=math.nan, target_system=target[0], target_component=target[1]
    )
    return frame(255, 190, mapping.COMMAND_LONG, payload)


def version(digest: bytes = DIGEST, sender: tuple[int, int] = EMULATOR) -> Frame:
    return frame(*sender, mapping.VERSION, mapping.encode_version(digest))


def farewell(sender: tuple[int, int] = EMULATOR) -> Frame:
    return frame(*sender, mapping.HEARTBEAT, mapping.encode_emulator_heartbeat(ending=True))


def said(made: HilSession, t_ns: int) -> list[Frame]:
    """What travels with the answer to the sample of t_ns."""
    return [one for raw in made.due_frames(t_ns) for one in FrameReader(is_datagram=True).read(raw)]


def session(*, arm: bool = False, agreed: bool = True) -> HilSession:
    near, _ = memory_pair()
    made = HilSession(Endpoint(near, 1, 1), DIGEST, (1, 191), arm=arm)
    if agreed:
        made.hear(frame(1, 191, mapping.VERSION, mapping.encode_version(DIGEST)))
    return made


def test_it_starts_disarmed_and_arms_by_itself_only_when_told_to() -> None:
    assert not session(arm=True, agreed=False).armed
    assert session(arm=True).armed
    assert not session(arm=False).armed


def test_a_station_arms_and_disarms_it() -> None:
    made = session()
    made.hear(request(1.0))
    assert made.armed
    made.hear(request(0.0))
    assert not made.armed


@pytest.mark.parametrize("param1", [math.nan, 0.5, -1.0])
def test_what_asks_for_neither_changes_nothing(param1: float) -> None:
    made = session(arm=True)
    made.hear(request(param1))
    assert made.armed


def test_requests_to_others_and_other_commands_change_nothing() -> None:
    made = session()
    for one in (request(1.0, target=(2, 1)), request(1.0, target=(1, 2)), request(1.0, command=511)):
        made.hear(one)
    assert not made.armed


def test_it_does_not_arm_before_the_emulator_has_shown_the_same_scenario() -> None:
    made = session(agreed=False)
    made.hear(request(1.0))
    assert not made.armed


def test_another_scenario_is_refused() -> None:
    with pytest.raises(ScenarioMismatchError):
        session().hear(frame(1, 191, mapping.VERSION, mapping.encode_version(OTHER_DIGEST)))


class TestWhoIsHeard:
    @STRANGERS
    def test_a_stranger_with_the_same_scenario_does_not_arm_it(self, stranger: tuple[int, int]) -> None:
        made = session(arm=True, agreed=False)
        made.hear(version(sender=stranger))
        assert not made.agreed
        assert not made.armed

    @STRANGERS
    def test_a_stranger_with_another_scenario_is_no_reason_to_end(self, stranger: tuple[int, int]) -> None:
        made = session(arm=True)
        made.hear(version(OTHER_DIGEST, stranger))
        assert made.agreed
        assert made.armed

    @STRANGERS
    def test_a_strangers_farewell_ends_nothing(self, stranger: tuple[int, int]) -> None:
        made = session()
        made.hear(farewell(stranger))
        assert not made.ended

    def test_the_emulators_farewell_ends_the_run_and_its_heartbeat_does_not(self) -> None:
        made = session()
        made.hear(frame(*EMULATOR, mapping.HEARTBEAT, mapping.encode_emulator_heartbeat()))
        assert not made.ended
        made.hear(farewell())
        assert made.ended

    def test_other_messages_that_could_be_read_as_a_farewell_end_nothing(self) -> None:
        made = session()
        made.hear(frame(*EMULATOR, mapping.GPS, mapping.encode_emulator_heartbeat(ending=True)))
        assert not made.ended


class TestArming:
    def test_a_version_that_comes_again_does_not_arm_what_was_disarmed(self) -> None:
        made = session(arm=True)
        made.hear(request(0.0))
        made.hear(version())
        assert not made.armed

    @pytest.mark.parametrize(
        ("agreed", "param1", "result"),
        [
            (True, 1.0, Result.ACCEPTED),
            (True, 0.0, Result.ACCEPTED),
            (False, 1.0, Result.DENIED),
            (False, 0.0, Result.ACCEPTED),  # to disarm is allowed at any time
            (True, math.nan, Result.DENIED),
        ],
    )
    def test_who_asks_is_answered_with_the_next_command(self, agreed: bool, param1: float, result: Result) -> None:
        made = session(agreed=agreed)
        made.hear(request(param1))
        (answer,) = [one for one in said(made, 0) if one.message_id == mapping.COMMAND_ACK.message_id]
        values = mapping.COMMAND_ACK.unpack_fields(answer.payload)
        assert (values["command"], values["result"]) == (ARM_DISARM, result)
        assert said(made, 1) == []


class TestWhatIsSaid:
    def test_a_heartbeat_a_second_of_simulation_time_says_whether_it_is_armed(self) -> None:
        made = session()
        beats = []
        for t_ns in range(0, 3_000 * MS, 4 * MS):
            if t_ns == 1_500 * MS:
                made.armed = True
            beats += [(t_ns // MS, one) for one in said(made, t_ns)]
        assert [t for t, _ in beats] == [0, 1_000, 2_000]
        assert [mapping.heartbeat_is_armed(one.payload) for _, one in beats] == [False, False, True]

    @pytest.mark.parametrize(("name", "ours"), [("HEARTBEAT", 0), ("AUTOPILOT_VERSION", 148)])
    def test_both_of_its_messages_are_given_when_asked_for(self, name: str, ours: int) -> None:
        made = session()
        said(made, 0)
        made.hear(request(float(ours), command=512))
        (answer, asked) = said(made, 4 * MS)
        assert mapping.COMMAND_ACK.unpack_fields(answer.payload)["result"] == 0
        assert asked.message_id == ours, name
        if name == "AUTOPILOT_VERSION":
            assert mapping.decode_version(asked.payload) == DIGEST
            capabilities = mapping.VERSION.unpack_fields(asked.payload)["capabilities"]
            # MAVSDK looks at these two before it reads a parameter
            assert capabilities & common.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
            assert capabilities & common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE

    def test_each_parameter_is_said_once_from_the_first_answer_on_one_at_a_time(self) -> None:
        parameters = Parameters(FLAPPER, lambda _scenario: None)
        near, _ = memory_pair()
        made = HilSession(Endpoint(near, 1, 1), DIGEST, EMULATOR, arm=False, parameters=parameters)
        names = []
        for tick in range(1200):
            values = [one for one in said(made, tick * 4 * MS) if one.message_id == VALUE.message_id]
            assert len(values) <= 1
            assert bool(values) == (tick % 5 == 0 and tick < 5 * len(parameters.table))  # 50 Hz
            names += [decode_value(one.payload)[0] for one in values]
        assert names == [one.name for one in parameters.table]
        made.say_parameter(3)
        made.say_parameter(1)
        changed = [
            decode_value(one.payload)[0] for one in said(made, 10_000 * MS) if one.message_id == VALUE.message_id
        ]
        assert changed == [parameters.table[3].name, parameters.table[1].name]
        assert all(one.message_id != VALUE.message_id for one in said(made, 20_000 * MS))

    def test_a_parameter_changed_at_the_start_holds_up_none_of_those_not_yet_said(self) -> None:
        parameters = Parameters(FLAPPER, lambda _scenario: None)
        near, _ = memory_pair()
        made = HilSession(Endpoint(near, 1, 1), DIGEST, EMULATOR, arm=False, parameters=parameters)
        made.say_parameter(5)
        names = [
            decode_value(one.payload)[0]
            for tick in range(1200)
            for one in said(made, tick * 4 * MS)
            if one.message_id == VALUE.message_id
        ]
        assert names == [parameters.table[5].name, *(one.name for one in parameters.table)]

    @pytest.mark.parametrize("in_real_time", [True, False])
    def test_the_time_is_told_in_real_time_only(self, in_real_time: bool) -> None:
        near, far = memory_pair()
        endpoint = Endpoint(near, 1, 1)
        sync = TimeSync(endpoint.seal, VirtualClock(5_000)) if in_real_time else None
        made = HilSession(endpoint, DIGEST, EMULATOR, arm=False, time_sync=sync)
        made.hear(frame(*EMULATOR, mapping.TIMESYNC, mapping.encode_timesync(0, 77)))
        answer = far.recv(0.0)
        if not in_real_time:
            assert answer is None
            return
        assert answer is not None
        (told,) = FrameReader(is_datagram=True).read(answer)
        assert mapping.decode_timesync(told.payload) == (5_000, 77)
        made.hear(frame(*EMULATOR, mapping.TIMESYNC, mapping.encode_timesync(9, 77)))  # no question
        assert far.recv(0.0) is None


class TestSilence:
    def test_waits_add_up_to_three_seconds_and_no_more(self) -> None:
        made = session()
        assert not made.is_silent
        for _ in range(3):
            made.count_silence(1_000 * MS, 1_000 * MS, 0)
        assert made.is_silent
        with pytest.raises(PeerLostError, match=r"fell silent for 3 s after t = 1\.500 s"):
            made.count_silence(1, 1_000 * MS, 1_500 * MS)

    def test_whatever_is_heard_begins_the_count_anew(self) -> None:
        made = session()
        made.count_silence(3_000 * MS, 3_000 * MS, 0)
        made.heard()
        assert not made.is_silent
        made.count_silence(3_000 * MS, 3_000 * MS, 0)

    def test_a_stall_of_the_machine_counts_as_one_wait(self) -> None:
        made = session()
        for _ in range(30):
            made.count_silence(60_000 * MS, 100 * MS, 0)
        with pytest.raises(PeerLostError):
            made.count_silence(60_000 * MS, 100 * MS, 0)


class Meeting:
    """A session that says hello on a clock that only moves while it listens."""

    def __init__(self, *, arm: bool = True) -> None:
        self._near, self.far = memory_pair()
        self.clock = VirtualClock(7_000 * MS)
        self.stop = StopFlag()
        self.session = HilSession(Endpoint(self._near, 1, 1), DIGEST, EMULATOR, arm=arm)
        self.listened_ns: list[int] = []

    def meet(
        self,
        heard: Callable[[int], list[Frame]] = lambda _count: [],
        met: Callable[[], bool] = lambda: False,
        wait_s: float = 1.0,
    ) -> None:
        def listen(timeout_s: float) -> None:
            self.listened_ns.append(self.clock.now_ns())
            for one in heard(len(self.listened_ns)):
                self.session.hear(one)
            self.clock.advance_ns(round(timeout_s * 1e9))

        self.session.meet(listen, met, self.clock, wait_s, self.stop)

    def hellos(self) -> list[list[int]]:
        """The messages of each datagram sent."""
        reader, found = FrameReader(is_datagram=True, follow_sequence=False), []
        while (data := self.far.recv(0.0)) is not None:
            found.append([one.message_id for one in reader.read(data)])
        return found


class TestMeeting:
    def test_it_says_hello_ten_times_a_second_and_gives_up_with_what_to_do(self) -> None:
        meeting = Meeting()
        with pytest.raises(PeerMissingError, match=r"no emulator at mem://.* within 1 s: start one with"):
            meeting.meet()
        assert HELLO_PERIOD_S == 0.1
        assert meeting.hellos() == [[mapping.HEARTBEAT.message_id, mapping.VERSION.message_id]] * 10
        assert len(meeting.listened_ns) == 10

    def test_traffic_does_not_make_it_say_hello_more_often(self) -> None:
        near, far = memory_pair()
        clock = VirtualClock()
        made = HilSession(Endpoint(near, 1, 1), DIGEST, EMULATOR, arm=True)
        with pytest.raises(PeerMissingError):
            made.meet(lambda _timeout_s: clock.advance_ns(10 * MS), lambda: False, clock, 1.0, StopFlag())
        count = 0
        while far.recv(0.0) is not None:
            count += 1
        assert count == 10

    def test_an_emulator_that_agreed_and_sends_no_tick_waits_for_arming(self) -> None:
        with pytest.raises(PeerMissingError, match="sent no tick within 1 s: arm this controller with --arm"):
            Meeting(arm=False).meet(lambda _count: [version()])

    def test_the_first_sample_ends_the_meeting(self) -> None:
        meeting = Meeting()
        meeting.meet(met=lambda: len(meeting.listened_ns) == 3)
        assert len(meeting.listened_ns) == 3

    def test_so_does_the_emulators_farewell(self) -> None:
        meeting = Meeting()
        meeting.meet(lambda count: [farewell()] if count == 2 else [])
        assert meeting.session.ended
        assert len(meeting.listened_ns) == 2

    def test_an_interruption_ends_it_at_once(self) -> None:
        meeting = Meeting()
        meeting.stop.requested = True
        with pytest.raises(Interrupted):
            meeting.meet()
        assert meeting.listened_ns == []

    def test_once_both_agree_it_says_so_at_once_and_is_armed(self) -> None:
        """The emulator waits for an armed heartbeat: the next tenth of a second would be lost."""
        near, far = memory_pair()
        clock = VirtualClock()
        made = HilSession(Endpoint(near, 1, 1), DIGEST, EMULATOR, arm=True)
        listened = 0

        def listen(_timeout_s: float) -> None:
            nonlocal listened
            listened += 1
            clock.advance_ns(MS)
            if listened == 1:
                made.hear(version())

        made.meet(listen, lambda: listened == 4, clock, 1.0, StopFlag())
        beats = []
        while (data := far.recv(0.0)) is not None:
            beats += FrameReader(is_datagram=True).read(data)[:1]
        assert [mapping.heartbeat_is_armed(one.payload) for one in beats] == [False, True]

    def test_requests_are_answered_while_it_waits(self) -> None:
        meeting = Meeting(arm=False)
        with pytest.raises(PeerMissingError):
            meeting.meet(lambda count: [request(1.0)] if count == 1 else [])
        hello = [mapping.HEARTBEAT.message_id, mapping.VERSION.message_id]
        assert meeting.hellos() == [hello, [*hello, mapping.COMMAND_ACK.message_id], *[hello] * 8]
