"""The Lyapunov quantities (22)-(30) along a run, per axis (a sum over the axes would mix metres and radians).

    q_z = q_e' + Lambda q_e (11)    V_1 = q_z^2 / 2 (22)    u~ = q_z' + K q_z    rho_1 = 2 K - 1 (27)    C_1 = u~^2 / 2 (28)

u~ is computed from the run: with the law's extra pole (24) holds only approximately, so u_d - uhat is not exactly u~. The
paper treats C_1 as a constant; here it is its largest value so far: V_1(t) <= V_1(0) + max C_1 / rho_1 (30). This
is soon dominated by the start. (26) itself, V_1' <= -rho_1 V_1 + C_1(t), gives a tighter bound, by comparison with
y' = -rho_1 y + C_1(t), y(0) = V_1(0).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from controller.laws.reference import reference_trajectory
from controller.laws.ude import UdeGains
from fwav_hil.simulate import Simulation
from protocol.messages import FloatArray
from protocol.scenario import NANOSECONDS, Scenario


class Bound(NamedTuple):
    """Per sample and axis, (n, 6) each: V_1, the bound (30) and whether it held; y of the comparison, and whether that held."""

    v1: FloatArray
    bound: FloatArray
    held: np.typing.NDArray[np.bool_]
    comparison: FloatArray
    comparison_held: np.typing.NDArray[np.bool_]


def lyapunov(scenario: Scenario, result: Simulation) -> Bound:
    """The bound along a run; (n, 6), in m^2/s^2 and rad^2/s^2."""
    gains = scenario.read_gains("ude", UdeGains)
    k, lam = np.array(gains.K), np.array(gains.Lambda)
    desired = reference_trajectory(scenario.reference, len(result.t_ns), scenario.period_ns)
    error = result.q - desired[:, 0]
    error[:, 3:] = (error[:, 3:] + np.pi) % (2.0 * np.pi) - np.pi
    q_z = result.q_dot - desired[:, 1] + lam * error
    u_tilde = np.gradient(q_z, scenario.period_ns / NANOSECONDS, axis=0) + k * q_z
    v1 = 0.5 * q_z**2
    c1, rho = 0.5 * u_tilde**2, 2.0 * k - 1.0
    bound = v1[0] + np.maximum.accumulate(c1, axis=0) / rho
    comparison = _comparison(v1[0], c1, rho, scenario.period_ns / NANOSECONDS)
    return Bound(v1, bound, v1 <= bound, comparison, v1 <= comparison)


def _comparison(start: FloatArray, c1: FloatArray, rho: FloatArray, period_s: float) -> FloatArray:
    """y (n, 6) of y' = -rho y + C_1(t) from `start` (6,), exact for C_1 held at the larger of its values at a sample's ends."""
    decay = np.exp(-rho * period_s)
    y = np.empty_like(c1)
    y[0] = start
    for k in range(1, len(y)):
        y[k] = decay * y[k - 1] + (1.0 - decay) / rho * np.maximum(c1[k - 1], c1[k])
    return y
