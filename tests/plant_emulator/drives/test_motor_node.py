"""The drives on a bus: time by SYNC and by their own clock, watchdog, faults, encoders; for each protocol."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from plant_emulator.drives.motor_node import HOST_GONE_NS, RUN_OVER_NS, MotorNode, is_of_drives
from protocol.can_frame import CanFrame
from protocol.motors.motor_protocol import Fault, Host, make_host
from protocol.motors.registry import PROTOCOLS
from protocol.motors.simulation_sync import (
    ALL_AXES,
    decode_answer,
    decode_encoders,
    decode_hello,
    encode_hello,
    encode_sync,
    is_simulation_only,
)
from tests.plant_emulator.drives.test_motor import with_motor

PERIOD_NS = 4_000_000
MILLISECOND = 1_000_000


class Bench:
    """A node and a host that talks to it, without a bus. `t_ns` is SYNC time, `now_ns` wall time."""

    def __init__(self, protocol: str, **motor: Any) -> None:
        self.protocol = protocol
        self.scenario = with_motor(**({"lag_s": 0.0} | motor))
        self.node = MotorNode(self.scenario, protocol)
        self.host: Host = make_host(protocol, self.scenario.motor)
        self.now_ns = 0
        self.t_ns = -PERIOD_NS

    def say(self, frames: list[CanFrame]) -> list[CanFrame]:
        return [answer for frame in frames for answer in self.node.receive(frame, self.now_ns)]

    def enable(self) -> None:
        self.say(self.host.enable())

    def tick(self, torque: float | None = 0.25, *, lockstep: bool = True) -> list[CanFrame]:
        """One tick; torque None: the commands stay away, and the SYNC says so."""
        self.t_ns += PERIOD_NS
        frames = [] if torque is None else self.host.command(np.full(6, torque))
        return self.say([*frames, encode_sync(self.t_ns, 0 if torque is None else ALL_AXES, lockstep=lockstep)])

    def wait(self, duration_ns: int) -> list[CanFrame]:
        """Let wall time pass."""
        frames = []
        for _ in range(duration_ns // MILLISECOND):
            self.now_ns += MILLISECOND
            frames += self.node.elapse(self.now_ns)
        return frames

    def torques(self) -> list[float]:
        return [reading.torque for reading in self.node.readings()]

    def enabled(self) -> list[bool]:
        return [reading.enabled for reading in self.node.readings()]


@pytest.fixture(params=sorted(PROTOCOLS))
def protocol(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def bench(protocol: str) -> Bench:
    return Bench(protocol)


def test_a_drive_follows_only_once_it_is_enabled(bench: Bench) -> None:
    frames = bench.tick()
    answers = [answer for frame in frames if (answer := decode_answer(frame))]
    assert [answer.enabled for answer in answers] == [False] * 6
    assert bench.torques() == [0.0] * 6
    bench.enable()
    frames = bench.tick()
    answers = [answer for frame in frames if (answer := decode_answer(frame))]
    assert [(answer.axis, answer.tick, answer.enabled) for answer in answers] == [(axis, 1, True) for axis in range(6)]
    assert bench.torques()[:2] == pytest.approx([0.25] * 2, abs=6e-4)
    assert bench.torques()[2] == pytest.approx(1 / 6)  # the limit: a sixth of full scale upwards


def test_without_commands_for_50_ms_of_sync_time_the_watchdog_trips(bench: Bench) -> None:
    bench.enable()
    for _ in range(5):
        bench.tick()
    for _ in range(12):  # 48 ms without
        bench.tick(None)
    assert all(bench.enabled())
    assert bench.node.counters["watchdog_trips"] == 0
    answers = [answer for frame in bench.tick(None) if (answer := decode_answer(frame))]
    assert bench.node.counters["watchdog_trips"] == 6
    assert not any(bench.enabled())
    assert not any(answer.enabled for answer in answers)
    assert bench.torques() == [0.0] * 6  # safe; the filters are reset, so it is there at once
    assert [reading.faults for reading in bench.node.readings()] == [Fault.WATCHDOG] * 6
    bench.tick(0.25)  # a command alone does not bring it back
    assert bench.torques() == [0.0] * 6
    bench.enable()
    bench.tick(0.25)
    assert bench.torques()[0] == pytest.approx(0.25, abs=6e-4)
    assert [reading.faults for reading in bench.node.readings()] == [Fault(0)] * 6


def test_a_killed_sender_trips_the_watchdog_in_the_drives_own_time(bench: Bench) -> None:
    bench.wait(10 * MILLISECOND)
    bench.enable()
    for _ in range(20):
        bench.say(bench.host.command(np.full(6, 0.1)))
        bench.wait(10 * MILLISECOND)
    assert all(bench.enabled())
    assert bench.torques()[0] == pytest.approx(0.1, abs=6e-4)
    bench.wait(40 * MILLISECOND)
    assert all(bench.enabled())
    bench.wait(20 * MILLISECOND)
    assert bench.node.counters["watchdog_trips"] == 6
    assert bench.torques() == [0.0] * 6


def test_a_host_killed_in_real_time_is_gone_after_2_s(bench: Bench) -> None:
    bench.enable()
    bench.tick(lockstep=False)
    assert bench.wait(HOST_GONE_NS - 10 * MILLISECOND) == []
    assert all(bench.enabled())
    bench.wait(20 * MILLISECOND)
    assert (bench.node.counters["lost_hosts"], bench.node.counters["watchdog_trips"]) == (1, 6)
    assert bench.torques() == [0.0] * 6
    bench.enable()  # it was a stall: the drives are taken up again
    answers = [answer for frame in bench.tick(lockstep=False) if (answer := decode_answer(frame))]
    assert all(answer.enabled for answer in answers)


def test_a_host_silent_in_lockstep_changes_nothing_until_its_run_is_over(bench: Bench) -> None:
    """However busy the machine is; and once the drives have let go that run is not flown on as if nothing were."""
    undisturbed = Bench(bench.protocol)
    for one in (undisturbed, bench):
        one.enable()
        one.tick()
    assert bench.wait(RUN_OVER_NS - 10 * MILLISECOND) == []
    assert bench.tick() == undisturbed.tick()
    assert bench.node.counters == undisturbed.node.counters
    assert bench.wait(RUN_OVER_NS - 10 * MILLISECOND) == []
    bench.wait(20 * MILLISECOND)
    assert (bench.node.counters["lost_hosts"], bench.node.counters["watchdog_trips"]) == (1, 6)
    assert bench.torques() == [0.0] * 6
    assert not any(decode_answer(frame) for frame in bench.tick())
    assert bench.node.counters["refused_syncs"] == 1
    bench.enable()
    assert any(decode_answer(frame) for frame in bench.tick(lockstep=False)), "in real time a first SYNC may be lost"
    bench.wait(RUN_OVER_NS)
    bench.enable()  # another run begins
    bench.say([encode_hello(bench.scenario.drive_digest(), drives=False)])
    bench.t_ns = -PERIOD_NS
    for _ in range(2):
        answers = [answer for frame in bench.tick() if (answer := decode_answer(frame))]
        assert len(answers) == 6
        assert all(answer.enabled for answer in answers)


def test_drives_that_join_a_run_say_hello_and_begin_disabled_at_the_safe_output(bench: Bench) -> None:
    bench.t_ns = 99 * PERIOD_NS
    first = [frame for frame in bench.tick() if is_simulation_only(frame)]
    assert decode_hello(first[0], drives=True) == bench.scenario.drive_digest()
    answers = [answer for frame in first if (answer := decode_answer(frame))]
    assert [(answer.axis, answer.enabled) for answer in answers] == [(axis, False) for axis in range(6)]
    assert not bench.node.bank.state.u.any()
    again = bench.say([encode_sync(bench.t_ns)])
    assert again == first[:7], "as long as the host may not have heard it"
    assert not any(decode_hello(frame, drives=True) for frame in bench.tick())
    assert not any(decode_hello(frame, drives=True) for frame in Bench(bench.protocol).tick()), "a run that begins"


def test_a_status_says_what_happened(bench: Bench) -> None:
    bench.enable()
    bench.tick()
    for _ in range(20):
        bench.tick(None)
    frames = [frame for _ in range(300) for frame in bench.tick(None)]
    if not frames or all(decode_answer(frame) or decode_encoders(frame) for frame in frames):
        frames = bench.say(bench.host.command(np.zeros(6)))  # MIT says something only when it is asked
    statuses = [status for frame in frames for status in _taken(bench.host, frame)]
    faulty = {status.axis for status in statuses if status.faulty}
    assert faulty == set(range(6))


def _taken(host: Host, frame: CanFrame) -> list[Any]:
    taken = host.decode(frame)
    return list(taken) if isinstance(taken, tuple | list) else []


def test_too_hot_a_motor_lets_go_and_says_so() -> None:
    bench = Bench("odrive", temperature_rise=200.0, thermal_time_constant_s=0.1, over_temperature_celsius=80.0)
    bench.enable()
    for _ in range(100):
        bench.tick(0.9)
    assert bench.node.counters["over_temperatures"] == 5  # z is limited to a sixth of full scale, and stays cool
    assert [reading.enabled for reading in bench.node.readings()] == [False, False, True, False, False, False]
    assert bench.node.readings()[0].faults == Fault.OVER_TEMPERATURE


def test_an_estop_stops_one_drive_until_it_is_cleared() -> None:
    bench = Bench("odrive")
    bench.enable()
    bench.tick()
    bench.say([CanFrame((21 + 3) << 5 | 0x02)])
    bench.tick()
    assert bench.enabled() == [True, True, True, False, True, True]
    bench.enable()
    bench.tick()
    assert all(bench.enabled())


def test_a_drive_that_is_enabled_again_does_not_disturb_the_others(protocol: str) -> None:
    """The emulator asks for it every tenth of a second while a drive is faulty: the healthy ones fly on meanwhile."""
    undisturbed, bench = Bench(protocol, lag_s=0.004), Bench(protocol, lag_s=0.004)
    for one in (undisturbed, bench):
        one.enable()
        for _ in range(4):
            one.tick(0.25)
    bench.node._latch(2, Fault.OVER_TEMPERATURE, "over_temperatures")
    bench.say(bench.host.enable([2]))
    for one in (undisturbed, bench):
        one.tick(0.25)
    others = [0, 1, 3, 4, 5]
    assert bench.enabled() == [True] * 6
    assert np.array_equal(bench.node.bank.state.u[others], undisturbed.node.bank.state.u[others])
    assert bench.torques()[2] < 0.9 * undisturbed.torques()[2], "it begins at its safe value"


def test_a_repeated_tick_moves_nothing_and_is_answered_alike() -> None:
    bench = Bench("odrive", lag_s=0.002)
    bench.enable()
    bench.tick(0.1)
    first = [frame for frame in bench.tick(0.2) if decode_answer(frame)]
    frames = bench.host.command(np.full(6, 0.2))
    before = bench.node.bank.state.packed.tobytes()
    assert bench.say([*frames, encode_sync(bench.t_ns)]) == first
    assert bench.node.bank.state.packed.tobytes() == before
    assert bench.node.counters["repeated_syncs"] == 1
    assert bench.say([encode_sync(bench.t_ns - PERIOD_NS)]) == []
    assert bench.node.counters["backward_syncs"] == 1


def test_a_lost_command_is_waited_for() -> None:
    """A drive that did not get its command must not answer from the old one."""
    bench = Bench("odrive")
    bench.enable()
    bench.tick(0.1)
    bench.t_ns += PERIOD_NS
    frames = bench.host.command(np.full(6, 0.2))
    assert bench.say([*frames[:3], *frames[4:], encode_sync(bench.t_ns)]) == []
    assert bench.node.counters["waiting_syncs"] == 1
    answers = [frame for frame in bench.say([*frames, encode_sync(bench.t_ns)]) if decode_answer(frame)]
    assert len(answers) == 6
    assert bench.torques()[3] == pytest.approx(0.2)


def test_a_flight_begins_at_the_initial_command_and_a_late_start_at_the_safe_value() -> None:
    begun, late = Bench("odrive"), Bench("odrive")
    trim = begun.scenario.initial.command[2] / begun.scenario.actuators.scale[2]
    begun.tick(None)
    assert begun.node.bank.state.u[2] == pytest.approx(0.0, abs=0.002)  # disabled: it went from trim to safe
    begun = Bench("odrive")
    begun.enable()
    begun.t_ns += PERIOD_NS
    begun.say([*begun.host.command(np.array([0, 0, trim, 0, 0, 0])), encode_sync(0)])
    assert begun.node.bank.state.u[2] == pytest.approx(begun.scenario.initial.command[2], rel=1e-6)
    late.t_ns = 100 * PERIOD_NS
    late.tick(0.0)
    assert late.node.bank.state.u[2] == 0.0


def test_the_encoders_show_both_sides_of_the_gear() -> None:
    """u against tau from the bus alone: the width of the hysteresis is there, in whole counts of the encoder."""
    bench = Bench("odrive", encoder_counts=16384)
    bench.enable()
    points = []
    for k in range(600):
        for frame in bench.tick(0.5 * math.sin(k / 20)):
            if (seen := decode_encoders(frame)) and seen[0] == 0:
                points.append(seen[1:])
    before, after = np.array(points).T
    count = 2 * math.pi / 16384
    assert np.array_equal(before, np.float32(np.round(before / count) * count))
    # At zero torque the force is apart by the width (h - kappa)/chi = 0.002 N, 0.05 of full scale, either way.
    near_zero = after[np.abs(before) < 0.03] - before[np.abs(before) < 0.03]
    assert near_zero.max() == pytest.approx(0.05, abs=0.004)
    assert near_zero.min() == pytest.approx(-0.05, abs=0.004)


def test_velocity_is_quantised() -> None:
    bench = Bench("odrive", velocity_resolution=0.5)
    bench.enable()
    seen = set()
    for k in range(50):
        bench.tick(0.5 * math.sin(k / 20))
        seen |= {reading.velocity for reading in bench.node.readings()}
    assert len(seen) > 3
    assert all(velocity == round(velocity / 0.5) * 0.5 for velocity in seen)


def test_cyclic_messages_go_by_sync_time(protocol: str) -> None:
    bench = Bench(protocol, encoder_rate_hz=50.0)
    bench.enable()
    encoders = [f for _ in range(250) for f in bench.tick() if decode_encoders(f)]
    assert len(encoders) == 6 * 50


def test_a_hello_is_answered_with_the_scenario() -> None:
    bench = Bench("odrive")
    (answer,) = bench.say([encode_hello(bytes(8), drives=False)])
    assert decode_hello(answer, drives=True) == bench.scenario.drive_digest()
    assert is_of_drives(answer)
    assert not is_of_drives(encode_sync(0))


def test_what_cannot_be_taken_is_counted_by_cause(bench: Bench) -> None:
    bench.say([CanFrame(0x7F0, b"\0"), CanFrame(0x7F0, b"\0"), CanFrame(0x581, b"\0")])
    assert bench.node.counters["foreign_frames"] == 3
    if bench.host.__module__.endswith("odrive"):
        bench.say([CanFrame(21 << 5 | 0x0E, b"\0"), CanFrame(21 << 5 | 0x1F, b"\0" * 8)])
        bench.say([CanFrame(21 << 5 | 0x0E, b"\0\0\xc0\x7f")])
        counted = [bench.node.counters[f"{cause}_frames"] for cause in ("short", "unknown", "malformed")]
        assert counted == [1, 1, 1]
