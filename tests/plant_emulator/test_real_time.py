"""Real time: what commands are believed, and what happens to the motors when they stop coming."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from bridge.clock import VirtualClock
from bridge.endpoint import VEHICLE, Endpoint
from bridge.link import Link
from bridge.process import StopFlag
from plant_emulator.emulator import Emulator
from plant_emulator.pacing import Parts, RealTime
from plant_emulator.process import warm_up
from protocol import mavlink_map
from protocol.errors import PeerLostError
from protocol.mavlink_codec import FrameWriter
from protocol.messages import ActuatorCommand
from tests.loop import scenario_of

SCENARIO = scenario_of("flapper")
PERIOD_NS = SCENARIO.period_ns
SCALE = np.array(SCENARIO.actuators.scale)


class Scripted(Link):
    """A link on a virtual clock: `answers` says what comes 1 ms after each tick; time passes while one waits."""

    is_datagram = True
    peer = "the script"

    def __init__(self, clock: VirtualClock, answers: Callable[[int], list[bytes]]) -> None:
        super().__init__("mem://script")
        self._clock = clock
        self._answers = answers
        self._coming: list[bytes] = []
        self._tick = 0

    def send(self, data: bytes | bytearray | memoryview) -> None:
        if data[7] == mavlink_map.TIMESYNC.message_id:
            return  # the script has no clock to tell
        self._coming = list(self._answers(self._tick))
        self._tick += 1

    def recv(self, timeout_s: float) -> bytes | None:
        if self._coming:
            self._clock.advance_ns(1_000_000)
            return self._coming.pop(0)
        self._clock.advance_ns(round(timeout_s * 1e9))
        return None

    def close(self) -> None:
        pass


class Flown(NamedTuple):
    pacing: RealTime
    emulator: Emulator


def answer(writer: FrameWriter, t_ns: int) -> bytes:
    command = ActuatorCommand(t_ns, np.array([0.5, 0.5, 0.0, 0.0, 0.0, 0.0]) * SCALE, armed=True)
    return writer.seal(mavlink_map.COMMAND, mavlink_map.encode_command(command, SCALE, lockstep=False))


def fly(ticks: int, answers: Callable[[FrameWriter, int], list[bytes]], *, waited_ns: int = 0) -> Flown:
    """Fly some ticks of real time against a script; `waited_ns` passes before the first."""
    warm_up(SCENARIO)
    clock, writer = VirtualClock(10**12), FrameWriter(*VEHICLE)
    link = Scripted(clock, lambda tick: answers(writer, tick))
    endpoint = Endpoint(link, 1, SCENARIO.wire.emulator_component)
    emulator = Emulator(SCENARIO, endpoint, None)
    pacing = RealTime(Parts(emulator, endpoint, None, clock, StopFlag(), PERIOD_NS))
    clock.advance_ns(waited_ns)
    for tick in range(ticks):
        pacing.exchange(tick, tick * PERIOD_NS)
    return Flown(pacing, emulator)


def test_each_answer_acts_when_it_comes_and_none_is_stale() -> None:
    flown = fly(50, lambda writer, tick: [answer(writer, tick * PERIOD_NS)])
    assert flown.pacing.latencies_ns == [1_000_000] * 50
    assert flown.pacing.counters["unanswered"] == flown.emulator.safety.counters["stale"] == 0


@pytest.mark.parametrize("repeats", [True, False], ids=["repeated", "silent"])
def test_an_old_command_grows_stale_even_if_it_is_said_again_and_again(repeats: bool) -> None:
    flown = fly(50, lambda writer, tick: [answer(writer, 0)] if repeats or tick == 0 else [])
    assert flown.emulator.safety.counters["stale"] == 1
    assert flown.pacing.counters["repeated"] == (49 if repeats else 0)
    assert flown.pacing.counters["unanswered"] == 49
    assert flown.emulator.plant.state.tau == pytest.approx(np.array(SCENARIO.actuators.safe))


def test_a_first_command_that_never_comes_ends_the_initial_one() -> None:
    beat = mavlink_map.encode_controller_heartbeat(armed=True)
    flown = fly(30, lambda writer, _tick: [writer.seal(mavlink_map.HEARTBEAT, beat)])
    assert flown.emulator.safety.counters["stale"] == 1
    assert flown.emulator.plant.state.tau == pytest.approx(np.array(SCENARIO.actuators.safe))


def test_an_echo_of_a_time_never_sent_is_dropped_and_shuts_nothing_out() -> None:
    def answers(writer: FrameWriter, tick: int) -> list[bytes]:
        return [answer(writer, 10**15)] if tick == 3 else [answer(writer, tick * PERIOD_NS)]

    flown = fly(50, answers)
    assert flown.pacing.counters["unknown_echoes"] == 1
    assert flown.pacing.counters["unanswered"] == 1
    assert flown.emulator.safety.counters["stale"] == 0


def test_an_older_command_than_the_newest_is_dropped() -> None:
    def answers(writer: FrameWriter, tick: int) -> list[bytes]:
        return [answer(writer, tick * PERIOD_NS), answer(writer, max(0, tick - 1) * PERIOD_NS)]

    assert fly(20, answers).pacing.counters["old_commands"] == 19


def test_a_long_wait_for_the_controller_is_not_held_against_it() -> None:
    flown = fly(5, lambda writer, tick: [answer(writer, tick * PERIOD_NS)] if tick else [], waited_ns=20 * 10**9)
    assert flown.pacing.counters["unanswered"] == 1


def test_three_seconds_of_silence_end_the_run_with_a_named_error() -> None:
    with pytest.raises(PeerLostError, match="3 s without"):
        fly(1000, lambda writer, tick: [answer(writer, tick * PERIOD_NS)] if tick < 5 else [])
