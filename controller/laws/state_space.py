"""A law as matrices: computed from a scenario by the law's own file, used by `law` and the margin study."""

from __future__ import annotations

from typing import NamedTuple

from protocol.messages import FloatArray

INPUTS = 5
POSITION, ERROR, REFERENCE_ACCELERATION, VELOCITY, ERROR_RATE = range(INPUTS)


class Realisation(NamedTuple):
    """A law as discrete state-space matrices per axis (first index), n states each, at one sampling period.

    A (6, n, n), B (6, n, INPUTS), B_tau (6, n), C (6, n), D (6, INPUTS), bias (6,): see the equations in `law`; tau is in
    the inertial frame, N and N m. C_u (6, n), D_u (6, INPUTS): estimate of u_d (m/s^2, rad/s^2). start_r (6, n, INPUTS),
    start_u (6, n): x_0 = start_r r_0 + start_u uhat_0. uhat0 (6,): the estimate at the start. memory_s (6,): a gap of this
    length or longer makes the axis start again from its last estimate.
    """

    A: FloatArray
    B: FloatArray
    B_tau: FloatArray
    C: FloatArray
    D: FloatArray
    bias: FloatArray
    C_u: FloatArray
    D_u: FloatArray
    start_r: FloatArray
    start_u: FloatArray
    uhat0: FloatArray
    memory_s: FloatArray
