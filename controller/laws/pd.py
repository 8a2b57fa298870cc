"""The PD baseline (section IV-A of the paper), with the derivative filter of the other laws.

    tau = -Kp q_e - Kd D q_e - uhat0/b

The last term is a constant feed-forward, gravity where the scenario gives it; the paper's run has none. No assumption on b
beyond that term; a constant disturbance leaves a constant error.
"""

from __future__ import annotations

from typing import Annotated

from controller.laws.filters import Filters
from controller.laws.gains import LinkParameter
from controller.laws.state_space import Realisation
from protocol.scenario import NotNegative6, Scenario, Table


class PdGains(Table, frozen=True):
    """The table [gains.pd]: Kp in N/m and N m/rad, Kd in N s/m and N m s/rad."""

    Kp: Annotated[NotNegative6, LinkParameter("LAW_KP", "gain Kp of PD and DOB, N/m, N m/rad")]
    Kd: Annotated[NotNegative6, LinkParameter("LAW_KD", "gain Kd of PD and DOB, N s/m, N m s/rad")]


def pd(scenario: Scenario, gains: PdGains, filters: Filters) -> Realisation:
    """PD."""
    return with_pd_gains(scenario, gains, filters, feed_forward=False, compensate=False)


def with_pd_gains(
    scenario: Scenario, gains: PdGains, filters: Filters, *, feed_forward: bool, compensate: bool
) -> Realisation:
    """A law with the PD gains Kp and Kd; the common form expects them multiplied by b."""
    import numpy as np  # here: as in `ude`

    from controller.laws.discretise import realise

    b = np.array(scenario.control.b)
    return realise(
        scenario,
        filters,
        error_gain=b * np.array(gains.Kp),
        rate_gain=b * np.array(gains.Kd),
        feed_forward=feed_forward,
        compensate=compensate,
    )
