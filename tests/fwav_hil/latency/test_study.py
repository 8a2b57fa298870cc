"""What a study makes of a run: losses from counters, the two predictions from recorded delays, probes beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from bridge.latency.probes import ProbeResult
from bridge.process import StopFlag
from bridge.timing.timesync import Estimate
from fwav_hil.latency import study
from fwav_hil.latency.analysis import LEGS, Legs, legs_of
from fwav_hil.latency.study import beside, leg_report, losses, prediction, report_of, summary_of, write_files
from fwav_hil.score import scores
from fwav_hil.simulate import Simulation, simulate
from protocol.scenario import Delay, Scenario
from tests.fwav_hil.latency.rows import AGE_NS, DURATIONS_NS, stamps
from tests.loop import scenario_of

SCENARIO = scenario_of("flapper", duration_s=0.8)
PERIOD_NS, TICKS = SCENARIO.period_ns, SCENARIO.ticks
MS = 1_000_000


def legs_with(delay_ns: npt.NDArray[np.int64], ticks: npt.NDArray[np.int64] | None = None) -> Legs:
    """Legs of a run whose commands acted with these delays."""
    numbers = np.arange(len(delay_ns)) if ticks is None else ticks
    nothing = {name: np.full(len(delay_ns), -1, dtype=np.int64) for name in LEGS}
    return Legs(numbers * PERIOD_NS, nothing, delay_ns, None, 0)


def delayed(seconds: float, scenario: Scenario = SCENARIO) -> Scenario:
    copy: Scenario = msgspec.structs.replace(scenario, delay=Delay(samples=0, seconds=seconds))
    return copy


def rmse(run: Simulation) -> dict[str, float | None]:
    found: dict[str, float | None] = scores(SCENARIO, run.t_ns, run.q)["rmse"]
    return found


FLOWN = {"ticks": TICKS, "rmse": {"x": 1.0}}


class TestPrediction:
    def test_with_one_delay_both_predictions_are_the_simulation_with_it(self) -> None:
        found = prediction(SCENARIO, legs_with(np.full(TICKS, 5 * MS)), FLOWN)
        assert found is not None
        expected = rmse(simulate(delayed(0.005)))
        assert found["delay_s"] == 0.005
        assert found["rmse_constant"] == found["rmse_recorded"] == expected
        assert found["rmse_run"] == {"x": 1.0}

    def test_the_scenarios_own_delay_is_no_part_of_it(self) -> None:
        assert SCENARIO.delay_ns > 0
        found = prediction(SCENARIO, legs_with(np.zeros(TICKS, dtype=np.int64)), FLOWN)
        assert found is not None
        assert found["rmse_constant"] == rmse(simulate(delayed(0.0)))

    def test_each_delay_counts_in_the_second_and_their_median_in_the_first(self) -> None:
        delay_ns = np.where(np.arange(TICKS) % 3 == 0, 11 * MS, 2 * MS)
        found = prediction(SCENARIO, legs_with(delay_ns), FLOWN)
        assert found is not None
        assert found["delay_s"] == 0.002
        assert found["rmse_constant"] == rmse(simulate(delayed(0.002)))
        assert found["rmse_recorded"] == rmse(simulate(SCENARIO, delays_ns=delay_ns))
        assert found["rmse_recorded"] != found["rmse_constant"]

    def test_a_command_that_never_came_never_acts(self) -> None:
        answered = np.setdiff1d(np.arange(TICKS), [20, 21, 22, 60])
        found = prediction(SCENARIO, legs_with(np.full(len(answered), 2 * MS), answered), FLOWN)
        delays_ns = np.full(TICKS, 2 * MS)
        delays_ns[[20, 21, 22, 60]] = -1
        assert found is not None
        assert found["rmse_recorded"] == rmse(simulate(SCENARIO, delays_ns=delays_ns))

    def test_a_run_that_ended_early_is_compared_with_as_much_of_a_simulation(self) -> None:
        found = prediction(SCENARIO, legs_with(np.full(TICKS, 5 * MS)), {"ticks": 100, "rmse": {}})
        run = simulate(delayed(0.005))
        assert found is not None
        assert found["rmse_constant"] == scores(SCENARIO, run.t_ns[:100], run.q[:100])["rmse"]

    def test_what_diverges_has_no_error_to_tell(self) -> None:
        found = prediction(SCENARIO, legs_with(np.full(TICKS, 90 * MS)), FLOWN)
        assert found is not None
        assert found["rmse_constant"] is found["rmse_recorded"] is None

    @pytest.mark.parametrize("summary", [FLOWN, {"ticks": 0, "rmse": {}}, {}])
    def test_without_an_answer_there_is_nothing_to_predict(self, summary: dict[str, Any]) -> None:
        count = 0 if summary is FLOWN else 5
        assert prediction(SCENARIO, legs_with(np.zeros(count, dtype=np.int64)), summary) is None

    def test_rows_of_another_run_do_not_count(self) -> None:
        legs = legs_with(np.full(TICKS + 2, 5 * MS))
        legs.t_ns[-2:] = 1, 10**15  # between two ticks; long after the run
        legs.delay_ns[-2:] = 99 * MS
        found = prediction(SCENARIO, legs, FLOWN)
        assert found is not None
        assert found["delay_s"] == 0.005
        assert found["rmse_recorded"] == rmse(simulate(SCENARIO, delays_ns=np.full(TICKS, 5 * MS)))


class TestLosses:
    def test_they_are_of_both_ends_and_repeats_of_the_controller_are_none(self) -> None:
        emulator = {"sequence_gaps": 2, "repeated": 7, "old_commands": 3, "unanswered": 11, "late": 13, "slipped": 17}
        controller = {"sequence_gaps": 1, "repeated": 5, "out_of_order": 1}
        assert losses({"counters": {"emulator": emulator, "controller": controller}}) == {
            "lost": 3,
            "duplicate": 2,
            "out_of_order": 4,
            "repeated": 5,
            "unanswered_in_period": 11,
            "missed_deadlines": 13,
            "slipped_periods": 17,
        }

    def test_a_repeat_that_got_lost_is_no_negative_duplicate(self) -> None:
        found = losses({"counters": {"emulator": {"repeated": 1}, "controller": {"repeated": 5}}})
        assert found["duplicate"] == 0

    @pytest.mark.parametrize("summary", [{}, {"counters": {}}, {"counters": {"emulator": {}, "controller": {}}}])
    def test_a_summary_without_counters_counts_nothing(self, summary: dict[str, Any]) -> None:
        assert set(losses(summary).values()) == {0}


def synthetic(count: int) -> Legs:
    return joined(count, None)


def joined(count: int, clocks: list[tuple[int, int, int]] | None) -> Legs:
    rows = stamps(count)
    two = None if clocks is None else np.array(clocks, dtype=np.int64).reshape(-1, 3)
    clock = Estimate(3_000, 10_000, 4)
    return legs_of(rows.ticks.rows, rows.answers.rows, rows.samples.rows, clock, clocks=two)


def test_the_report_of_known_stamps() -> None:
    legs = synthetic(101)
    report = report_of(SCENARIO, {**FLOWN, "placement": "here"}, legs)
    for name, duration_ns in DURATIONS_NS.items():
        figures = report["legs_us"][name]
        assert figures["count"] == 101
        assert figures["p50"] == pytest.approx((duration_ns + 50) / 1e3, rel=1e-3)
        assert figures["max"] == (duration_ns + 100) / 1e3
    assert report["legs_us"]["age"]["max"] == (AGE_NS + 7 * 100) / 1e3
    assert report["time_sync"]["held"] is True
    assert report["time_sync"]["error_us"] == 3.0
    assert report["negative_legs"] == 0
    assert (report["scenario"], report["law"], report["placement"]) == ("flapper", "ude", "here")


def test_with_two_clocks_there_is_nothing_to_check_timesync_by() -> None:
    sent_ns = stamps(5).ticks.rows[:, 3].tolist()
    answers = [(sent_ns[0], 3_000, 10_000), (sent_ns[-1], 4_000, 12_000)]
    assert report_of(SCENARIO, FLOWN, joined(5, answers), two_clocks=True)["time_sync"] == {
        "offset_us": 3.0,
        "offset_at_end_us": 4.0,
        "bound_us": pytest.approx(5.0 + 1e-4 * (sent_ns[3] - sent_ns[0]) / 1e3, abs=1e-3),
        "answers": 4,
    }
    assert report_of(SCENARIO, FLOWN, joined(5, []), two_clocks=True)["time_sync"] is None


def test_a_run_without_an_answer_has_a_report_too() -> None:
    report = report_of(SCENARIO, FLOWN, legs_with(np.zeros(0, dtype=np.int64)))
    assert report["prediction"] is None
    assert all(figures["count"] == 0 for figures in report["legs_us"].values())


def test_each_distribution_that_is_not_empty_has_a_file(tmp_path: Path) -> None:
    files = write_files(tmp_path, {"age": np.array([1, 2]), "wake": np.zeros(0, dtype=np.int64)})
    assert files == {"age_hgrm": str(tmp_path / "latency_age.hgrm")}
    assert (tmp_path / "latency_age.hgrm").exists()
    assert not (tmp_path / "latency_wake.hgrm").exists()


def test_leg_report_names_every_leg() -> None:
    assert list(leg_report(synthetic(3))) == list(LEGS)


def test_the_counters_of_the_other_machine_are_taken_from_its_folder(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (tmp_path / "summary.json").write_text(json.dumps({"counters": {"emulator": {"late": 1}, "controller": {}}}))
    (other / "controller.json").write_text(json.dumps({"counters": {"repeated": 4}}))
    assert summary_of(tmp_path)["counters"]["controller"] == {}
    assert summary_of(tmp_path, other)["counters"] == {"emulator": {"late": 1}, "controller": {"repeated": 4}}


class TestBeside:
    @pytest.fixture(autouse=True)
    def probes(self, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        """Peers that cost no time: every answer after 50 us, from when it was due after 70."""
        asked: list[str] = []

        def stand_in(name: str) -> Any:
            def ask(_stop: StopFlag, *, rate_hz: float, count: int, told: Any) -> ProbeResult:
                asked.append(name)
                told(count)
                from_due = np.full(count, 70_000)
                from_due[0] = -1
                return ProbeResult(from_due, np.where(from_due < 0, -1, 50_000), 2, 3, 4)

            return ask

        for name in ("probe_responder", "probe_echo", "probe_mavutil"):
            monkeypatch.setattr(study, name, stand_in(name))
        return asked

    def test_alone_there_is_only_our_own_responder(self, probes: list[str]) -> None:
        told: list[tuple[str, float]] = []
        found = beside(500.0, 5.0, StopFlag(), lambda name, share: told.append((name, share)), against=False)
        assert probes == ["probe_responder"]
        assert told == [("open_loop", 1.0)]
        assert list(found) == ["open_loop"]
        assert found["open_loop"]["from_due"]["p50"] == pytest.approx(70.0, rel=1e-3)
        assert found["open_loop"]["from_sent"]["count"] == 2499
        counts = {name: found["open_loop"][name] for name in ("lost", "duplicate", "out_of_order", "unknown")}
        assert counts == {"lost": 1, "duplicate": 2, "out_of_order": 3, "unknown": 4}

    @pytest.mark.parametrize("lateness", [None, np.array([1000, 3000])])
    def test_against_others_all_are_asked(
        self, lateness: npt.NDArray[np.int64] | None, probes: list[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(study, "cyclictest", lambda _stop, **_: lateness)
        found = beside(500.0, 5.0, StopFlag(), lambda _name, _share: None, against=True)
        assert probes == ["probe_responder", "probe_echo", "probe_mavutil"]
        assert list(found) == ["open_loop", "bare_echo", "mavutil", "cyclictest"]
        if lateness is None:
            assert "apt-get install rt-tests" in found["cyclictest"]["note"]
        else:
            assert found["cyclictest"]["wake"]["max"] == 3.0
