"""Real time: what commands are believed, and what happens to the motors when they stop coming."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from plant_emulator.pacing.pacing import Parts
from plant_emulator.pacing.real_time import RealTime
from plant_emulator.plant.truth import TruthWriter
from plant_emulator.process import warm_up
from plant_emulator.tick import Emulator
from protocol.errors import PeerLostError
from protocol.logs.tlog import TlogWriter, read_tlog
from protocol.messages import VEHICLE, ActuatorCommand
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter
from tests.loop import scenario_of
from tests.plant_emulator.pacing.scripted import Scripted

SCENARIO = scenario_of("flapper")
PERIOD_NS = SCENARIO.period_ns
SCALE = np.array(SCENARIO.actuators.scale)


class Fly(Protocol):
    """`fly_some` in one of the two ways."""

    def __call__(
        self, ticks: int, answers: Callable[[FrameWriter, int], list[bytes]], *, waited_ns: int = 0
    ) -> Flown: ...


class Flown(NamedTuple):
    pacing: RealTime
    emulator: Emulator
    link: Scripted
    truth: Path


@pytest.fixture(params=[False, True], ids=["wakes", "sleeps_through"])
def fly(request: pytest.FixtureRequest, tmp_path: Path) -> Fly:
    """Fly in either way."""
    return functools.partial(fly_some, tmp_path / "truth.npy", sleeps_through=request.param)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fifty periods of silence are too many."""
    monkeypatch.setattr("plant_emulator.pacing.real_time.HEARTBEAT_TIMEOUT_NS", 50 * PERIOD_NS)


def answer(writer: FrameWriter, t_ns: int) -> bytes:
    command = ActuatorCommand(t_ns, np.array([0.5, 0.5, 0.0, 0.0, 0.0, 0.0]) * SCALE, armed=True)
    return writer.seal(mapping.COMMAND, mapping.encode_command(command, SCALE, lockstep=False))


def fly_some(
    path: Path,
    ticks: int,
    answers: Callable[[FrameWriter, int], list[bytes]],
    *,
    waited_ns: int = 0,
    sleeps_through: bool = False,
) -> Flown:
    """Fly some ticks of real time against a script; `waited_ns` passes before the first."""
    warm_up(SCENARIO)
    clock, writer = VirtualClock(10**12), FrameWriter(*VEHICLE)
    link = Scripted(clock, lambda tick: answers(writer, tick))
    endpoint = Endpoint(link, 1, SCENARIO.wire.emulator_component)
    with TruthWriter(path) as truth:
        emulator = Emulator(SCENARIO, endpoint, truth)
        parts = Parts(emulator, endpoint, None, clock, StopFlag(), PERIOD_NS, ticks)
        pacing = RealTime(parts, sleeps_through=sleeps_through)
        clock.advance_ns(waited_ns)
        for tick in range(ticks):
            pacing.exchange(tick * PERIOD_NS)
    return Flown(pacing, emulator, link, path)


def test_each_answer_acts_when_it_comes_and_none_is_stale(fly: Fly) -> None:
    flown = fly(50, lambda writer, tick: [answer(writer, tick * PERIOD_NS)])
    assert flown.pacing.latencies_ns == [1_000_000] * 50
    assert flown.pacing.counters["unanswered"] == flown.emulator.safety.counters["stale"] == 0


@pytest.mark.parametrize("repeats", [True, False], ids=["repeated", "silent"])
def test_an_old_command_grows_stale_even_if_it_is_said_again_and_again(fly: Fly, repeats: bool) -> None:
    flown = fly(50, lambda writer, tick: [answer(writer, 0)] if repeats or tick == 0 else [])
    assert flown.emulator.safety.counters["stale"] == 1
    assert flown.emulator.source.counters()["repeated"] == (49 if repeats else 0)
    assert flown.pacing.counters["unanswered"] == 49
    assert flown.emulator.plant.state.tau == pytest.approx(np.array(SCENARIO.actuators.safe))


def test_a_first_command_that_never_comes_ends_the_initial_one(fly: Fly) -> None:
    beat = mapping.encode_controller_heartbeat(armed=True)
    flown = fly(30, lambda writer, _tick: [writer.seal(mapping.HEARTBEAT, beat)])
    assert flown.emulator.safety.counters["stale"] == 1
    assert flown.emulator.plant.state.tau == pytest.approx(np.array(SCENARIO.actuators.safe))


def test_an_echo_of_a_time_never_sent_is_dropped_and_shuts_nothing_out(fly: Fly) -> None:
    def answers(writer: FrameWriter, tick: int) -> list[bytes]:
        return [answer(writer, 10**15)] if tick == 3 else [answer(writer, tick * PERIOD_NS)]

    flown = fly(50, answers)
    assert flown.emulator.source.counters()["unknown_echoes"] == 1
    assert flown.pacing.counters["unanswered"] == 1
    assert flown.emulator.safety.counters["stale"] == 0


def test_an_older_command_than_the_newest_is_dropped(fly: Fly) -> None:
    def answers(writer: FrameWriter, tick: int) -> list[bytes]:
        return [answer(writer, tick * PERIOD_NS), answer(writer, max(0, tick - 1) * PERIOD_NS)]

    assert fly(20, answers).emulator.source.counters()["old_commands"] == 19


def test_a_long_wait_for_the_controller_is_not_held_against_it(fly: Fly) -> None:
    flown = fly(5, lambda writer, tick: [answer(writer, tick * PERIOD_NS)] if tick else [], waited_ns=20 * 10**9)
    assert flown.pacing.counters["unanswered"] == 1


def test_three_seconds_of_silence_end_the_run_with_a_named_error(fly: Fly) -> None:
    with pytest.raises(PeerLostError, match="3 s without"):
        fly(1000, lambda writer, tick: [answer(writer, tick * PERIOD_NS)] if tick < 5 else [])


def mixed(writer: FrameWriter, tick: int) -> list[bytes]:
    """Plain answers for the most part; none, twice, with a heartbeat before or after, and too late for its tick."""
    plain = answer(writer, tick * PERIOD_NS)
    beat = writer.seal(mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=True))
    if tick % 10 == 3:
        return []
    if tick % 10 == 5:
        return [plain, plain]
    if tick % 10 == 6:
        return [beat, plain]
    if tick % 10 == 7:
        return [plain, beat]
    if tick % 10 == 8:
        return [beat] * 4 + [plain]
    return [plain]


def test_sleeping_through_a_period_changes_nothing_but_when_the_work_is_done(tmp_path: Path) -> None:
    woken = fly_some(tmp_path / "woken.npy", 100, mixed)
    slept = fly_some(tmp_path / "slept.npy", 100, mixed, sleeps_through=True)
    assert slept.truth.read_bytes() == woken.truth.read_bytes()
    assert slept.link.sent == woken.link.sent
    assert slept.pacing.latencies_ns == woken.pacing.latencies_ns
    assert slept.pacing.all_counters() == woken.pacing.all_counters()
    assert slept.emulator.safety.counters == woken.emulator.safety.counters


def test_a_flood_does_not_stop_the_plant(tmp_path: Path) -> None:
    class Flooded(Scripted):
        def recv(self, timeout_s: float) -> bytes | None:
            return beat

    beat = FrameWriter(*VEHICLE).seal(mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=True))
    clock = VirtualClock(10**12)
    link = Flooded(clock, lambda _tick: [])
    endpoint = Endpoint(link, 1, SCENARIO.wire.emulator_component)
    emulator = Emulator(SCENARIO, endpoint, None)
    pacing = RealTime(Parts(emulator, endpoint, None, clock, StopFlag(), PERIOD_NS, 5), sleeps_through=True)
    for tick in range(5):
        pacing.exchange(tick * PERIOD_NS)
    assert emulator.plant.t_ns == 5 * PERIOD_NS
    assert len(link.sent) == 5


class TestRefusals:
    """What does not count as an answer, nor as a sign of life."""

    def test_a_control_that_is_no_number_is_refused_and_the_command_before_it_stands(self, fly: Fly) -> None:
        def answers(writer: FrameWriter, tick: int) -> list[bytes]:
            if tick != 3:
                return [answer(writer, tick * PERIOD_NS)]
            controls = [0.5, 0.5, float("nan"), 0.0, 0.0, 0.0]
            payload = mapping.COMMAND.pack_fields(time_usec=tick * PERIOD_NS // 1000, controls=controls, mode=0xFF)
            return [writer.seal(mapping.COMMAND, payload)]

        flown = fly(4, answers)
        assert flown.emulator.source.counters()["refused_commands"] == 1
        assert flown.pacing.counters["unanswered"] == 1
        assert flown.emulator.plant.state.tau == pytest.approx(np.array([0.5, 0.5, 0.0, 0.0, 0.0, 0.0]) * SCALE)

    def test_a_strangers_command_does_not_act(self, fly: Fly) -> None:
        stranger = FrameWriter(1, 2)
        flown = fly(30, lambda _writer, tick: [answer(stranger, tick * PERIOD_NS)])
        assert flown.pacing.counters["unanswered"] == 30
        assert flown.emulator.safety.counters["stale"] == 1
        assert flown.emulator.plant.state.tau == pytest.approx(np.array(SCENARIO.actuators.safe))

    def test_a_disarmed_command_turns_the_motors_to_zero(self, fly: Fly) -> None:
        def answers(writer: FrameWriter, tick: int) -> list[bytes]:
            command = ActuatorCommand(tick * PERIOD_NS, SCALE, armed=tick < 3)
            return [writer.seal(mapping.COMMAND, mapping.encode_command(command, SCALE, lockstep=False))]

        flown = fly(5, answers)
        assert flown.emulator.safety.counters["disarmed"] == 2
        assert flown.emulator.plant.state.tau.tolist() == [0.0] * 6

    def test_a_strangers_words_do_not_keep_a_silent_run_alive(self, fly: Fly, impatient: None) -> None:
        stranger = FrameWriter(255, 190)
        beat = mapping.encode_controller_heartbeat(armed=True)
        with pytest.raises(PeerLostError, match="fell silent"):
            fly(60, lambda _writer, _tick: [stranger.seal(mapping.HEARTBEAT, beat)])

    @pytest.mark.parametrize("spoken", ["heartbeat", "command"])
    def test_the_controllers_words_do(self, fly: Fly, impatient: None, spoken: str) -> None:
        def answers(writer: FrameWriter, tick: int) -> list[bytes]:
            if tick % 40:
                return []
            beat = writer.seal(mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=True))
            return [beat if spoken == "heartbeat" else answer(writer, tick * PERIOD_NS)]

        assert fly(120, answers).emulator.plant.t_ns == 120 * PERIOD_NS

    def test_the_time_is_told_to_the_controller_alone(self, fly: Fly) -> None:
        question = mapping.encode_timesync(0, 77)
        for sender, told in ((VEHICLE, 1), ((1, 2), 0)):
            asker = FrameWriter(*sender)
            flown = fly(
                3,
                lambda _writer, tick, asker=asker: [asker.seal(mapping.TIMESYNC, question)] if tick == 1 else [],  # type: ignore[misc]
            )
            reader = FrameReader(is_datagram=True)
            times = [mapping.decode_timesync(one.payload) for raw in flown.link.questions for one in reader.read(raw)]
            assert [asked_ns for answered_ns, asked_ns in times if answered_ns] == [77] * told


class TestTimes:
    def test_a_command_acts_at_the_moment_it_came_within_its_period(self, fly: Fly) -> None:
        """1 ms after the tick it answers: until then, the command before it acts."""
        flown = fly(2, lambda writer, tick: [answer(writer, tick * PERIOD_NS)] if tick == 0 else [])
        plant = flown.emulator.plant
        other = Emulator(SCENARIO, Endpoint(memory_pair()[0], 1, 191), None)
        other.plant.command(1_000_000, flown.emulator.source.newest)
        other.plant.advance(2 * PERIOD_NS)
        assert plant.state.motion.tolist() == other.plant.state.motion.tolist()

    def test_each_frame_both_ways_is_logged_once_in_its_order(self, tmp_path: Path) -> None:
        warm_up(SCENARIO)
        clock, writer = VirtualClock(10**12), FrameWriter(*VEHICLE)
        link = Scripted(clock, lambda tick: [answer(writer, tick * PERIOD_NS)])
        endpoint = Endpoint(link, 1, SCENARIO.wire.emulator_component)
        with TlogWriter(tmp_path / "run.tlog") as log:
            emulator = Emulator(SCENARIO, endpoint, None)
            pacing = RealTime(Parts(emulator, endpoint, log, clock, StopFlag(), PERIOD_NS, 7))
            for tick in range(7):
                pacing.exchange(tick * PERIOD_NS)
                pacing.flush()
        kept = [frame for _, frame in read_tlog(tmp_path / "run.tlog")]
        ids = [frame.message_id for frame in kept if frame.message_id != mapping.TIMESYNC.message_id]
        exchange = [mapping.POSE.message_id, mapping.TICK.message_id, mapping.COMMAND.message_id]
        assert ids[2:] == exchange * 7, "behind the first heartbeat and fix"
        sent = b"".join(link.sent)
        assert all(frame.raw in sent for frame in kept if frame.message_id == mapping.TICK.message_id)
        assert len([frame for frame in kept if frame.message_id == mapping.TIMESYNC.message_id]) == len(link.questions)
