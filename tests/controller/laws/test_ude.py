"""The law of the paper against its own equations in continuous time, flown on a plant that has an exact solution."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from controller.laws.filters import Filters
from controller.laws.law import make_law
from controller.laws.ude import UdeGains
from protocol.messages import FloatArray
from protocol.scenario import Reference, Scenario, find_scenario, load_scenario
from tests.contracts.law_contract import WIDE

T_END_S = 0.6
ROOT_2 = np.sqrt(2.0)
FLAPPER = load_scenario(find_scenario("flapper"))

INPUT_GAIN = np.array([150.0, 178.0, 210.0, 1.5e6, 1.7e6, 1.1e6])
"""What the plant makes of a command; the law's b is near it, as in a flight."""
DISTURBANCE = np.array([0.5, -1.0, 9.81, 3.0, -5.0, 8.0])


def straight_scenario(rate_hz: float) -> Scenario:
    """`flapper` on a plant q'' = g tau + disturbance: without rotation, limits in reach, and near the reference."""
    return msgspec.structs.replace(
        FLAPPER,
        rate_hz=rate_hz,
        substep_s=1.0 / rate_hz,
        actuators=WIDE,
        reference=Reference(
            A_d=(30.0,) * 3 + (40.0,) * 3, B_d=(200.0,) * 3 + (500.0,) * 3, C_d=(20.0,) * 6, amplitude=(1.0,) * 6,
            frequency_rad_s=(3.0, 4.0, 5.0, 6.0, 7.0, 8.0), initial=(0.1, 0.0, -0.1, 0.1, 0.0, -0.1),
        ),
        control=msgspec.structs.replace(FLAPPER.control, rotate_force=False, uhat0=(0.0, 0.0, 9.0, 1.0, 0.0, 0.0)),
    )  # fmt: skip


def start_motion(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    return np.array(scenario.reference.initial) + 0.01, np.zeros(6)


def sampled_flight(scenario: Scenario, name: str) -> FloatArray:
    """q (6,) at T_END_S with the law as it runs, on the exact solution of the plant between its commands."""
    law = make_law(name, scenario)
    state, period = law.start(), scenario.period_ns * 1e-9
    q, q_dot = start_motion(scenario)
    for k in range(round(T_END_S / period)):
        acceleration = INPUT_GAIN * law.step(state, k * scenario.period_ns, q, q_dot) + DISTURBANCE
        q = q + period * q_dot + 0.5 * period**2 * acceleration
        q_dot = q_dot + period * acceleration
    assert law.counts(state)["saturated"] == 0
    return q


def continuous_flight(scenario: Scenario, *, state_feedback: bool, compensate: bool) -> FloatArray:
    """q (6,) at T_END_S with the equations themselves: plant, (12), (18) with u_d = q'' - b tau, and the law (17).

    Output feedback takes v = D q_e with D(s) = N s/(s + N) for q_e'; the Butterworth filter of (18) runs on the true u_d,
    which neither the law nor its realisation ever sees.
    """
    model, gains, filters = (
        scenario.reference,
        scenario.read_gains("ude", UdeGains),
        scenario.read_gains("filters", Filters),
    )
    damping, stiffness, gain, frequency = (
        np.array(part) for part in (model.A_d, model.B_d, model.C_d, model.frequency_rad_s)
    )
    k, lam, b, n, t_f = (np.array(part) for part in (gains.K, gains.Lambda, scenario.control.b, filters.N, filters.T))

    def slope(t: float, state: FloatArray) -> FloatArray:
        q, q_dot, q_d, q_d_dot, slow, uhat, uhat_dot = state.reshape(7, 6)
        q_d_ddot = -damping * q_d_dot - stiffness * q_d - gain * np.sin(frequency * t)
        error = q - q_d
        rate = q_dot - q_d_dot if state_feedback else n * (error - slow)
        tau = (q_d_ddot - (k + lam) * rate - k * lam * error - uhat) / b
        q_ddot = INPUT_GAIN * tau + DISTURBANCE
        u_d = q_ddot - b * tau
        uhat_ddot = (u_d - uhat - ROOT_2 * t_f * uhat_dot) / t_f**2 if compensate else np.zeros(6)
        return np.concatenate((q_dot, q_ddot, q_d_dot, q_d_ddot, n * (error - slow), uhat_dot, uhat_ddot))

    q, q_dot = start_motion(scenario)
    q_d, zero = np.array(model.initial), np.zeros(6)
    start = np.concatenate((q, q_dot, q_d, zero, q - q_d, np.array(scenario.control.uhat0), zero))
    solution = solve_ivp(slope, (0.0, T_END_S), start, "DOP853", rtol=1e-11, atol=1e-13)
    end: FloatArray = solution.y[:6, -1]
    return end


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("ude", {"state_feedback": False, "compensate": True}),
        ("ude_state", {"state_feedback": True, "compensate": True}),
        ("uncompensated", {"state_feedback": False, "compensate": False}),
    ],
)
def test_the_law_tends_to_its_continuous_equations(name: str, kind: dict[str, Any]) -> None:
    """As the period shrinks, on every axis, and at least with the first order that a held command allows."""
    expected = continuous_flight(straight_scenario(500.0), **kind)
    errors = np.array([sampled_flight(straight_scenario(rate), name) - expected for rate in (500.0, 1000.0, 2000.0)])
    order = np.log2(np.abs(errors[:-1] / errors[1:]))
    assert order == pytest.approx(np.ones((2, 6)), abs=0.1)
    # Halving the period twice also tells what the first order would leave at no period at all: nothing.
    assert 2.0 * errors[2] - errors[1] == pytest.approx(np.zeros(6), abs=1e-2 * np.abs(errors[0]).max())


def test_without_compensation_the_estimate_stays_what_it_was() -> None:
    """tau is then the same whatever has been applied, and b tau = q_d'' - (K + Lambda) D q_e - K Lambda q_e - uhat0."""
    scenario = straight_scenario(250.0)
    law = make_law("uncompensated", scenario)
    rng = np.random.default_rng(1)
    q = np.array(scenario.reference.initial) + 0.01 * rng.normal(size=(20, 6))
    one, other = law.start(), law.start()
    for k, row in enumerate(q):
        tau = law.step(one, k * scenario.period_ns, row)
        assert law.step(other, k * scenario.period_ns, row).tobytes() == tau.tobytes()
        other.applied[:] = 1e-3 * rng.normal(size=6)  # as if the motors had done something else
        if k == 0:
            c, gains = scenario.control, scenario.read_gains("ude", UdeGains)
            error = q[0] - np.array(scenario.reference.initial)
            q_d_ddot = -np.array(scenario.reference.B_d) * np.array(scenario.reference.initial)
            b_tau = q_d_ddot - np.array(gains.K) * np.array(gains.Lambda) * error - np.array(c.uhat0)
            assert tau * np.array(c.b) == pytest.approx(b_tau, rel=1e-6, abs=1e-6 * np.abs(b_tau).max())
