"""What the controller takes for a sample, driven by frames over a link: each refusal of `HilSource` has a test of its own."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from controller.sources.hil import CAUSES, HilSource
from controller.sources.source import Found
from protocol.messages import VEHICLE, FloatArray
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter, layout
from tests.frames import EMULATOR, NO_READINGS, emulator_writer, tick_frames
from tests.streams import AsStream

MS = 1_000_000
Q = np.array([0.25, -0.5, 1.5, 0.1, -0.2, 0.3])
OTHER_Q = np.array([1.0, 2.0, 3.0, -0.3, 0.2, 0.1])
AGAIN = "again"
STRANGERS = pytest.mark.parametrize("stranger", [(2, 191), (1, 190), (1, 1), (255, 190), (0, 0)])


class End:
    """The controller's receiving end of a link, heard as `controller.tick` hears it."""

    def __init__(self, *, is_datagram: bool = True) -> None:
        self.near, far = memory_pair()
        self._far = far if is_datagram else AsStream(far)
        self._endpoint = Endpoint(self._far, *VEHICLE)
        self.source = HilSource(self._endpoint.reader, EMULATOR)

    def hear(self, *datagrams: bytes) -> list[int | str]:
        """Send datagrams to this end; what it found in them, in order: times of samples (ns), AGAIN, names of others."""
        for datagram in datagrams:
            self.near.send(datagram)
        heard: list[int | str] = []
        names = {layout(name).message_id: name for name in ("HEARTBEAT", "COMMAND_LONG", "HIL_GPS", "HIL_SENSOR")}
        while (data := self._far.recv(0.0)) is not None:
            self.source.feed(data)
            while True:
                found = self.source.read()
                others, self.source.others = self.source.others, []
                heard += [names[frame.message_id] for frame in others]
                if found is Found.SAMPLE:
                    heard.append(self.source.t_ns)
                elif found is Found.AGAIN:
                    heard.append(AGAIN)
                if self.source.is_read:
                    break
        return heard

    def counted(self) -> dict[str, int]:
        """What was refused, and what the reader counted: the causes that are not zero."""
        counters = {**self._endpoint.reader.counters, **self.source.counters()}
        return {cause: count for cause, count in counters.items() if count}


def pose(writer: FrameWriter, t_ns: int, q: FloatArray = Q) -> bytes:
    return writer.seal(mapping.POSE, mapping.encode_pose(t_ns, q))


def tick(writer: FrameWriter, t_ns: int) -> bytes:
    return writer.seal(mapping.TICK, mapping.encode_tick(t_ns, NO_READINGS))


def tick_at_us(writer: FrameWriter, t_us: int, **fields: int) -> bytes:
    return writer.seal(mapping.TICK, mapping.TICK.pack_fields(time_usec=t_us, **fields))


def pose_at_us(writer: FrameWriter, t_us: int) -> bytes:
    return writer.seal(mapping.POSE, mapping.POSE.pack_fields(time_usec=t_us, q=(1.0, 0.0, 0.0, 0.0)))


def beat(writer: FrameWriter) -> bytes:
    return writer.seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat())


def as_the_wire_has_it(q: FloatArray) -> FloatArray:
    sample = mapping.decode_pose(mapping.encode_pose(0, q))
    assert sample is not None
    return sample.q


@pytest.fixture
def end() -> End:
    return End()


@pytest.fixture
def writer() -> FrameWriter:
    return emulator_writer()


class TestSamples:
    def test_a_pose_and_the_tick_of_its_time_are_a_sample(self, end: End, writer: FrameWriter) -> None:
        assert end.source.t_ns < 0
        assert end.hear(tick_frames(writer, 4 * MS, Q)) == [4 * MS]
        assert end.source.t_ns == 4 * MS
        assert end.source.q.tobytes() == as_the_wire_has_it(Q).tobytes()
        assert end.counted() == {}

    def test_they_may_come_in_datagrams_of_their_own(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(pose(writer, 0), tick(writer, 0)) == [0]

    def test_the_newest_pose_of_a_time_counts(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(pose(writer, 0, OTHER_Q) + tick_frames(writer, 0, Q)) == [0]
        assert end.source.q.tobytes() == as_the_wire_has_it(Q).tobytes()

    def test_nothing_is_no_sample(self, end: End) -> None:
        assert end.hear(b"") == []
        assert end.source.read() is Found.NOTHING


class TestWhoIsBelieved:
    @STRANGERS
    def test_a_strangers_tick_is_no_sample(self, end: End, writer: FrameWriter, stranger: tuple[int, int]) -> None:
        assert end.hear(pose(writer, 0) + tick(FrameWriter(*stranger), 0)) == []
        assert end.counted() == {"unknown_sender": 1}
        assert end.hear(tick(writer, 0)) == [0], "and it has taken nothing from the emulator's"

    @STRANGERS
    def test_a_strangers_pose_is_no_pose(self, end: End, writer: FrameWriter, stranger: tuple[int, int]) -> None:
        assert end.hear(pose(FrameWriter(*stranger), 0) + tick(writer, 0)) == []
        assert end.counted() == {"unknown_sender": 1, "tick_without_pose": 1}

    @STRANGERS
    def test_a_strangers_pose_behind_the_emulators_changes_nothing(
        self, end: End, writer: FrameWriter, stranger: tuple[int, int]
    ) -> None:
        assert end.hear(pose(writer, 0) + pose(FrameWriter(*stranger), 0, OTHER_Q) + tick(writer, 0)) == [0]
        assert end.source.q.tobytes() == as_the_wire_has_it(Q).tobytes()
        assert end.counted() == {"unknown_sender": 1}

    def test_the_tick_is_instance_0_of_the_sensor(self, end: End, writer: FrameWriter) -> None:
        for number in (1, 2, 255):
            assert end.hear(pose(writer, 0) + tick_at_us(writer, 0, id=number)) == []
        assert end.counted() == {}
        assert end.hear(tick(writer, 0)) == [0]


class TestTime:
    def test_it_never_runs_back(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(tick_frames(writer, 8 * MS, Q)) == [8 * MS]
        assert end.hear(tick_frames(writer, 8 * MS - 1000, OTHER_Q), tick_frames(writer, 0, OTHER_Q)) == []
        assert end.counted() == {"backwards": 2}
        assert end.source.t_ns == 8 * MS
        assert end.source.q.tobytes() == as_the_wire_has_it(Q).tobytes()
        assert end.hear(tick_frames(writer, 8 * MS + 1000, Q)) == [8 * MS + 1000]

    def test_the_newest_tick_once_more_is_no_new_sample(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(tick_frames(writer, 4 * MS, Q), tick_frames(writer, 4 * MS, OTHER_Q)) == [4 * MS, AGAIN]
        assert end.source.q.tobytes() == as_the_wire_has_it(Q).tobytes(), "whatever its pose says"
        assert end.counted() == {}

    def test_the_newest_tick_once_more_needs_no_pose(self, end: End, writer: FrameWriter) -> None:
        assert end.hear(tick_frames(writer, 4 * MS, Q), tick(writer, 4 * MS)) == [4 * MS, AGAIN]

    @pytest.mark.parametrize("t_us", [2**53, 2**63 - 1, 2**63, 2**64 - 1])
    def test_one_out_of_all_range_is_no_time(self, end: End, writer: FrameWriter, t_us: int) -> None:
        assert end.hear(pose_at_us(writer, t_us) + tick_at_us(writer, t_us)) == []
        assert end.counted() == {"bad_time": 1}
        assert end.hear(tick_frames(writer, 0, Q)) == [0], "and it shuts nothing out"
        assert end.hear(pose_at_us(writer, t_us) + tick_at_us(writer, t_us)) == []
        assert end.counted() == {"bad_time": 2}

    def test_the_last_one_in_range_is_one(self, end: End, writer: FrameWriter) -> None:
        latest_us = 2**53 - 1
        assert end.hear(pose_at_us(writer, latest_us) + tick_at_us(writer, latest_us)) == [latest_us * 1000]


class TestPoses:
    @pytest.mark.parametrize("pose_ns", [0, 4 * MS - 1000, 4 * MS + 1000, 8 * MS])
    def test_one_of_another_time_is_not_the_ticks(self, end: End, writer: FrameWriter, pose_ns: int) -> None:
        assert end.hear(pose(writer, pose_ns) + tick(writer, 4 * MS)) == []
        assert end.counted() == {"tick_without_pose": 1}

    @pytest.mark.parametrize("t_ns", [0, 1000, 4 * MS])
    def test_a_tick_whose_pose_was_lost_is_no_sample(self, end: End, writer: FrameWriter, t_ns: int) -> None:
        assert end.hear(tick(writer, t_ns)) == []
        assert end.counted() == {"tick_without_pose": 1}
        assert end.hear(tick_frames(writer, t_ns, Q)) == [t_ns], "sent again, whole, it is one"
        assert end.hear(tick(writer, t_ns + 4 * MS)) == [], "the pose before it is not used twice"
        assert end.counted() == {"tick_without_pose": 2}

    def test_a_tick_whose_pose_was_damaged_is_no_sample(self, end: End, writer: FrameWriter) -> None:
        damaged = bytearray(pose(writer, 0))
        damaged[12] ^= 1
        assert end.hear(bytes(damaged) + tick(writer, 0)) == []
        assert end.counted() == {"bad_crc": 1, "tick_without_pose": 1}

    BAD = pytest.mark.parametrize(
        "fields",
        [
            *({"q": (1.0, 0.0, 0.0, 0.0), name: value} for name in "xyz" for value in (math.nan, math.inf, -math.inf)),
            *(
                {"q": tuple(value if i == at else 0.5 for i in range(4))}
                for at in range(4)
                for value in (math.nan, math.inf, -math.inf)
            ),
            {"q": (0.0, 0.0, 0.0, 0.0)},
            {"q": (1.002, 0.0, 0.0, 0.0)},
            {"q": (0.998, 0.0, 0.0, 0.0)},
            {"q": (0.5, 0.5, 0.5, 0.6)},
        ],
    )

    @BAD
    def test_one_that_holds_no_pose_is_refused(self, end: End, writer: FrameWriter, fields: dict[str, object]) -> None:
        bad = writer.seal(mapping.POSE, mapping.POSE.pack_fields(time_usec=1, **fields))
        assert end.hear(bad + tick(writer, 1000)) == []
        assert end.counted() == {"bad_pose": 1, "tick_without_pose": 1}

    @BAD
    def test_one_that_holds_no_pose_takes_the_place_of_the_one_before_it(
        self, end: End, writer: FrameWriter, fields: dict[str, object]
    ) -> None:
        bad = writer.seal(mapping.POSE, mapping.POSE.pack_fields(time_usec=4000, **fields))
        assert end.hear(tick_frames(writer, 0, Q)) == [0]
        assert end.hear(pose(writer, 4 * MS, OTHER_Q) + bad + tick(writer, 4 * MS)) == []
        assert end.source.q.tobytes() == as_the_wire_has_it(Q).tobytes()

    @pytest.mark.parametrize("length", [0.9995, 1.0005])
    def test_a_quaternion_may_be_a_hair_from_unit_length(self, end: End, writer: FrameWriter, length: float) -> None:
        near_unit = mapping.POSE.pack_fields(time_usec=0, q=(length, 0.0, 0.0, 0.0))
        assert end.hear(writer.seal(mapping.POSE, near_unit) + tick(writer, 0)) == [0]


class TestSequence:
    def test_numbers_count_from_the_first_sample_on(self, end: End, writer: FrameWriter) -> None:
        writer.sequence = 77
        other = FrameWriter(255, 190)
        end.hear(beat(writer), beat(other))
        writer.sequence, other.sequence = 0, 50
        assert end.hear(tick_frames(writer, 0, Q), beat(writer) + beat(other)) == [0, "HEARTBEAT", "HEARTBEAT"]
        assert end.counted() == {}

    def test_a_lost_frame_is_counted(self, end: End, writer: FrameWriter) -> None:
        end.hear(tick_frames(writer, 0, Q))
        tick_frames(writer, 4 * MS, Q)
        assert end.hear(tick_frames(writer, 8 * MS, Q)) == [8 * MS]
        assert end.counted() == {"sequence_gaps": 2}

    def test_the_frame_right_behind_the_first_sample_is_counted_too(self, end: End, writer: FrameWriter) -> None:
        first = tick_frames(writer, 0, Q)
        beat(writer)
        assert end.hear(first + beat(writer)) == [0, "HEARTBEAT"]
        assert end.counted() == {"sequence_gaps": 1}

    def test_what_comes_late_is_counted_and_no_gap(self, end: End, writer: FrameWriter) -> None:
        first, second, third = (tick_frames(writer, k * 4 * MS, Q) for k in range(3))
        assert end.hear(first, third, second) == [0, 8 * MS]
        assert end.counted() == {"sequence_gaps": 2, "out_of_order": 2, "backwards": 1}

    def test_later_samples_restart_no_numbers(self, end: End, writer: FrameWriter) -> None:
        end.hear(tick_frames(writer, 0, Q))
        station = FrameWriter(255, 190)
        end.hear(beat(station))
        for k in range(1, 4):
            beat(station)
            end.hear(tick_frames(writer, k * 4 * MS, Q), beat(station))
        assert end.counted() == {"sequence_gaps": 3}


class TestSeveralAtOnce:
    @pytest.mark.parametrize("is_datagram", [True, False])
    def test_several_samples_in_one_chunk_are_each_found_in_turn(self, is_datagram: bool, writer: FrameWriter) -> None:
        end = End(is_datagram=is_datagram)
        poses = [Q * scale for scale in (0.1, 0.2, 0.3)]
        end.source.feed(b"".join(tick_frames(writer, k * MS, q) for k, q in enumerate(poses)))
        for k, q in enumerate(poses):
            assert end.source.read() is Found.SAMPLE
            assert end.source.t_ns == k * MS
            assert end.source.q.tobytes() == as_the_wire_has_it(q).tobytes()
        assert end.source.read() is Found.NOTHING

    @pytest.mark.parametrize("lead", [b"", b"\1\2\3"])
    def test_a_sample_that_a_stream_cuts_in_two_is_put_together(self, writer: FrameWriter, lead: bytes) -> None:
        data = lead + tick_frames(writer, 0, Q) + tick_frames(writer, MS, OTHER_Q)
        for cut in range(len(data) + 1):
            end = End(is_datagram=False)
            assert end.hear(data[:cut], data[cut:]) == [0, MS], cut
            assert end.source.q.tobytes() == as_the_wire_has_it(OTHER_Q).tobytes()
            assert end.counted() == ({"garbage_bytes": len(lead)} if lead else {})

    def test_a_datagram_cut_in_two_is_no_sample(self, end: End, writer: FrameWriter) -> None:
        data = tick_frames(writer, 0, Q)
        assert end.hear(data[:-5], data[-5:]) == []
        assert end.counted()["truncated"] == 1

    def test_other_frames_are_heard_where_they_stand(self, end: End, writer: FrameWriter) -> None:
        asked = FrameWriter(255, 190).seal(mapping.COMMAND_LONG, mapping.COMMAND_LONG.pack_fields(command=400))
        fix = writer.seal(mapping.GPS, mapping.GPS.pack_fields(lat=1))
        first = asked + tick_frames(writer, 0, Q) + beat(writer)
        second = fix + pose(writer, MS) + asked + tick(writer, MS) + asked
        assert end.hear(first) == ["COMMAND_LONG", 0, "HEARTBEAT"]
        assert end.hear(second) == ["HIL_GPS", "COMMAND_LONG", MS, "COMMAND_LONG"]

    @pytest.mark.parametrize("count", [63, 64, 65, 200])
    def test_any_number_of_other_frames_is_heard(self, end: End, writer: FrameWriter, count: int) -> None:
        beats = b"".join(beat(writer) for _ in range(count))
        assert (
            end.hear(beats + tick_frames(writer, 0, Q) + beats) == ["HEARTBEAT"] * count + [0] + ["HEARTBEAT"] * count
        )

    def test_other_frames_come_with_all_that_was_on_the_wire(self, end: End) -> None:
        frame = beat(FrameWriter(7, 9))
        end.source.feed(frame)
        assert end.source.read() is Found.NOTHING
        (heard,) = end.source.others
        assert (heard.system, heard.component, heard.raw) == (7, 9, frame)


_steps = st.one_of(
    st.tuples(st.just("pose"), st.integers(0, 5), st.booleans()),
    st.tuples(st.just("tick"), st.integers(0, 5), st.booleans()),
)


@settings(max_examples=60)
@given(st.lists(_steps, max_size=30))
def test_whatever_comes_a_sample_is_newer_than_the_last_and_has_the_emulators_pose(
    steps: list[tuple[str, int, bool]],
) -> None:
    """Against the rule in plain words: of the emulator alone, time grows, the last pose is of the tick's very time."""
    end, writers = End(), {True: emulator_writer(), False: FrameWriter(1, 190)}
    last_pose: tuple[int, FloatArray] | None = None
    newest = -1
    for number, (kind, k, ours) in enumerate(steps):
        t_ns, q = k * MS, Q + 0.01 * number
        heard = end.hear(pose(writers[ours], t_ns, q) if kind == "pose" else tick(writers[ours], t_ns))
        if not ours:
            assert heard == []
        elif kind == "pose":
            last_pose = (t_ns, q)
            assert heard == []
        elif t_ns == newest:
            assert heard == [AGAIN]
        elif t_ns > newest and last_pose is not None and last_pose[0] == t_ns:
            newest = t_ns
            assert heard == [t_ns]
            assert end.source.q.tobytes() == as_the_wire_has_it(last_pose[1]).tobytes()
        else:
            assert heard == []
    assert set(end.source.counters()) == set(CAUSES)
