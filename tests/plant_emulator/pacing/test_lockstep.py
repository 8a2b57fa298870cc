"""The exact profile of lockstep: one answer for each tick, whatever the link does to the datagrams."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bridge.links.link import Link, open_link
from bridge.links.memory import memory_pair
from bridge.links.tcp import TcpIn
from bridge.links.udp import UdpIn
from fwav_hil.simulate import simulate
from plant_emulator.plant.truth import load_truth
from protocol.errors import (
    DivergenceError,
    PeerLostError,
    PeerMissingError,
    RunFolderError,
    ScenarioMismatchError,
)
from protocol.logs.tlog import read_tlog
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from protocol.wire.requests import ARM_DISARM
from tests.loop import fly_both, scenario_of

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
    assert "no answer" in str(ends.emulator)
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
