"""Real time: what commands are believed, and what happens to the motors when they stop coming."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.links.link import Link
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from plant_emulator.pacing.pacing import Parts
from plant_emulator.pacing.real_time import RealTime
from plant_emulator.plant.truth import TruthWriter
from plant_emulator.process import warm_up
from plant_emulator.tick import Emulator
from protocol.errors import PeerLostError
from protocol.messages import VEHICLE, ActuatorCommand
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from tests.loop import scenario_of

SCENARIO = scenario_of("flapper")
PERIOD_NS = SCENARIO.period_ns
SCALE = np.array(SCENARIO.actuators.scale)


class Fly(Protocol):
    """`fly_some` in one of the two ways."""

    def __call__(
        self, ticks: int, answers: Callable[[FrameWriter, int], list[bytes]], *, waited_ns: int = 0
    ) -> Flown: ...


class Scripted(Link):
    """A link on a virtual clock: `answers` says what comes 1 ms, 2 ms ... after each tick; time passes while one waits."""

    is_datagram = True
    peer = "the script"

    def __init__(self, clock: VirtualClock, answers: Callable[[int], list[bytes]]) -> None:
        super().__init__("mem://script")
        self._clock = clock
        self._answers = answers
        self._coming: list[tuple[int, bytes]] = []
        self._tick = 0
        self.sent: list[bytes] = []

    def send(self, data: bytes | bytearray | memoryview) -> None:
        if data[7] == mapping.TIMESYNC.message_id:
            return  # the script has no clock to tell
        self.sent.append(bytes(data))
        now_ns = self._clock.now_ns()
        for number, coming in enumerate(self._answers(self._tick), 1):
            self._coming.append((now_ns + 1_000_000 * number, coming))
        self._tick += 1

    def recv(self, timeout_s: float) -> bytes | None:
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if self._coming and self._coming[0][0] <= until_ns:
            self.received_ns, data = self._coming.pop(0)
            self._clock.sleep_until_ns(self.received_ns)
            return data
        self._clock.sleep_until_ns(until_ns)
        return None

    def close(self) -> None:
        pass


class Flown(NamedTuple):
    pacing: RealTime
    emulator: Emulator
    link: Scripted
    truth: Path


@pytest.fixture(params=[False, True], ids=["wakes", "sleeps_through"])
def fly(request: pytest.FixtureRequest, tmp_path: Path) -> Fly:
    """Fly in either way."""
    return functools.partial(fly_some, tmp_path / "truth.npy", sleeps_through=request.param)


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
    woken = fly_some(tmp_path / "woken.npy", 400, mixed)
    slept = fly_some(tmp_path / "slept.npy", 400, mixed, sleeps_through=True)
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
