"""The PD baseline (section IV-A of the paper), with the derivative filter of the other laws.

    tau = -Kp q_e - Kd D q_e - uhat0/b

The last term is a constant feed-forward, gravity where the scenario gives it; the paper's run has none. No assumption on b
beyond that term; a constant disturbance leaves a constant error.
"""

from __future__ import annotations

import numpy as np

from controller.laws.discretise import realise
from controller.laws.state_space import Realisation
from protocol.scenario import Scenario


def pd(scenario: Scenario) -> Realisation:
    """PD."""
    return pd_gains(scenario, feed_forward=False, compensate=False)


def pd_gains(scenario: Scenario, *, feed_forward: bool, compensate: bool) -> Realisation:
    """A law with the PD gains Kp and Kd, which the common form takes multiplied by b."""
    control = scenario.control
    b = np.array(control.b)
    return realise(
        scenario,
        error_gain=b * np.array(control.Kp),
        rate_gain=b * np.array(control.Kd),
        feed_forward=feed_forward,
        compensate=compensate,
    )
