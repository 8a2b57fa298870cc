"""The disturbance-observer baseline: PD plus the estimate of the same G_f as the UDE's ("internal-model-embedded").

    b tau = -b Kp q_e - b Kd D q_e - uhat                 `dob`, as far as the paper describes it
    b tau = q_d'' - b Kp q_e - b Kd D q_e - uhat          `dob_ff`, with feed-forward

With b Kp = K Lambda and b Kd = K + Lambda the second *is* the UDE, digit for digit: every gap between the two comes from
the baseline's gains or from its missing feed-forward.
"""

from __future__ import annotations

from controller.laws.pd import pd_gains
from controller.laws.state_space import Realisation
from protocol.scenario import Scenario


def dob(scenario: Scenario) -> Realisation:
    """Without feed-forward."""
    return pd_gains(scenario, feed_forward=False, compensate=True)


def dob_ff(scenario: Scenario) -> Realisation:
    """With the feed-forward of q_d''."""
    return pd_gains(scenario, feed_forward=True, compensate=True)
