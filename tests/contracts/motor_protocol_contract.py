"""MotorProtocolContract: what every motor protocol must do. Inherit it and give `name`."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.can_frame import LONGEST_DATA, CanFrame
from protocol.motors.motor_protocol import (
    DRIVES,
    Action,
    Cause,
    Drive,
    Fault,
    Host,
    Order,
    Reading,
    make_drive,
    make_host,
    traffic,
)
from protocol.motors.simulation_sync import is_simulation_only
from protocol.scenario import Motor


def random_frame(rng: np.random.Generator) -> CanFrame:
    """Any frame there can be."""
    extended = bool(rng.integers(2))
    data = rng.bytes(int(rng.integers(LONGEST_DATA + 1)))
    return CanFrame(int(rng.integers(1 << (29 if extended else 11))), data, extended, remote=rng.random() < 0.1)


def orders_of(drive: Drive, frames: list[CanFrame]) -> list[Order]:
    """All orders in frames that must all be taken."""
    orders: list[Order] = []
    for frame in frames:
        taken = drive.decode(frame)
        assert not isinstance(taken, Cause), (frame, taken)
        orders += taken
    return orders


class MotorProtocolContract:
    """The tests; `resolution` is half the step of a commanded torque, as a fraction of full scale."""

    name: str
    resolution: float

    def ends(self, motor: Motor | None = None) -> tuple[Host, Drive]:
        motor = motor or Motor()
        return make_host(self.name, motor), make_drive(self.name, motor)

    def test_torques_arrive_within_half_a_step(self) -> None:
        host, drive = self.ends()
        corners = [np.ones(DRIVES), -np.ones(DRIVES), np.zeros(DRIVES), np.full(DRIVES, 1e-9)]
        for torques in [*corners, *np.random.default_rng(1).uniform(-1.0, 1.0, (100, DRIVES))]:
            orders = orders_of(drive, host.command(torques))
            came = {order.axis: order.torque for order in orders if order.action is Action.TORQUE}
            assert sorted(came) == list(range(DRIVES))
            for axis, torque in enumerate(torques):
                assert abs(came[axis] - torque) <= self.resolution * 1.0001 + 1e-7 * abs(torque)

    def test_enable_and_disable_reach_all_six(self) -> None:
        host, drive = self.ends()
        actions = {(order.action, order.axis) for order in orders_of(drive, host.enable())}
        assert {(Action.ENABLE, axis) for axis in range(DRIVES)} <= actions
        assert {(Action.CLEAR, axis) for axis in range(DRIVES)} <= actions
        letting_go = orders_of(drive, host.disable())
        assert {order.axis for order in letting_go} == set(range(DRIVES))
        assert all(order.torque == 0.0 for order in letting_go)

    def test_no_frame_whatever_is_an_exception(self) -> None:
        host, drive = self.ends()
        rng = np.random.default_rng(2)
        for _ in range(2000):
            frame = random_frame(rng)
            for taken in (host.decode(frame), drive.decode(frame)):
                assert isinstance(taken, Cause | tuple | list)

    def test_damaged_frames_of_our_own_are_no_exception(self) -> None:
        host, drive = self.ends()
        rng = np.random.default_rng(3)
        frames = [*host.enable(), *host.command(np.linspace(-1.0, 1.0, DRIVES))]
        frames += drive.cyclic(0, [Reading(torque=0.5)] * DRIVES)
        for _ in range(2000):
            frame = frames[rng.integers(len(frames))]
            damaged = frame._replace(data=rng.bytes(int(rng.integers(LONGEST_DATA + 1))))
            host.decode(damaged)
            taken = drive.decode(damaged)
            if not isinstance(taken, Cause):
                assert all(np.isfinite(order.torque) for order in taken)

    def test_our_own_words_are_foreign_to_us(self) -> None:
        """Each end hears itself on some interfaces, and must not take that for the other's."""
        host, drive = self.ends()
        readings = [Reading(torque=0.25, temperature_celsius=30.0)] * DRIVES
        for frame in drive.cyclic(0, readings):
            assert isinstance(drive.decode(frame), Cause)
        for frame in [*host.enable(), *host.command(np.zeros(DRIVES))]:
            assert isinstance(host.decode(frame), Cause)

    def test_nothing_meets_the_frames_of_the_simulation(self) -> None:
        host, drive = self.ends(Motor(first_node_id=38))
        frames = [*host.enable(), *host.disable(), *host.command(np.zeros(DRIVES)), *host.cyclic(0)]
        frames += drive.cyclic(0, [Reading()] * DRIVES)
        frames += [reply for order in orders_of(drive, host.enable()) for reply in drive.reply(order, Reading())]
        assert not any(is_simulation_only(frame) for frame in frames)

    def test_what_drives_say_reaches_the_host(self) -> None:
        host, drive = self.ends()
        reading = Reading(velocity=2.0, torque=0.5, temperature_celsius=41.0, faults=Fault.OVER_TEMPERATURE)
        frames = drive.cyclic(0, [reading] * DRIVES)
        for order in orders_of(drive, host.command(np.full(DRIVES, 0.1))):
            frames += drive.reply(order, reading)
        heard: dict[str, float] = {}
        for frame in frames:
            taken = host.decode(frame)
            assert not isinstance(taken, Cause), frame
            for status in taken:
                assert 0 <= status.axis < DRIVES
                heard |= {name: value for name, value in status._asdict().items() if value is not None}
        assert heard["torque"] == pytest.approx(0.5, abs=1e-3)
        assert heard["velocity"] == pytest.approx(2.0, abs=0.06)
        assert heard["temperature_celsius"] == pytest.approx(41.0, abs=0.6)
        assert heard["faulty"]

    def test_the_traffic_is_that_of_the_frames(self) -> None:
        """Lengths and numbers of the commands as `command` makes them."""
        host, _ = self.ends()
        commands = sorted(len(frame.data) for frame in host.command(np.linspace(-1.0, 1.0, DRIVES)))
        listed = [one for one in traffic(self.name, Motor(), 321.0) if one.rate_hz == 321.0 and "repl" not in one.name]
        assert sorted(length for one in listed for length in [one.length] * one.number) == commands
