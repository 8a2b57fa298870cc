"""Gear hysteresis: the closed form against an ODE solution of (3), and the properties that make it safe at any rate."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from plant_emulator.plant.backlash import GearHysteresis, backlash_step, gear_parameters, gear_step, play_step
from protocol.errors import ScenarioError
from protocol.messages import FloatArray
from protocol.scenario import Backlash, Play, Scenario, find_scenario, load_scenario, with_overrides

modest = settings(deadline=None, max_examples=60)
few = settings(deadline=None, max_examples=20)


class Gear(NamedTuple):
    h: float
    kappa: float
    chi: float

    @property
    def bound(self) -> float:
        return (self.h - self.kappa) / self.chi


PAPER = Gear(h=3.15, kappa=0.35, chi=1.0)

unit = st.floats(-1.0, 1.0)
fraction = st.floats(0.0, 1.0)
any_tau = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def gears(draw: st.DrawFn) -> Gear:
    h = draw(st.floats(0.1, 10.0))
    return Gear(h, h * draw(st.floats(0.0, 0.99)), 10.0 ** draw(st.floats(-1.0, 7.0)))


def step(gear: Gear, tau: float, tau_next: float, d: float) -> float:
    return backlash_step(tau, tau_next, d, *gear)


def solve_equation_3(
    gear: Gear, tau: Callable[[float], float], rate: Callable[[float], float], t: Sequence[float], u: float
) -> float:
    """Equation (3) by Runge-Kutta of eighth order; |tau'| has a kink at each reversal, so the solution pauses at each t."""

    def slope(now: float, state: FloatArray) -> list[float]:
        return [gear.chi * abs(rate(now)) * (gear.h * tau(now) - float(state[0])) + gear.kappa * rate(now)]

    for start, end in itertools.pairwise(t):
        u = solve_ivp(slope, (start, end), [u], method="DOP853", rtol=1e-11, atol=1e-13).y[0, -1]
    return u


@pytest.mark.parametrize("amplitude", [2.5, 3.5, 4.5])
@pytest.mark.parametrize("quarters", [0.4, 1.0, 1.7, 2.0, 6.3])
def test_the_papers_figure_solves_equation_3(amplitude: float, quarters: float) -> None:
    frequency = 2.3
    # tau = x sin(2.3 t) reverses after every odd quarter of its period.
    turns = [quarter for quarter in (1.0, 3.0, 5.0) if quarter < quarters]
    t = [0.5 * math.pi * quarter / frequency for quarter in (0.0, *turns, quarters)]

    def tau(now: float) -> float:
        return amplitude * math.sin(frequency * now)

    expected = solve_equation_3(PAPER, tau, lambda now: amplitude * frequency * math.cos(frequency * now), t, u=0.0)
    d = 0.0
    for start, end in itertools.pairwise(t):
        d = step(PAPER, tau(start), tau(end), d)
    assert PAPER.h * tau(t[-1]) + d == pytest.approx(expected, rel=1e-9, abs=1e-9)


@few
@given(gears(), st.lists(st.integers(-500, 500), min_size=2, max_size=5), unit)
def test_straight_strokes_solve_equation_3(gear: Gear, places: list[int], start: float) -> None:
    taus = [0.01 * place / gear.chi for place in places]
    d = round(start, 3) * gear.bound  # nothing so small that the solver's error estimate divides zero by zero

    def tau(now: float) -> float:
        return float(np.interp(now, range(len(taus)), taus))

    def rate(now: float) -> float:
        k = min(int(now), len(taus) - 2)
        return taus[k + 1] - taus[k]

    u = gear.h * taus[0] + d
    # The strokes scale with 1/chi: so must the solver's absolute tolerance, so the equation is solved for chi tau.
    scaled = Gear(gear.h, gear.kappa, 1.0)
    expected = solve_equation_3(
        scaled, lambda now: gear.chi * tau(now), lambda now: gear.chi * rate(now), range(len(taus)), gear.chi * u
    )
    for one, following in itertools.pairwise(taus):
        d = step(gear, one, following, d)
    assert gear.chi * (gear.h * taus[-1] + d) == pytest.approx(expected, rel=1e-8, abs=1e-8)


@modest
@given(gears(), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), unit)
def test_one_stroke_is_the_corrected_closed_form(gear: Gear, start: float, end: float, part: float) -> None:
    tau_0, tau, d = start / gear.chi, end / gear.chi, part * gear.bound
    sign = math.copysign(1.0, tau - tau_0)
    # (4)-(5) with e^(+chi zeta sgn) under the integral; both exponentials are joined, lest they overflow apart.
    integral, _ = quad(
        lambda zeta: (gear.kappa - gear.h) * math.exp(-gear.chi * (tau - zeta) * sign), tau_0, tau, epsabs=0.0
    )
    expected = d * math.exp(-gear.chi * (tau - tau_0) * sign) + integral
    assert step(gear, tau_0, tau, d) == pytest.approx(expected, rel=1e-9, abs=1e-12 * gear.bound)


@modest
@given(gears(), st.floats(-20.0, 20.0), st.floats(-20.0, 20.0), fraction, unit)
def test_the_backlash_knows_no_rate(gear: Gear, start: float, end: float, part: float, d: float) -> None:
    """A stroke in two moves is the same as in one."""
    tau, tau_next = start / gear.chi, end / gear.chi
    between = min(max(tau + part * (tau_next - tau), min(tau, tau_next)), max(tau, tau_next))
    at_once = step(gear, tau, tau_next, d * gear.bound)
    in_two = step(gear, between, tau_next, step(gear, tau, between, d * gear.bound))
    assert in_two == pytest.approx(at_once, rel=0.0, abs=1e-13 * gear.bound)


@modest
@given(gears(), any_tau, any_tau, unit)
@example(PAPER, -1e308, 1e308, 1.0)
@example(PAPER, 1e308, -1e308, 0.5)
def test_d_keeps_its_bound_for_any_stroke(gear: Gear, tau: float, tau_next: float, part: float) -> None:
    d = step(gear, tau, tau_next, part * gear.bound)
    assert abs(d) <= gear.bound * (1.0 + 1e-15)


@modest
@given(gears(), any_tau, any_tau, unit)
def test_the_backlash_is_odd(gear: Gear, tau: float, tau_next: float, part: float) -> None:
    d = part * gear.bound
    assert step(gear, -tau, -tau_next, -d) == -step(gear, tau, tau_next, d)


@modest
@given(gears(), st.sampled_from([-1.0, 1.0]))
def test_the_slope_is_kappa_then_h_then_2_kappa_minus_h_after_a_reversal(gear: Gear, direction: float) -> None:
    small, far = direction * 1e-6 / gear.chi, direction * 50.0 / gear.chi

    def slope(d: float, stroke: float) -> float:
        return gear.h + (step(gear, 0.0, stroke, d) - d) / stroke

    assert slope(0.0, small) == pytest.approx(gear.kappa, abs=2e-6 * gear.h)
    saturated = step(gear, 0.0, far, 0.0)
    assert saturated == pytest.approx(-direction * gear.bound, rel=1e-14)
    assert slope(saturated, small) == pytest.approx(gear.h, rel=1e-8)
    assert slope(saturated, -small) == pytest.approx(2.0 * gear.kappa - gear.h, abs=4e-6 * gear.h)


def test_with_the_papers_numbers_u_first_moves_the_wrong_way() -> None:
    up = step(PAPER, 0.0, 30.0, 0.0)
    back = step(PAPER, 30.0, 29.9, up)
    assert PAPER.h * 29.9 + back > PAPER.h * 30.0 + up


@modest
@given(st.floats(0.1, 10.0), st.floats(0.0, 1.0), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), fraction)
def test_the_play_stays_in_its_band_and_knows_no_rate(
    h: float, half_width: float, tau: float, tau_next: float, part: float
) -> None:
    u = play_step(0.0, tau, h, half_width)
    at_once = play_step(u, tau_next, h, half_width)
    assert abs(at_once - h * tau_next) <= h * half_width + 1e-14 * h
    between = min(max(tau + part * (tau_next - tau), min(tau, tau_next)), max(tau, tau_next))
    assert play_step(play_step(u, between, h, half_width), tau_next, h, half_width) == at_once


@modest
@given(st.floats(0.1, 10.0), st.floats(0.01, 1.0), st.floats(-5.0, 5.0), st.floats(0.0, 0.99), st.sampled_from([-1, 1]))
def test_the_play_has_a_dead_band_of_twice_its_half_width(
    h: float, half_width: float, tau: float, part: float, direction: int
) -> None:
    engaged = play_step(0.0, tau, h, half_width)
    far = tau + direction * 20.0
    u = play_step(engaged, far, h, half_width)
    assert u == h * (far - direction * half_width)  # the first two lines of (2)
    back = far - direction * 2.0 * half_width * part
    assert play_step(u, back, h, half_width) == u  # the third
    beyond = far - direction * (2.0 * half_width + 1.0)
    assert play_step(u, beyond, h, half_width) == pytest.approx(u - direction * h, rel=1e-12, abs=1e-12 * h)


@modest
@given(any_tau.map(lambda tau: 1e-3 * tau), any_tau, st.floats(0.1, 10.0))
def test_a_play_without_width_is_a_straight_line(tau: float, u: float, h: float) -> None:
    assert play_step(u, tau, h, 0.0) == h * tau


@pytest.fixture(scope="module")
def flapper() -> Scenario:
    return load_scenario(find_scenario("flapper"))


def six_gears(model: str) -> Backlash | Play:
    """Six gears that all differ, so that none can be taken for another."""
    h = (1.0, 1.5, 2.0, 2.5, 3.0, 3.15)
    if model == "play":
        return Play(h=h, B=(0.0, 0.1, 0.2, 0.3, 0.4, 0.5))
    return Backlash(h=h, kappa=(0.0, 0.1, 0.2, 0.3, 0.35, 1.0), chi=(0.5, 1.0, 2.0, 3.0, 4.0, 5.0))


@pytest.mark.parametrize("model", ["backlash", "play"])
def test_six_gears_are_six_times_one(model: str) -> None:
    gears = six_gears(model)
    code, h, p, chi = gear_parameters(gears)
    rng = np.random.default_rng(7)
    strokes = rng.normal(size=(50, 6)).round(1)  # rounded: some axes stand still at times
    tau = strokes[0]
    six = GearHysteresis(gears, tau)
    assert six.u == pytest.approx(np.array(gears.h) * strokes[0], rel=0.0, abs=0.0)
    u, d = (h * tau).tolist(), [0.0] * 6
    for following in strokes[1:]:
        for i in range(6):
            u[i], d[i] = gear_step(code, tau[i], following[i], u[i], d[i], h[i], p[i], chi[i])
        tau = following
        assert six.step(following).tolist() == u
        assert six.d.tolist() == d
    assert np.array(u) - h * tau == pytest.approx(d, abs=1e-14)


@pytest.mark.parametrize("model", ["backlash", "play"])
def test_a_motor_that_stands_still_moves_no_gear(model: str) -> None:
    tau = np.array([0.3, -0.2, 0.1, 5.0, -1.0, 0.0])
    six = GearHysteresis(six_gears(model), np.zeros(6))
    u, d = six.step(tau), six.d.copy()
    assert six.step(tau).tobytes() == u.tobytes()
    assert six.d.tobytes() == d.tobytes()


def test_the_gears_keep_no_hold_on_what_they_are_given() -> None:
    gears, tau = six_gears("backlash"), np.ones(6)
    six, other = GearHysteresis(gears, tau), GearHysteresis(gears, np.ones(6))
    u = six.step(tau)
    tau[:] = u[:] = 9.0
    other.step(np.ones(6))
    assert six.step(np.full(6, 2.0)).tobytes() == other.step(np.full(6, 2.0)).tobytes()


@pytest.mark.parametrize("kappa", [3.15, 4.0])
def test_a_kappa_not_below_h_is_refused(flapper: Scenario, kappa: float) -> None:
    table = msgspec.to_builtins(flapper.hysteresis) | {"h": (3.15,) * 6, "kappa": (0.35,) * 4 + (kappa, 0.35)}
    with pytest.raises(ScenarioError, match=r"hysteresis.*kappa must be below h.*axis beta"):
        with_overrides(flapper, hysteresis=table)
