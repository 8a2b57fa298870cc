"""The true state as MAVLink messages, for logs, ground stations and comparison in autopilots; never for the laws.

All values are the integrated state of the emulator, without noise, at the time of a tick.
"""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import common

from protocol.messages import FloatArray
from protocol.rotations import quaternion_from_euler, rotate_to_body
from protocol.wire.codec import layout
from protocol.wire.mapping import saturated

STATE = layout("HIL_STATE_QUATERNION")
ODOMETRY = layout("ODOMETRY")
RPM = layout("RAW_RPM")

_MILLI_G = 1000.0 / 9.80665
_LARGEST = 3.4e38
_PER_MINUTE = 60.0 / (2.0 * math.pi)


def encode_state(
    t_ns: int, motion: FloatArray, rates: FloatArray, place: tuple[float, float, float], force: FloatArray
) -> bytes:
    """HIL_STATE_QUATERNION payload; values are saturated at the range of their field.

    motion (12,): position, attitude, velocity (north, east, down), attitude rates; rates (3,): body rates; place: latitude
    and longitude (deg), altitude (m); force (3,): specific force in the body frame (m/s^2). There is no wind: both airspeeds
    are the speed.
    """
    latitude_deg, longitude_deg, altitude = place
    velocity = [saturated(100.0 * float(v), 32767) for v in motion[6:9]]
    speed = saturated(100.0 * math.hypot(*map(float, motion[6:9])), 65535)
    acceleration = [saturated(_MILLI_G * float(f), 32767) for f in force]
    return STATE.pack_fields(
        time_usec=t_ns // 1000,
        attitude_quaternion=_quaternion(motion),
        **dict(zip(("rollspeed", "pitchspeed", "yawspeed"), map(_held, rates), strict=True)),
        lat=saturated(latitude_deg * 1e7, 2**31 - 1),
        lon=saturated(longitude_deg * 1e7, 2**31 - 1),
        alt=saturated(altitude * 1000.0, 2**31 - 1),
        **dict(zip(("vx", "vy", "vz"), velocity, strict=True)),
        ind_airspeed=speed,
        true_airspeed=speed,
        **dict(zip(("xacc", "yacc", "zacc"), acceleration, strict=True)),
    )


def encode_odometry(t_ns: int, motion: FloatArray, rates: FloatArray) -> bytes:
    """ODOMETRY payload: pose in the local NED frame, velocity and rates in the body frame; all covariances are zero.

    motion, rates: see `encode_state`.
    """
    position = dict(zip(("x", "y", "z"), map(_held, motion[:3]), strict=True))
    body_velocity = rotate_to_body(*map(float, motion[3:9]))
    return ODOMETRY.pack_fields(
        time_usec=t_ns // 1000,
        frame_id=common.MAV_FRAME_LOCAL_NED,
        child_frame_id=common.MAV_FRAME_BODY_FRD,
        **position,
        q=_quaternion(motion),
        **dict(zip(("vx", "vy", "vz"), map(_held, body_velocity), strict=True)),
        **dict(zip(("rollspeed", "pitchspeed", "yawspeed"), map(_held, rates), strict=True)),
    )


def encode_rpm(drive: int, velocity: float) -> bytes:
    """RAW_RPM payload of a drive (counted from 0) with speed `velocity` (rad/s)."""
    return RPM.pack_fields(index=drive, frequency=velocity * _PER_MINUTE)


def _held(value: float) -> float:
    """The value saturated at the range of a float32."""
    return max(-_LARGEST, min(_LARGEST, float(value)))


def _quaternion(motion: FloatArray) -> tuple[float, float, float, float]:
    return quaternion_from_euler(float(motion[3]), float(motion[4]), float(motion[5]))
