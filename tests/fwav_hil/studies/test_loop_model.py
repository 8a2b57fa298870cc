"""The linear loop: borders of stability against the simulated plant itself, closed forms, and the settled numbers."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from fwav_hil.simulate import simulate
from fwav_hil.studies.loop_model import (
    Channel,
    _root,
    channels,
    crossovers,
    gain_ratios,
    largest_delay,
    range_around,
    stable_gains,
)
from protocol.errors import UsageError
from protocol.messages import AXES
from protocol.scenario import ZERO6, Actuators, Backlash, Delay, Initial, Noise, Scenario, replace_gains
from tests.loop import scenario_of


def linear_plant(scenario: Scenario, axis: str, ratio: float, delay_s: float) -> Scenario:
    """The emulator with straight gears of that g/b, far limits, no gravity, noise or reference; one axis let go 1e-3 off."""
    h = tuple((np.array(scenario.hysteresis.h) * ratio / gain_ratios(scenario)).tolist())
    far = (1e6,) * 6
    offset = np.zeros(6)
    offset[AXES.index(axis)] = 1e-3
    period_s = scenario.period_ns * 1e-9
    return msgspec.structs.replace(
        scenario,
        duration_s=3000 * period_s,
        substep_s=period_s,  # Runge-Kutta is exact here: the acceleration is constant between commands
        body=msgspec.structs.replace(scenario.body, gravity=0.0),
        hysteresis=Backlash(h=h, kappa=tuple(x * (1.0 - 1e-9) for x in h), chi=(1.0,) * 6),
        actuators=Actuators(lower=(-1e6,) * 6, upper=far, scale=far),
        reference=msgspec.structs.replace(scenario.reference, amplitude=ZERO6, initial=ZERO6),
        initial=Initial(position=tuple(offset[:3]), attitude=tuple(offset[3:])),
        noise=Noise(),
        delay=Delay(samples=0, seconds=delay_s),
        control=msgspec.structs.replace(scenario.control, uhat0=ZERO6, rotate_force=False),
    )


def grows(scenario: Scenario, axis: str) -> bool:
    """Whether an oscillation of the simulated loop is larger at the end of the flight than before."""
    result = simulate(scenario)
    moved = np.abs(np.diff(result.q[:, AXES.index(axis)]))
    if result.divergence or moved.max() > 1.0:
        return True
    quarter = len(moved) // 4
    return bool(moved[-quarter:].max() > moved[quarter : 2 * quarter].max())


def border(is_unstable: Callable[[float], bool], low: float, high: float) -> float:
    """Bisection to 0.3 %; `low` is stable, `high` is not."""
    assert not is_unstable(low)
    assert is_unstable(high)
    while high / low > 1.003:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if is_unstable(middle) else (middle, high)
    return float(np.sqrt(low * high))


CELLS = [
    ("flapper", "ude", 250.0, "x", 0.009),
    ("flapper", "ude", 250.0, "alpha", 0.0),
    ("flapper", "pd", 500.0, "z", 0.0033),
    ("flapper", "dob", 200.0, "gamma", 0.0071),
    ("flapper", "ude_state", 250.0, "beta", 0.0055),
    ("flapper", "uncompensated", 100.0, "y", 0.013),
    ("paper", "ude", 1000.0, "alpha", 0.0017),
    ("paper", "dob_ff", 1000.0, "z", 0.001),
]


@pytest.mark.parametrize(("name", "law", "rate_hz", "axis", "delay_s"), CELLS)
class TestAgainstTheSimulatedPlant:
    """The linear margin against a time-domain bisection on a linear plant, to within 2 %."""

    def test_largest_gain(self, name: str, law: str, rate_hz: float, axis: str, delay_s: float) -> None:
        scenario = scenario_of(name, law=law, rate_hz=rate_hz)
        channel = channels(scenario)[axis]
        interval = range_around(stable_gains(channel, delay_s), channel.ratio)
        assert interval is not None
        found = border(
            lambda ratio: grows(linear_plant(scenario, axis, ratio, delay_s), axis),
            0.6 * interval[1],
            1.6 * interval[1],
        )
        assert interval[1] == pytest.approx(found, rel=0.02)

    def test_largest_delay(self, name: str, law: str, rate_hz: float, axis: str, delay_s: float) -> None:
        scenario = scenario_of(name, law=law, rate_hz=rate_hz)
        channel = channels(scenario)[axis]
        most = largest_delay(channel, channel.ratio)
        assert most is not None
        found = border(
            lambda delay: grows(linear_plant(scenario, axis, channel.ratio, delay), axis), 0.6 * most, 1.6 * most
        )
        assert most == pytest.approx(found, rel=0.02)


def test_smallest_gain_against_the_simulated_plant() -> None:
    scenario = scenario_of("flapper")
    interval = range_around(stable_gains(channels(scenario)["alpha"], 0.009), 1.0)
    assert interval is not None
    found = border(
        lambda less: grows(linear_plant(scenario, "alpha", 1.0 / less, 0.009), "alpha"),
        0.6 / interval[0],
        1.6 / interval[0],
    )
    assert interval[0] == pytest.approx(1.0 / found, rel=0.02)


@pytest.mark.parametrize(("samples", "limit"), [(0, 2.0), (1, 2.0 * np.sqrt(2.0) - 2.0)])
def test_a_pure_rate_feedback_has_a_closed_form(samples: int, limit: float) -> None:
    """tau = -K/b (q_k - q_(k-1))/Ts on q'' = g tau: z - 1 + a (1 + 1/z) z^-n / 2, a = K Ts g/b, Jury's criterion by hand."""
    scenario = scenario_of("paper", law="pd", rate_hz=1000.0)
    rate_gain = 300.0
    b = scenario.control.b
    scenario = replace_gains(scenario, "filters", N=(1e9,) * 6)
    scenario = replace_gains(scenario, "pd", Kp=[1e-3 / x for x in b], Kd=[rate_gain / x for x in b])
    for channel in channels(scenario).values():
        top = stable_gains(channel, samples * 1e-3)[-1][1]
        assert top * rate_gain * 1e-3 == pytest.approx(limit, rel=1e-4)


@pytest.mark.parametrize(("samples", "limit"), [(0, 1.88), (1, 0.80)])
def test_the_rule_of_thumb_for_the_largest_gain(samples: int, limit: float) -> None:
    """g/b < 1.88/(K Ts), .80/(K Ts) with one sample, for a large N: a rule of thumb, so to 6 % (ours: 1.965 and .816)."""
    channel = channels(replace_gains(scenario_of("paper"), "filters", N=(1e7,) * 6))["x"]
    assert stable_gains(channel, samples * 1e-3)[-1][1] * 500.0 * 1e-3 == pytest.approx(limit, rel=0.06)


def test_the_papers_gains_at_100_hz_are_thin_rather_than_unstable() -> None:
    for channel in channels(scenario_of("paper", rate_hz=100.0)).values():
        assert channel.stable(channel.ratio, 0.0)
        interval = range_around(stable_gains(channel, 0.0), channel.ratio)
        assert interval is not None
        assert interval[1] < 2.0 * channel.ratio
        assert not channel.stable(channel.ratio, 0.002)


def test_the_flappers_gains_stand_16_ms_and_not_25() -> None:
    limits = [largest_delay(channel, channel.ratio) for channel in channels(scenario_of("flapper")).values()]
    assert all(limit is not None and limit > 0.016 for limit in limits)
    assert min(limit for limit in limits if limit is not None) < 0.025


@pytest.mark.parametrize("law", ["ude", "pd", "dob", "uncompensated", "ude_state"])
@pytest.mark.parametrize("delay_s", [0.0, 0.004, 0.0101])
def test_poles_are_on_the_circle_at_each_border(law: str, delay_s: float) -> None:
    for channel in channels(scenario_of("flapper", law=law)).values():
        for end in stable_gains(channel, delay_s)[0]:
            if 0.0 < end < np.inf:
                assert np.abs(channel.poles(end, delay_s)).max() == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 2000.0])
def test_at_the_largest_delay_the_phase_margin_is_used_up(rate_hz: float) -> None:
    for channel in channels(scenario_of("flapper", rate_hz=rate_hz)).values():
        most = largest_delay(channel, channel.ratio)
        assert most is not None
        assert min(abs(margin) for _, margin in crossovers(channel, channel.ratio, most)) < 1e-5
        assert channel.stable(channel.ratio, most - 0.1 * channel.period)
        assert not channel.stable(channel.ratio, most + 0.1 * channel.period)


def test_a_delay_of_whole_samples_is_the_limit_of_fractional_ones() -> None:
    channel = channels(scenario_of("flapper"))["x"]
    near, at = (np.abs(channel.poles(1.0, delay)).max() for delay in (0.008 - 1e-9, 0.008))
    assert near == pytest.approx(at, abs=1e-6)


def test_the_bisection_agrees_with_the_proposed_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    channel = channels(scenario_of("flapper"))["alpha"]
    proposed = largest_delay(channel, 1.0)
    monkeypatch.setattr("fwav_hil.studies.loop_model._proposed_delay", lambda *_: None)
    assert largest_delay(channel, 1.0) == pytest.approx(proposed, abs=0.01 * channel.period)


def test_an_unstable_loop_stands_no_delay_and_its_range_is_the_nearest() -> None:
    channel = channels(scenario_of("flapper"))["x"]
    assert largest_delay(channel, 40.0) == 0.0
    intervals = stable_gains(channel, 0.009)
    assert range_around(intervals, 40.0) == intervals[-1]
    assert range_around([], 1.0) is None


def test_twins_differ_in_nothing_but_units() -> None:
    loops = channels(scenario_of("flapper"))
    assert loops["alpha"].twin_of(loops["gamma"])
    assert not loops["x"].twin_of(loops["alpha"])
    paper = channels(scenario_of("paper"))
    assert not paper["alpha"].twin_of(paper["gamma"])  # other inertia, same b


def test_a_complex_gain_of_modulus_one_keeps_only_positive_frequencies() -> None:
    channel: Channel = channels(scenario_of("flapper"))["x"]
    assert (np.angle(channel.poles(np.exp(-0.3j), 0.009)) > 0.0).all()
    assert len(channel.poles(1.0, 0.009)) > len(channel.poles(np.exp(-0.3j), 0.009))


def test_an_unknown_law_is_refused() -> None:
    with pytest.raises(UsageError, match="there is no law 'lqr'"):
        channels(scenario_of("flapper", law="lqr"))


@given(
    zero=st.floats(0.01, 99.0),
    power=st.integers(1, 3),
    bend=st.floats(-0.9, 5.0),
    rising=st.booleans(),
)
def test_a_root_is_where_brentq_finds_it(zero: float, power: int, bend: float, rising: bool) -> None:
    sign = 1.0 if rising else -1.0

    def function(w: float) -> float:
        return sign * (math.log(w / zero) + max(0.0, bend) * ((w / zero) ** power - 1.0))

    assert _root(function, 0.005, 100.0) == pytest.approx(brentq(function, 0.005, 100.0, xtol=1e-15), rel=1e-9)


def test_the_budget_of_a_run_loads_neither_kernels_nor_optimisers() -> None:
    """It is worked out while the two processes get ready, on the cores that they need."""
    program = """
import sys
from fwav_hil.studies.margin import budget_line
from protocol.scenario import find_scenario, load_scenario
budget_line(load_scenario(find_scenario("flapper")))
print("numba" in sys.modules, "scipy.optimize" in sys.modules)
"""
    told = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert told == "False False\n"
