"""DroneCAN: a node of the `dronecan` library commands our ESCs and sees them."""

from __future__ import annotations

from collections import deque
from typing import Any

import dronecan
import numpy as np
import pytest
from dronecan.driver.common import AbstractDriver, CANFrame

from protocol.can_frame import CanFrame
from protocol.motors import dronecan_esc as motor_dronecan
from protocol.motors.motor_protocol import Action, Cause, Fault, Order, Reading
from protocol.scenario import Motor
from tests.contracts.motor_protocol_contract import MotorProtocolContract, orders_of

MOTOR = Motor(first_node_id=21)
READING = Reading(velocity=10.0, torque=0.5, temperature_celsius=40.0, enabled=True)


class TestContract(MotorProtocolContract):
    name = "dronecan"
    resolution = 0.5 / 8191


class _Bus(AbstractDriver):  # type: ignore[misc]
    """A driver for the library that keeps what it sends and receives what it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.sent: list[CanFrame] = []
        self.coming: deque[CanFrame] = deque()

    def send_frame(self, frame: Any) -> None:
        self.sent.append(CanFrame(frame.id, bytes(frame.data), extended=frame.extended))

    def receive(self, timeout: float | None = None) -> Any:
        if not self.coming:
            return None
        frame = self.coming.popleft()
        return CANFrame(frame.can_id, bytearray(frame.data), frame.extended)

    def close(self) -> None:
        """Nothing to let go of."""


@pytest.fixture
def station() -> tuple[Any, _Bus]:
    """A node of the library, id 100, on a bus of its own."""
    bus = _Bus()
    return dronecan.node.Node(bus, node_id=100, catch_handler_exceptions=False), bus


def test_its_raw_command_reaches_the_drives(station: tuple[Any, _Bus]) -> None:
    node, bus = station
    node.broadcast(dronecan.uavcan.equipment.esc.RawCommand(cmd=[8191, -8192, 0, 4096, 1, -1]))
    orders = orders_of(motor_dronecan.Drive(MOTOR), bus.sent)
    torques = {order.axis: order.torque for order in orders if order.action is Action.TORQUE}
    assert torques == pytest.approx({0: 1.0, 1: -8192 / 8191, 2: 0.0, 3: 4096 / 8191, 4: 1 / 8191, 5: -1 / 8191})
    assert [order for order in orders if order.action is Action.ENABLE] == [Order(Action.ENABLE, 2)]  # only at zero


def test_a_command_for_fewer_than_six_leaves_the_others(station: tuple[Any, _Bus]) -> None:
    node, bus = station
    node.broadcast(dronecan.uavcan.equipment.esc.RawCommand(cmd=[100, 200]))
    assert [order.axis for order in orders_of(motor_dronecan.Drive(MOTOR), bus.sent)] == [0, 1]


def test_it_sees_six_escs_and_their_health(station: tuple[Any, _Bus]) -> None:
    node, bus = station
    statuses: list[Any] = []
    nodes: list[Any] = []
    node.add_handler(dronecan.uavcan.equipment.esc.Status, statuses.append)
    node.add_handler(dronecan.uavcan.protocol.NodeStatus, nodes.append)
    readings = [READING] * 5 + [READING._replace(faults=Fault.WATCHDOG, torque=-0.25)]
    bus.coming.extend(motor_dronecan.Drive(MOTOR).cyclic(5_000_000_000, readings))
    while bus.coming:
        node.spin(0)
    seen = {event.message.esc_index: event.message for event in statuses}
    health = {event.transfer.source_node_id: event.message.health for event in nodes}
    assert sorted(seen) == [0, 1, 2, 3, 4, 5]
    assert seen[0].current == pytest.approx(0.5 * 16.0 / 0.82, rel=1e-3)  # float16
    assert seen[5].current == pytest.approx(-0.25 * 16.0 / 0.82, rel=1e-3)
    assert seen[0].voltage == 24.0
    assert seen[0].temperature == pytest.approx(313.15, abs=0.2)
    assert seen[0].rpm == 95
    assert (seen[0].error_count, seen[5].error_count) == (0, 1)
    assert health == {21: 0, 22: 0, 23: 0, 24: 0, 25: 0, 26: 2}


def test_it_is_told_who_they_are(station: tuple[Any, _Bus]) -> None:
    node, bus = station
    drive = motor_dronecan.Drive(MOTOR)
    answers: list[Any] = []
    node.request(dronecan.uavcan.protocol.GetNodeInfo.Request(), 23, answers.append)
    requests, bus.sent = bus.sent, []
    for order in orders_of(drive, requests):
        bus.coming.extend(drive.reply(order, READING))
    while bus.coming:
        node.spin(0)
    (answer,) = answers
    assert answer is not None
    assert str(answer.response.name) == "fwav-hil.drive.z"
    assert answer.transfer.source_node_id == 23


def test_our_commands_are_commands_to_it(station: tuple[Any, _Bus]) -> None:
    node, bus = station
    commands: list[list[int]] = []
    uptimes: list[int] = []
    node.add_handler(
        dronecan.uavcan.equipment.esc.RawCommand, lambda e: commands.append([int(v) for v in e.message.cmd])
    )
    node.add_handler(dronecan.uavcan.protocol.NodeStatus, lambda e: uptimes.append(e.message.uptime_sec))
    host = motor_dronecan.Host(MOTOR)
    for tick in range(40):  # transfer ids wrap at 32
        bus.coming.extend(host.cyclic(tick * 100_000_000))
        bus.coming.extend(host.command(np.array([tick / 40, -1.0, 1.0, 2.0, -2.0, 0.0])))
    while bus.coming:
        node.spin(0)
    assert commands == [[round(tick / 40 * 8191), -8191, 8191, 8191, -8192, 0] for tick in range(40)]
    assert uptimes == [0, 1, 2, 3]


def test_damage_has_a_cause_and_the_next_command_is_taken() -> None:
    host, drive = motor_dronecan.Host(MOTOR), motor_dronecan.Drive(MOTOR)
    first, second = host.command(np.full(6, 0.5))
    damaged = first._replace(data=bytes((first.data[0] ^ 1, *first.data[1:])))
    assert drive.decode(damaged) == ()
    assert drive.decode(second) is Cause.MALFORMED
    assert drive.decode(second) is Cause.MALFORMED  # an end without a start
    assert len([o for o in orders_of(drive, host.command(np.full(6, 0.5))) if o.action is Action.TORQUE]) == 6
    assert drive.decode(CanFrame(first.can_id, b"", extended=True)) is Cause.SHORT
