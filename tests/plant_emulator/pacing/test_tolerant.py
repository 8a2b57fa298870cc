"""The tolerant profile before a fake PX4: one that speaks, is silent and answers as PX4's simulator link was seen to do."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from bridge.endpoint import Endpoint
from bridge.links.link import Link, open_link
from bridge.links.memory import memory_pair
from bridge.links.tcp import TcpIn
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from plant_emulator.options import EmulatorOptions
from plant_emulator.pacing import tolerant
from plant_emulator.pacing.pacing import Parts
from plant_emulator.pacing.tolerant import Tolerant
from plant_emulator.plant.truth import load_truth
from plant_emulator.process import fly, run_emulator, warm_up
from plant_emulator.tick import Emulator
from protocol.errors import LinkClosedError, PeerLostError, PeerMissingError, UsageError
from protocol.logs.tlog import TlogWriter, read_tlog
from protocol.messages import VEHICLE, FloatArray
from protocol.scenario import Scenario
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter, layout
from tests.frames import command_frame
from tests.loop import scenario_of
from tests.plant_emulator.pacing.scripted import Scripted
from tests.plant_emulator.pacing.test_lockstep import Faulty, lose_each

HOVER = (0.0, 0.0, -0.0056 * 9.81 / 0.12, 0.0, 0.0, 0.0)


class FakePx4:
    """PX4 as its module `simulator_mavlink` is seen from the outside, made of pymavlink alone.

    silent: HIL_SENSORs that it does not answer at first. every_us: time between answers, as PX4 has it from 500 Hz on.
    arms_us, mute_us: when it arms (mode 129), and falls silent for good.
    """

    def __init__(
        self, link: Link, *, silent: int = 20, every_us: int = 4000, arms_us: int = 0, mute_us: int = 1 << 62
    ) -> None:
        self._link = link
        self._silent, self._every_us, self._arms_us, self._mute_us = silent, every_us, arms_us, mute_us
        self._mavlink = common.MAVLink(None, 1, 1)
        self._answered_us = -1 << 62
        self.heard: list[Any] = []
        self.refused: list[int] = []
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> FakePx4:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._link.close()
        self._thread.join()

    def _send(self, message: Any) -> None:
        self._link.send(message.pack(self._mavlink))

    def _run(self) -> None:
        nan = float("nan")
        self._mavlink.seq = 77  # it has been running for a while
        try:
            self._send(common.MAVLink_command_long_message(0, 0, 511, 0, 115, 5000, nan, nan, nan, nan, nan))
            self._send(common.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3))
            while True:
                for message in common.MAVLink(None).parse_buffer(self._link.recv(0.1) or b"") or []:
                    self.heard.append(message)
                    if message.get_type() == "HIL_SENSOR":
                        self._take(message)
        except LinkClosedError:
            return

    def _take(self, sensor: Any) -> None:
        self._silent -= 1
        t_us = sensor.time_usec
        if sensor.fields_updated != 0x1FFF or sensor.id != 0:
            self.refused.append(t_us)  # without all groups PX4 denies arming; bits of another id print errors
        if self._silent >= 0 or t_us >= self._mute_us or 0 <= t_us - self._answered_us < self._every_us:
            return
        self._answered_us = t_us
        armed = t_us >= self._arms_us
        controls = [*(HOVER if armed else (0.0,) * 6), *[0.0] * 10]
        self._send(common.MAVLink_hil_actuator_controls_message(t_us, controls, 129 if armed else 1, 1))


def fly_px4(scenario: Scenario, near: Link, out: Path | None = None, *, wait_s: float = 10.0) -> dict[str, Any]:
    warm_up(scenario)
    options = EmulatorOptions(link="-", out=out, wait_s=wait_s, profile="tolerant")
    return fly(scenario, near, options, lambda _event: None, StopFlag())


def flapper(rate_hz: float, duration_s: float, **changes: Any) -> Scenario:
    return scenario_of("flapper", rate_hz=rate_hz, duration_s=duration_s, **changes)


def test_at_250_hz_it_is_sent_to_freely_and_then_answers_each_tick(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, FakePx4(far, arms_us=600_000) as px4:
        summary = fly_px4(flapper(250.0, 1.0), near, tmp_path)
    counters = summary["counters"]
    assert summary["ticks"] == 250
    # Twenty went out freely: silence at first is no loss. A machine may stall now and then, not at each tick.
    assert 20 <= counters["unanswered"] - counters["resent"] <= 30
    assert counters["resent"] < 100
    assert 150 <= counters["held"] <= 160  # until it armed
    assert counters["sequence_gaps"] == counters["refused_commands"] == 0
    assert px4.refused == []
    times = [one.time_usec for one in px4.heard if one.get_type() == "HIL_SENSOR"]
    assert sorted(set(times)) == list(range(0, 1_000_000, 4000))
    fixes = [one for one in px4.heard if one.get_type() == "HIL_GPS"]
    assert len(fixes) == 10
    assert {(one.fix_type, one.eph, one.satellites_visible) for one in fixes} == {(3, 30, 12)}
    (answer,) = [one for one in px4.heard if one.get_type() == "COMMAND_ACK"]
    assert (answer.command, answer.result) == (511, 0)
    assert sum(one.get_type() == "HIL_STATE_QUATERNION" for one in px4.heard) >= 200  # 200 Hz, as it asked
    truth = load_truth(tmp_path / "ground_truth.npy")
    assert np.array_equal(truth["q"][:151], np.tile(truth["q"][0], (151, 1)))
    assert not np.array_equal(truth["q"][-1], truth["q"][0])
    kept = [f.message_id for _, f in read_tlog(tmp_path / "run.tlog")]
    assert kept.count(layout("HIL_STATE_QUATERNION").message_id) == 200
    assert kept.count(mapping.COMMAND.message_id) == 250 - counters["unanswered"] + counters["late_answers"]


@pytest.mark.parametrize(("rate_hz", "unanswered"), [(500.0, 1 / 2), (1000.0, 3 / 4)])
def test_above_250_hz_it_answers_every_4_ms_and_the_run_goes_on(
    rate_hz: float, unanswered: float, tmp_path: Path
) -> None:
    near, far = memory_pair()
    with near, FakePx4(far, silent=8):
        summary = fly_px4(flapper(rate_hz, 0.1), near, tmp_path)
    counters = summary["counters"]
    ticks = summary["ticks"]
    assert ticks == 0.1 * rate_hz
    assert 0.9 * unanswered * ticks <= counters["unanswered"] < ticks
    assert counters["stale"] == 0
    answered = [f for _, f in read_tlog(tmp_path / "run.tlog") if f.message_id == mapping.COMMAND.message_id]
    assert len(answered) == ticks - counters["unanswered"] + counters["late_answers"]


def test_a_link_that_loses_ticks_and_answers_stalls_nobody() -> None:
    near, far = memory_pair()
    with near, FakePx4(Faulty(far, lose_each(9)), silent=0):
        counters = fly_px4(flapper(250.0, 0.4), Faulty(near, lose_each(7)))["counters"]
    assert 5 < counters["unanswered"] < 95
    assert counters["late_answers"] > 0  # the tick sent once more was answered, while the next one was out


def test_one_that_falls_silent_is_flown_safely_for_a_while_and_then_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tolerant, "HEARTBEAT_TIMEOUT_NS", 300_000_000)
    near, far = memory_pair()
    with near, FakePx4(far, silent=0, mute_us=100_000), pytest.raises(PeerLostError, match="no HIL_ACTUATOR_CONTROLS"):
        fly_px4(flapper(250.0, 5.0), near, tmp_path)
    truth = load_truth(tmp_path / "ground_truth.npy")
    assert 50 <= len(truth) <= 60  # 25 answered, 30 waited for, 10 ms each
    assert truth["tau"][30][2] < -0.05  # the command stands ...
    assert np.array_equal(truth["tau"][-1], np.zeros(6))  # ... until it is 50 ms old


def test_one_that_never_answers_is_waited_for_with_a_bound() -> None:
    near, far = memory_pair()
    with near, FakePx4(far, silent=10**9), pytest.raises(PeerLostError, match="check that it still runs"):
        fly_px4(flapper(250.0, 60.0), near, wait_s=0.4)


def test_none_at_all_is_said() -> None:
    near, _far = memory_pair()
    with near, pytest.raises(PeerMissingError, match=r"tcpin://127\.0\.0\.1:4560"):
        fly_px4(flapper(250.0, 1.0), near, wait_s=0.2)


def test_over_tcp_as_px4_comes() -> None:
    with open_link("tcpin://127.0.0.1:0") as near:
        assert isinstance(near, TcpIn)
        with FakePx4(open_link(f"tcpout://127.0.0.1:{near.port}")) as px4:
            summary = fly_px4(flapper(250.0, 0.2), near)
    assert summary["ticks"] == 50
    assert px4.refused == []


def test_it_is_of_lockstep_only() -> None:
    options = EmulatorOptions(link="mem://none", clock="realtime", profile="tolerant")
    with pytest.raises(UsageError, match="needs lockstep"):
        run_emulator(flapper(250.0, 1.0), options, lambda _event: None, StopFlag())


PERIOD_NS = 4_000_000
MS = 1_000_000
SCENARIO = flapper(250.0, 60.0)
SCALE = np.array(SCENARIO.actuators.scale)
TAU = np.array([0.25, -0.25, 0.5, 0.1, -0.1, 0.2]) * SCALE
SAFE = np.array(SCENARIO.actuators.safe)


class Flown(NamedTuple):
    """Some ticks of the tolerant profile before a script."""

    pacing: Tolerant
    emulator: Emulator
    link: Scripted
    kept: list[tuple[int, bytes]]


def command(writer: FrameWriter, tick: int, tau: FloatArray = TAU, *, armed: bool = True) -> bytes:
    return command_frame(writer, tick * PERIOD_NS, tau, SCALE, armed=armed)


def fly_script(
    path: Path, ticks: int, script: Callable[[FrameWriter, int], list[bytes]], wait_s: float = 10.0
) -> Flown:
    """`script` says what comes 1 ms, 2 ms ... after the datagram of that number: a tick, or one sent again."""
    warm_up(SCENARIO)
    clock, writer = VirtualClock(10**12), FrameWriter(*VEHICLE)
    link = Scripted(clock, lambda number: script(writer, number))
    endpoint = Endpoint(link, 1, SCENARIO.wire.emulator_component)
    emulator = Emulator(SCENARIO, endpoint, None)
    with TlogWriter(path) as log:
        parts = Parts(emulator, endpoint, log, clock, StopFlag(), PERIOD_NS, ticks)
        pacing = Tolerant(parts, delay_ns=SCENARIO.delay_ns, keeper=None, wait_s=wait_s)
        try:
            for tick in range(ticks):
                pacing.exchange(tick * PERIOD_NS)
        finally:
            pacing.flush()
    kept = [(t_us, frame.raw) for t_us, frame in read_tlog(path) if frame.component == 1]
    return Flown(pacing, emulator, link, kept)


class TestScript:
    """The same profile on a clock that moves only while one waits: each rule to the millisecond."""

    @pytest.fixture
    def path(self, tmp_path: Path) -> Path:
        return tmp_path / "run.tlog"

    def test_before_the_first_answer_ticks_go_out_a_period_apart_and_none_twice(self, path: Path) -> None:
        flown = fly_script(path, 5, lambda _writer, _number: [])
        assert flown.link.sent_ns == [10**12 + k * PERIOD_NS for k in range(5)]
        assert flown.pacing.counters == {"resent": 0, "foreign": 0, "unanswered": 5, "late_answers": 0, "held": 5}
        assert flown.emulator.plant.state.motion.tolist() == SCENARIO.initial_motion.tolist()

    def test_after_it_one_is_waited_for_10_ms_then_sent_once_more_and_time_steps_on(self, path: Path) -> None:
        flown = fly_script(path, 3, lambda writer, number: [command(writer, 0)] if number == 0 else [])
        start_ns = 10**12 + MS
        # The copy of a tick and the next tick leave together, when the wait is over.
        assert flown.link.sent_ns == [10**12, *(start_ns + wait * MS for wait in (0, 10, 10, 20))]
        assert flown.link.sent[1] == flown.link.sent[2]
        assert flown.pacing.counters == {"resent": 2, "foreign": 0, "unanswered": 2, "late_answers": 0, "held": 0}
        assert flown.emulator.plant.t_ns == 3 * PERIOD_NS

    def test_a_late_answer_acts_when_it_comes_and_is_logged_then(self, path: Path) -> None:
        late: list[bytes] = []

        def script(writer: FrameWriter, number: int) -> list[bytes]:
            if number == 1:  # the tick at 4 ms has no answer in time ...
                late.append(command(writer, 1, 0.5 * TAU))
                return []
            return [late[0], command(writer, 2)] if number == 3 else [command(writer, number)] if not number else []

        flown = fly_script(path, 3, script)
        assert flown.pacing.counters == {"resent": 1, "foreign": 0, "unanswered": 1, "late_answers": 1, "held": 0}
        assert [t_us for t_us, raw in flown.kept] == [0, 8000, 8000]

    def test_an_answer_that_comes_again_is_no_answer_to_the_next_tick(self, path: Path) -> None:
        first = command(FrameWriter(*VEHICLE), 0)
        flown = fly_script(path, 4, lambda _writer, _number: [first])
        assert flown.pacing.counters["unanswered"] == 3
        assert flown.emulator.source.counters()["repeated"] > 0

    @pytest.mark.parametrize("spoken", ["nothing", "the first answer again", "a stranger's answers", "not a number"])
    def test_three_seconds_without_an_answer_end_the_run_whatever_else_is_said(self, path: Path, spoken: str) -> None:
        stranger = FrameWriter(1, 2)

        def script(writer: FrameWriter, number: int) -> list[bytes]:
            if number == 0 or spoken == "the first answer again":
                return [command(writer, 0)]
            if spoken == "not a number":
                bad = mapping.COMMAND.pack_fields(time_usec=number * PERIOD_NS // 1000, controls=[math.nan] * 6)
                return [writer.seal(mapping.COMMAND, bad)]
            return [command(stranger, number)] if spoken == "a stranger's answers" else []

        with pytest.raises(PeerLostError, match=r"no HIL_ACTUATOR_CONTROLS for 3\.01 s of waiting, up to t = 1\.204 s"):
            fly_script(path, 1000, script)

    def test_the_first_answer_is_waited_for_as_long_as_one_chose(self, path: Path) -> None:
        with pytest.raises(PeerLostError, match=r"for 0\.504 s of waiting, up to t = 0\.500 s"):
            fly_script(path, 1000, lambda _writer, _number: [], wait_s=0.5)
        path.unlink()
        flown = fly_script(path, 125, lambda _writer, _number: [], wait_s=0.5)
        assert flown.pacing.counters["unanswered"] == 125

    def test_any_answer_begins_the_silence_anew(self, path: Path) -> None:
        """Two silences of some 2 s each, with one late answer in between."""

        def script(writer: FrameWriter, number: int) -> list[bytes]:
            tick = {0: 0, 400: 200}.get(number)  # each tick from the second on is sent twice
            return [] if tick is None else [command(writer, tick, np.zeros(6))]

        flown = fly_script(path, 400, script)
        assert (flown.pacing.counters["unanswered"], flown.pacing.counters["late_answers"]) == (399, 1)
        assert flown.emulator.plant.t_ns == 400 * PERIOD_NS

    def test_the_plant_is_held_until_the_first_armed_command_and_flies_from_there_on(self, path: Path) -> None:
        flown = fly_script(path, 6, lambda writer, number: [command(writer, number, armed=number == 3)])
        assert flown.pacing.counters["held"] == 3
        assert flown.emulator.safety.counters["disarmed"] == 2, "those before it reach no motor"
        assert flown.emulator.plant.state.motion.tolist() != SCENARIO.initial_motion.tolist()

    def test_while_held_no_command_is_missed(self, path: Path) -> None:
        flown = fly_script(path, 100, lambda writer, number: [command(writer, number, armed=False)])
        assert flown.emulator.safety.counters == {"clamped": 0, "disarmed": 0, "stale": 0}
        assert flown.pacing.counters["held"] == 100

    def test_a_command_that_stands_too_long_ends_in_the_safe_output(self, path: Path) -> None:
        flown = fly_script(path, 20, lambda writer, number: [command(writer, number)] if number == 0 else [])
        assert flown.emulator.safety.counters["stale"] == 1
        assert flown.emulator.plant.state.tau.tolist() == SAFE.tolist()
