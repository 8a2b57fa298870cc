"""DroneCAN: six ESCs that PX4, ArduPilot and the DroneCAN GUI recognise. The `dronecan` library makes the frames.

Source: DroneCAN specification, "CAN bus transport layer" (dronecan.github.io/Specification/4._CAN_bus_transport_layer)
and the standard data types 1030 uavcan.equipment.esc.RawCommand, 1034 uavcan.equipment.esc.Status, 341
uavcan.protocol.NodeStatus, service 1 uavcan.protocol.GetNodeInfo.

    identifier   29 bits: priority 5, type 16, 0, source 7; of a service: priority 5, type 8, request 1, to 7, 1, from 7
    RawCommand   14 bits signed for each ESC, 8191 is full scale; six of them take two frames
    Status       error count, V, A, K, rev/min, per cent, index; three frames, at status_rate_hz of each drive
    NodeStatus   once per second from each drive and from the host; a decreasing uptime means a restart

ESC i is node first_node_id + i. DroneCAN has no message that enables an ESC or clears its errors: here, as with many ESCs,
only a zero command does both, so a drive never starts or recovers with torque on it (our choice).
RawCommand is not defined as a torque; here 8191 is full-scale torque.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import dronecan
from dronecan import transport

from protocol.can_frame import CanFrame
from protocol.due import Due
from protocol.messages import AXES, FloatArray
from protocol.motors import motor_protocol
from protocol.motors.motor_protocol import AXIS_NUMBERS, DRIVES, Action, Cause, Order, Reading, Status, Traffic
from protocol.scenario import NANOSECONDS, Motor

HOST_NODE = 120
RAW_COMMAND = 1030
ESC_STATUS = 1034
NODE_STATUS = 341
GET_NODE_INFO = 1
FULL_SCALE = 8191
NODE_STATUS_RATE_HZ = 1.0
HIGH, MEDIUM, LOW = 8, 16, 24
"""Transfer priorities: commands, status, node status."""

_KELVIN = 273.15
_RPM = 60.0 / (2.0 * math.pi)
_HIGHEST_RPM = (1 << 17) - 1
_SERVICE = 0x80
_REQUEST = 0x8000
_uavcan: Any = dronecan.uavcan


class _Sender:
    """Turns messages of several nodes into frames, each with the next transfer id of its node and type."""

    def __init__(self) -> None:
        self._next: dict[tuple[int, int], int] = {}

    def broadcast(self, node: int, message: Any, priority: int) -> list[CanFrame]:
        key = (node, message._type.default_dtid)
        transfer_id = self._next.get(key, 0)
        self._next[key] = (transfer_id + 1) % 32
        return _frames(transport.Transfer(transfer_id, node, payload=message, transfer_priority=priority))

    @staticmethod
    def respond(request: Any, response: Any) -> list[CanFrame]:
        return _frames(
            transport.Transfer(
                request.transfer_id,
                request.dest_node_id,
                request.source_node_id,
                payload=response,
                transfer_priority=request.transfer_priority,
                service_not_message=True,
                request_not_response=False,
            )
        )


def _frames(transfer: Any) -> list[CanFrame]:
    return [CanFrame(frame.message_id, bytes(frame.bytes), extended=True) for frame in transfer.to_frames()]


class _Receiver:
    """Assembles frames to transfers; returns a complete transfer, or a Cause for a bad one."""

    def __init__(self) -> None:
        self._manager = transport.TransferManager()

    def decode(self, frame: CanFrame) -> Any:
        """The transfer that the frame completes, None where it is not complete yet, or a Cause."""
        if not frame.data:
            return Cause.SHORT
        first, last = frame.data[-1] & 0x80, frame.data[-1] & 0x40
        if not first and transport.Frame(frame.can_id, frame.data).transfer_key not in self._manager.active_transfers:
            return Cause.MALFORMED  # the middle of a transfer whose start was lost
        frames = self._manager.receive_frame(transport.Frame(frame.can_id, frame.data))
        if not last:
            return None
        transfer = transport.Transfer()
        try:
            transfer.from_frames(frames)
        except (transport.TransferError, ValueError, IndexError):  # the library unpacks any bits
            return Cause.MALFORMED
        return transfer


class Host(motor_protocol.Host):
    """The commanding end, node HOST_NODE."""

    def __init__(self, motor: Motor) -> None:
        super().__init__(motor)
        self._sender, self._receiver = _Sender(), _Receiver()
        self._node_status = Due(NODE_STATUS_RATE_HZ)

    def enable(self, axes: Sequence[int] = AXIS_NUMBERS) -> list[CanFrame]:
        return self._command([0] * DRIVES)

    def disable(self) -> list[CanFrame]:
        return self._command([0] * DRIVES)

    def command(self, torque: FloatArray) -> list[CanFrame]:
        return self._command([max(-FULL_SCALE - 1, min(FULL_SCALE, round(v * FULL_SCALE))) for v in torque.tolist()])

    def _command(self, values: list[int]) -> list[CanFrame]:
        return self._sender.broadcast(HOST_NODE, _uavcan.equipment.esc.RawCommand(cmd=values), HIGH)

    def cyclic(self, t_ns: int) -> list[CanFrame]:
        if not self._node_status.at(t_ns):
            return []
        return self._sender.broadcast(HOST_NODE, _node_status(t_ns, 0), LOW)

    def decode(self, frame: CanFrame) -> Sequence[Status] | Cause:
        axis = (frame.can_id & 0x7F) - self.motor.first_node_id
        if not frame.extended or frame.remote or not 0 <= axis < DRIVES:
            return Cause.FOREIGN
        kind = frame.can_id >> 8 & 0xFFFF
        if frame.can_id & _SERVICE or kind not in (ESC_STATUS, NODE_STATUS):
            return Cause.UNKNOWN
        transfer = self._receiver.decode(frame)
        if transfer is None or isinstance(transfer, Cause):
            return transfer or ()
        message = transfer.payload
        if kind == NODE_STATUS:
            return (Status(axis, faulty=message.health != message.HEALTH_OK),)
        amperes = self.motor.full_scale_nm / self.motor.torque_constant
        return (
            Status(
                axis,
                velocity=message.rpm / _RPM,
                torque=message.current / amperes,
                temperature_celsius=message.temperature - _KELVIN,
            ),
        )


class Drive(motor_protocol.Drive):
    """Six ESC nodes."""

    def __init__(self, motor: Motor) -> None:
        super().__init__(motor)
        self._sender, self._receiver = _Sender(), _Receiver()
        self._now_ns = 0
        self.restart()

    def restart(self) -> None:
        self._node_status = Due(NODE_STATUS_RATE_HZ)
        self._status = Due(self.motor.status_rate_hz)

    def decode(self, frame: CanFrame) -> Sequence[Order] | Cause:
        if not frame.extended or frame.remote or frame.can_id & 0x7F == 0:
            return Cause.FOREIGN
        if frame.can_id & _SERVICE:
            return self._take_request(frame)
        if frame.can_id >> 8 & 0xFFFF != RAW_COMMAND:
            return Cause.FOREIGN
        transfer = self._receiver.decode(frame)
        if transfer is None or isinstance(transfer, Cause):
            return transfer or ()
        orders = []
        for axis, value in zip(range(DRIVES), list(transfer.payload.cmd), strict=False):
            if value == 0:
                orders += [Order(Action.CLEAR, axis), Order(Action.ENABLE, axis)]
            orders.append(Order(Action.TORQUE, axis, value / FULL_SCALE))
        return orders

    def _take_request(self, frame: CanFrame) -> Sequence[Order] | Cause:
        axis = (frame.can_id >> 8 & 0x7F) - self.motor.first_node_id
        if not 0 <= axis < DRIVES or not frame.can_id & _REQUEST:
            return Cause.FOREIGN
        if frame.can_id >> 16 & 0xFF != GET_NODE_INFO:
            return Cause.UNKNOWN
        # A request without content is a frame with only the tail byte, which the library's Transfer accepts.
        transfer = self._receiver.decode(frame)
        if transfer is None or isinstance(transfer, Cause):
            return transfer or ()
        return (Order(Action.ASK, axis, detail=transfer),)

    def reply(self, order: Order, reading: Reading) -> Sequence[CanFrame]:
        if order.action is not Action.ASK:
            return ()
        info = _uavcan.protocol.GetNodeInfo.Response()
        info.status = _node_status(self._now_ns, int(reading.faults))
        info.software_version = _uavcan.protocol.SoftwareVersion(major=1, minor=0)
        info.hardware_version = _uavcan.protocol.HardwareVersion(major=1, minor=0)
        info.name = f"fwav-hil.drive.{AXES[order.axis]}"
        return self._sender.respond(order.detail, info)

    def cyclic(self, t_ns: int, readings: Sequence[Reading]) -> list[CanFrame]:
        self._now_ns = t_ns
        frames: list[CanFrame] = []
        first = self.motor.first_node_id
        if self._node_status.at(t_ns):
            for axis, reading in enumerate(readings):
                frames += self._sender.broadcast(first + axis, _node_status(t_ns, int(reading.faults)), LOW)
        if self._status.at(t_ns):
            for axis, reading in enumerate(readings):
                frames += self._sender.broadcast(first + axis, self._esc_status(axis, reading), MEDIUM)
        return frames

    def _esc_status(self, axis: int, reading: Reading) -> Any:
        motor = self.motor
        return _uavcan.equipment.esc.Status(
            error_count=int(reading.faults).bit_count(),
            voltage=motor.bus_voltage,
            current=reading.torque * motor.full_scale_nm / motor.torque_constant,
            temperature=reading.temperature_celsius + _KELVIN,
            rpm=max(-_HIGHEST_RPM, min(_HIGHEST_RPM, round(reading.velocity * _RPM))),
            power_rating_pct=min(127, round(100.0 * abs(reading.torque))),
            esc_index=axis,
        )


def _node_status(t_ns: int, faults: int) -> Any:
    status = _uavcan.protocol.NodeStatus(uptime_sec=t_ns // NANOSECONDS)
    status.health = status.HEALTH_ERROR if faults else status.HEALTH_OK
    status.mode = status.MODE_OPERATIONAL
    status.vendor_specific_status_code = faults
    return status


def traffic(motor: Motor, rate_hz: float) -> list[Traffic]:
    """RawCommand at rate_hz in two frames, Status of each drive in three, NodeStatus of each drive and of the host."""
    raw = HIGH << 24 | RAW_COMMAND << 8 | HOST_NODE
    status = MEDIUM << 24 | ESC_STATUS << 8 | motor.first_node_id
    node = LOW << 24 | NODE_STATUS << 8 | motor.first_node_id
    return [
        Traffic("RawCommand", raw, 8, rate_hz, 1, extended=True, command=True),
        Traffic("RawCommand, end", raw, 7, rate_hz, 1, extended=True, command=True),
        Traffic("Status", status, 8, motor.status_rate_hz, 2 * DRIVES, extended=True, step=0),
        Traffic("Status, end", status, 3, motor.status_rate_hz, DRIVES, extended=True),
        Traffic("NodeStatus", node, 8, NODE_STATUS_RATE_HZ, DRIVES + 1, extended=True),
    ]
