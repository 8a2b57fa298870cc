"""Mapping between our messages and MAVLink: scale, range, resolution and the meaning of NaN, one function each way.

Positions and quaternions travel as float32, commands as float32 fractions of the scenario's scale. The compiled functions
at the top define this mapping; the in-process simulation uses the same functions, so that its results are bit-identical.
A payload with bad data (NaN instead of a number, a quaternion that is not of unit length) decodes to None.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from protocol.can_frame import EXTENDED_IDS, LONGEST_DATA, STANDARD_IDS, CanFrame
from protocol.compiled import Packed, compiled
from protocol.messages import ActuatorCommand, FloatArray, PositionSample
from protocol.rotations import euler_from_quaternion, quaternion_from_euler
from protocol.wire.codec import Layout, layout

POSE = layout("ATT_POS_MOCAP")
TICK = layout("HIL_SENSOR")
GPS = layout("HIL_GPS")
COMMAND = layout("HIL_ACTUATOR_CONTROLS")
HEARTBEAT = layout("HEARTBEAT")
VERSION = layout("AUTOPILOT_VERSION")
POSITION_TARGET = layout("POSITION_TARGET_LOCAL_NED")
ATTITUDE_TARGET = layout("ATTITUDE_TARGET")
COMMAND_LONG = layout("COMMAND_LONG")
COMMAND_ACK = layout("COMMAND_ACK")
TIMESYNC = layout("TIMESYNC")
CAN_FRAME = layout("CAN_FRAME")

UNIT_TOLERANCE = 1e-3
"""How far the length of a quaternion may be from one."""
ALL_SENSORS = 0x1FFF
"""HIL_SENSOR.fields_updated with the bits of all groups: accelerometer, gyroscope, magnetometer, pressures, temperature."""
LOCKSTEP_FLAG = 1
ARMED = common.MAV_MODE_FLAG_SAFETY_ARMED
HIL = common.MAV_MODE_FLAG_HIL_ENABLED
_CUSTOM = common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
TICK_BASE = 64
"""Size of HIL_SENSOR without its extension, the instance id."""


@compiled
def _float32(value: float) -> float:
    """The nearest float32, as a float64."""
    return float(np.float32(value))


@compiled
def pose_to_wire(q: FloatArray, wire: FloatArray) -> None:
    """Fill `wire` (7,) with q (6,) as carried by ATT_POS_MOCAP: quaternion w x y z, then x y z, float32 values."""
    w, x, y, z = quaternion_from_euler(q[3], q[4], q[5])
    wire[0] = _float32(w)
    wire[1] = _float32(x)
    wire[2] = _float32(y)
    wire[3] = _float32(z)
    for i in range(3):
        wire[4 + i] = _float32(q[i])


@compiled
def pose_from_wire(wire: FloatArray, q: FloatArray) -> None:
    """Fill q (6,) from `wire` (7,): position, then roll, pitch, yaw in [-pi, pi]."""
    q[0] = wire[4]
    q[1] = wire[5]
    q[2] = wire[6]
    q[3], q[4], q[5] = euler_from_quaternion(wire[0], wire[1], wire[2], wire[3])


@compiled
def fill_pose(message: Any, t_us: int, q: FloatArray) -> None:
    """Fill an ATT_POS_MOCAP structure: covariance unknown (first value NaN); the message has no velocity."""
    w, x, y, z = quaternion_from_euler(q[3], q[4], q[5])
    message.time_usec = t_us
    message.q[0] = w
    message.q[1] = x
    message.q[2] = y
    message.q[3] = z
    message.x = q[0]
    message.y = q[1]
    message.z = q[2]
    message.covariance[0] = math.nan


@compiled
def read_pose(message: Any, q: FloatArray) -> bool:
    """Fill q (6,) from an ATT_POS_MOCAP structure; False where it has no valid pose."""
    wire = np.empty(7)
    for i in range(4):
        wire[i] = message.q[i]
    wire[4], wire[5], wire[6] = message.x, message.y, message.z
    length_squared = wire[0] * wire[0] + wire[1] * wire[1] + wire[2] * wire[2] + wire[3] * wire[3]
    if not abs(length_squared - 1.0) < 2.0 * UNIT_TOLERANCE:  # written so that NaN fails the test
        return False
    if not math.isfinite(wire[4] + wire[5] + wire[6]):
        return False
    pose_from_wire(wire, q)
    return True


@compiled
def fill_tick(message: Any, t_us: int, readings: FloatArray) -> None:
    """Fill a HIL_SENSOR structure, id 0; readings (13,) as in `encode_tick`."""
    message.time_usec = t_us
    message.xacc = readings[0]
    message.yacc = readings[1]
    message.zacc = readings[2]
    message.xgyro = readings[3]
    message.ygyro = readings[4]
    message.zgyro = readings[5]
    message.xmag = readings[6]
    message.ymag = readings[7]
    message.zmag = readings[8]
    message.abs_pressure = readings[9]
    message.diff_pressure = readings[10]
    message.pressure_alt = readings[11]
    message.temperature = readings[12]
    message.fields_updated = ALL_SENSORS


@compiled
def fill_command(message: Any, t_us: int, tau: FloatArray, scale: FloatArray, armed: bool, lockstep: bool) -> None:
    """Fill a HIL_ACTUATOR_CONTROLS structure: fractions of the scale; zeros when disarmed."""
    message.time_usec = t_us
    message.flags = LOCKSTEP_FLAG if lockstep else 0
    for i in range(6):
        message.controls[i] = command_to_wire(tau[i], scale[i]) if armed else 0.0
    message.mode = _CUSTOM | HIL | ARMED if armed else _CUSTOM | HIL


@compiled
def read_command(message: Any, scale: FloatArray, tau: FloatArray) -> bool:
    """Fill tau (6,) from the first six controls of a HIL_ACTUATOR_CONTROLS structure; False where one is not finite."""
    total = 0.0
    for i in range(6):
        tau[i] = command_from_wire(float(message.controls[i]), scale[i])
        total += tau[i]
    return math.isfinite(total)


@compiled
def command_to_wire(tau: float, scale: float) -> float:
    """One channel as carried by HIL_ACTUATOR_CONTROLS: the float32 fraction of its scale."""
    return _float32(tau / scale)


@compiled
def command_from_wire(control: float, scale: float) -> float:
    """The command of one channel from its fraction."""
    return control * scale


def _structure(message: Layout, payload: bytes) -> Packed:
    """A payload as the structure of its message; zeros that were cut off are restored."""
    return np.frombuffer(payload.ljust(message.size, b"\0"), message.dtype, 1)


def encode_pose(t_ns: int, q: FloatArray) -> bytes:
    """ATT_POS_MOCAP payload of the position and attitude q (6,)."""
    message = np.zeros(1, POSE.dtype)
    fill_pose(message[0], t_ns // 1000, q)
    return message.tobytes()


def decode_pose(payload: bytes) -> PositionSample | None:
    """The sample, or None where a position is not finite or the quaternion not of unit length."""
    message, q = _structure(POSE, payload), np.empty(6)
    return PositionSample(int(message["time_usec"][0]) * 1000, q) if read_pose(message[0], q) else None


def encode_tick(t_ns: int, readings: FloatArray) -> bytes:
    """HIL_SENSOR payload, id 0.

    readings (13,): specific force (m/s^2) and body rates (rad/s) in the body frame, field (gauss) in the body frame,
    absolute and differential pressure (hPa), pressure altitude (m), temperature (Celsius).
    """
    message = np.zeros(1, TICK.dtype)
    fill_tick(message[0], t_ns // 1000, np.asarray(readings, dtype=float))
    return message.tobytes()


def decode_tick_time_ns(payload: bytes) -> int:
    """Simulation time of a HIL_SENSOR, the only field that the controller reads."""
    return int.from_bytes(payload[:8].ljust(8, b"\0"), "little") * 1000


def tick_sensor_id(payload: bytes) -> int:
    """Sensor instance of a HIL_SENSOR; the tick is instance 0."""
    return payload[TICK_BASE] if len(payload) > TICK_BASE else 0


def encode_gps(t_ns: int, latitude_deg: float, longitude_deg: float, altitude: float, velocity: FloatArray) -> bytes:
    """HIL_GPS payload, 3D fix. Velocity north, east, down in m/s; eph and epv in cm (as PX4 reads them).

    Values are saturated at the range of their field, so that a distant plant does not stop the run.
    """
    north, east, down = (saturated(100.0 * v, 32767) for v in velocity)
    speed = saturated(100.0 * math.hypot(velocity[0], velocity[1]), 65534)
    course = round(math.degrees(math.atan2(velocity[1], velocity[0])) * 100.0) % 36000 if speed else 65535
    return GPS.pack_fields(
        time_usec=t_ns // 1000,
        fix_type=3,
        lat=saturated(latitude_deg * 1e7, 2**31 - 1),
        lon=saturated(longitude_deg * 1e7, 2**31 - 1),
        alt=saturated(altitude * 1000.0, 2**31 - 1),
        eph=30,
        epv=40,
        vel=speed,
        vn=north,
        ve=east,
        vd=down,
        cog=course,
        satellites_visible=12,
    )


def saturated(value: float, limit: int) -> int:
    """The value rounded to a whole number and saturated at +-limit."""
    return round(max(-limit, min(limit, value)))


def encode_command(command: ActuatorCommand, scale: FloatArray, *, lockstep: bool) -> bytes:
    """HIL_ACTUATOR_CONTROLS payload: fractions of the scale (6,); zeros when disarmed."""
    message = np.zeros(1, COMMAND.dtype)
    scale = np.asarray(scale, dtype=float)
    fill_command(message[0], command.t_ns // 1000, command.tau, scale, command.armed, lockstep)
    return message.tobytes()


def decode_command(payload: bytes, scale: FloatArray) -> ActuatorCommand | None:
    """The command, or None where one of the six controls is not finite; scale (6,)."""
    message, tau = _structure(COMMAND, payload), np.empty(6)
    if not read_command(message[0], np.asarray(scale, dtype=float), tau):
        return None
    return ActuatorCommand(int(message["time_usec"][0]) * 1000, tau, bool(message["mode"][0] & ARMED))


def is_armed(payload: bytes) -> bool:
    """Whether the command in a HIL_ACTUATOR_CONTROLS may act."""
    return bool(_structure(COMMAND, payload)["mode"][0] & ARMED)


def encode_controller_heartbeat(*, armed: bool, ending: bool = False) -> bytes:
    """HEARTBEAT of the vehicle: flapping wing, generic autopilot, HIL enabled."""
    return HEARTBEAT.pack_fields(
        type=common.MAV_TYPE_FLAPPING_WING,
        autopilot=common.MAV_AUTOPILOT_GENERIC,
        base_mode=HIL | (ARMED if armed else 0),
        system_status=_status(armed=armed, ending=ending),
        mavlink_version=3,
    )


def encode_emulator_heartbeat(*, ending: bool = False) -> bytes:
    """HEARTBEAT of the simulator: no autopilot. `ending`: the run is over."""
    return HEARTBEAT.pack_fields(
        type=common.MAV_TYPE_GENERIC,
        autopilot=common.MAV_AUTOPILOT_INVALID,
        system_status=_status(armed=True, ending=ending),
        mavlink_version=3,
    )


def _status(*, armed: bool, ending: bool) -> int:
    if ending:
        return int(common.MAV_STATE_POWEROFF)
    return int(common.MAV_STATE_ACTIVE if armed else common.MAV_STATE_STANDBY)


def heartbeat_is_armed(payload: bytes) -> bool:
    """Whether the sender of a HEARTBEAT is armed."""
    return bool(HEARTBEAT.unpack_fields(payload)["base_mode"] & ARMED)


def heartbeat_is_ending(payload: bytes) -> bool:
    """Whether the sender of a HEARTBEAT is shutting down."""
    return bool(HEARTBEAT.unpack_fields(payload)["system_status"] == common.MAV_STATE_POWEROFF)


def encode_version(digest: bytes, *, has_parameters: bool = False) -> bytes:
    """AUTOPILOT_VERSION payload with the scenario's digest (8 bytes) as flight_custom_version.

    has_parameters: the sender has parameters, floats as floats and integers bytewise.
    """
    capabilities = common.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    if has_parameters:
        capabilities |= common.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
        capabilities |= common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    return VERSION.pack_fields(capabilities=capabilities, flight_custom_version=digest, flight_sw_version=1 << 16)


def decode_version(payload: bytes) -> bytes:
    """The digest (8 bytes) of the sender's scenario."""
    return bytes(VERSION.unpack_fields(payload)["flight_custom_version"])


def encode_position_target(t_ns: int, q: FloatArray, q_dot: FloatArray, q_ddot: FloatArray) -> bytes:
    """POSITION_TARGET_LOCAL_NED payload of a reference: position, velocity, acceleration, yaw."""
    return POSITION_TARGET.pack_fields(
        time_boot_ms=t_ns // 1_000_000,
        coordinate_frame=common.MAV_FRAME_LOCAL_NED,
        **dict(zip(("x", "y", "z"), q[:3].tolist(), strict=True)),
        **dict(zip(("vx", "vy", "vz"), q_dot[:3].tolist(), strict=True)),
        **dict(zip(("afx", "afy", "afz"), q_ddot[:3].tolist(), strict=True)),
        yaw=float(q[5]),
        yaw_rate=float(q_dot[5]),
    )


def encode_attitude_target(t_ns: int, q: FloatArray) -> bytes:
    """ATTITUDE_TARGET payload of a reference; rates and thrust are marked as not given."""
    ignored = (
        common.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
        | common.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
        | common.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
        | common.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
    )
    attitude = quaternion_from_euler(float(q[3]), float(q[4]), float(q[5]))
    return ATTITUDE_TARGET.pack_fields(time_boot_ms=t_ns // 1_000_000, q=attitude, type_mask=ignored)


def encode_timesync(answer_ns: int, asked_ns: int) -> bytes:
    """TIMESYNC payload: tc1 (responder's clock, 0 in a request) and ts1 (requester's clock), ns."""
    return TIMESYNC.pack_fields(tc1=answer_ns, ts1=asked_ns)


def decode_timesync(payload: bytes) -> tuple[int, int]:
    """(tc1, ts1) of a TIMESYNC, ns."""
    values = TIMESYNC.unpack_fields(payload)
    return int(values["tc1"]), int(values["ts1"])


_CAN_EXTENDED = 1 << 31
_CAN_REMOTE = 1 << 30


def encode_can_frame(frame: CanFrame) -> bytes:
    """CAN_FRAME payload, bus 0, for all receivers; bit 31 of the identifier marks 29 bits, bit 30 a remote frame."""
    flags = (_CAN_EXTENDED if frame.extended else 0) | (_CAN_REMOTE if frame.remote else 0)
    return CAN_FRAME.pack_fields(id=frame.can_id | flags, len=len(frame.data), data=frame.data)


def decode_can_frame(payload: bytes) -> CanFrame | None:
    """The frame in a CAN_FRAME for bus 0; None where it is for another bus or is not a classical frame."""
    values = CAN_FRAME.unpack_fields(payload)
    extended, remote = bool(values["id"] & _CAN_EXTENDED), bool(values["id"] & _CAN_REMOTE)
    can_id = values["id"] & (EXTENDED_IDS - 1)
    if values["bus"] != 0 or values["len"] > LONGEST_DATA or (not extended and can_id >= STANDARD_IDS):
        return None
    return CanFrame(can_id, b"" if remote else bytes(values["data"][: values["len"]]), extended, remote)
