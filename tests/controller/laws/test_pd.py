"""The PD baseline by its own formula."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from controller.laws.filters import Filters
from controller.laws.law import make_law
from controller.laws.pd import PdGains
from controller.laws.reference import reference_trajectory
from protocol.messages import FloatArray
from protocol.scenario import Scenario, find_scenario, load_scenario, replace_gains
from tests.contracts.law_contract import WIDE

COUNT = 40


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """`flapper` with gains that have nothing to do with K, Lambda and b."""
    flapper = load_scenario(find_scenario("flapper"))
    control = msgspec.structs.replace(flapper.control, uhat0=(0.5, 0.0, 9.81, 0.0, -2.0, 0.0), rotate_force=False)
    return replace_gains(
        msgspec.structs.replace(flapper, actuators=WIDE, control=control),
        "pd",
        Kp=(0.3, 0.2, 0.1, 3e-5, 2e-5, 1e-5),
        Kd=(0.05, 0.04, 0.03, 3e-6, 2e-6, 1e-6),
    )


def errors() -> FloatArray:
    """q_e (COUNT, 6): a walk around the reference."""
    walk: FloatArray = 0.01 * np.cumsum(np.random.default_rng(8).normal(size=(COUNT, 6)), axis=0)
    return walk


def commands(scenario: Scenario, name: str) -> FloatArray:
    q = reference_trajectory(scenario.reference, COUNT, scenario.period_ns)[:, 0] + errors()
    law = make_law(name, scenario)
    state = law.start()
    return np.array([law.step(state, k * scenario.period_ns, row) for k, row in enumerate(q)])


def test_tau_is_kp_times_the_error_and_kd_times_its_filtered_rate(scenario: Scenario) -> None:
    """tau = -Kp q_e - Kd D q_e - uhat0/b."""
    control, period = scenario.control, scenario.period_ns * 1e-9
    gains, poles = scenario.read_gains("pd", PdGains), scenario.read_gains("filters", Filters).N
    error, decay = errors(), np.exp(-np.array(poles) * scenario.period_ns * 1e-9)
    rate = np.zeros((COUNT, 6))
    for k in range(1, COUNT):
        rate[k] = decay * rate[k - 1] + (1.0 - decay) * (error[k] - error[k - 1]) / period
    feed_forward = np.array(control.uhat0) / np.array(control.b)
    expected = -np.array(gains.Kp) * error - np.array(gains.Kd) * rate - feed_forward
    # float32 fractions of the wire's scale, and no more, lie between the two.
    difference = np.abs(commands(scenario, "pd") - expected) / np.abs(expected).max(axis=0)
    assert difference.max() < 1e-7


def test_neither_the_reference_acceleration_nor_k_lambda_and_t_are_in_it(scenario: Scenario) -> None:
    other = replace_gains(scenario, "ude", K=(7.0,) * 6, Lambda=(3.0,) * 6)
    other = replace_gains(other, "filters", T=(0.2,) * 6)
    assert commands(other, "pd").tobytes() == commands(scenario, "pd").tobytes()


def test_without_an_estimate_at_the_start_there_is_no_feed_forward(scenario: Scenario) -> None:
    bare = msgspec.structs.replace(scenario, control=msgspec.structs.replace(scenario.control, uhat0=(0.0,) * 6))
    shift = commands(scenario, "pd") - commands(bare, "pd")
    expected = -np.array(scenario.control.uhat0) / np.array(scenario.control.b)
    assert shift == pytest.approx(np.tile(expected, (COUNT, 1)), rel=1e-5, abs=1e-9)
