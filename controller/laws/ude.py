"""The law of the paper: output feedback by an uncertainty and disturbance estimator (21), and its relatives.

    b tau = q_d'' - (K + Lambda) D q_e - K Lambda q_e - uhat        uhat = s^2 G_f q - b G_f tau_applied

The same law as (21) with one more pole: (21) as printed has s/(1 - G_f) acting on q_e, which is improper for every proper
G_f; the derivative D(s) = N s/(s + N) makes it realisable, and N to infinity gives (21) back. Read (13) as q_z' = -K q_z
and the bracket in (21) as (K + Lambda) q_e.

Assumptions: b is near the true input gain over inertia; the bandwidth 1/T covers the disturbance; a delay well below 1/K.
"""

from __future__ import annotations

from typing import Annotated

from controller.laws.filters import Filters, StateFeedbackFilters
from controller.laws.gains import LinkParameter
from controller.laws.state_space import Realisation
from protocol.scenario import Positive6, Scenario, Table


class UdeGains(Table, frozen=True):
    """The table [gains.ude]: K (13) and Lambda (11), 1/s."""

    K: Annotated[Positive6, LinkParameter("LAW_K", "gain K (13), 1/s")]
    Lambda: Annotated[Positive6, LinkParameter("LAW_LAMBDA", "gain Lambda (11), 1/s")]


def ude(scenario: Scenario, gains: UdeGains, filters: Filters) -> Realisation:
    """Output feedback (21)."""
    return _paper_law(scenario, gains, filters)


def ude_state(scenario: Scenario, gains: UdeGains, filters: StateFeedbackFilters) -> Realisation:
    """State feedback (20): the true q_e' in place of D q_e, and uhat = s G_f q' - b G_f tau. It needs the velocity."""
    return _paper_law(scenario, gains, filters, state_feedback=True)


def uncompensated(scenario: Scenario, gains: UdeGains, filters: Filters) -> Realisation:
    """The same gains with G_f = 0: the estimate keeps its initial value (`uhat0`)."""
    return _paper_law(scenario, gains, filters, compensate=False)


def _paper_law(
    scenario: Scenario,
    gains: UdeGains,
    filters: StateFeedbackFilters,
    *,
    compensate: bool = True,
    state_feedback: bool = False,
) -> Realisation:
    import numpy as np  # here: `fwav-hil run` checks the gains before it starts anything, and does not wait for NumPy

    from controller.laws.discretise import realise

    k, lam = np.array(gains.K), np.array(gains.Lambda)
    return realise(
        scenario,
        filters,
        error_gain=k * lam,
        rate_gain=k + lam,
        feed_forward=True,
        compensate=compensate,
        state_feedback=state_feedback,
    )
