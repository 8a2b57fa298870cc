"""The order of a tick at the controller, driven by frames over a link: hear, answer with the law, repeat, skip."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from controller.laws.law import make_law
from controller.laws.reference import reference_trajectory
from controller.session import HilSession
from controller.sinks.hil import HilSink
from controller.sources.hil import HilSource
from controller.tick import Tick, reference_encoders
from protocol.errors import ScenarioMismatchError
from protocol.messages import VEHICLE, ActuatorCommand, FloatArray
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader, FrameWriter
from protocol.wire.requests import ARM_DISARM
from tests.frames import EMULATOR, command_frame, emulator_writer, tick_frames
from tests.loop import scenario_of

FLAPPER = scenario_of("flapper")
PERIOD_NS = FLAPPER.period_ns
SCALE = np.array(FLAPPER.actuators.scale)
DIGEST = b"12345678"


class End:
    """A controller behind a link, and the emulator's side of it."""

    def __init__(self, *, arm: bool = True, at_once: bool = True, law: str = "ude") -> None:
        self.near, self._far = memory_pair()
        self._endpoint = Endpoint(self._far, *VEHICLE)
        self.emulator = emulator_writer()
        self.law = make_law(law, FLAPPER)
        self.session = HilSession(self._endpoint, DIGEST, EMULATOR, arm=arm)
        source, sink = HilSource(self._endpoint.reader, EMULATOR), HilSink(self._endpoint.writer, lockstep=True)
        writer = self._endpoint.writer
        kept = {} if at_once else {"at_once": False}
        self.tick = Tick(self.law, source, sink, self.session, writer, self._far.send, **kept)
        self._reader = FrameReader(is_datagram=True, follow_sequence=False)
        self.say(self.emulator.seal(mapping.VERSION, mapping.encode_version(DIGEST)))

    def say(self, *datagrams: bytes) -> list[bytes]:
        """Send datagrams to the controller; returns those that it sends."""
        for datagram in datagrams:
            self.near.send(datagram)
        while (data := self._far.recv(0.0)) is not None:
            self.tick.process(data)
        return self.answers()

    def answers(self) -> list[bytes]:
        """The datagrams that the controller has sent."""
        answers = []
        while (data := self.near.recv(0.0)) is not None:
            answers.append(data)
        return answers

    def frames(self, datagram: bytes) -> list[Frame]:
        return self._reader.read(datagram)

    def commands(self, datagrams: list[bytes]) -> list[ActuatorCommand]:
        """The commands in datagrams, in order."""
        decoded = [
            mapping.decode_command(frame.payload, SCALE)
            for datagram in datagrams
            for frame in self.frames(datagram)
            if frame.message_id == mapping.COMMAND.message_id
        ]
        assert None not in decoded
        return [command for command in decoded if command is not None]

    def sample(self, k: int, q: FloatArray | None = None) -> bytes:
        return tick_frames(self.emulator, k * PERIOD_NS, pose_of(k) if q is None else q)

    def steps(self) -> int:
        return self.law.counts(self.tick.state)["steps"]


def pose_of(k: int) -> FloatArray:
    q: FloatArray = FLAPPER.initial_motion[:6] + 0.01 * np.random.default_rng(k).normal(size=6)
    return q


def measured(k: int) -> FloatArray:
    """The pose of sample k as the wire has it."""
    sample = mapping.decode_pose(mapping.encode_pose(0, pose_of(k)))
    assert sample is not None
    return sample.q


def arming(param1: float) -> bytes:
    request = mapping.COMMAND_LONG.pack_fields(
        command=ARM_DISARM, param1=param1, param2=math.nan, target_system=1, target_component=1
    )
    return FrameWriter(255, 190).seal(mapping.COMMAND_LONG, request)


def expected(samples: list[int]) -> list[FloatArray]:
    """What a law of its own commands upon these samples."""
    law = make_law("ude", FLAPPER)
    state = law.start()
    return [law.step(state, k * PERIOD_NS, measured(k)) for k in samples]


class TestAnswers:
    def test_each_sample_is_answered_by_one_step_of_the_law_and_with_its_time(self) -> None:
        end = End()
        commands = end.commands([answer for k in range(5) for answer in end.say(end.sample(k))])
        assert [one.t_ns for one in commands] == [k * PERIOD_NS for k in range(5)]
        assert [one.tau.tobytes() for one in commands] == [tau.tobytes() for tau in expected(list(range(5)))]
        assert all(one.armed for one in commands)
        assert end.tick.answered_ns == 4 * PERIOD_NS
        assert end.tick.counters == {"repeated": 0, "skipped_samples": 0}

    def test_several_samples_in_one_datagram_are_each_answered(self) -> None:
        end = End()
        answers = end.say(end.sample(0) + end.sample(1))
        assert len(answers) == 2
        assert [one.tau.tobytes() for one in end.commands(answers)] == [tau.tobytes() for tau in expected([0, 1])]

    def test_what_is_due_travels_in_front_of_the_command_in_one_datagram(self) -> None:
        end = End()
        (answer,) = end.say(end.sample(0))
        frames = end.frames(answer)
        assert [frame.message_id for frame in frames] == [mapping.HEARTBEAT.message_id, mapping.COMMAND.message_id]
        (lone,) = end.say(end.sample(1))
        assert [frame.message_id for frame in end.frames(lone)] == [mapping.COMMAND.message_id]

    def test_the_numbers_of_the_run_begin_with_its_first_answer_and_only_there(self) -> None:
        end = End()
        end.tick._writer.sequence = 99
        numbers = [f.sequence for k in range(20) for answer in end.say(end.sample(k)) for f in end.frames(answer)]
        assert numbers == list(range(len(numbers)))

    def test_the_scenario_of_another_run_is_refused(self) -> None:
        end = End()
        with pytest.raises(ScenarioMismatchError):
            end.say(end.sample(0) + end.emulator.seal(mapping.VERSION, mapping.encode_version(b"another!")))


class TestRepeats:
    def test_a_tick_that_comes_again_gets_the_same_bytes_without_a_step_of_the_law(self) -> None:
        end = End()
        end.say(end.sample(0))
        tick = end.sample(1)
        (answer,) = end.say(tick)
        state, sequence = end.tick.state.packed.copy(), end.tick._writer.sequence
        assert end.say(tick, tick) == [answer, answer]
        assert end.tick.state.packed.tobytes() == state.tobytes()
        assert end.tick._writer.sequence == sequence
        assert end.tick.counters == {"repeated": 2, "skipped_samples": 0}

    def test_the_whole_answer_is_repeated_with_what_travelled_in_front_of_it(self) -> None:
        end = End()
        tick = end.sample(0)
        (answer,) = end.say(tick)
        assert len(end.frames(answer)) == 2
        assert end.say(tick) == [answer]

    def test_before_the_first_answer_there_is_nothing_to_repeat(self) -> None:
        end = End()
        end.tick.repeat()
        assert end.answers() == []
        assert end.tick.counters["repeated"] == 0

    def test_a_law_steps_on_as_if_nothing_had_been_repeated(self) -> None:
        end = End()
        ticks = [end.sample(k) for k in range(3)]
        commands = end.commands(end.say(ticks[0], ticks[1], ticks[1], ticks[2]))
        first, second, third = expected([0, 1, 2])
        assert [one.tau.tobytes() for one in commands] == [tau.tobytes() for tau in (first, second, second, third)]


class TestArming:
    def test_a_disarm_in_front_of_the_tick_makes_its_answer_disarmed(self) -> None:
        end = End()
        end.say(end.sample(0))
        (command,) = end.commands(end.say(arming(0.0) + end.sample(1)))
        assert not command.armed
        assert command.tau.tolist() == [0.0] * 6

    def test_a_disarm_behind_the_tick_makes_the_next_answer_disarmed(self) -> None:
        end = End()
        end.say(end.sample(0))
        (command,) = end.commands(end.say(end.sample(1) + arming(0.0)))
        assert command.armed
        (following,) = end.commands(end.say(end.sample(2)))
        assert not following.armed

    def test_a_disarm_between_the_pose_and_the_tick_counts_for_that_tick(self) -> None:
        end = End()
        tick = end.sample(0)
        pose_ends = 12 + tick[1]
        (command,) = end.commands(end.say(tick[:pose_ends] + arming(0.0) + tick[pose_ends:]))
        assert not command.armed

    def test_an_arming_in_front_of_the_tick_makes_its_answer_armed(self) -> None:
        end = End(arm=False)
        (command,) = end.commands(end.say(end.sample(0)))
        assert not command.armed
        (command,) = end.commands(end.say(arming(1.0) + end.sample(1)))
        assert command.armed

    def test_a_disarmed_controller_answers_every_tick_all_the_same(self) -> None:
        end = End(arm=False)
        commands = end.commands([answer for k in range(4) for answer in end.say(end.sample(k))])
        assert [(one.t_ns, one.armed) for one in commands] == [(k * PERIOD_NS, False) for k in range(4)]

    def test_what_a_disarmed_law_remembers_never_acts(self) -> None:
        """However long it was disarmed, and from the very first sample on: armed, it starts anew."""
        end = End(arm=False)
        for k in range(7):
            end.say(end.sample(k, pose_of(k) + 0.3))
        commands = end.commands(end.say(arming(1.0) + end.sample(7), end.sample(8), end.sample(9)))
        assert [one.tau.tobytes() for one in commands] == [tau.tobytes() for tau in expected([7, 8, 9])]

    @pytest.mark.parametrize("disarmed", [1, 2, 5])
    def test_a_law_that_was_disarmed_starts_anew(self, disarmed: int) -> None:
        end = End()
        for k in range(5):
            end.say(end.sample(k))
        end.say(arming(0.0))
        for k in range(5, 5 + disarmed):
            end.say(end.sample(k))
        first = 5 + disarmed
        commands = end.commands(end.say(arming(1.0) + end.sample(first), end.sample(first + 1)))
        assert [one.tau.tobytes() for one in commands] == [tau.tobytes() for tau in expected([first, first + 1])]

    def test_a_disarm_and_an_arming_between_two_ticks_are_no_restart(self) -> None:
        """No answer was disarmed, so what the law remembers did act."""
        end = End()
        end.say(end.sample(0))
        (command,) = end.commands(end.say(arming(0.0) + arming(1.0) + end.sample(1)))
        assert command.tau.tobytes() == expected([0, 1])[1].tobytes()


class TestClockOfItsOwn:
    """at_once=False: the newest sample is kept until `answer` is called."""

    def test_samples_are_kept_and_the_newest_is_answered_when_asked(self) -> None:
        end = End(at_once=False)
        assert not end.tick.is_fresh
        assert end.say(end.sample(0)) == []
        assert end.tick.is_fresh
        end.tick.answer()
        assert not end.tick.is_fresh
        (command,) = end.commands(end.answers())
        assert command.t_ns == 0
        assert end.steps() == 1

    def test_a_sample_that_a_newer_one_replaced_is_counted(self) -> None:
        end = End(at_once=False)
        end.say(end.sample(0) + end.sample(1), end.sample(2))
        end.tick.answer()
        (command,) = end.commands(end.answers())
        assert command.t_ns == 2 * PERIOD_NS
        assert end.tick.counters == {"repeated": 0, "skipped_samples": 2}
        assert end.steps() == 1

    def test_a_tick_that_comes_again_is_not_answered_again(self) -> None:
        end = End(at_once=False)
        tick = end.sample(0)
        end.say(tick)
        end.tick.answer()
        end.answers()
        assert end.say(tick) == []
        assert not end.tick.is_fresh
        assert end.tick.counters == {"repeated": 0, "skipped_samples": 0}

    def test_the_last_answer_is_given_again_when_asked(self) -> None:
        end = End(at_once=False)
        end.say(end.sample(0))
        end.tick.answer()
        end.tick.repeat()
        first, again = end.answers()
        assert first == again
        assert end.tick.counters["repeated"] == 1


class TestReferenceEncoders:
    @pytest.mark.parametrize("k", [0, 1, 500])
    def test_they_say_the_reference_at_the_time_of_the_sample(self, k: int) -> None:
        law = make_law("ude", FLAPPER)
        q, q_dot, q_ddot = reference_trajectory(FLAPPER.reference, k + 1, PERIOD_NS)[-1]
        encoders = reference_encoders(law)
        t_ns = k * PERIOD_NS
        assert list(encoders["POSITION_TARGET_LOCAL_NED"](t_ns)) == [
            (mapping.POSITION_TARGET, mapping.encode_position_target(t_ns, q, q_dot, q_ddot))
        ]
        assert list(encoders["ATTITUDE_TARGET"](t_ns)) == [
            (mapping.ATTITUDE_TARGET, mapping.encode_attitude_target(t_ns, q))
        ]


def test_the_command_is_the_frame_of_the_plain_writer() -> None:
    end = End()
    end.say(end.sample(0))
    (answer,) = end.say(end.sample(1))
    writer = FrameWriter(*VEHICLE)
    writer.sequence = 2  # behind the heartbeat and the first command
    assert answer == command_frame(writer, PERIOD_NS, expected([0, 1])[1], SCALE)
