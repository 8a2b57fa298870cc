"""The describing function against closed forms, and its limit cycles against the simulated plant."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import iv

from fwav_hil.studies.describing import (
    Gear,
    amplitudes,
    describing_function,
    gears,
    growth,
    limit_cycles,
)
from fwav_hil.studies.flight_check import at_rest
from fwav_hil.studies.loop_model import channels
from plant_emulator.plant.backlash import BACKLASH, PLAY, gear_step
from protocol.messages import AXES
from tests.loop import scenario_of


def backlash_closed_form(h: float, kappa: float, a: float) -> complex:
    """Fourier integrals of (3) over a settled sine of amplitude a/chi, done by hand: Bessel's I1 and a tanh."""
    in_phase = h - (h - kappa) * 2.0 * float(iv(1, a)) / (a * math.cosh(a))
    return complex(in_phase, -4.0 * (h - kappa) / (math.pi * a) * (1.0 - math.tanh(a) / a))


def play_closed_form(h: float, half_width: float, amplitude: float) -> complex:
    """The textbook describing function of a play (friction controlled backlash) of slope h."""
    c = 2.0 * half_width / amplitude - 1.0
    in_phase = h / math.pi * (math.pi / 2.0 - math.asin(c) - c * math.sqrt(1.0 - c * c))
    return complex(in_phase, 4.0 * half_width * h / (math.pi * amplitude) * (half_width / amplitude - 1.0))


@given(
    h=st.floats(0.2, 5.0), share=st.floats(0.0, 0.95), chi=st.floats(1.0, 1e7), a=st.floats(0.05, 50.0)
)  # fmt: skip
def test_of_the_backlash(h: float, share: float, chi: float, a: float) -> None:
    found = describing_function(Gear(BACKLASH, h, share * h, chi), a / chi)
    assert abs(found - backlash_closed_form(h, share * h, a)) < 1e-6 * h


@given(h=st.floats(0.2, 5.0), half_width=st.floats(1e-6, 1.0), relative=st.floats(1.05, 100.0))
def test_of_the_play(h: float, half_width: float, relative: float) -> None:
    found = describing_function(Gear(PLAY, h, half_width, 1.0), relative * half_width)
    assert abs(found - play_closed_form(h, half_width, relative * half_width)) < 1e-5 * h


def test_it_goes_from_kappa_to_h_with_the_lag_in_between() -> None:
    gear = Gear(BACKLASH, 3.15, 0.35, 1.0)
    assert describing_function(gear, 1e-4) == pytest.approx(0.35, rel=1e-3)
    assert describing_function(gear, 1e4) == pytest.approx(3.15, rel=1e-3)
    lags = [-math.degrees(np.angle(describing_function(gear, a))) for a in np.geomspace(0.1, 10.0, 200)]
    # control.md says "up to 38 degrees"; the closed form above has its largest, 42.6, at A = .54/chi.
    assert max(lags) == pytest.approx(42.65, abs=0.05)


def test_the_slope_after_a_saturated_reversal_is_negative_with_the_papers_numbers() -> None:
    gear = Gear(BACKLASH, 3.15, 0.35, 1.0)
    u, d = gear_step(*gear[:1], 0.0, 40.0, 0.0, 0.0, *gear[1:])
    after, _ = gear_step(gear.model, 40.0, 40.0 - 1e-6, u, d, *gear[1:])
    slope = (u - after) / 1e-6
    assert slope == pytest.approx(gear.reversal_slope, rel=1e-4)
    assert gear.reversal_slope == pytest.approx(-2.45)
    assert Gear(PLAY, 3.15, 0.35, 1.0).reversal_slope == 0.0


def test_gears_are_alike_but_for_the_scale_of_their_command() -> None:
    x, *_, yaw = gears(scenario_of("flapper").hysteresis)
    assert x.alike(yaw)
    assert abs(describing_function(x, 3.0 * x.amplitude) - describing_function(yaw, 3.0 * yaw.amplitude)) < 1e-12
    assert not x.alike(x._replace(p=0.5))
    assert not x.alike(Gear(PLAY, x.h, x.p, x.chi))


class TestLimitCycles:
    @pytest.mark.parametrize(("name", "rate_hz"), [("flapper", 250.0), ("paper", 1000.0)])
    def test_the_plant_does_what_is_predicted(self, name: str, rate_hz: float) -> None:
        """Harmonic balance is a first harmonic's word: amplitudes and frequencies to 25 and 12 %."""
        scenario = scenario_of(name, rate_hz=rate_hz)
        loops, worn = channels(scenario), gears(scenario.hysteresis)
        predicted = {}
        for i, axis in enumerate(AXES):
            (cycle,) = (
                c for c in limit_cycles(loops[axis], worn[i], scenario.control.b[i], scenario.delay_ns * 1e-9)
                if c.attracting
            )  # fmt: skip
            predicted[axis] = cycle
        shown = at_rest(scenario, 10.0 * np.array([predicted[axis].motion for axis in AXES]))
        for axis in AXES:
            found = shown[axis]
            assert found.amplitude == pytest.approx(predicted[axis].amplitude, rel=0.25)
            assert found.motion == pytest.approx(predicted[axis].motion, rel=0.25)
            assert found.frequency_rad_s == pytest.approx(predicted[axis].frequency_rad_s, rel=0.12)

    def test_a_law_without_integral_action_has_none_and_comes_to_rest(self) -> None:
        scenario = scenario_of("flapper", law="pd")
        loops, worn = channels(scenario), gears(scenario.hysteresis)
        for i, axis in enumerate(AXES):
            assert limit_cycles(loops[axis], worn[i], scenario.control.b[i], 0.009) == []
        shown = at_rest(scenario, np.repeat((1e-3, 1e-2), 3))
        assert all(one.motion == 0.0 and one.frequency_rad_s is None for one in shown.values())

    def test_one_that_repels_separates_decay_from_growth(self) -> None:
        scenario = scenario_of("flapper")
        loop, gear = channels(scenario)["alpha"], gears(scenario.hysteresis)[3]
        repelling, attracting = limit_cycles(loop, gear, scenario.control.b[3], 0.009)
        assert not repelling.attracting
        assert attracting.attracting
        for cycle, outward in ((repelling, 1.0), (attracting, -1.0)):
            below, above = (growth(loop, gear, 0.009, cycle.amplitude * x)[0] - 1.0 for x in (0.9, 1.1))
            assert below * outward < 0.0 < above * outward

    def test_a_predicted_cycle_solves_the_harmonic_balance(self) -> None:
        scenario = scenario_of("flapper", rate_hz=500.0)
        loop, gear = channels(scenario)["x"], gears(scenario.hysteresis)[0]
        (cycle,) = limit_cycles(loop, gear, scenario.control.b[0], 0.007)
        n = describing_function(gear, cycle.amplitude) / gear.h
        open_loop = loop.loop(0.007, np.array([cycle.frequency_rad_s]))[0]
        assert abs(1.0 + n * loop.ratio * open_loop) < 1e-4


def test_amplitudes_of_a_play_begin_where_it_passes_something_on() -> None:
    play = Gear(PLAY, 1.0, 0.5, 1.0)
    assert amplitudes(play, 5)[0] > 0.5
    assert abs(describing_function(play, 0.4)) < 1e-12
