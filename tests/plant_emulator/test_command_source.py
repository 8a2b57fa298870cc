"""Which commands the emulator believes, driven by frames over a link: each refusal of `CommandSource` has a test of its own."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from plant_emulator.command_source import CAUSES, CommandSource, Found
from protocol.messages import VEHICLE, FloatArray
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from tests.frames import EMULATOR, command_frame, vehicle_writer
from tests.streams import AsStream

PERIOD_NS = 4_000_000
PERIOD_US = PERIOD_NS // 1000
SCALE = np.array([0.04, 0.05, 0.12, 3e-4, 7e-4, 1.0])
TAU = np.array([0.5, -0.25, 0.125, -0.5, 0.75, -1.0]) * SCALE
OTHER_TAU = -0.5 * TAU
FAR_NS = 1000 * PERIOD_NS
STRANGERS = pytest.mark.parametrize("stranger", [(2, 1), (1, 2), (1, 191), (255, 190), (0, 0)])


class End:
    """The emulator's receiving end of a link, read as `plant_emulator.pacing` reads it."""

    def __init__(self, *, is_datagram: bool = True, oldest_ns: int = 0, latest_ns: int = FAR_NS) -> None:
        self.near, far = memory_pair()
        self._far = far if is_datagram else AsStream(far)
        self._endpoint = Endpoint(self._far, *EMULATOR)
        self.source = CommandSource(self._endpoint.reader, VEHICLE, SCALE, PERIOD_NS)
        self.source.expect(oldest_ns, latest_ns)

    def hear(self, *datagrams: bytes) -> list[int | str]:
        """Send datagrams to this end; in order the times (ns) that commands answer, and the names of other frames."""
        for datagram in datagrams:
            self.near.send(datagram)
        heard: list[int | str] = []
        names = {mapping.HEARTBEAT.message_id: "beat", mapping.COMMAND.message_id: "command"}
        while (data := self._far.recv(0.0)) is not None:
            self.source.feed(data)
            while True:
                found = self.source.read()
                others, self.source.others = self.source.others, []
                heard += [names[frame.message_id] for frame in others]
                if found is Found.COMMAND:
                    heard.append(self.source.newest_ns)
                if self.source.is_read:
                    break
        return heard

    def counted(self) -> dict[str, int]:
        """What was refused, and what the reader counted: the causes that are not zero."""
        counters = {**self._endpoint.reader.counters, **self.source.counters()}
        return {cause: count for cause, count in counters.items() if count}


def command(writer: FrameWriter, t_ns: int, tau: FloatArray = TAU, *, armed: bool = True) -> bytes:
    return command_frame(writer, t_ns, tau, SCALE, armed=armed)


def command_of(writer: FrameWriter, t_us: int, controls: list[float], mode: int = 0xFF) -> bytes:
    payload = mapping.COMMAND.pack_fields(time_usec=t_us, controls=controls, mode=mode)
    return writer.seal(mapping.COMMAND, payload)


def beat(writer: FrameWriter) -> bytes:
    return writer.seal(mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=True))


def as_the_wire_has_it(tau: FloatArray) -> FloatArray:
    return np.array([float(np.float32(one / scale)) * scale for one, scale in zip(tau, SCALE, strict=True)])


@pytest.fixture
def end() -> End:
    return End()


@pytest.fixture
def writer() -> FrameWriter:
    return vehicle_writer()


class TestCommands:
    def test_one_that_answers_a_tick_may_act(self, end: End, writer: FrameWriter) -> None:
        assert end.source.newest_ns < 0
        assert not end.source.armed
        assert end.hear(command(writer, 8 * PERIOD_NS)) == [8 * PERIOD_NS]
        assert end.source.newest.tolist() == as_the_wire_has_it(TAU).tolist()
        assert end.source.armed
        assert end.counted() == {}
        assert end.source.strays == 0

    def test_a_disarmed_one_is_read_as_disarmed(self, end: End, writer: FrameWriter) -> None:
        end.hear(command(writer, 0))
        assert end.hear(command(writer, PERIOD_NS, armed=False)) == [PERIOD_NS]
        assert not end.source.armed
        assert end.hear(command(writer, 2 * PERIOD_NS)) == [2 * PERIOD_NS]
        assert end.source.armed

    @pytest.mark.parametrize(("mode", "armed"), [(0x80, True), (0xFF, True), (0x7F, False), (0, False), (1, False)])
    def test_the_armed_bit_alone_says_whether_it_may_act(
        self, end: End, writer: FrameWriter, mode: int, armed: bool
    ) -> None:
        end.hear(command_of(writer, 0, [0.5] * 6, mode))
        assert end.source.armed == armed

    def test_each_one_in_a_datagram_is_found_in_turn(self, end: End, writer: FrameWriter) -> None:
        end.source.feed(command(writer, 0) + command(writer, PERIOD_NS, OTHER_TAU))
        assert end.source.read() is Found.COMMAND
        assert end.source.newest.tolist() == as_the_wire_has_it(TAU).tolist()
        assert end.source.read() is Found.COMMAND
        assert end.source.newest.tolist() == as_the_wire_has_it(OTHER_TAU).tolist()
        assert end.source.read() is Found.NOTHING

    def test_one_that_a_stream_cuts_in_two_is_put_together(self, writer: FrameWriter) -> None:
        data = beat(writer) + command(writer, 0) + command(writer, PERIOD_NS)
        for cut in range(len(data) + 1):
            end = End(is_datagram=False)
            assert end.hear(data[:cut], data[cut:]) == ["beat", 0, PERIOD_NS], cut
            assert b"".join(end.source.raws) == data
            assert end.counted() == {}

    @pytest.mark.parametrize("count", [1, 64])
    @pytest.mark.parametrize("armed", [None, True, False])
    def test_what_else_comes_changes_nothing_of_it(
        self, end: End, writer: FrameWriter, armed: bool | None, count: int
    ) -> None:
        if armed is not None:
            end.hear(command(writer, PERIOD_NS, armed=armed))
        before = end.source.newest_ns
        assert end.hear(b"".join(beat(writer) for _ in range(count))) == ["beat"] * count
        assert end.source.armed == bool(armed)
        assert (end.source.newest_ns // PERIOD_NS, end.source.newest_ns < 0) == (before // PERIOD_NS, armed is None)


class TestWhoIsBelieved:
    @STRANGERS
    def test_a_strangers_command_does_not_act(self, end: End, writer: FrameWriter, stranger: tuple[int, int]) -> None:
        assert end.hear(command(FrameWriter(*stranger), 0, OTHER_TAU)) == ["command"], "it is heard as any other frame"
        assert end.source.newest_ns < 0
        assert end.source.newest.tolist() == [0.0] * 6
        assert end.source.counters() == dict.fromkeys(CAUSES, 0)
        assert end.hear(command(writer, 0)) == [0], "nor does it take the place of the controller's"

    @STRANGERS
    def test_a_strangers_command_beside_the_controllers_changes_nothing(
        self, end: End, writer: FrameWriter, stranger: tuple[int, int]
    ) -> None:
        strange = command(FrameWriter(*stranger), 0, OTHER_TAU)
        assert end.hear(strange + command(writer, 0) + strange) == ["command", 0, "command"]
        assert end.source.newest.tolist() == as_the_wire_has_it(TAU).tolist()

    def test_the_sender_is_the_one_it_is_told_of(self) -> None:
        near, far = memory_pair()
        source = CommandSource(Endpoint(far, *EMULATOR).reader, (7, 9), SCALE, PERIOD_NS)
        for sender in ((7, 7), (9, 9), (9, 7), (7, 9)):
            near.send(command(FrameWriter(*sender), 0))
            source.feed(far.recv(0.0) or b"")
            assert (source.read() is Found.COMMAND) == (sender == (7, 9))
        assert source.newest_ns == 0, "and before it is told of any, the first tick may be answered"


class TestNumbers:
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize("axis", range(6))
    def test_a_control_that_is_no_number_refuses_the_command(
        self, end: End, writer: FrameWriter, axis: int, value: float
    ) -> None:
        end.hear(command(writer, 0))
        controls = [value if i == axis else 0.25 for i in range(6)]
        assert end.hear(command_of(writer, PERIOD_US, controls)) == []
        assert end.counted() == {"refused_commands": 1}
        assert end.source.newest_ns == 0
        assert end.source.newest.tolist() == as_the_wire_has_it(TAU).tolist(), "the command before it stands"
        assert end.hear(command(writer, PERIOD_NS, OTHER_TAU)) == [PERIOD_NS], "and its tick may still be answered"

    def test_two_that_would_cancel_each_other_refuse_it_too(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(command_of(writer, 0, [math.inf, -math.inf, 0.0, 0.0, 0.0, 0.0])) == []
        assert end.counted() == {"refused_commands": 1}

    def test_the_controls_behind_the_six_are_not_looked_at(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(command_of(writer, 0, [0.5] * 6 + [math.nan] * 10)) == [0]


class TestEchoes:
    def test_one_that_comes_again_does_not_count_as_fresh(self, end: End, writer: FrameWriter) -> None:
        end.hear(command(writer, 0))
        assert end.hear(command(writer, 0, OTHER_TAU), command(writer, 0, armed=False)) == []
        assert end.counted() == {"repeated": 2}
        assert end.source.strays == 2
        assert end.source.armed
        assert end.source.newest.tolist() == as_the_wire_has_it(TAU).tolist()

    def test_one_to_a_tick_before_the_oldest_is_too_late(self, writer: FrameWriter) -> None:
        end = End(oldest_ns=2 * PERIOD_NS, latest_ns=2 * PERIOD_NS)
        assert end.hear(command(writer, PERIOD_NS), command(writer, 0)) == []
        assert end.counted() == {"old_commands": 2}
        assert end.hear(command(writer, 2 * PERIOD_NS)) == [2 * PERIOD_NS]

    def test_one_to_a_tick_before_the_newest_answered_is_too_late(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(command(writer, 2 * PERIOD_NS), command(writer, PERIOD_NS, OTHER_TAU)) == [2 * PERIOD_NS]
        assert end.counted() == {"old_commands": 1}
        assert end.source.newest.tolist() == as_the_wire_has_it(TAU).tolist()

    def test_one_between_the_newest_answered_and_the_tick_may_act_late(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(command(writer, 0), command(writer, PERIOD_NS)) == [0, PERIOD_NS]

    @pytest.mark.parametrize("ahead", [1, 2, 10**6])
    def test_one_to_a_tick_that_was_not_sent_is_unknown(self, writer: FrameWriter, ahead: int) -> None:
        end = End(latest_ns=3 * PERIOD_NS)
        assert end.hear(command(writer, (3 + ahead) * PERIOD_NS)) == []
        assert end.counted() == {"unknown_echoes": 1}
        assert end.hear(command(writer, 3 * PERIOD_NS)) == [3 * PERIOD_NS], "and it shuts nothing out"
        assert end.hear(command(writer, 4 * PERIOD_NS)) == []
        end.source.expect(0, 4 * PERIOD_NS)
        assert end.hear(command(writer, 4 * PERIOD_NS)) == [4 * PERIOD_NS]

    @pytest.mark.parametrize("off_us", [1, PERIOD_US // 2, PERIOD_US - 1])
    def test_one_to_a_time_between_ticks_is_unknown(self, end: End, writer: FrameWriter, off_us: int) -> None:
        assert end.hear(command_of(writer, 5 * PERIOD_US + off_us, [0.5] * 6)) == []
        assert end.counted() == {"unknown_echoes": 1}

    @pytest.mark.parametrize("already", [True, False])
    @pytest.mark.parametrize("t_us", [2**53, 2**63 - 1, 2**63, 2**63 + PERIOD_US, 2**64 - PERIOD_US, 2**64 - 1])
    def test_a_huge_one_is_unknown(self, end: End, writer: FrameWriter, t_us: int, already: bool) -> None:
        if already:
            end.hear(command(writer, 0))
        assert end.hear(command_of(writer, t_us, [0.5] * 6)) == []
        assert end.counted() == {"unknown_echoes": 1}
        assert end.hear(command(writer, PERIOD_NS)) == [PERIOD_NS]


class TestSequence:
    def test_numbers_count_from_the_first_command_on(self, end: End, writer: FrameWriter) -> None:
        writer.sequence = 200
        end.hear(beat(writer))
        writer.sequence = 0
        end.hear(command(writer, 0))
        assert end.counted() == {}
        beat(writer)
        end.hear(command(writer, PERIOD_NS))
        assert end.counted() == {"sequence_gaps": 1}

    def test_others_restart_with_it(self, end: End, writer: FrameWriter) -> None:
        station = FrameWriter(255, 190)
        station.sequence = 9
        end.hear(beat(station), command(writer, 0))
        station.sequence = 50
        end.hear(beat(station), beat(station))
        assert end.counted() == {}

    def test_later_commands_restart_no_numbers(self, end: End, writer: FrameWriter) -> None:
        station = FrameWriter(255, 190)
        for k in range(4):
            end.hear(command(writer, k * PERIOD_NS), beat(station))
            beat(station)
        assert end.counted() == {"sequence_gaps": 3}

    def test_a_command_that_comes_late_is_counted(self, end: End, writer: FrameWriter) -> None:
        first, second, third = (command(writer, k * PERIOD_NS) for k in range(3))
        end.hear(first, third, second)
        assert end.counted() == {"sequence_gaps": 1, "out_of_order": 1, "old_commands": 1}


class TestOthers:
    def test_they_are_heard_where_they_stand_and_all_frames_are_kept_as_they_came(
        self, end: End, writer: FrameWriter
    ) -> None:
        station = FrameWriter(255, 190)
        frames = [beat(station), command(writer, 0), beat(writer), command(writer, 0), command(writer, PERIOD_NS)]
        assert end.hear(b"".join(frames)) == ["beat", 0, "beat", PERIOD_NS]
        assert end.source.raws == frames

    def test_a_lone_command_is_kept_as_it_came(self, end: End, writer: FrameWriter) -> None:
        frame = command(writer, 0)
        end.hear(frame)
        assert end.source.raws == [frame]

    def test_what_stands_around_a_command_and_is_no_frame_is_not_kept(self, writer: FrameWriter) -> None:
        end = End(is_datagram=False)
        frame, other = command(writer, 0), command(writer, PERIOD_NS)
        end.hear(b"\1\2" + frame, other + b"\3")
        assert end.source.raws == [frame, other]

    def test_a_damaged_frame_in_front_of_a_command_is_not_kept(self, end: End, writer: FrameWriter) -> None:
        damaged = bytearray(beat(writer))
        damaged[12] ^= 1
        frame = command(writer, 0)
        assert end.hear(bytes(damaged) + frame) == [0]
        assert end.source.raws == [frame]

    @pytest.mark.parametrize("count", [62, 63, 64, 65, 200])
    def test_any_number_of_them_is_heard_and_kept(self, end: End, writer: FrameWriter, count: int) -> None:
        beats = [beat(writer) for _ in range(count)]
        frame = command(writer, 0)
        assert end.hear(b"".join([*beats, frame, *beats])) == ["beat"] * count + [0] + ["beat"] * count
        assert end.source.raws == [*beats, frame, *beats]

    def test_a_refused_command_is_kept_for_the_log_too(self, end: End, writer: FrameWriter) -> None:
        frame = command_of(writer, 0, [math.nan] * 6)
        assert end.hear(frame) == []
        assert end.source.raws == [frame]


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.integers(-1, 8), st.booleans(), st.booleans(), st.integers(0, 4)), max_size=30),
    st.integers(0, 3),
)
def test_whatever_comes_what_acts_answers_a_tick_in_the_window_and_is_newer_than_the_last(
    steps: list[tuple[int, bool, bool, int]], width: int
) -> None:
    """Against the rule in plain words, with a window of ticks that moves on."""
    end, ours, theirs = End(), vehicle_writer(), FrameWriter(1, 2)
    newest, refused = -1, 0
    for at, (k, is_ours, is_finite, wait) in enumerate(steps):
        latest = at // (wait + 1)
        oldest = max(0, latest - width)
        end.source.expect(oldest * PERIOD_NS, latest * PERIOD_NS)
        controls = [0.01 * at if is_finite else math.nan] * 6
        heard = end.hear(command_of(ours if is_ours else theirs, k * PERIOD_US % 2**64, controls))
        if not is_ours:
            assert heard == ["command"]
        elif is_finite and max(oldest, newest + 1) <= k <= latest:
            assert heard == [k * PERIOD_NS]
            newest = k
        else:
            assert heard == []
            refused += 1
        assert end.source.strays == refused
