"""The disturbance-observer baseline: PD plus the estimate of the same G_f as the UDE's ("internal-model-embedded").

    b tau = -b Kp q_e - b Kd D q_e - uhat                 `dob`, as far as the paper describes it
    b tau = q_d'' - b Kp q_e - b Kd D q_e - uhat          `dob_ff`, with feed-forward

With b Kp = K Lambda and b Kd = K + Lambda the second *is* the UDE, digit for digit: every difference between the two comes
from the baseline's gains or from its missing feed-forward.
"""

from __future__ import annotations

from controller.laws.filters import Filters
from controller.laws.pd import PdGains, with_pd_gains
from controller.laws.state_space import Realisation
from protocol.scenario import Scenario


def dob(scenario: Scenario, gains: PdGains, filters: Filters) -> Realisation:
    """Without feed-forward."""
    return with_pd_gains(scenario, gains, filters, feed_forward=False, compensate=True)


def dob_ff(scenario: Scenario, gains: PdGains, filters: Filters) -> Realisation:
    """With the feed-forward of q_d''."""
    return with_pd_gains(scenario, gains, filters, feed_forward=True, compensate=True)
