"""MIT mini-cheetah protocol, as used by T-Motor AK drives ("MIT power mode").

Source: B. Katz, "A low cost modular actuator for dynamic robots" (MIT, 2018) and its firmware's CAN description; CubeMars
"AK Series Actuator Driver Manual" V1.0.8, section 5.3. Layout in mit.dbc, for drive 1, raw numbers.

    command   identifier: drive   8 bytes, big endian: position 16 bits, velocity 12, kp 12, kd 12, torque 12
    enter     FF FF FF FF FF FF FF FC      exit  ... FD      set zero  ... FE
    reply     identifier: MASTER  byte 0 drive, position 16, velocity 12, torque 12 [, temperature 8 [, error 8]]

Each number is an unsigned fraction of its range: raw = round((x + range) / (2 range) (2^bits - 1)). Zero torque lies between
two raw numbers (2047.5): a drive that gets 2048 sees 1.2e-4 of its range. Ranges and the length of a reply (5 bytes: no drive
byte; 6; 8: temperature and error) depend on the motor, so they are parameters. Every command, enter, exit and zero frame gets
one reply. Only torques are commanded here: position, velocity and both gains are 0.

The drive's temperature is sent in whole degrees with an offset of 40 (AK manual); error codes: 0 none, 1 over temperature,
8 lost command (not in the manual).
"""

from __future__ import annotations

from collections.abc import Sequence

from protocol.can_frame import CanFrame
from protocol.errors import ScenarioError
from protocol.messages import FloatArray
from protocol.motors import motor_protocol
from protocol.motors.motor_protocol import AXIS_NUMBERS, DRIVES, Action, Cause, Fault, Order, Reading, Status, Traffic
from protocol.scenario import Motor

MASTER = 0x000
"""Identifier of all replies."""
ENTER = bytes.fromhex("FFFFFFFFFFFFFFFC")
EXIT = bytes.fromhex("FFFFFFFFFFFFFFFD")
ZERO = bytes.fromhex("FFFFFFFFFFFFFFFE")
KP_RANGE = 500.0
KD_RANGE = 5.0
TEMPERATURE_OFFSET = 40
NO_ERROR = 0
OVER_TEMPERATURE = 1
LOST_COMMAND = 8

_FULL16, _FULL12 = 0xFFFF, 0xFFF


def to_raw(value: float, low: float, high: float, full: int) -> int:
    """The raw number nearest to a value, saturated at its range."""
    return round((min(max(value, low), high) - low) / (high - low) * full)


def from_raw(raw: int, low: float, high: float, full: int) -> float:
    """The value of a raw number."""
    return low + raw * (high - low) / full


def pack_command(position: int, velocity: int, kp: int, kd: int, torque: int) -> bytes:
    """The 8 bytes of a command, from raw numbers."""
    return (position << 48 | velocity << 36 | kp << 24 | kd << 12 | torque).to_bytes(8, "big")


def unpack_command(data: bytes) -> tuple[int, int, int, int, int]:
    """Raw position, velocity, kp, kd, torque of a command."""
    bits = int.from_bytes(data, "big")
    return bits >> 48, bits >> 36 & _FULL12, bits >> 24 & _FULL12, bits >> 12 & _FULL12, bits & _FULL12


class Host(motor_protocol.Host):
    """The commanding end. A 5-byte reply does not name its drive: replies are then assigned in the order of the commands."""

    def __init__(self, motor: Motor) -> None:
        super().__init__(motor)
        _check_range(motor)
        self._ids = range(motor.first_node_id, motor.first_node_id + DRIVES)
        centre = to_raw(0.0, -1.0, 1.0, _FULL16), to_raw(0.0, -1.0, 1.0, _FULL12)
        self._blank = int.from_bytes(pack_command(*centre, 0, 0, 0), "big")
        self._next = 0

    def enable(self, axes: Sequence[int] = AXIS_NUMBERS) -> list[CanFrame]:
        # EXIT clears errors and disables: an enabled drive must not get it. But 5-byte replies are told apart only by
        # their order, so then all drives get it.
        chosen = AXIS_NUMBERS if self.motor.mit_reply_bytes == 5 else axes
        return [CanFrame(self._ids[axis], data) for data in (EXIT, ENTER) for axis in chosen]

    def disable(self) -> list[CanFrame]:
        return [CanFrame(drive, EXIT) for drive in self._ids]

    def command(self, torque: FloatArray) -> list[CanFrame]:
        limit, scale, blank = self.motor.mit_torque_range, self.motor.full_scale_nm, self._blank
        self._next = 0
        return [
            CanFrame(drive, (blank | to_raw(value * scale, -limit, limit, _FULL12)).to_bytes(8, "big"))
            for drive, value in zip(self._ids, torque.tolist(), strict=True)
        ]

    def decode(self, frame: CanFrame) -> Sequence[Status] | Cause:
        if frame.extended or frame.remote or frame.can_id != MASTER:
            return Cause.FOREIGN
        motor, data = self.motor, frame.data
        if len(data) < motor.mit_reply_bytes:
            return Cause.SHORT
        if motor.mit_reply_bytes == 5:
            axis, at = self._next, 0
            self._next = (axis + 1) % DRIVES
        else:
            axis, at = data[0] - motor.first_node_id, 1
            if not 0 <= axis < DRIVES:
                return Cause.FOREIGN
        bits = int.from_bytes(data[at : at + 5], "big")
        position = from_raw(bits >> 24, -motor.mit_position_range, motor.mit_position_range, _FULL16)
        velocity = from_raw(bits >> 12 & _FULL12, -motor.mit_velocity_range, motor.mit_velocity_range, _FULL12)
        torque = from_raw(bits & _FULL12, -motor.mit_torque_range, motor.mit_torque_range, _FULL12)
        known = motor.mit_reply_bytes == 8
        return (
            Status(
                axis,
                position,
                velocity,
                torque / motor.full_scale_nm,
                temperature_celsius=float(data[6] - TEMPERATURE_OFFSET) if known else None,
                faulty=data[7] != NO_ERROR if known else None,
            ),
        )


class Drive(motor_protocol.Drive):
    """Six drives, without cyclic messages: each frame to a drive gets one reply."""

    def __init__(self, motor: Motor) -> None:
        super().__init__(motor)
        _check_range(motor)

    def restart(self) -> None:
        """Do nothing: there are no cyclic messages."""

    def decode(self, frame: CanFrame) -> Sequence[Order] | Cause:
        axis, data, motor = frame.can_id - self.motor.first_node_id, frame.data, self.motor
        if frame.extended or not 0 <= axis < DRIVES:
            return Cause.FOREIGN
        if frame.remote:
            return Cause.UNKNOWN
        if len(data) < 8:
            return Cause.SHORT
        if data == ENTER:
            return (Order(Action.ENABLE, axis),)
        if data == EXIT:
            return Order(Action.DISABLE, axis, detail="silent"), Order(Action.CLEAR, axis)
        if data == ZERO:
            return (Order(Action.NOTHING, axis),)
        *_, kp, kd, torque = unpack_command(data)
        if kp or kd:
            return Cause.UNKNOWN  # this drive has no position or velocity loop
        limit = motor.mit_torque_range
        return (Order(Action.TORQUE, axis, from_raw(torque, -limit, limit, _FULL12) / motor.full_scale_nm),)

    def reply(self, order: Order, reading: Reading) -> Sequence[CanFrame]:
        if order.detail == "silent":
            return ()  # the second half of the same frame replies
        motor = self.motor
        bits = (
            to_raw(reading.position, -motor.mit_position_range, motor.mit_position_range, _FULL16) << 24
            | to_raw(reading.velocity, -motor.mit_velocity_range, motor.mit_velocity_range, _FULL12) << 12
            | to_raw(reading.torque * motor.full_scale_nm, -motor.mit_torque_range, motor.mit_torque_range, _FULL12)
        )
        whole = (
            bytes((motor.first_node_id + order.axis,))
            + bits.to_bytes(5, "big")
            + bytes((min(max(round(reading.temperature_celsius) + TEMPERATURE_OFFSET, 0), 255), _error(reading.faults)))
        )
        length = motor.mit_reply_bytes
        return (CanFrame(MASTER, whole[1:6] if length == 5 else whole[:length]),)

    def cyclic(self, t_ns: int, readings: Sequence[Reading]) -> list[CanFrame]:
        return []


def _error(faults: Fault) -> int:
    if Fault.OVER_TEMPERATURE in faults:
        return OVER_TEMPERATURE
    return LOST_COMMAND if faults else NO_ERROR


def _check_range(motor: Motor) -> None:
    if motor.full_scale_nm > motor.mit_torque_range:
        raise ScenarioError(
            f"motor.full_scale_nm {motor.full_scale_nm:g} is beyond motor.mit_torque_range {motor.mit_torque_range:g}: "
            "the frames could not carry full scale; lower full_scale_nm or raise mit_torque_range"
        )


def traffic(motor: Motor, rate_hz: float) -> list[Traffic]:
    """One command and one reply per axis, at rate_hz."""
    return [
        Traffic("reply", MASTER, motor.mit_reply_bytes, rate_hz, step=0),
        Traffic("command", motor.first_node_id, 8, rate_hz, command=True),
    ]
