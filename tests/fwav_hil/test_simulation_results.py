"""Results of in-process simulations: the spread over seeds against flights made one by one, and summaries like a run's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from controller.laws.reference import reference_trajectory
from fwav_hil import simulation_results as simulated
from fwav_hil.simulate import Simulation, simulate
from fwav_hil.simulation_results import ground_truth, simulate_run, simulate_spread
from plant_emulator.plant.truth import ROW, load_truth
from protocol.errors import DivergenceError, RunFolderError
from protocol.messages import AXES, FloatArray
from protocol.scenario import Delay, Scenario, find_scenario, load_scenario

FLAPPER = load_scenario(find_scenario("flapper"))
STABLE_KEYS = {
    *("scenario", "law", "clock", "rate_hz", "seed", "duration_s", "ticks", "ticks_per_s", "rmse", "mae"),
    *("latency_us", "counters", "files"),
}


def replaced(scenario: Scenario, **changes: Any) -> Scenario:
    copy: Scenario = msgspec.structs.replace(scenario, **changes)
    return copy


SHORT = replaced(FLAPPER, duration_s=0.5)
DIVERGING = replaced(FLAPPER, delay=Delay(samples=1, seconds=0.06))


def rmse(scenario: Scenario, run: Simulation, from_s: float = 0.0) -> FloatArray:
    desired = reference_trajectory(scenario.reference, len(run.q), scenario.period_ns)[:, 0]
    error = (run.q - desired)[round(from_s * scenario.rate_hz) :]
    result: FloatArray = np.sqrt(np.mean(np.square(error), axis=0))
    return result


def by_axis(values: FloatArray) -> Any:
    return pytest.approx(dict(zip(AXES, values.tolist(), strict=True)), rel=1e-9)


class TestSpread:
    @pytest.mark.parametrize("count", [3, 4])
    def test_median_and_worst_are_those_of_flights_made_one_by_one(self, count: int) -> None:
        scenario = replaced(FLAPPER, duration_s=2.4, seed=10)
        flights = [(one, simulate(one)) for one in (replaced(scenario, seed=10 + k) for k in range(count))]
        spread = simulate_spread(scenario, count)
        assert (spread["first_seed"], spread["seeds"]) == (10, count)
        for name, from_s in (("rmse", 0.0), ("rmse_settled", 2.0)):
            ordered = np.sort([rmse(one, flight, from_s) for one, flight in flights], axis=0)
            assert np.all(ordered[0] < ordered[-1]), "seeds that make a difference"
            middle = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
            assert spread[f"{name}_median"] == by_axis(middle)
            assert spread[f"{name}_worst"] == by_axis(ordered[-1])

    def test_one_seed_is_its_own_median_and_worst(self) -> None:
        spread = simulate_spread(SHORT, 1)
        assert spread["rmse_median"] == spread["rmse_worst"] == by_axis(rmse(SHORT, simulate(SHORT)))

    def test_it_says_what_was_flown(self) -> None:
        spread = simulate_spread(replaced(SHORT, law="pd", rate_hz=500.0), 1)
        expected = {"scenario": "flapper", "law": "pd", "rate_hz": 500.0, "duration_s": 0.5, "clock": "simulated"}
        assert {key: spread[key] for key in expected} == expected

    def test_a_short_flight_has_no_settled_part(self) -> None:
        spread = simulate_spread(SHORT, 2)
        assert spread["rmse_settled_median"] is spread["rmse_settled_worst"] is None

    def test_a_divergence_names_the_seed(self) -> None:
        with pytest.raises(DivergenceError, match=r"^seed 5: the flight diverged at t = "):
            simulate_spread(replaced(DIVERGING, seed=5), 2)

    def test_and_that_one_only(self, monkeypatch: pytest.MonkeyPatch) -> None:
        flown = []

        def diverge_at_7(scenario: Scenario) -> Simulation:
            flown.append(scenario.seed)
            return simulate(scenario)._replace(divergence="it fell" if scenario.seed == 7 else None)

        monkeypatch.setattr(simulated, "simulate", diverge_at_7)
        with pytest.raises(DivergenceError, match=r"^seed 7: it fell$"):
            simulate_spread(replaced(SHORT, seed=5), 5)
        assert flown == [5, 6, 7]


class TestSummary:
    def test_the_keys_are_those_of_a_run(self) -> None:
        summary = simulate_run(SHORT, None)
        assert set(summary) >= STABLE_KEYS
        assert set(summary["latency_us"]) == {"p50", "p99", "p999", "max"}
        assert set(summary["counters"]) >= {"missed", "late", "dropped", "refused"}
        expected = {
            **{"scenario": "flapper", "law": "ude", "clock": "simulated", "rate_hz": 250.0, "seed": FLAPPER.seed},
            **{"duration_s": 0.5, "ticks": 125, "error": None, "files": {}},
        }
        assert {key: summary[key] for key in expected} == expected
        assert summary["ticks_per_s"] > 0.0

    def test_the_scores_are_the_flights(self) -> None:
        scenario = replaced(FLAPPER, duration_s=2.4)
        summary, flight = simulate_run(scenario, None), simulate(scenario)
        assert summary["rmse"] == by_axis(rmse(scenario, flight))
        assert summary["rmse_settled"] == by_axis(rmse(scenario, flight, 2.0))
        assert summary["counters"]["controller"] == flight.law_counts

    def test_without_a_folder_nothing_is_written(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        simulate_run(SHORT, None)
        assert not list(tmp_path.iterdir())

    def test_into_a_folder_go_ground_truth_and_summary(self, tmp_path: Path) -> None:
        summary = simulate_run(SHORT, tmp_path)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["ground_truth.npy", "summary.json"]
        assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8")) == summary
        assert load_truth(tmp_path / "ground_truth.npy").tobytes() == ground_truth(simulate(SHORT)).tobytes()
        assert Path(summary["files"]["ground_truth"]) == tmp_path / "ground_truth.npy"

    def test_a_folder_that_cannot_be_written_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(RunFolderError, match=r"cannot write to .*nowhere: No such file"):
            simulate_run(SHORT, tmp_path / "nowhere")

    def test_a_divergence_is_told_and_what_was_flown_is_kept(self, tmp_path: Path) -> None:
        summary, flight = simulate_run(DIVERGING, tmp_path), simulate(DIVERGING)
        assert summary["error"] == flight.divergence
        assert flight.divergence is not None
        assert summary["ticks"] == len(flight.t_ns) == len(load_truth(tmp_path / "ground_truth.npy"))


def test_ground_truth_has_the_rows_that_an_emulator_writes() -> None:
    flight = simulate(SHORT)
    rows = ground_truth(flight)
    assert rows.dtype == ROW
    for name in ("t_ns", "q", "q_dot", "command", "tau", "u"):
        assert rows[name].tobytes() == np.ascontiguousarray(getattr(flight, name)).tobytes()
