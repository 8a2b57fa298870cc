"""Frames and rotations, as compiled scalar functions.

Inertial frame I: north, east, down. Body frame B: forward, right, down. Attitude: roll alpha, pitch beta, yaw gamma,
R^BI = C^B2(alpha) C^21(beta) C^1I(gamma) (paper, section II), the aerospace z-y-x order. A quaternion is w, x, y, z and
turns body vectors into inertial ones, as in MAVLink.
"""

from __future__ import annotations

import math

from protocol.compiled import compiled

PI = math.pi
TWO_PI = 2.0 * math.pi
PITCH_LIMIT_RAD = 1.4
"""Largest |pitch| (beta) of the plant: det M_r = Ixx Iyy Izz cos(beta) goes to zero at pi/2."""


@compiled
def wrap_angle(angle: float) -> float:
    """`angle` (rad) wrapped to [-pi, pi]."""
    if -PI <= angle <= PI:
        return angle
    return angle - TWO_PI * math.floor((angle + PI) / TWO_PI)


@compiled
def unwrap_angle(angle: float, last: float) -> float:
    """`angle` (rad) shifted by whole turns to within half a turn of `last`; bit-identical where no shift is needed."""
    difference = angle - last
    if -PI <= difference <= PI:
        return angle
    return last + wrap_angle(difference)


@compiled
def quaternion_from_euler(alpha: float, beta: float, gamma: float) -> tuple[float, float, float, float]:
    """Quaternion w, x, y, z (body to inertial) of roll, pitch, yaw (rad)."""
    sa, ca = math.sin(0.5 * alpha), math.cos(0.5 * alpha)
    sb, cb = math.sin(0.5 * beta), math.cos(0.5 * beta)
    sg, cg = math.sin(0.5 * gamma), math.cos(0.5 * gamma)
    return (
        ca * cb * cg + sa * sb * sg,
        sa * cb * cg - ca * sb * sg,
        ca * sb * cg + sa * cb * sg,
        ca * cb * sg - sa * sb * cg,
    )


@compiled
def euler_from_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Roll, pitch, yaw (rad) of a quaternion that need not be of unit length (not zero)."""
    norm_squared = w * w + x * x + y * y + z * z
    sine = 2.0 * (w * y - z * x) / norm_squared
    return (
        math.atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z),
        math.asin(min(1.0, max(-1.0, sine))),
        math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z),
    )


@compiled
def rotate_to_inertial(
    alpha: float, beta: float, gamma: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """R^IB v: the inertial components of a body vector."""
    sa, ca = math.sin(alpha), math.cos(alpha)
    sb, cb = math.sin(beta), math.cos(beta)
    sg, cg = math.sin(gamma), math.cos(gamma)
    return (
        cb * cg * x + (sa * sb * cg - ca * sg) * y + (ca * sb * cg + sa * sg) * z,
        cb * sg * x + (sa * sb * sg + ca * cg) * y + (ca * sb * sg - sa * cg) * z,
        -sb * x + sa * cb * y + ca * cb * z,
    )


@compiled
def rotate_to_body(alpha: float, beta: float, gamma: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """R^BI v: the body components of an inertial vector."""
    sa, ca = math.sin(alpha), math.cos(alpha)
    sb, cb = math.sin(beta), math.cos(beta)
    sg, cg = math.sin(gamma), math.cos(gamma)
    return (
        cb * cg * x + cb * sg * y - sb * z,
        (sa * sb * cg - ca * sg) * x + (sa * sb * sg + ca * cg) * y + sa * cb * z,
        (ca * sb * cg + sa * sg) * x + (ca * sb * sg - sa * cg) * y + ca * cb * z,
    )
