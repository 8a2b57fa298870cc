"""When a flight is lost, tried both ways; and the bisection on delay."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from fwav_hil.score import desired_positions
from fwav_hil.simulate import Simulation, simulate
from fwav_hil.studies.flight_check import (
    LOST_SATURATED,
    about_rest,
    at_rest,
    flown_delay,
    fly,
    judge_flight,
    saturated_share,
    with_far_limits,
    without_hysteresis,
    without_noise,
)
from fwav_hil.studies.loop_model import channels, largest_delay
from protocol.scenario import Play, Scenario, replace_gains
from tests.loop import scenario_of


def made_up(scenario: Scenario, *, off: float, saturated: float, divergence: str | None = None) -> Simulation:
    """A flight whose z is off by `off` reference swings, with that share of its commands at the upper limit of roll."""
    count = scenario.ticks
    desired = desired_positions(scenario, count)
    q = desired.copy()
    q[:, 2] += off * desired[count // 2 :, 2].std()
    command = np.zeros((count, 6))
    command[: round(saturated * count), 3] = np.float32(scenario.actuators.upper[3])
    np.random.default_rng(1).shuffle(command)
    zeros = np.zeros((count, 6))
    t_ns = np.arange(count, dtype=np.int64) * scenario.period_ns
    return Simulation(t_ns, q, zeros, command, zeros, zeros, {}, divergence)


class TestDefinition:
    @pytest.mark.parametrize(
        ("off", "saturated", "lost"),
        [
            (0.0, 0.0, False),
            (1.0, 0.1, False),
            (0.1, 0.9, False),
            (0.5, 0.5, True),
            (0.2, 0.3, False),
            (0.3, 0.3, True),
        ],
    )
    def test_both_an_error_and_saturation_make_a_loss(self, off: float, saturated: float, lost: bool) -> None:
        scenario = scenario_of("flapper")
        flight = judge_flight(scenario, made_up(scenario, off=off, saturated=saturated))
        assert (flight.lost is not None) == lost
        assert flight.error["z"] == pytest.approx(off, abs=1e-9)
        assert flight.saturated == pytest.approx(saturated, abs=0.06)
        if lost:
            assert "z does not settle" in (flight.lost or "")

    def test_a_divergence_is_one_by_itself(self) -> None:
        scenario = scenario_of("flapper")
        assert judge_flight(scenario, made_up(scenario, off=0.0, saturated=0.0, divergence="it fell")).lost == "it fell"

    def test_what_is_within_the_noise_is_no_error(self) -> None:
        scenario = scenario_of("flapper")
        still = msgspec.structs.replace(
            scenario, reference=msgspec.structs.replace(scenario.reference, amplitude=(1e-3,) * 6)
        )
        assert judge_flight(still, made_up(still, off=1.0, saturated=0.9)).lost is None

    def test_a_flight_without_a_tick_is_judged_too(self) -> None:
        scenario = scenario_of("flapper")
        made = made_up(scenario, off=0.0, saturated=0.0, divergence="at once")
        none = np.zeros((0, 6))
        nothing = made._replace(t_ns=made.t_ns[:0], q=none, q_dot=none, command=none, tau=none, u=none)
        flight = judge_flight(scenario, nothing)
        assert (flight.lost, flight.saturated, flight.error["x"]) == ("at once", 0.0, None)

    def test_limits_are_met_to_the_rounding_of_the_wire(self) -> None:
        scenario = scenario_of("flapper")
        command = np.array([scenario.actuators.lower, np.zeros(6), 0.999 * np.array(scenario.actuators.upper)])
        assert saturated_share(scenario, np.float32(command).astype(float)) == pytest.approx(1.0 / 3.0)
        assert saturated_share(scenario, command[:0]) == 0.0


class TestFlights:
    """The scenarios that the definition was made for."""

    @pytest.mark.parametrize(
        ("name", "changes"),
        [
            ("flapper", {}),
            ("paper", {}),
            ("paper", {"law": "pd"}),  # z is off by 9 cm for want of gravity feed-forward: constant, and no loss
            ("flapper", {"law": "dob"}),
        ],
    )
    def test_a_loop_that_holds_is_not_lost(self, name: str, changes: dict[str, Any]) -> None:
        scenario = scenario_of(name, **changes)
        assert fly(scenario, scenario.delay_ns * 1e-9).lost is None

    def test_the_small_limit_cycle_of_a_worn_gear_is_no_loss(self) -> None:
        scenario = without_noise(scenario_of("flapper"))
        assert fly(scenario, 0.009).lost is None

    def test_the_papers_gains_at_100_hz_saturate_for_ever_and_that_is_one(self) -> None:
        scenario = scenario_of("paper", rate_hz=100.0)
        assert simulate(scenario).divergence is None
        flight = fly(scenario, 0.0)
        assert flight.saturated > LOST_SATURATED
        assert "z does not settle" in (flight.lost or "")

    @pytest.mark.parametrize("delay_s", [0.0221, 0.025, 0.03, 0.06])
    def test_a_flapper_with_too_much_delay_is_lost_however_it_ends(self, delay_s: float) -> None:
        assert fly(scenario_of("flapper"), delay_s).lost

    def test_a_start_up_alone_is_not_judged(self) -> None:
        scenario = scenario_of("flapper", duration_s=0.1)
        assert judge_flight(scenario, simulate(scenario)).lost
        assert fly(scenario, 0.009).lost is None


class TestFlownDelay:
    def test_of_the_flapper_is_between_16_and_25_ms(self) -> None:
        flown = flown_delay(scenario_of("flapper"), 0.024)
        assert flown.lost_delay_s is not None
        assert 0.016 < flown.max_delay_s < flown.lost_delay_s < 0.025
        assert flown.lost_delay_s - flown.max_delay_s <= 0.1 * 0.004
        assert flown.why_lost
        assert flown.at_own_delay.lost is None

    @pytest.mark.parametrize("rate_hz", [500.0, 1000.0])
    def test_of_the_papers_gains_stands_2_ms_and_not_6(self, rate_hz: float) -> None:
        assert 0.002 < flown_delay(scenario_of("paper", rate_hz=rate_hz), 0.005).max_delay_s < 0.006

    def test_of_a_slow_derivative_pole_is_none(self) -> None:
        """N = 100 is lost at 1 kHz without any delay."""
        scenario = scenario_of("paper")
        slow = replace_gains(scenario, "filters", N=(100.0,) * 6)
        flown = flown_delay(slow, 0.002)
        assert (flown.max_delay_s, flown.lost_delay_s) == (0.0, 0.0)

    def test_of_small_motions_without_hysteresis_and_noise_is_the_linear_one(self) -> None:
        scenario = scenario_of("paper")
        linear = min(largest_delay(loop, loop.ratio) or 0.0 for loop in channels(scenario).values())
        plain = without_noise(without_hysteresis(about_rest(scenario)))
        assert flown_delay(plain, linear).max_delay_s == pytest.approx(linear, rel=0.04)

    def test_a_loop_that_nothing_shakes_has_no_limit(self, monkeypatch: pytest.MonkeyPatch) -> None:
        scenario = scenario_of("flapper", duration_s=0.1)
        good = fly(scenario, 0.0)
        monkeypatch.setattr("fwav_hil.studies.flight_check.fly", lambda *_: good)
        flown = flown_delay(scenario, None)
        assert (flown.max_delay_s, flown.lost_delay_s, flown.why_lost) == (1.0, None, None)


def test_variants_change_what_they_say() -> None:
    scenario = scenario_of("flapper")
    assert with_far_limits(scenario).actuators.upper[0] == pytest.approx(4.0)
    assert without_noise(scenario).noise.position == 0.0
    straight = simulate(msgspec.structs.replace(without_hysteresis(scenario), duration_s=0.5))
    assert straight.u == pytest.approx(straight.tau, abs=1e-9)
    play = msgspec.structs.replace(scenario, hysteresis=Play(h=(1.0,) * 6, B=(1e-3,) * 6), duration_s=0.5)
    straight = simulate(without_hysteresis(play))
    assert np.array_equal(straight.u, straight.tau)


def test_a_divergence_at_rest_has_no_amplitude() -> None:
    scenario = scenario_of("flapper")
    delayed = msgspec.structs.replace(scenario, delay=msgspec.structs.replace(scenario.delay, seconds=0.1))
    shown = at_rest(delayed, np.repeat((1e-2, 1e-1), 3))
    assert {one.motion for one in shown.values()} == {None}
