"""The rigid body of the flapping-wing vehicle, equation (1), as a wing-beat average: forces are means over a beat.

    M(q) q'' + C(q, q') q' + G(q) = F,   F = blockdiag(R^IB, I) u

M = blockdiag(m I, Ip T), C = blockdiag(0, Ip T' + L) with L q_r' = (T q_r') x Ip (T q_r'), G = [0 0 -mg 0 0 0] (down is
positive z). With the body rate w = T q_r' the lower half is Euler's equation Ip w' + w x Ip w = torque.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from protocol.compiled import compiled
from protocol.messages import FloatArray
from protocol.scenario import Body, Disturbance

Specific: TypeAlias = tuple[float, float, float, float, float, float]
"""A wrench divided by the inertia: force / m (m/s^2), torque_i / I_ii (rad/s^2), body frame."""


class BodyParameters(NamedTuple):
    """Parameters of the equations of motion, prepared for the kernels.

    mass                kg
    specific (6,)       1/m three times, then 1/Ixx, 1/Iyy, 1/Izz: a wrench times this is specific
    gyration (3,)       (Izz - Iyy)/Ixx, (Ixx - Izz)/Iyy, (Iyy - Ixx)/Izz
    gravity             m/s^2
    disturbance (6,)    specific amplitude of a wrench after the gears, times sin(disturbance_frequency t)
    """

    mass: float
    specific: FloatArray
    gyration: FloatArray
    gravity: float
    disturbance: FloatArray
    disturbance_frequency: float


def body_parameters(body: Body, disturbance: Disturbance) -> BodyParameters:
    """The parameters of a scenario as the kernels take them."""
    ixx, iyy, izz = body.inertia
    specific = 1.0 / np.array((body.mass,) * 3 + body.inertia)
    return BodyParameters(
        body.mass,
        specific,
        np.array(((izz - iyy) / ixx, (ixx - izz) / iyy, (iyy - ixx) / izz)),
        body.gravity,
        specific * np.array(disturbance.amplitude),
        disturbance.frequency_rad_s,
    )


@compiled
def acceleration(
    alpha: float,
    beta: float,
    gamma: float,
    alpha_dot: float,
    beta_dot: float,
    gamma_dot: float,
    wrench: Specific,
    body: BodyParameters,
) -> Specific:
    """q'' (m/s^2, rad/s^2) at these angles (rad) and their rates (rad/s) under a specific wrench in the body frame.

    Singular at cos(pitch) = 0; the caller keeps |pitch| below 1.4 rad.
    """
    sa, ca = math.sin(alpha), math.cos(alpha)
    sb, cb = math.sin(beta), math.cos(beta)
    sg, cg = math.sin(gamma), math.cos(gamma)
    fx, fy, fz, tx, ty, tz = wrench

    # R^IB f, with the common terms of its rows.
    side, lift = sa * fy + ca * fz, ca * fy - sa * fz
    ahead = cb * fx + sb * side
    # Body rates w = T q_r'.
    p = alpha_dot - sb * gamma_dot
    q = ca * beta_dot + cb * sa * gamma_dot
    r = -sa * beta_dot + cb * ca * gamma_dot
    # Euler's equation, then q_r'' = T^-1 (w' - T' q_r').
    slip = sb * beta_dot * gamma_dot
    p_dot = tx - body.gyration[0] * q * r + cb * beta_dot * gamma_dot
    q_dot = ty - body.gyration[1] * r * p + sa * (slip + alpha_dot * beta_dot) - cb * ca * alpha_dot * gamma_dot
    r_dot = tz - body.gyration[2] * p * q + ca * (slip + alpha_dot * beta_dot) + cb * sa * alpha_dot * gamma_dot
    turn = (sa * q_dot + ca * r_dot) / cb
    return (
        cg * ahead - sg * lift,
        sg * ahead + cg * lift,
        -sb * fx + cb * side + body.gravity,
        p_dot + sb * turn,
        ca * q_dot - sa * r_dot,
        turn,
    )


@compiled
def body_rates(motion: FloatArray) -> tuple[float, float, float]:
    """w = T q_r', the body rates p, q, r (rad/s)."""
    alpha, beta = motion[3], motion[4]
    alpha_dot, beta_dot, gamma_dot = motion[9], motion[10], motion[11]
    sa, ca = math.sin(alpha), math.cos(alpha)
    sb, cb = math.sin(beta), math.cos(beta)
    return (
        alpha_dot - sb * gamma_dot,
        ca * beta_dot + cb * sa * gamma_dot,
        -sa * beta_dot + cb * ca * gamma_dot,
    )
