"""The exact profile of lockstep: one answer for each tick, whatever the link does to the datagrams."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.links.link import Link, open_link
from bridge.links.memory import memory_pair
from bridge.links.tcp import TcpIn
from bridge.links.udp import UdpIn
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from bridge.timing.rate import RateKeeper
from fwav_hil.simulate import simulate
from plant_emulator.pacing.lockstep import RESEND_AFTER_S, Lockstep
from plant_emulator.pacing.pacing import Parts
from plant_emulator.plant.truth import load_truth
from plant_emulator.process import warm_up
from plant_emulator.tick import Emulator
from protocol.errors import (
    DivergenceError,
    Interrupted,
    PeerLostError,
    PeerMissingError,
    RunFolderError,
    ScenarioMismatchError,
)
from protocol.logs.tlog import TlogWriter, read_tlog
from protocol.messages import VEHICLE, FloatArray
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameWriter
from protocol.wire.requests import ARM_DISARM
from tests.frames import command_frame
from tests.loop import fly_both, scenario_of
from tests.plant_emulator.pacing.scripted import Scripted

SHORT = scenario_of("flapper", duration_s=0.4)


class Faulty(Link):
    """A link that does something to each datagram it sends: a list of what goes out instead."""

    is_datagram = True

    def __init__(self, link: Link, fault: Callable[[int, bytes], list[bytes]]) -> None:
        super().__init__(link.uri)
        self.stats = link.stats
        self._link = link
        self._fault = fault
        self._count = 0

    def recv(self, timeout_s: float) -> bytes | None:
        return self._link.recv(timeout_s)

    def send(self, data: bytes | bytearray | memoryview) -> None:
        self._count += 1
        for datagram in self._fault(self._count, bytes(data)):
            self._link.send(datagram)

    def close(self) -> None:
        self._link.close()

    @property
    def peer(self) -> str:
        return self._link.peer


def lose_each(number: int) -> Callable[[int, bytes], list[bytes]]:
    return lambda count, data: [] if count % number == 0 else [data]


def double_each(number: int) -> Callable[[int, bytes], list[bytes]]:
    return lambda count, data: [data, data] if count % number == 0 else [data]


def damage_each(number: int) -> Callable[[int, bytes], list[bytes]]:
    return lambda count, data: [data[:-5] + bytes([data[-5] ^ 1]) + data[-4:]] if count % number == 0 else [data]


def test_a_flight_on_a_clean_link_equals_the_simulation_to_the_bit(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        ends = fly_both(SHORT, near, far, tmp_path)
    assert isinstance(ends.emulator, dict), ends
    assert isinstance(ends.controller, dict), ends
    truth, simulated = load_truth(tmp_path / "ground_truth.npy"), simulate(SHORT)
    assert len(truth) == SHORT.ticks == ends.emulator["ticks"]
    for name in ("q", "q_dot", "command", "tau", "u"):
        assert np.array_equal(truth[name], getattr(simulated, name)), name


@pytest.mark.parametrize("fault", [lose_each(7), double_each(5), damage_each(6)], ids=["lost", "doubled", "damaged"])
@pytest.mark.parametrize("end", ["emulator", "controller"])
def test_faults_of_the_link_change_no_byte_of_log_and_ground_truth(
    end: str, fault: Callable[[int, bytes], list[bytes]], tmp_path: Path
) -> None:
    folders = tmp_path / "clean", tmp_path / "faulty"
    near, far = memory_pair()
    with near, far:
        fly_both(SHORT, near, far, folders[0])
    near, far = memory_pair()
    with near, far:
        emulator_link = Faulty(near, fault) if end == "emulator" else near
        controller_link = Faulty(far, fault) if end == "controller" else far
        ends = fly_both(SHORT, emulator_link, controller_link, folders[1])
    assert isinstance(ends.emulator, dict), ends
    assert isinstance(ends.controller, dict), ends
    emulator, controller = ends.emulator["counters"], ends.controller["counters"]
    assert (
        emulator["resent"] + controller["repeated"] + emulator["foreign"] > 5
    )  # the fault did happen, and was counted
    assert controller["steps"] == SHORT.ticks  # and a tick that came twice was not stepped twice
    for name in ("run.tlog", "ground_truth.npy"):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes(), name


@pytest.mark.parametrize(("waiting", "scheme"), [("udpin", "udpout"), ("tcpin", "tcpout")])
def test_sockets_carry_the_same_flight(waiting: str, scheme: str, tmp_path: Path) -> None:
    with open_link(f"{waiting}://127.0.0.1:0") as near:
        assert isinstance(near, UdpIn | TcpIn)
        with open_link(f"{scheme}://127.0.0.1:{near.port}") as far:
            ends = fly_both(SHORT, near, far, tmp_path)
    assert isinstance(ends.emulator, dict), ends
    assert np.array_equal(load_truth(tmp_path / "ground_truth.npy")["q"], simulate(SHORT).q)


def test_the_log_holds_each_tick_and_its_answer_once_under_simulation_time(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        fly_both(SHORT, near, far, tmp_path)
    records = list(read_tlog(tmp_path / "run.tlog"))
    for message in (mapping.POSE, mapping.TICK, mapping.COMMAND):
        times = [int.from_bytes(f.payload[:8], "little") for _, f in records if f.message_id == message.message_id]
        assert times == [k * SHORT.period_ns // 1000 for k in range(SHORT.ticks)], message.name
    assert all(
        t_us == int.from_bytes(f.payload[:8], "little")
        for t_us, f in records
        if f.message_id == mapping.COMMAND.message_id
    )
    for sender in ((1, 1), (1, SHORT.wire.emulator_component)):
        numbers = [frame.sequence for _, frame in records if (frame.system, frame.component) == sender]
        assert numbers == [k % 256 for k in range(len(numbers))], sender  # restarted at t = 0, none missing


def test_each_end_refuses_another_scenario(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        ends = fly_both(SHORT, near, far, tmp_path, controller_scenario=scenario_of("paper"))
    for outcome in ends:
        assert isinstance(outcome, ScenarioMismatchError)
        assert "same scenario file" in str(outcome)


def test_a_controller_may_run_at_another_rate_than_the_ticks(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        ends = fly_both(SHORT, near, far, tmp_path, controller_scenario=scenario_of("flapper", rate_hz=500.0))
    assert isinstance(ends.controller, dict), ends
    counters = ends.controller["counters"]
    assert counters["steps"] == SHORT.ticks
    assert counters["missed_samples"] == SHORT.ticks - 1  # every other period of the law has no sample
    error = load_truth(tmp_path / "ground_truth.npy")["q"] - simulate(SHORT).q
    assert np.abs(error).max() < 0.05  # and it flies all the same


def test_an_emulator_whose_controller_does_not_arm_says_so() -> None:
    near, far = memory_pair()
    with near, far:
        ends = fly_both(SHORT, near, far, arm=False, wait_s=0.5)
    assert isinstance(ends.emulator, PeerMissingError)
    assert "--arm" in str(ends.emulator)
    assert isinstance(ends.controller, PeerMissingError)


def test_a_ground_station_arms_the_controller(tmp_path: Path) -> None:
    near, far = memory_pair()
    station = FrameWriter(255, 190)
    arm = mapping.COMMAND_LONG.pack_fields(command=ARM_DISARM, param1=1.0, param2=float("nan"))
    frame = station.seal(mapping.COMMAND_LONG, arm)
    # The station speaks through the emulator's end of the link, once the controller has had time to be refused.
    with near, far:
        with_station = Faulty(near, lambda count, data: [data, frame] if count == 5 else [data])
        ends = fly_both(SHORT, with_station, far, tmp_path, arm=False)
    assert isinstance(ends.emulator, dict), ends
    assert ends.emulator["counters"]["disarmed"] == 0


class Dripping(Link):
    """A stream that hands on what it receives in pieces of a few bytes, as a slow serial line does."""

    is_datagram = False

    def __init__(self, link: Link) -> None:
        super().__init__(link.uri)
        self._link = link
        self._waiting = b""

    def recv(self, timeout_s: float) -> bytes | None:
        if not self._waiting:
            self._waiting = self._link.recv(timeout_s) or b""
        piece, self._waiting = self._waiting[:7], self._waiting[7:]
        return piece or None

    def send(self, data: bytes | bytearray | memoryview) -> None:
        self._link.send(data)

    def close(self) -> None:
        self._link.close()

    @property
    def peer(self) -> str:
        return self._link.peer


def test_a_stream_that_comes_in_pieces_is_no_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "plant_emulator.pacing.lockstep.RESEND_AFTER_S", (5.0,)
    )  # a stall of the machine is not what is tested
    near, far = memory_pair()
    with near, far:
        ends = fly_both(SHORT, Dripping(near), Dripping(far), tmp_path)
    assert isinstance(ends.emulator, dict), ends
    assert ends.emulator["counters"]["resent"] == 0
    assert np.array_equal(load_truth(tmp_path / "ground_truth.npy")["q"], simulate(SHORT).q)


@pytest.mark.parametrize(("ticks_hz", "law_hz"), [(500.0, 250.0), (1000.0, 250.0), (500.0, 200.0)])
def test_a_law_that_is_slower_than_the_ticks_steps_at_its_own_rate(
    ticks_hz: float, law_hz: float, tmp_path: Path
) -> None:
    near, far = memory_pair()
    scenario = scenario_of("flapper", duration_s=0.4, rate_hz=ticks_hz)
    with near, far:
        ends = fly_both(scenario, near, far, tmp_path, controller_scenario=scenario_of("flapper", rate_hz=law_hz))
    assert isinstance(ends.controller, dict), ends
    assert abs(ends.controller["counters"]["steps"] - 0.4 * law_hz) <= 1
    assert isinstance(ends.emulator, dict)
    assert ends.emulator["ticks"] == 0.4 * ticks_hz  # and every tick had its answer


def test_an_emulator_does_not_overwrite_a_run(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        fly_both(SHORT, near, far, tmp_path)
    before = (tmp_path / "run.tlog").read_bytes()
    near, far = memory_pair()
    with near, far:
        ends = fly_both(SHORT, near, far, tmp_path, wait_s=0.3)
    assert isinstance(ends.emulator, RunFolderError)
    assert (tmp_path / "run.tlog").read_bytes() == before


def test_silence_ends_the_run_with_a_named_error_and_a_log_up_to_there(tmp_path: Path) -> None:
    near, far = memory_pair()
    with near, far:
        mute = Faulty(far, lambda count, data: [] if count > 30 else [data])
        ends = fly_both(SHORT, near, mute, tmp_path)
    assert isinstance(ends.emulator, PeerLostError)
    assert "did not answer" in str(ends.emulator)
    rows = load_truth(tmp_path / "ground_truth.npy")
    answers = [f for _, f in read_tlog(tmp_path / "run.tlog") if f.message_id == mapping.COMMAND.message_id]
    assert 0 < len(rows) == len(answers) < 30


def test_a_divergence_is_named_and_logged_up_to_there(tmp_path: Path) -> None:
    scenario = scenario_of("flapper", delay={"samples": 6, "seconds": 0.005})  # 29 ms: too much
    near, far = memory_pair()
    with near, far:
        ends = fly_both(scenario, near, far, tmp_path)
    assert isinstance(ends.emulator, DivergenceError)
    assert isinstance(ends.controller, dict)  # for the controller the run just ended
    simulated = simulate(scenario)
    assert simulated.divergence
    assert np.array_equal(load_truth(tmp_path / "ground_truth.npy")["q"], simulated.q)


PERIOD_NS = SHORT.period_ns
SCALE = np.array(SHORT.actuators.scale)
TAU = np.array([0.25, -0.25, 0.5, 0.1, -0.1, 0.2]) * SCALE
MS = 1_000_000


class Flown(NamedTuple):
    """Some ticks of lockstep before a script, on a clock that moves only while one waits."""

    pacing: Lockstep
    emulator: Emulator
    link: Scripted
    kept: list[Frame]


def command(writer: FrameWriter, tick: int, tau: FloatArray = TAU, *, armed: bool = True) -> bytes:
    return command_frame(writer, tick * PERIOD_NS, tau, SCALE, armed=armed)


def beat(writer: FrameWriter) -> bytes:
    return writer.seal(mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=True))


def fly_script(
    path: Path, ticks: int, script: Callable[[FrameWriter, int], list[bytes]], *, speed: float = 0.0
) -> Flown:
    """`script` says what comes 1 ms, 2 ms ... after the datagram of that number: a tick, or one sent again."""
    warm_up(SHORT)
    clock, writer = VirtualClock(10**12), FrameWriter(*VEHICLE)
    link = Scripted(clock, lambda number: script(writer, number))
    endpoint = Endpoint(link, 1, SHORT.wire.emulator_component)
    emulator = Emulator(SHORT, endpoint, None)
    keeper = RateKeeper(clock, round(PERIOD_NS / speed)) if speed else None
    with TlogWriter(path) as log:
        parts = Parts(emulator, endpoint, log, clock, StopFlag(), PERIOD_NS, ticks)
        pacing = Lockstep(parts, delay_ns=SHORT.delay_ns, keeper=keeper)
        try:
            for tick in range(ticks):
                pacing.exchange(tick * PERIOD_NS)
        finally:
            pacing.flush()
    return Flown(pacing, emulator, link, [frame for _, frame in read_tlog(path)])


def theirs(flown: Flown) -> list[bytes]:
    """What the log holds of the controller's words."""
    return [frame.raw for frame in flown.kept if (frame.system, frame.component) != (1, SHORT.wire.emulator_component)]


class TestAnswers:
    @pytest.fixture
    def path(self, tmp_path: Path) -> Path:
        return tmp_path / "run.tlog"

    def test_each_tick_leaves_when_the_one_before_it_is_answered(self, path: Path) -> None:
        flown = fly_script(path, 5, lambda writer, number: [command(writer, number)])
        assert flown.link.sent_ns == [10**12 + k * MS for k in range(5)]
        assert flown.pacing.latencies_ns == [MS] * 5
        assert flown.pacing.all_counters() == {"resent": 0, "foreign": 0}

    def test_with_a_speed_to_keep_a_tick_waits_for_its_time(self, path: Path) -> None:
        flown = fly_script(path, 5, lambda writer, number: [command(writer, number)], speed=0.5)
        assert flown.link.sent_ns == [10**12 + (k + 1) * 2 * PERIOD_NS for k in range(5)]
        assert flown.pacing.all_counters() == {"resent": 0, "foreign": 0, "late": 0, "slipped": 0}

    def test_a_late_copy_of_an_earlier_answer_is_foreign_and_not_logged(self, path: Path) -> None:
        frames: list[bytes] = []

        def script(writer: FrameWriter, number: int) -> list[bytes]:
            frames.append(command(writer, number))
            return [frames[number - 1], frames[number]] if number == 3 else [frames[number]]

        flown = fly_script(path, 5, script)
        assert flown.pacing.counters == {"resent": 0, "foreign": 1}
        assert theirs(flown) == frames
        assert flown.emulator.source.counters()["repeated"] == 1

    def test_neither_is_what_came_with_it(self, path: Path) -> None:
        def script(writer: FrameWriter, number: int) -> list[bytes]:
            frame = command(writer, number)
            return [frame] if number != 3 else [command(FrameWriter(*VEHICLE), 2) + beat(FrameWriter(7, 7)), frame]

        flown = fly_script(path, 5, script)
        assert flown.pacing.counters == {"resent": 0, "foreign": 2}
        assert len(theirs(flown)) == 5

    @pytest.mark.parametrize("stray", ["of a tick to come", "between ticks", "not a number"])
    def test_a_stray_command_is_foreign_and_does_not_act(self, path: Path, stray: str) -> None:
        def script(writer: FrameWriter, number: int) -> list[bytes]:
            frame, other = command(writer, number), FrameWriter(*VEHICLE)
            if number != 3:
                return [frame]
            if stray == "of a tick to come":
                return [command(other, 4, -TAU), frame]
            t_us = 3 * PERIOD_NS // 1000 + (stray == "between ticks")
            controls = [float("nan") if stray == "not a number" else 1.0] * 6
            payload = mapping.COMMAND.pack_fields(time_usec=t_us, controls=controls, mode=0xFF)
            return [other.seal(mapping.COMMAND, payload), frame]

        flown = fly_script(path, 5, script)
        assert flown.pacing.counters == {"resent": 0, "foreign": 1}
        assert len(theirs(flown)) == 5
        clean = fly_script(path.with_name("clean.tlog"), 5, lambda writer, number: [command(writer, number)])
        assert flown.emulator.plant.state.packed.tobytes() == clean.emulator.plant.state.packed.tobytes()

    def test_frames_of_others_travel_into_the_log_with_the_answer(self, path: Path) -> None:
        station = beat(FrameWriter(255, 190))

        def script(writer: FrameWriter, number: int) -> list[bytes]:
            frame = command(writer, number)
            return [station, frame] if number == 3 else [frame]

        flown = fly_script(path, 5, script)
        assert flown.pacing.counters["foreign"] == 0
        assert theirs(flown).index(station) == 3
        assert [t_us for t_us, frame in read_tlog(path) if frame.raw == station] == [3 * PERIOD_NS // 1000]

    def test_of_a_damaged_answer_and_its_copy_each_frame_is_logged_once(self, path: Path) -> None:
        whole: list[bytes] = []

        def script(writer: FrameWriter, number: int) -> list[bytes]:
            if number < 3:
                return [command(writer, number)]
            if number == 3:
                whole[:] = [beat(writer), command(writer, 3)]
                damaged = bytearray(whole[1])
                damaged[-1] ^= 1
                return [whole[0] + bytes(damaged)]
            return [b"".join(whole)] if number == 4 else [command(writer, number - 1)]

        flown = fly_script(path, 5, script)
        assert flown.pacing.counters == {"resent": 1, "foreign": 1}
        assert theirs(flown)[3:5] == whole
        assert len(theirs(flown)) == 6

    def test_what_the_controller_said_before_its_first_answer_is_not_logged(self, path: Path) -> None:
        hello, station = FrameWriter(*VEHICLE), beat(FrameWriter(255, 190))
        hello.sequence = 41

        def script(writer: FrameWriter, number: int) -> list[bytes]:
            if number:
                return [command(writer, number)]
            return [beat(hello), beat(hello) + station, beat(writer) + command(writer, 0)]

        flown = fly_script(path, 3, script)
        ids = [(frame.system, frame.message_id) for frame in flown.kept if frame.component != 191]
        beat_id, command_id = mapping.HEARTBEAT.message_id, mapping.COMMAND.message_id
        assert ids == [(255, beat_id), (1, beat_id), (1, command_id), (1, command_id), (1, command_id)]
        assert flown.pacing.counters["foreign"] == 2
        numbers = [frame.sequence for frame in flown.kept if (frame.system, frame.component) == VEHICLE]
        assert numbers == [0, 1, 2, 3]

    def test_a_disarmed_answer_is_an_answer_and_acts_as_zeros(self, path: Path) -> None:
        flown = fly_script(path, 5, lambda writer, number: [command(writer, number, armed=number < 2)])
        assert flown.emulator.safety.counters["disarmed"] == 3
        assert flown.emulator.plant.state.tau.tolist() == [0.0] * 6

    def test_a_strangers_command_is_no_answer(self, path: Path) -> None:
        stranger = FrameWriter(1, 2)

        def script(writer: FrameWriter, number: int) -> list[bytes]:
            return [command(stranger, number, -TAU), command(writer, number)]

        flown = fly_script(path, 5, script)
        assert flown.pacing.latencies_ns == [2 * MS] * 5
        assert flown.emulator.source.newest == pytest.approx(TAU, rel=1e-6)


class TestSilence:
    def test_the_same_bytes_go_out_again_after_growing_waits_for_two_seconds(self, tmp_path: Path) -> None:
        with pytest.raises(PeerLostError, match=r"did not answer the tick at t = 0\.008 s within 2 s") as caught:
            fly_script(tmp_path / "run.tlog", 5, lambda writer, number: [command(writer, number)] if number < 2 else [])
        assert "the script" in str(caught.value)

    def test_an_answer_to_the_last_copy_goes_on_with_the_run(self, tmp_path: Path) -> None:
        flown = fly_script(
            tmp_path / "run.tlog",
            2,
            lambda writer, number: [command(writer, max(0, number - 7))] if number >= 7 else [],
        )
        waits_ms = (10, 20, 40, 80, 160, 320, 640)
        assert flown.link.sent_ns[:8] == [10**12 + sum(waits_ms[:k]) * MS for k in range(8)]
        assert len(set(flown.link.sent[:8])) == 1
        assert flown.pacing.counters == {"resent": 7, "foreign": 0}
        assert sum(RESEND_AFTER_S) == pytest.approx(2.0)
        sent = [frame.sequence for frame in flown.kept if frame.component == SHORT.wire.emulator_component]
        assert sent == list(range(len(sent))), "each tick is in the log once"

    def test_a_stop_is_heard_while_it_waits(self, tmp_path: Path) -> None:
        stop = StopFlag()

        def silent(_number: int) -> list[bytes]:
            stop.requested = True
            return []

        link = Scripted(clock := VirtualClock(), silent)
        endpoint = Endpoint(link, 1, 191)
        parts = Parts(Emulator(SHORT, endpoint, None), endpoint, None, clock, stop, PERIOD_NS, 5)
        with pytest.raises(Interrupted):
            Lockstep(parts, delay_ns=0, keeper=None).exchange(0)
        assert len(link.sent) == 1

    def test_what_keeps_coming_without_an_answer_does_not_hold_it_for_ever(self, tmp_path: Path) -> None:
        """A flood of other frames: it looks at its time all the same."""

        class Flooded(Scripted):
            def recv(self, timeout_s: float) -> bytes | None:
                self._clock.advance_ns(MS)
                return beat(FrameWriter(255, 190))

        link = Flooded(clock := VirtualClock(), lambda _number: [])
        endpoint = Endpoint(link, 1, 191)
        parts = Parts(Emulator(SHORT, endpoint, None), endpoint, None, clock, StopFlag(), PERIOD_NS, 5)
        with pytest.raises(PeerLostError):
            Lockstep(parts, delay_ns=0, keeper=None).exchange(0)
        assert clock.now_ns() < 10_000 * MS
