"""Gear hysteresis between motor command and wing wrench: backlash-like (3)-(5), or the play operator (2)."""

from __future__ import annotations

import math

import numpy as np

from protocol.compiled import compiled
from protocol.messages import FloatArray
from protocol.scenario import Backlash, Play

BACKLASH = 0
PLAY = 1
ELSEWHERE = 2
"""No gear here: the input is already the force after a gear (drives on a CAN bus contain the gears)."""


@compiled
def backlash_step(tau: float, tau_next: float, d: float, h: float, kappa: float, chi: float) -> float:
    """State d = u - h tau after tau has moved monotonically to tau_next; exact for any size of step.

    With D = tau_next - tau, s = sign D, the solution of (3) is
        d+ = d exp(-chi |D|) + s (kappa - h)/chi (1 - exp(-chi |D|)).
    The closed form printed as (5) has a wrong sign: its integrand needs e^(+chi zeta sgn), its beta_i is kappa_i.
    """
    stroke = tau_next - tau
    decay = -math.expm1(-chi * abs(stroke))  # 1 - exp(.), without cancellation for small strokes
    return d + decay * (math.copysign((h - kappa) / chi, -stroke) - d)  # s (kappa - h)/chi: d opposes the stroke


@compiled
def play_step(u: float, tau_next: float, h: float, half_width: float) -> float:
    """Output u of the play operator (2) after tau has moved monotonically to tau_next."""
    return min(max(u, h * (tau_next - half_width)), h * (tau_next + half_width))


@compiled
def gear_step(
    model: int, tau: float, tau_next: float, u: float, d: float, h: float, p: float, chi: float
) -> tuple[float, float]:
    """(u, d) of one gear after tau has moved to tau_next; p is kappa, or the half width of the play."""
    if tau_next == tau:
        return u, d
    if model == BACKLASH:
        d = backlash_step(tau, tau_next, d, h, p, chi)
        return h * tau_next + d, d
    if model == ELSEWHERE:
        return tau_next, 0.0
    u = play_step(u, tau_next, h, p)
    return u, u - h * tau_next


class GearHysteresis:
    """The six gears of the flapper: motor command in, generalised force on the body out. Rate independent.

    input   tau (6,)  motor command (N, N m)           output  u (6,)  generalised force, same units as h * tau
    state   d (6,)    u - h tau; d = 0 at the start

        backlash   du = chi |dtau| (h tau - u) + kappa dtau             (3), solved exactly over each move
        play       u follows h (tau - B) upward, h (tau + B) downward   (2)

    Just after a reversal from saturated d the backlash has the slope 2 kappa - h: where that is negative (as with the
    paper's numbers), u first moves the wrong way. Dynamics are not modelled: no inertia of the gear, no friction torque.
    """

    def __init__(self, model: Backlash | Play, tau0: FloatArray) -> None:
        self.model, self.h, self.p, self.chi = gear_parameters(model)
        self.tau = tau0.copy()
        self.d = np.zeros(6)
        self.u = self.h * tau0

    def step(self, tau: FloatArray) -> FloatArray:
        """Move the motors to tau (6,) along a straight line; returns u (6,)."""
        for i in range(6):
            self.u[i], self.d[i] = gear_step(
                self.model, self.tau[i], tau[i], self.u[i], self.d[i], self.h[i], self.p[i], self.chi[i]
            )
        self.tau = np.asarray(tau, dtype=float).copy()
        return self.u.copy()


def gear_parameters(model: Backlash | Play) -> tuple[int, FloatArray, FloatArray, FloatArray]:
    """(model code, h, kappa or half width, chi) as the kernels take them, each (6,)."""
    if isinstance(model, Backlash):
        return BACKLASH, np.array(model.h), np.array(model.kappa), np.array(model.chi)
    return PLAY, np.array(model.h), np.array(model.B), np.ones(6)
