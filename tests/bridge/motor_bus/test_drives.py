"""A flight with its drives on a bus inside one process: equal to the direct path, and safe where the drives fail."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import msgspec
import numpy as np
import pytest

from bridge.links.memory import memory_pair
from bridge.motor_bus.can_bus import CanBus
from bridge.motor_bus.can_load import plan_bus
from bridge.motor_bus.drives import RESEND_AFTER_S, CanMotors
from bridge.process import StopFlag
from bridge.shared_options import ClockMode
from bridge.timing.clock import MonotonicClock
from fwav_hil.bus_plot import plot_bus, read_encoders
from fwav_hil.score import scores
from fwav_hil.simulate import simulate
from plant_emulator.drives.motor_node import MotorNode
from plant_emulator.drives.motor_process import MotorThread
from plant_emulator.options import MotorLink
from plant_emulator.plant.truth import load_truth
from protocol.can_frame import CanFrame
from protocol.errors import LinkInUseError, PeerLostError, PeerMissingError, ScenarioMismatchError, UsageError
from protocol.messages import AXES
from protocol.motors.motor_protocol import make_host
from protocol.motors.registry import PROTOCOLS
from protocol.motors.simulation_sync import decode_answer, decode_sync, encode_answer, encode_hello, encode_sync
from protocol.scenario import Scenario
from tests.dbc import our_dbc
from tests.loop import fly_both
from tests.plant_emulator.drives.test_motor import with_motor

_names = itertools.count()


@pytest.fixture
def uri() -> str:
    return f"virtual:motors{next(_names)}"


def short(**motor: Any) -> Scenario:
    return msgspec.structs.replace(with_motor(**({"lag_s": 0.0} | motor)), duration_s=0.4)


def fly(scenario: Scenario, out: Path, motors: MotorLink, clock: ClockMode = "lockstep") -> dict[str, Any]:
    near, far = memory_pair()
    with near, far:
        ends = fly_both(scenario, near, far, out, motors=motors, clock=clock)
    assert isinstance(ends.emulator, dict), ends
    assert isinstance(ends.controller, dict), ends
    return ends.emulator


def test_a_flight_over_odrive_equals_the_direct_one_to_the_bit(tmp_path: Path, uri: str) -> None:
    scenario = short()
    emulator = fly(scenario, tmp_path, MotorLink(can=uri))
    truth, simulated = load_truth(tmp_path / "ground_truth.npy"), simulate(scenario)
    assert len(truth) == scenario.ticks
    for name in ("q", "q_dot", "command", "tau", "u"):
        assert np.array_equal(truth[name], getattr(simulated, name)), name
    counters = emulator["counters"]
    assert (counters["motor_enables"], counters["motor_outages"], counters["motor_safe_ticks"]) == (1, 0, 0)


@pytest.mark.parametrize("protocol", sorted(set(PROTOCOLS) - {"odrive"}))
def test_a_flight_over_a_coarser_protocol_tracks_as_well(protocol: str, tmp_path: Path, uri: str) -> None:
    scenario = short(protocol=protocol)
    fly(scenario, tmp_path, MotorLink(can=uri))
    truth, simulated = load_truth(tmp_path / "ground_truth.npy"), simulate(scenario)
    assert not np.array_equal(truth["u"], simulated.u)  # 12 or 14 bits are not all
    ours = scores(scenario, truth["t_ns"], truth["q"])["rmse"]
    direct = scores(scenario, simulated.t_ns, simulated.q)["rmse"]
    assert all(ours[axis] == pytest.approx(direct[axis], rel=0.10) for axis in AXES)


def test_the_record_is_read_back_and_is_the_same_each_time(tmp_path: Path, uri: str) -> None:
    folders = [tmp_path / name for name in ("one", "two")]
    for k, folder in enumerate(folders):
        fly(short(), folder, MotorLink(can=f"{uri}{k}", log=folder / "bus.log"))
    assert (folders[0] / "bus.log").read_bytes() == (folders[1] / "bus.log").read_bytes()
    messages = list(can.LogReader(folders[0] / "bus.log"))
    torques = [m for m in messages if m.arbitration_id == (21 + 2) << 5 | 0x0E]
    assert [round(m.timestamp * 1000) for m in torques] == list(range(1000, 1400, 4))
    truth = load_truth(folders[0] / "ground_truth.npy")
    dbc = our_dbc("odrive")
    said = [dbc.decode_message("Set_Input_Torque", bytes(m.data))["Input_Torque"] / 16.0 * 0.12 for m in torques]
    assert said == pytest.approx(np.clip(truth["command"][:, 2], -0.12, 0.02), rel=1e-6)


def test_the_default_record_is_a_blf_with_every_answer(tmp_path: Path, uri: str) -> None:
    fly(short(), tmp_path, MotorLink(can=uri))
    frames = [
        CanFrame(m.arbitration_id, bytes(m.data), m.is_extended_id) for m in can.LogReader(tmp_path / "motor_bus.blf")
    ]
    assert len([frame for frame in frames if decode_answer(frame)]) == 6 * 100
    assert len([frame for frame in frames if decode_sync(frame)]) == 100


def test_the_gears_can_be_drawn_from_the_bus_alone(tmp_path: Path, uri: str) -> None:
    """Along the backlash u - tau is never more than half its width, and in a stroke it reaches that on both sides."""
    scenario = short()
    fly(scenario, tmp_path, MotorLink(can=uri))
    points = read_encoders(tmp_path / "motor_bus.blf")
    assert [len(of_axis) for of_axis in points] == [40] * 6
    width = 0.002 / 0.04  # (h - kappa)/chi over full scale, at 1 rad of travel
    apart = points[0][:, 1] - points[0][:, 0]
    assert np.abs(apart).max() == pytest.approx(width, rel=0.05)
    assert plot_bus(tmp_path / "motor_bus.blf", scenario, "flapper").stat().st_size > 10_000


def test_the_load_on_the_bus_is_below_what_was_reckoned(tmp_path: Path, uri: str) -> None:
    scenario = short()
    summary = fly(scenario, tmp_path, MotorLink(can=uri))["can"]
    planned = plan_bus("odrive", scenario.motor, 250.0).loads[1_000_000]
    assert summary["load_percent"]["1000000"] == pytest.approx(100.0 * planned)
    assert 0.7 * planned < summary["measured_load_percent"]["1000000"] / 100.0 < planned


def test_feedback_from_the_bus_is_as_coarse_as_the_bus(tmp_path: Path, uri: str) -> None:
    scenario = short(protocol="mit", encoder_counts=512)
    fly(scenario, tmp_path, MotorLink(can=uri, feedback="bus"))
    u = load_truth(tmp_path / "ground_truth.npy")["u"][20:, 2]
    count = 2 * np.pi / 512 * 0.12
    assert np.abs(u / count - np.round(u / count)).max() < 0.02  # whole counts, but for the 16 bits of the reply
    assert len(np.unique(np.round(u / count))) > 3


def test_dronecan_has_nothing_to_feed_back(tmp_path: Path, uri: str) -> None:
    near, far = memory_pair()
    with near, far:
        ends = fly_both(
            short(protocol="dronecan"), near, far, tmp_path, motors=MotorLink(can=uri, feedback="bus"), wait_s=0.5
        )
    assert isinstance(ends.emulator, UsageError)


def test_a_bus_delay_acts_later(tmp_path: Path, uri: str) -> None:
    scenario = short(bus_delay=True)
    fly(scenario, tmp_path, MotorLink(can=uri))
    delay_ns = plan_bus("odrive", scenario.motor, 250.0).response_s * 1e9
    truth, direct = load_truth(tmp_path / "ground_truth.npy"), simulate(scenario)
    assert 4e6 < delay_ns < 8e6  # one to two ticks more
    late = int(np.flatnonzero(truth["u"][:, 0] != truth["u"][0, 0])[0])
    early = int(np.flatnonzero(direct.u[:, 0] != direct.u[0, 0])[0])
    assert late - early in (1, 2)


def test_real_time_takes_answers_as_they_come(tmp_path: Path, uri: str) -> None:
    emulator = fly(short(), tmp_path, MotorLink(can=uri), clock="realtime")
    assert emulator["clock"] == "realtime"
    assert emulator["counters"]["motor_enables"] >= 1
    assert np.abs(load_truth(tmp_path / "ground_truth.npy")["u"]).max() > 0


def test_real_time_on_the_protocol_alone_needs_no_sync(tmp_path: Path, uri: str) -> None:
    """As on hardware: no frame of the simulation from the host, u from the drives' own status."""
    fly(short(encoder_rate_hz=250.0), tmp_path, MotorLink(can=uri, feedback="bus"), clock="realtime")
    frames = [CanFrame(m.arbitration_id, bytes(m.data)) for m in can.LogReader(tmp_path / "motor_bus.blf")]
    assert not any(decode_sync(frame) or decode_answer(frame) for frame in frames)
    assert np.abs(load_truth(tmp_path / "ground_truth.npy")["u"][-50:, 2]).max() > 0


class Rig:
    """The emulator's end of the bus and drives in a thread, without a flight; waits are short."""

    def __init__(self, uri: str, scenario: Scenario | None = None, *, lockstep: bool = True) -> None:
        self.scenario = scenario or short()
        self.events: list[str] = []
        self.stop = StopFlag()
        self.bus = CanBus(uri, 1_000_000)
        plan = plan_bus("odrive", self.scenario.motor, 250.0)
        self.motors = CanMotors(
            self.scenario, self.bus, plan, lockstep=lockstep, feedback="sync", clock=MonotonicClock(), stop=self.stop,
            report=lambda event: self.events.append(event["event"]), waits_s=(0.05, 0.05),
        )  # fmt: skip
        self.t_ns = -4_000_000

    def tick(self, torque: float = 0.01) -> Any:
        self.t_ns += 4_000_000
        return self.motors.drive(self.t_ns, np.array([torque, 0, 0, 0, 0, 0]), self.t_ns)

    def counted(self) -> dict[str, int]:
        return {name: count for name, count in self.motors.counters.items() if name.startswith("motor_") and count}


@pytest.fixture
def rig(uri: str) -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(scenario: Scenario | None = None, *, lockstep: bool = True) -> Rig:
        made.append(Rig(uri, scenario, lockstep=lockstep))
        return made[-1]

    yield make
    for one in made:
        one.bus.close()


def test_in_real_time_drives_that_vanish_are_an_outage_with_safe_output_and_are_taken_up_again(
    rig: Callable[..., Rig], uri: str
) -> None:
    one = rig(lockstep=False)
    with MotorThread(one.scenario, "odrive", uri):
        one.motors.meet(10.0)
        for _ in range(10_000):  # nobody waits for the thread, which may need a moment
            held = one.tick()
            if held[0] > 0.0:
                break
    one.events.clear()
    before = one.counted().get("motor_outages", 0), one.counted().get("motor_outage_ticks", 0)
    for _ in range(40):
        last = one.tick()
        if "motors_lost" in one.events:
            break
        assert np.array_equal(last, held), "for actuators.staleness_s"
    assert not last.any()  # the safe output
    one.tick()
    assert one.events == ["motors_lost"]
    assert one.counted()["motor_outages"] == before[0] + 1
    assert one.counted()["motor_outage_ticks"] == before[1] + 2
    with MotorThread(one.scenario, "odrive", uri):
        for _ in range(10_000):
            last = one.tick()
            if last[0] > 0.0:
                break
    assert one.events[:2] == ["motors_lost", "motors_back"]
    assert last[0] > 0.0
    assert one.counted()["motor_recoveries"] >= 1


def test_in_real_time_drives_that_stay_away_disarm_and_end_the_run(
    rig: Callable[..., Rig], uri: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bridge.motor_bus.drives.GIVE_UP_NS", 20_000_000)
    one = rig(lockstep=False)
    with MotorThread(one.scenario, "odrive", uri):
        one.motors.meet(10.0)
        one.tick()
    with pytest.raises(PeerLostError, match="the run is disarmed"):
        for _ in range(1000):
            one.tick()


@pytest.mark.parametrize("lockstep", [True, False])
def test_the_drives_are_told_whether_time_waits_for_them(rig: Callable[..., Rig], uri: str, lockstep: bool) -> None:
    one = rig(lockstep=lockstep)
    syncs = []
    one.motors.watches.append(lambda _, frame: syncs.append(sync) if (sync := decode_sync(frame)) else None)
    with MotorThread(one.scenario, "odrive", uri):
        one.motors.meet(10.0)
        one.tick()
    assert [sync.lockstep for sync in syncs] == [lockstep]


def answers(tick: int, u: float, *, enabled: bool = True) -> list[CanFrame]:
    """What six drives say to the SYNC of a tick."""
    return [encode_answer(axis, tick, u, enabled=enabled) for axis in range(6)]


@contextmanager
def script(one: Rig, said: list[list[CanFrame]]) -> Iterator[None]:
    """Drives that say this, item by item, to each SYNC that they hear, and then no more."""
    one.motors._waits_s = (0.05,) * 200
    ending = threading.Event()

    def speak() -> None:
        with CanBus(one.bus.uri.text, 1_000_000) as bus:
            while not ending.is_set():
                frame = bus.recv(0.05)
                if frame is not None and decode_sync(frame) and said:
                    for answer in said.pop(0):
                        bus.send(answer)

    thread = threading.Thread(target=speak)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join(10.0)


class TestLockstepWithDrivesAway:
    """Simulation time stands still: how long the drives are away changes nothing but the number of repetitions."""

    def flight(self, one: Rig, away_s: float) -> tuple[list[Any], dict[str, int]]:
        """60 ticks, u and counters; after 20 the drives are gone for some wall time, and then others take their place."""
        one.motors._waits_s = (0.02,) * 3000
        uri = one.bus.uri.text
        with MotorThread(one.scenario, "odrive", uri):
            one.motors.meet(10.0)
            seen = [one.tick(0.02 * np.sin(k)) for k in range(20)]
        following = MotorThread(one.scenario, "odrive", uri)
        timer = threading.Timer(away_s, following.__enter__)
        timer.start()
        try:
            seen += [one.tick(0.02 * np.sin(k)) for k in range(20, 60)]
        finally:
            timer.join()
            following.__exit__(None, None, None)
        return seen, one.counted()

    def test_the_result_depends_on_the_tick_alone_at_which_they_were_lost(self, rig: Callable[..., Rig]) -> None:
        (seen, counted), (seen_later, counted_later) = [self.flight(rig(short(lag_s=0.002)), s) for s in (0.0, 0.3)]
        assert np.array_equal(seen, seen_later)
        assert counted_later["motor_resent"] > counted.get("motor_resent", 0)
        of_the_wait = {"motor_resent", "motor_late_answers"}
        counted, counted_later = (
            {k: n for k, n in c.items() if k not in of_the_wait} for c in (counted, counted_later)
        )
        assert (
            counted
            == counted_later
            == {"motor_outages": 1, "motor_recoveries": 1, "motor_safe_ticks": 1, "motor_enables": 2}
        )

    def test_the_plant_sees_one_tick_at_the_safe_output(self, rig: Callable[..., Rig]) -> None:
        one = rig()
        seen, _ = self.flight(one, 0.1)
        assert one.events == ["motors_back"]
        safe = np.array(one.scenario.hysteresis.h) * np.array(one.scenario.actuators.safe)
        assert [k for k, u in enumerate(seen) if np.array_equal(u, safe)] == [20]

    def test_none_that_come_end_the_run_with_their_name(self, rig: Callable[..., Rig], uri: str) -> None:
        one = rig()
        with MotorThread(one.scenario, "odrive", uri):
            one.motors.meet(10.0)
            one.tick()
        with pytest.raises(
            PeerLostError, match=r"the drives on virtual:.* did not answer the tick at t = 0\.004 s"
        ) as lost:
            one.tick()
        assert "restart them with `fwav-hil motor SCENARIO --can virtual:" in str(lost.value)
        assert lost.value.exit_code == 4
        assert one.counted()["motor_resent"] == 1
        assert "motor_outages" not in one.counted()

    def test_a_bus_that_is_away_is_named_too(
        self, rig: Callable[..., Rig], uri: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        one = rig()
        with MotorThread(one.scenario, "odrive", uri):
            one.motors.meet(10.0)
            one.tick()

        def gone(*_: object) -> None:
            raise can.CanError("no such device")

        monkeypatch.setattr(one.bus._bus, "send", gone)
        monkeypatch.setattr(one.bus, "_open", gone)
        with pytest.raises(PeerLostError, match=r"\(the interface is lost: no such device\)"):
            one.tick()

    def test_they_are_waited_for_8_s(self) -> None:
        assert sum(RESEND_AFTER_S) == pytest.approx(8.0)
        assert RESEND_AFTER_S[:3] == (0.01, 0.02, 0.04)

    def test_a_process_that_is_started_again_gets_the_whole_time(self, rig: Callable[..., Rig]) -> None:
        one = rig()
        restarts = iter([True, False, True])

        def look() -> None:
            one.stop.peer_restarts += next(restarts, False)

        one.motors.poll.append(look)
        with pytest.raises(PeerLostError):
            one.tick()
        # Sent with 2 waits ahead, 2 again, 1, 2 again, 1: five times.
        assert one.counted()["motor_resent"] == 4

    def test_a_long_wait_is_told_to_those_who_wait_for_us(
        self, rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("bridge.motor_bus.drives.LONG_WAIT_S", 0.03)
        one = rig()
        one.motors._waits_s = (0.01, 0.02, 0.03, 0.04)
        told: list[int] = []
        one.motors.on_long_wait.append(lambda: told.append(one.counted().get("motor_resent", 0)))
        with pytest.raises(PeerLostError):
            one.tick()
        assert told == [2, 3]

    def test_others_with_another_scenario_are_refused(self, rig: Callable[..., Rig], uri: str) -> None:
        one = rig()
        with MotorThread(one.scenario, "odrive", uri):
            one.motors.meet(10.0)
            one.tick()
        with (
            MotorThread(short(lag_s=0.005), "odrive", uri),
            pytest.raises(ScenarioMismatchError, match="run another scenario"),
        ):
            for _ in range(2):
                one.motors._waits_s = (0.02,) * 500
                one.tick()

    def test_what_the_lost_ones_had_answered_is_void(self, rig: Callable[..., Rig]) -> None:
        """Three axes answered before the process was killed; the one that takes its place answers for all six."""
        one = rig()
        hello = encode_hello(one.scenario.drive_digest(), drives=True)
        said = [answers(0, 1.0), answers(1, 2.0)[:3], [hello, *answers(1, 3.0, enabled=False)]]
        with script(one, said):
            assert one.tick().tolist() == [1.0] * 6
            assert one.tick().tolist() == [3.0] * 6
        assert one.counted()["motor_outages"] == 1

    def test_drives_that_let_go_later_are_no_second_outage(self, rig: Callable[..., Rig]) -> None:
        one = rig()
        hello = encode_hello(one.scenario.drive_digest(), drives=True)
        with script(one, [answers(0, 1.0), [hello, *answers(1, 0.0, enabled=False)], answers(2, 0.0, enabled=False)]):
            for _ in range(3):
                one.tick()
        assert one.counted()["motor_outages"] == 1
        assert one.counted()["motor_safe_ticks"] == 2

    def test_a_hello_that_is_late_when_a_run_begins_is_no_outage(self, rig: Callable[..., Rig]) -> None:
        one = rig()
        hello = encode_hello(one.scenario.drive_digest(), drives=True)
        with script(one, [[hello, *answers(0, 0.0, enabled=False)]]):
            one.tick()
        assert "motor_outages" not in one.counted()

    def test_a_hello_that_somebody_else_asked_for_changes_nothing(self, rig: Callable[..., Rig], uri: str) -> None:
        one = rig()
        one.motors._waits_s = (0.02,) * 500
        with MotorThread(one.scenario, "odrive", uri), CanBus(uri, 1_000_000) as station:
            one.motors.meet(10.0)
            for _ in range(10):
                one.tick()
            station.send(encode_hello(bytes(8), drives=False))
            assert all(one.tick()[0] != 0.0 for _ in range(10))
        assert {"motor_outages", "motor_safe_ticks", "motor_recoveries"}.isdisjoint(one.counted())


def test_drives_that_never_answer_leave_the_run_unarmed(rig: Callable[..., Rig]) -> None:
    with pytest.raises(PeerMissingError, match=r"not armed: start them with `fwav-hil motor SCENARIO --can virtual:"):
        rig().motors.meet(0.2)


def test_drives_with_other_gears_are_refused(rig: Callable[..., Rig], uri: str) -> None:
    with (
        MotorThread(short(lag_s=0.005), "odrive", uri),
        pytest.raises(ScenarioMismatchError, match="run another scenario"),
    ):
        rig().motors.meet(10.0)


def test_a_second_emulator_on_the_bus_is_refused(rig: Callable[..., Rig], uri: str) -> None:
    one = rig()
    with CanBus(uri, 1_000_000) as other:
        other.send(encode_sync(0))
        with pytest.raises(LinkInUseError, match="another emulator"):
            one.motors.meet(10.0)


def test_a_drive_that_lets_go_in_flight_is_enabled_again(rig: Callable[..., Rig], uri: str) -> None:
    one = rig()
    with MotorThread(one.scenario, "odrive", uri), CanBus(uri, 1_000_000) as station:
        one.motors.meet(10.0)
        one.tick()
        cleared: list[int] = []
        one.motors.watches.append(lambda _, frame: cleared.append(frame.can_id >> 5) if frame.data == b"\0" else None)
        station.send(CanFrame(21 << 5 | 0x02))  # an Estop from somebody else
        torques = [one.tick()[0] for _ in range(60)]
    assert one.counted()["motor_safe_ticks"] >= 1
    assert one.counted()["motor_enables"] >= 2
    assert set(cleared) == {21}, "the others are left alone"
    assert min(torques) < 0.5 * torques[-1]  # without torque only the gear's width is left


def test_lost_and_late_frames_change_no_answer(rig: Callable[..., Rig], uri: str) -> None:
    """A bus between that loses each ninth frame and says each seventh twice."""
    one = rig(short(lag_s=0.002))
    reference = MotorNode(one.scenario, "odrive")
    ending = threading.Event()
    node = MotorNode(one.scenario, "odrive")

    def lossy() -> None:
        heard = 0
        with CanBus(uri, 1_000_000) as bus:
            while not ending.is_set():
                frame = bus.recv(0.05)
                heard += frame is not None
                if frame is None or heard % 9 == 0:
                    continue
                for k, answer in enumerate(node.receive(frame, 0)):
                    if (heard + k) % 11:
                        bus.send(answer)
                    if (heard + k) % 7 == 0:
                        bus.send(answer)

    thread = threading.Thread(target=lossy)
    thread.start()
    one.motors._waits_s = (0.02,) * 100
    noted: list[tuple[int, int]] = []
    one.motors.watches.append(
        lambda t_ns, frame: noted.append((t_ns, answer.axis)) if (answer := decode_answer(frame)) else None
    )
    try:
        one.motors.meet(10.0)
        seen = [one.tick(0.02 * np.sin(k)) for k in range(60)]
    finally:
        ending.set()
        thread.join(10.0)
    expected = []
    host = make_host("odrive", one.scenario.motor)
    for k in range(60):
        torque = np.array([0.02 * np.sin(k), 0, 0, 0, 0, 0]) / np.array(one.scenario.actuators.scale)
        enabling = [] if k else host.enable()
        for frame in [*enabling, *host.command(torque), encode_sync(k * 4_000_000)]:
            reference.receive(frame, 0)
        expected.append(reference.bank.state.mean_u.copy())
    assert one.counted()["motor_resent"] > 5
    assert one.counted()["motor_late_answers"] > 5
    assert sorted(noted) == [(k * 4_000_000, axis) for k in range(60) for axis in range(6)], "each once in the record"
    assert np.array_equal(seen, expected)
