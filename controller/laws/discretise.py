"""From a law's equation to its discrete matrices: the estimator of u_d, the derivative filter, and how they are held.

Every law of this project is, per axis,

    b tau = f q_d'' - k_1 D q_e - k_0 q_e - c uhat + bias            D(s) = N s/(s + N)
    uhat  = s^2 G_f q - b G_f tau_applied     (output feedback)       uhat = s G_f q' - b G_f tau_applied   (state feedback)

with G_f = 1/A(Ts), A the Butterworth polynomial of the chosen order. The path of tau is discretised with a zero-order hold
(exact: the actuator holds), the path of q with a first-order hold, by the matrix exponential; Tustin's rule would lose most
of the margin at 100 Hz.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from controller.laws.filters import StateFeedbackFilters
from controller.laws.state_space import (
    ERROR,
    ERROR_RATE,
    INPUTS,
    POSITION,
    REFERENCE_ACCELERATION,
    VELOCITY,
    Realisation,
)
from protocol.messages import FloatArray
from protocol.scenario import NANOSECONDS, Scenario


class Estimator(NamedTuple):
    """uhat of one axis, discrete: w+ = A w + B m + B_tau tau, uhat = C w + D m; m is q, or q' for state feedback.

    The start is w_0 = start_m m_0 + start_u uhat_0. Shapes: A (n, n), the others (n,), D a number.
    """

    A: FloatArray
    B: FloatArray
    B_tau: FloatArray
    C: FloatArray
    D: float
    start_m: FloatArray
    start_u: FloatArray


def butterworth(order: int) -> FloatArray:
    """Coefficients (order + 1,), highest first, of the monic Butterworth polynomial A(p) of unit cut-off.

    Its zeros lie on the unit circle, evenly over the left half. The same to the bit as `scipy.signal.butter` gives (a test
    holds it), without the second that importing that module adds to every start.
    """
    zeros = -np.exp(1j * np.pi * np.arange(1 - order, order, 2) / (2 * order))
    return np.asarray(np.poly(zeros).real)


def exponential(matrix: FloatArray) -> FloatArray:
    """e to the power of a small square matrix: Taylor's series of its 2^-s th part, to rounding, squared s times.

    As `scipy.linalg.expm` gives it (a test holds that), without the quarter of a second that importing that module adds to
    every start.
    """
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(matrix).sum(axis=1).max()), 1e-300))) + 2)
    part = matrix / 2.0**halvings  # its norm is a quarter at most: the last term below is under 1e-22
    power = np.eye(len(matrix))
    for k in range(14, 0, -1):
        power = np.eye(len(matrix)) + part @ power / k
    for _ in range(halvings):
        power = power @ power
    return power


def estimator(order: int, T: float, b: float, period: float, *, derivatives: int) -> Estimator:
    """The estimator of (18) with G_f of the given order; `derivatives` is 2 where m = q, 1 where m = q' (T, period in s).

    With p = Ts and T^j uhat = (p^j m - b T^j tau)/A(p), j = derivatives, in observer form: the state is shifted by the
    first-order hold's share of the newest sample, w = x - G_2 m, so that sample k acts at step k. The order is at least
    `derivatives`.
    """
    size = order
    falling = butterworth(order)[1:]  # a_(n-1) .. a_0
    numerator = np.zeros(order)
    direct = 1.0 if derivatives == order else 0.0
    if derivatives < order:
        numerator[order - 1 - derivatives] = 1.0
    a = np.eye(size, k=1)
    a[:, 0] -= falling
    a /= T
    b_m = (numerator - direct * falling) / T
    b_tau = np.zeros(size)
    b_tau[-1] = -b * T**derivatives / T

    hold = np.zeros((size + 3, size + 3))
    hold[:size, :size] = a * period
    hold[:size, size] = b_m * period
    hold[size, size + 1] = 1.0
    hold[:size, size + 2] = b_tau * period
    power = exponential(hold)
    a_d, g_1, g_2, held = power[:size, :size], power[:size, size], power[:size, size + 1], power[:size, size + 2]

    scale = T**derivatives
    start_u = np.concatenate(([1.0], falling[:-1])) * scale
    start_m = np.concatenate(([-direct], -numerator[:-1]))
    output = np.zeros(size)
    output[0] = 1.0 / scale
    return Estimator(
        A=a_d,
        B=a_d @ g_2 + g_1 - g_2,
        B_tau=held,
        C=output,
        D=(g_2[0] + direct) / scale,
        start_m=start_m - g_2,
        start_u=start_u,
    )


def realise(
    scenario: Scenario,
    filters: StateFeedbackFilters,
    *,
    error_gain: FloatArray,
    rate_gain: FloatArray,
    feed_forward: bool,
    compensate: bool,
    state_feedback: bool = False,
) -> Realisation:
    """The matrices of a law with k_0 = error_gain, k_1 = rate_gain (6,), f = feed_forward, c = compensate.

    Without compensation the constant bias -uhat0 replaces the estimate: gravity feed-forward. For output feedback the
    filters are `Filters`, which checks their order.
    """
    control = scenario.control
    derivatives = 1 if state_feedback else 2
    period = scenario.period_ns / NANOSECONDS
    size = filters.order + 1
    law = Realisation(
        A=np.zeros((6, size, size)),
        B=np.zeros((6, size, INPUTS)),
        B_tau=np.zeros((6, size)),
        C=np.zeros((6, size)),
        D=np.zeros((6, INPUTS)),
        bias=np.zeros(6),
        C_u=np.zeros((6, size)),
        D_u=np.zeros((6, INPUTS)),
        start_r=np.zeros((6, size, INPUTS)),
        start_u=np.zeros((6, size)),
        uhat0=np.array(control.uhat0),
        memory_s=np.array(filters.T),
    )
    measured = VELOCITY if state_feedback else POSITION
    for axis in range(6):
        b = control.b[axis]
        part = estimator(filters.order, filters.T[axis], b, period, derivatives=derivatives)
        n = filters.order
        law.A[axis, :n, :n] = part.A
        law.B[axis, :n, measured] = part.B
        law.B_tau[axis, :n] = part.B_tau
        law.start_r[axis, :n, measured] = part.start_m
        law.start_u[axis, :n] = part.start_u
        law.C_u[axis, :n] = part.C
        law.D_u[axis, measured] = part.D

        law.D[axis, REFERENCE_ACCELERATION] = feed_forward / b
        law.D[axis, ERROR] = -error_gain[axis] / b
        if state_feedback:
            law.D[axis, ERROR_RATE] = -rate_gain[axis] / b
        else:
            # v_k = a v_(k-1) + (1 - a)(e_k - e_(k-1))/Ts with the state s_k = a v_(k-1) - (1 - a)/Ts e_(k-1), v_0 = 0.
            pole = np.exp(-filters.N[axis] * period)
            slope = -np.expm1(-filters.N[axis] * period) / period
            law.A[axis, n, n] = pole
            law.B[axis, n, ERROR] = (pole - 1.0) * slope
            law.start_r[axis, n, ERROR] = -slope
            law.C[axis, n] = -rate_gain[axis] / b
            law.D[axis, ERROR] -= rate_gain[axis] * slope / b
        if compensate:
            law.C[axis, :n] -= part.C / b
            law.D[axis, measured] -= part.D / b
        else:
            law.bias[axis] = -control.uhat0[axis] / b
    return law
