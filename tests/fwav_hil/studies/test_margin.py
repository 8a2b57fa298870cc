"""Margins put together: the channels' figures, the verdict, the delay budget."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from controller.laws.filters import Filters
from fwav_hil.studies.loop_model import channels, gain_ratios
from fwav_hil.studies.margin import (
    RATES_HZ,
    ChannelMargin,
    at_rate,
    budget_line,
    channel_margin,
    judge,
    linear_margins,
    rate_row,
    with_derivative_pole,
    with_gain_ratio,
)
from protocol.errors import ScenarioError
from protocol.messages import AXES
from protocol.scenario import Delay, Play, Scenario
from tests.loop import scenario_of


def delayed(scenario: Scenario, delay: Delay) -> Scenario:
    copy: Scenario = msgspec.structs.replace(scenario, delay=delay)
    return copy


class TestChannels:
    def test_margins_belong_together(self) -> None:
        scenario = scenario_of("flapper")
        for axis, margin in linear_margins(scenario).items():
            assert margin.stable
            assert margin.gain_range is not None
            low, high = margin.gain_range
            assert high is not None
            assert margin.gain_margin_up == pytest.approx(high / margin.gain_ratio)
            assert margin.gain_margin_down == pytest.approx(margin.gain_ratio / low)
            assert margin.gain_margin == min(margin.gain_margin_up or 0.0, margin.gain_margin_down or 0.0)
            assert margin.max_delay_s is not None
            assert margin.max_delay_samples == pytest.approx(margin.max_delay_s / 0.004)
            loop = channels(scenario)[axis].loop(0.009, np.array([margin.crossover_rad_s]))[0] * margin.gain_ratio
            assert abs(loop) == pytest.approx(1.0)
            assert margin.phase_margin_rad == pytest.approx(abs(np.angle(-loop)))

    def test_phase_margin_is_about_what_the_delay_may_grow(self) -> None:
        margin = linear_margins(scenario_of("flapper"))["alpha"]
        assert margin.phase_margin_rad is not None
        assert margin.crossover_rad_s is not None
        assert margin.max_delay_s is not None
        grows = margin.phase_margin_rad / margin.crossover_rad_s
        assert margin.max_delay_s - 0.009 == pytest.approx(grows, rel=0.02)

    def test_of_an_unstable_channel_say_so(self) -> None:
        loop = channels(scenario_of("flapper"))["x"]
        margin = channel_margin(loop, 0.009, 10.0)
        assert not margin.stable
        assert margin.gain_margin is not None
        assert margin.gain_margin < 1.0
        assert margin.phase_margin_rad is not None
        assert margin.phase_margin_rad < 0.0

    def test_where_no_gain_is_stable_there_is_no_margin(self) -> None:
        """Not "any", which is what a loop without a border has."""
        scenario = at_rate(scenario_of("paper"), 20.0)
        margin = channel_margin(channels(scenario)["x"], 0.5)
        assert margin.gain_range is None
        assert (margin.gain_margin_up, margin.gain_margin_down, margin.gain_margin) == (0.0, 0.0, 0.0)
        row = rate_row(delayed(scenario, Delay(samples=10)), 20.0)
        assert not row.stable
        assert row.gain_margin == 0.0

    def test_a_pd_may_lose_any_gain(self) -> None:
        margin = linear_margins(scenario_of("flapper", law="pd"))["x"]
        assert margin.gain_range is not None
        assert margin.gain_range[0] == 0.0
        assert margin.gain_margin_down is None
        assert margin.gain_margin == margin.gain_margin_up

    def test_six_channels_are_in_the_order_of_the_axes(self) -> None:
        assert tuple(linear_margins(scenario_of("paper"))) == AXES


class TestChanges:
    @pytest.mark.parametrize("model", ["backlash", "play"])
    def test_a_gain_ratio_scales_the_gears_and_nothing_else(self, model: str) -> None:
        scenario = scenario_of("paper")
        if model == "play":
            scenario = msgspec.structs.replace(scenario, hysteresis=Play(h=(3.0,) * 6, B=(1e-5,) * 6))
        changed = with_gain_ratio(scenario, 0.5)
        assert gain_ratios(changed) == pytest.approx(np.full(6, 0.5))
        assert msgspec.structs.replace(changed, hysteresis=scenario.hysteresis) == scenario
        if model == "backlash":
            before, after = scenario.hysteresis, changed.hysteresis
            assert np.array(after.kappa) / after.h == pytest.approx(np.array(before.kappa) / before.h)  # type: ignore[union-attr]

    def test_a_derivative_pole_is_that_of_all_channels(self) -> None:
        changed = with_derivative_pole(scenario_of("flapper"), 77.0)
        assert changed.read_gains("filters", Filters).N == (77.0,) * 6

    @pytest.mark.parametrize("rate_hz", RATES_HZ)
    def test_every_rate_of_the_table_fits_every_scenario(self, rate_hz: float) -> None:
        for name in ("flapper", "paper"):
            scenario = at_rate(scenario_of(name), rate_hz)
            assert scenario.rate_hz == rate_hz
            assert scenario.substep_ns <= scenario_of(name).substep_ns
            assert scenario.period_ns % scenario.substep_ns == 0

    @pytest.mark.parametrize("rate_hz", [0.0, -5.0, 300.0, float("nan"), 1e12])
    def test_a_rate_that_makes_no_sense_is_refused(self, rate_hz: float) -> None:
        with pytest.raises(ScenarioError):
            at_rate(scenario_of("flapper"), rate_hz)

    def test_a_slower_rate_has_a_longer_sample_of_delay(self) -> None:
        row = rate_row(scenario_of("flapper"), 100.0)
        assert row.delay_s == pytest.approx(0.015)
        assert row.stable
        assert row.max_delay_s is not None
        assert row.max_delay_s < 0.0242


def margins(**changes: Any) -> dict[str, ChannelMargin]:
    good = ChannelMargin(
        gain_ratio=1.0,
        gain_range=(0.1, 4.0),
        gain_margin=4.0,
        gain_margin_up=4.0,
        gain_margin_down=10.0,
        phase_margin_rad=0.7,
        max_delay_s=0.030,
        max_delay_samples=7.5,
        crossover_rad_s=30.0,
        stable=True,
    )
    return dict.fromkeys(AXES, good) | {"beta": msgspec.structs.replace(good, **changes)}


class TestVerdict:
    @pytest.mark.parametrize(
        ("changes", "lost", "flown", "verdict", "reason"),
        [
            ({}, None, 0.025, "good", ""),
            ({"stable": False}, None, 0.025, "unusable", "linearly unstable in pitch"),
            ({}, "it fell", 0.0, "unusable", "it fell"),
            ({"gain_margin": 1.9}, None, 0.025, "thin", "gain margin of pitch is 1.90"),
            ({"max_delay_s": 0.0199}, None, 0.025, "thin", "pitch is stable up to 1.99 times the delay"),
            ({}, None, 0.0199, "thin", "flights are lost beyond 1.99"),
            ({"max_delay_s": None, "gain_margin": None}, None, None, "good", ""),
        ],
    )
    def test_goes_by_margins_and_flight(
        self, changes: dict[str, Any], lost: str | None, flown: float | None, verdict: str, reason: str
    ) -> None:
        found = judge(0.010, margins(**changes), lost=lost, flown_delay_s=flown)
        assert found.verdict == verdict
        assert reason in " ".join(found.reasons)
        assert bool(found.reasons) == (verdict != "good")


class TestBudget:
    def test_of_the_flapper(self) -> None:
        budget = budget_line(scenario_of("flapper"), "lockstep")
        smallest = min(m.max_delay_s or 0.0 for m in linear_margins(scenario_of("flapper")).values())
        assert budget.max_delay_s == smallest
        assert budget.channel in AXES[3:]
        assert budget.delay_s == pytest.approx(0.009)
        assert budget.left_s == pytest.approx(smallest - 0.009)
        assert not budget.warn
        assert "24.2 ms" in budget.sentence
        assert "9 ms (1 sample at 250 Hz + 5 ms)" in budget.sentence
        assert "15.2 ms left" in budget.sentence

    @pytest.mark.parametrize(("delay_s", "warn"), [(0.0160, False), (0.0163, True), (0.030, True)])
    def test_warns_where_less_than_a_third_is_left(self, delay_s: float, warn: bool) -> None:
        budget = budget_line(delayed(scenario_of("flapper"), Delay(samples=0, seconds=delay_s)), "lockstep")
        assert budget.warn == warn
        assert ("fwav-hil margin" in budget.sentence) == warn
        assert ("less than a third" in budget.sentence) == (warn and delay_s < 0.024)
        assert ("too much: unstable" in budget.sentence) == (delay_s > 0.0242)

    def test_of_a_scenario_without_delay(self) -> None:
        budget = budget_line(scenario_of("paper"))
        assert (budget.delay_s, budget.left_s) == (0.0, budget.max_delay_s)
        assert "this link has no delay, 5.84 ms left" in budget.sentence

    def test_in_real_time_the_link_is_the_delay(self) -> None:
        budget = budget_line(scenario_of("flapper"), "realtime")
        assert budget.delay_s == pytest.approx(0.004)
        assert "an answer in time takes up to one period" in budget.sentence

    def test_of_gains_that_are_unstable_without_delay(self) -> None:
        budget = budget_line(with_gain_ratio(scenario_of("flapper"), 40.0), "lockstep")
        assert (budget.max_delay_s, budget.warn) == (0.0, True)
        assert "unstable even without delay" in budget.sentence

    def test_of_a_loop_without_a_limit(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("fwav_hil.studies.margin.largest_delay", lambda *_: None)
        budget = budget_line(scenario_of("flapper"), "lockstep")
        assert (budget.max_delay_s, budget.left_s, budget.warn) == (None, None, False)
        assert "is stable at any delay" in budget.sentence

    def test_of_the_papers_gains_at_100_hz_is_all_but_used_up(self) -> None:
        budget = budget_line(scenario_of("paper", rate_hz=100.0), "lockstep")
        assert budget.max_delay_s is not None
        assert 0.0 < budget.max_delay_s < 0.0005
        assert budget_line(scenario_of("paper", rate_hz=100.0), "realtime").warn
