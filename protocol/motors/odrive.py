"""ODrive CANSimple, firmware 0.6 (ODrive Pro, S1, Micro).

Source: ODrive documentation, "CAN Protocol" (docs.odriverobotics.com/v/latest/manual/can-protocol.html), and the DBC that
ODrive publishes for 0.6.10; the part used here is in odrive.dbc, written for node 0. Firmware 0.5 differs in the contents
of Get_Error (0x03) and Get_Temperature (0x15).

    identifier (11 bits)   node << 5 | message           all numbers little endian, float32, uint32, uint8

Messages to a drive: Set_Axis_State, Set_Controller_Mode, Set_Input_Torque (4 bytes), Clear_Errors, Estop. From a drive:
Heartbeat, Get_Encoder_Estimates and the other readings, each at a period of whole milliseconds or when requested by a
remote frame with the same identifier. No message is answered. Errors are latched until Clear_Errors, and disarm the axis.

Torque is in N m (full scale is `full_scale_nm`), position in turns of the output shaft, as for an axis with a load encoder.
Source of the defaults: heartbeat_msg_rate_ms 100, encoder_msg_rate_ms 10; the others are off by default (0).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from protocol.can_frame import CanFrame
from protocol.due import Due
from protocol.messages import FloatArray
from protocol.motors import motor_protocol
from protocol.motors.motor_protocol import AXIS_NUMBERS, DRIVES, Action, Cause, Fault, Order, Reading, Status, Traffic
from protocol.scenario import Motor

HEARTBEAT = 0x01
ESTOP = 0x02
GET_ERROR = 0x03
SET_AXIS_STATE = 0x07
GET_ENCODER_ESTIMATES = 0x09
SET_CONTROLLER_MODE = 0x0B
SET_INPUT_TORQUE = 0x0E
GET_IQ = 0x14
GET_TEMPERATURE = 0x15
GET_BUS_VOLTAGE_CURRENT = 0x17
CLEAR_ERRORS = 0x18

IDLE = 1
CLOSED_LOOP_CONTROL = 8
TORQUE_CONTROL = 1
PASSTHROUGH = 1
MOTOR_OVER_TEMP = 1 << 13
WATCHDOG_TIMER_EXPIRED = 1 << 24
ESTOP_REQUESTED = 1 << 25

_ERRORS = (
    (Fault.WATCHDOG, WATCHDOG_TIMER_EXPIRED),
    (Fault.OVER_TEMPERATURE, MOTOR_OVER_TEMP),
    (Fault.ESTOP, ESTOP_REQUESTED),
)
_READ = frozenset((HEARTBEAT, GET_ERROR, GET_ENCODER_ESTIMATES, GET_IQ, GET_TEMPERATURE, GET_BUS_VOLTAGE_CURRENT))
_FLOAT, _TWO_FLOATS = struct.Struct("<f"), struct.Struct("<ff")
_UINT, _TWO_UINTS = struct.Struct("<I"), struct.Struct("<II")
_HEARTBEAT = struct.Struct("<IBBBx")
_TURN = 2.0 * math.pi


class Host(motor_protocol.Host):
    """The commanding end: torque control, input passed through."""

    def __init__(self, motor: Motor) -> None:
        super().__init__(motor)
        nodes = range(motor.first_node_id, motor.first_node_id + DRIVES)
        self._torque_ids = [node << 5 | SET_INPUT_TORQUE for node in nodes]
        self._enable = [
            (
                CanFrame(node << 5 | CLEAR_ERRORS, b"\0"),
                CanFrame(node << 5 | SET_CONTROLLER_MODE, _TWO_UINTS.pack(TORQUE_CONTROL, PASSTHROUGH)),
                CanFrame(node << 5 | SET_AXIS_STATE, _UINT.pack(CLOSED_LOOP_CONTROL)),
            )
            for node in nodes
        ]
        self._disable = [CanFrame(node << 5 | SET_AXIS_STATE, _UINT.pack(IDLE)) for node in nodes]

    def enable(self, axes: Sequence[int] = AXIS_NUMBERS) -> list[CanFrame]:
        return [frame for axis in axes for frame in self._enable[axis]]

    def disable(self) -> list[CanFrame]:
        return list(self._disable)

    def command(self, torque: FloatArray) -> list[CanFrame]:
        scale, pack = self.motor.full_scale_nm, _FLOAT.pack
        return [
            CanFrame(can_id, pack(value * scale))
            for can_id, value in zip(self._torque_ids, torque.tolist(), strict=True)
        ]

    def decode(self, frame: CanFrame) -> Sequence[Status] | Cause:
        axis = (frame.can_id >> 5) - self.motor.first_node_id
        if frame.extended or frame.remote or not 0 <= axis < DRIVES:
            return Cause.FOREIGN
        message, data = frame.can_id & 0x1F, frame.data
        if message not in _READ:
            return Cause.UNKNOWN
        if len(data) < 8:
            return Cause.SHORT
        if message == HEARTBEAT:
            errors, state, _, _ = _HEARTBEAT.unpack_from(data)
            return (Status(axis, enabled=state == CLOSED_LOOP_CONTROL, faulty=errors != 0),)
        if message == GET_ERROR:
            return (Status(axis, faulty=_UINT.unpack_from(data)[0] != 0),)
        first, second = _TWO_FLOATS.unpack_from(data)
        if not math.isfinite(first + second):
            return Cause.MALFORMED
        if message == GET_ENCODER_ESTIMATES:
            return (Status(axis, position=first * _TURN, velocity=second * _TURN),)
        if message == GET_IQ:
            return (Status(axis, torque=second * self.motor.torque_constant / self.motor.full_scale_nm),)
        if message == GET_TEMPERATURE:
            return (Status(axis, temperature_celsius=second),)
        return (Status(axis),)


class Drive(motor_protocol.Drive):
    """Six axes. An axis that is not in closed-loop control accepts torque commands but ignores them."""

    def __init__(self, motor: Motor) -> None:
        super().__init__(motor)
        self.restart()

    def restart(self) -> None:
        motor = self.motor
        self._schedule = (
            (Due(motor.heartbeat_rate_hz), (HEARTBEAT,)),
            (Due(motor.encoder_rate_hz), (GET_ENCODER_ESTIMATES,)),
            (Due(motor.status_rate_hz), (GET_IQ, GET_TEMPERATURE, GET_BUS_VOLTAGE_CURRENT)),
        )

    def decode(self, frame: CanFrame) -> Sequence[Order] | Cause:
        axis = (frame.can_id >> 5) - self.motor.first_node_id
        if frame.extended or not 0 <= axis < DRIVES:
            return Cause.FOREIGN
        message, data = frame.can_id & 0x1F, frame.data
        if frame.remote:
            return (Order(Action.ASK, axis, detail=message),) if message in _READ else Cause.UNKNOWN
        if message == SET_INPUT_TORQUE:
            if len(data) < 4:
                return Cause.SHORT
            (torque,) = _FLOAT.unpack_from(data)
            if not math.isfinite(torque):
                return Cause.MALFORMED
            return (Order(Action.TORQUE, axis, torque / self.motor.full_scale_nm),)
        if message == SET_AXIS_STATE:
            if len(data) < 4:
                return Cause.SHORT
            (state,) = _UINT.unpack_from(data)
            action = {CLOSED_LOOP_CONTROL: Action.ENABLE, IDLE: Action.DISABLE}.get(state)
            return (Order(action, axis),) if action else Cause.UNKNOWN
        if message == SET_CONTROLLER_MODE:
            if len(data) < 8:
                return Cause.SHORT
            known = _TWO_UINTS.unpack_from(data) == (TORQUE_CONTROL, PASSTHROUGH)
            return (Order(Action.NOTHING, axis),) if known else Cause.UNKNOWN
        if message == CLEAR_ERRORS:
            return (Order(Action.CLEAR, axis),)
        if message == ESTOP:
            return (Order(Action.ESTOP, axis),)
        return Cause.UNKNOWN

    def reply(self, order: Order, reading: Reading) -> Sequence[CanFrame]:
        return (self._frame(order.detail, order.axis, reading),) if order.action is Action.ASK else ()

    def cyclic(self, t_ns: int, readings: Sequence[Reading]) -> list[CanFrame]:
        return [
            self._frame(message, axis, reading)
            for due, messages in self._schedule
            if due.at(t_ns)
            for axis, reading in enumerate(readings)
            for message in messages
        ]

    def _frame(self, message: int, axis: int, reading: Reading) -> CanFrame:
        can_id = (self.motor.first_node_id + axis) << 5 | message
        if message == HEARTBEAT:
            state = CLOSED_LOOP_CONTROL if reading.enabled else IDLE
            return CanFrame(can_id, _HEARTBEAT.pack(_errors(reading.faults), state, 0, 0))
        if message == GET_ERROR:
            errors = _errors(reading.faults)
            return CanFrame(can_id, _TWO_UINTS.pack(errors, errors))
        return CanFrame(can_id, _TWO_FLOATS.pack(*self._values(message, reading)))

    def _values(self, message: int, reading: Reading) -> tuple[float, float]:
        amperes = self.motor.full_scale_nm / self.motor.torque_constant
        if message == GET_ENCODER_ESTIMATES:
            return reading.position / _TURN, reading.velocity / _TURN
        if message == GET_IQ:
            return reading.target * amperes, reading.torque * amperes
        if message == GET_TEMPERATURE:
            return reading.temperature_celsius, reading.temperature_celsius
        return self.motor.bus_voltage, abs(reading.torque) * amperes


def _errors(faults: Fault) -> int:
    return sum(code for fault, code in _ERRORS if fault in faults)


def traffic(motor: Motor, rate_hz: float) -> list[Traffic]:
    """Commands at rate_hz, cyclic messages at their own rates."""
    first = motor.first_node_id << 5
    kinds = (
        ("Set_Input_Torque", SET_INPUT_TORQUE, 4, rate_hz),
        ("Heartbeat", HEARTBEAT, 8, motor.heartbeat_rate_hz),
        ("Get_Encoder_Estimates", GET_ENCODER_ESTIMATES, 8, motor.encoder_rate_hz),
        ("Get_Iq", GET_IQ, 8, motor.status_rate_hz),
        ("Get_Temperature", GET_TEMPERATURE, 8, motor.status_rate_hz),
        ("Get_Bus_Voltage_Current", GET_BUS_VOLTAGE_CURRENT, 8, motor.status_rate_hz),
    )
    return [
        Traffic(name, first | message, length, rate, step=1 << 5, command=message == SET_INPUT_TORQUE)
        for name, message, length, rate in kinds
    ]
