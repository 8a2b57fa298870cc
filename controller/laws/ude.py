"""The law of the paper: output feedback by an uncertainty and disturbance estimator (21), and its relatives.

    b tau = q_d'' - (K + Lambda) D q_e - K Lambda q_e - uhat        uhat = s^2 G_f q - b G_f tau_applied

The same law as (21) with one more pole: (21) as printed has s/(1 - G_f) acting on q_e, which is improper for every proper
G_f; the derivative D(s) = N s/(s + N) makes it realisable, and N to infinity gives (21) back. Read (13) as q_z' = -K q_z
and the bracket in (21) as (K + Lambda) q_e.

Assumptions: b is near the true input gain over inertia; the bandwidth 1/T covers the disturbance; a delay well below 1/K.
"""

from __future__ import annotations

import numpy as np

from controller.laws.discretise import realise
from controller.laws.state_space import Realisation
from protocol.scenario import Scenario


def ude(scenario: Scenario) -> Realisation:
    """Output feedback (21)."""
    return _paper_law(scenario)


def ude_state(scenario: Scenario) -> Realisation:
    """State feedback (20): the true q_e' in place of D q_e, and uhat = s G_f q' - b G_f tau. It needs the velocity."""
    return _paper_law(scenario, state_feedback=True)


def uncompensated(scenario: Scenario) -> Realisation:
    """The same gains with G_f = 0: the estimate stays what it was at the start (`uhat0`)."""
    return _paper_law(scenario, compensate=False)


def _paper_law(scenario: Scenario, *, compensate: bool = True, state_feedback: bool = False) -> Realisation:
    k, lam = np.array(scenario.control.K), np.array(scenario.control.Lambda)
    return realise(
        scenario,
        error_gain=k * lam,
        rate_gain=k + lam,
        feed_forward=True,
        compensate=compensate,
        state_feedback=state_feedback,
    )
