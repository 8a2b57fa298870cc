"""The disturbance observer, and the fact that with the UDE's gains and its feed-forward it is the UDE."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from controller.laws.law import make_law
from controller.laws.pd import PdGains
from controller.laws.reference import reference_trajectory
from controller.laws.ude import UdeGains
from fwav_hil.simulate import simulate
from protocol.scenario import Scenario, Vector6, find_scenario, load_scenario, replace_gains
from tests.contracts.law_contract import WIDE

FLAPPER = load_scenario(find_scenario("flapper"))


def quotients(dividend: tuple[float, ...], divisor: tuple[float, ...]) -> Vector6:
    one, two, three, four, five, six = (a / b for a, b in zip(dividend, divisor, strict=True))
    return one, two, three, four, five, six


def with_the_gains_of_the_ude() -> Scenario:
    """b is a power of two near 1/m and 1/I: so Kp = K Lambda / b and Kd = (K + Lambda) / b are exact, and b times them too.

    With b = 1/m itself the products round, and the two laws differ in their last bits.
    """
    gains = FLAPPER.read_gains("ude", UdeGains)
    b = (128.0,) * 3 + (2.0**21, 2.0**21, 2.0**20)
    return replace_gains(
        msgspec.structs.replace(FLAPPER, control=msgspec.structs.replace(FLAPPER.control, b=b)),
        "pd",
        Kp=quotients(tuple(k * lam for k, lam in zip(gains.K, gains.Lambda, strict=True)), b),
        Kd=quotients(tuple(k + lam for k, lam in zip(gains.K, gains.Lambda, strict=True)), b),
    )


def test_with_the_same_gains_and_feed_forward_it_is_the_ude_digit_for_digit() -> None:
    scenario = with_the_gains_of_the_ude()
    ude, dob = simulate(scenario, make_law("ude", scenario)), simulate(scenario, make_law("dob_ff", scenario))
    assert ude.divergence is None
    assert len(ude.t_ns) == scenario.ticks
    for field in ("q", "q_dot", "command", "tau", "u"):
        assert getattr(dob, field).tobytes() == getattr(ude, field).tobytes()
    assert dob.law_counts == ude.law_counts


def test_with_the_gains_of_flapper_the_two_differ_by_rounding_alone() -> None:
    ude, dob = (simulate(FLAPPER, make_law(name, FLAPPER)) for name in ("ude", "dob_ff"))
    assert dob.q == pytest.approx(ude.q, rel=0.0, abs=1e-4), "ten seconds of a noisy nonlinear flight may amplify it"
    assert dob.q[:250] == pytest.approx(ude.q[:250], rel=0.0, abs=1e-6)


@pytest.mark.parametrize(("gain", "factor"), [("Kp", 1.01), ("Kd", 1.01)])
def test_other_gains_are_another_law(gain: str, factor: float) -> None:
    """The identity above is not for want of a difference."""
    scenario = with_the_gains_of_the_ude()
    gains = [factor * value for value in getattr(scenario.read_gains("pd", PdGains), gain)]
    other = replace_gains(scenario, "pd", **{gain: gains})
    assert np.abs(simulate(other, make_law("dob_ff", other)).q - simulate(scenario).q).max() > 1e-5


def test_without_feed_forward_just_the_reference_acceleration_is_missing() -> None:
    """In the first command, and with the observer fed alike, in all: b tau differs by q_d''."""
    straight = msgspec.structs.replace(
        FLAPPER, actuators=WIDE, control=msgspec.structs.replace(FLAPPER.control, rotate_force=False)
    )
    with_it, without = (make_law(name, straight) for name in ("dob_ff", "dob"))
    reference = reference_trajectory(straight.reference, 30, straight.period_ns)
    one, other = with_it.start(), without.start()
    rng = np.random.default_rng(6)
    for k, (q_d, _, q_d_ddot) in enumerate(reference):
        q = q_d + 0.005 * rng.normal(size=6)
        difference = with_it.step(one, k * straight.period_ns, q) - without.step(other, k * straight.period_ns, q)
        expected = q_d_ddot / np.array(straight.control.b)
        assert difference == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.array(WIDE.scale).min())
        other.x[:] = one.x
