"""The search for gains: its constraints, what it minimises, its result as a file, and the command."""

from __future__ import annotations

import json
import multiprocessing
import shutil
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

from bridge.command_line import run_command
from bridge.process import StopFlag
from fwav_hil.cli import cli
from fwav_hil.score import scores
from fwav_hil.simulate import simulate
from fwav_hil.studies import design, design_result
from fwav_hil.studies.design import (
    _INFEASIBLE,
    _LOST,
    Found,
    Map,
    Task,
    at_twice_the_delay,
    bounds,
    compare,
    cost,
    flown_error,
    gain_of,
    gains_of,
    search,
    shortfall,
    with_gains,
)
from fwav_hil.studies.design_pool import mapping
from fwav_hil.studies.design_result import Design, judge_design, scenario_text, with_delay
from fwav_hil.studies.margin import linear_margins, with_gain_ratio
from protocol.errors import Interrupted, UsageError
from protocol.messages import AXES, FloatArray
from protocol.scenario import Scenario, find_scenario, load_scenario
from tests.loop import scenario_of

NAMES = ("K", "Lambda", "T", "N")
HAND_TUNED = np.log([40.0, 2.0, 0.05, 200.0])
BETTER = np.log([16.5, 27.0, 0.155, 1700.0])


def attitude_task(*, flights: int = 1, own: tuple[tuple[float, ...], ...] | None = None) -> Task:
    return Task(scenario_of("flapper"), "attitude", (3, 4, 5), NAMES, tuple(range(1, 1 + flights)), own)


class TestConstraints:
    def test_the_hand_tuned_gains_keep_them(self) -> None:
        assert shortfall(scenario_of("flapper"), range(6)) == 0.0

    @pytest.mark.parametrize(("slack", "kept"), [(1.02, True), (0.98, False)])
    @pytest.mark.parametrize("way", ["up", "down"])
    def test_the_gain_margin_is_one(self, way: str, slack: float, kept: bool) -> None:
        """Gears scaled until that margin, by the figures of `fwav-hil margin`, is a little above or below 2."""
        scenario = scenario_of("flapper")
        margin = linear_margins(scenario)["alpha"]
        assert margin.gain_margin_up is not None
        assert margin.gain_margin_down is not None
        ratio = margin.gain_margin_up / (2.0 * slack) if way == "up" else 2.0 * slack / margin.gain_margin_down
        assert (shortfall(with_gain_ratio(scenario, ratio), (3, 4)) == 0.0) == kept

    @pytest.mark.parametrize(("slack", "kept"), [(1.02, True), (0.98, False)])
    def test_the_largest_delay_is_one(self, slack: float, kept: bool) -> None:
        scenario = with_gain_ratio(scenario_of("flapper"), 0.7)
        most = linear_margins(scenario)["x"].max_delay_s
        assert most is not None
        slower = with_delay(scenario, most / (2.0 * slack))
        assert (linear_margins(slower)["x"].gain_margin or 0.0) > 2.0  # so it is not that one that decides
        assert (shortfall(slower, (0,)) == 0.0) == kept

    def test_twice_the_delay_is_all_of_it_twice(self) -> None:
        assert at_twice_the_delay(scenario_of("flapper")).delay_ns == 18_000_000


class TestCost:
    def test_is_the_mean_log_rmse_of_the_groups_axes(self) -> None:
        scenario = scenario_of("flapper")
        flown = simulate(scenario)
        score = scores(scenario, flown.t_ns, flown.q)
        expected = np.mean([np.log(score[m][axis]) for m in ("rmse", "rmse_settled") for axis in AXES[3:]])
        assert cost(attitude_task(), HAND_TUNED) == pytest.approx(expected)

    def test_what_lacks_the_margins_is_worse_than_what_is_lost_and_both_than_what_flies(self) -> None:
        task = attitude_task()
        too_fast = cost(task, np.log([150.0, 2.0, 0.05, 200.0]))
        much_too_fast = cost(task, np.log([300.0, 2.0, 0.05, 200.0]))
        assert cost(task, HAND_TUNED) < _LOST < _INFEASIBLE < too_fast < much_too_fast

    def test_lost_flights_cost_what_they_should(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("fwav_hil.studies.design.flown_error", lambda *_: (None, "it fell"))
        assert cost(attitude_task(), HAND_TUNED) == _LOST

    def test_a_cell_worse_than_the_scenarios_own_is_punished(self) -> None:
        found, _ = flown_error(scenario_of("flapper"), (1,))
        assert found is not None
        own = found[:, 3:]
        free = cost(attitude_task(), HAND_TUNED)
        same = cost(attitude_task(own=tuple(map(tuple, own.tolist()))), HAND_TUNED)
        worse = cost(attitude_task(own=tuple(map(tuple, (own - 0.1).tolist()))), HAND_TUNED)
        easy = cost(attitude_task(own=tuple(map(tuple, (own + 1.0).tolist()))), HAND_TUNED)
        assert free == easy < same < worse

    def test_better_gains_cost_less(self) -> None:
        assert cost(attitude_task(), BETTER) < cost(attitude_task(), HAND_TUNED) - 0.1


def candidates_instead_of_flights(best: FloatArray) -> Callable[[Task], Map]:
    """A map whose cost is the distance to `best`, without a flight."""

    def of(_: Task) -> Map:
        def run(_: Callable[[FloatArray], float], candidates: Iterable[FloatArray]) -> list[float]:
            return [float(np.abs(x - best).sum()) for x in candidates]

        return run

    return of


class TestSearch:
    def test_finds_what_costs_least_and_the_same_for_the_same_seed(self) -> None:
        scenario = scenario_of("flapper")
        heard: list[str] = []
        runs = [
            search(
                scenario, seed=seed, flights=1, generations=25, mapping=candidates_instead_of_flights(BETTER),
                progress=lambda group, _: heard.append(group),
            )
            for seed in (3, 3, 4)
        ]  # fmt: skip
        assert runs[0].scenario == runs[1].scenario
        assert runs[0].scenario != runs[2].scenario
        found = runs[0].scenario
        assert np.log([gain_of(found, name)[4] for name in NAMES]) == pytest.approx(BETTER, abs=0.7)
        assert heard[0] == "attitude"
        assert heard[-1] == "position"
        # Everything that is not searched for stays.
        assert found.gains["pd"] == scenario.gains["pd"]
        assert found.gains["filters"]["order"] == scenario.gains["filters"]["order"]
        assert msgspec.structs.replace(found, gains=scenario.gains) == scenario

    def test_never_loses_the_gains_it_began_with(self) -> None:
        """At the cost of nothing but its own gains the first generation keeps them, to three digits."""
        found = search(
            scenario_of("flapper"), seed=1, flights=1, generations=1, mapping=candidates_instead_of_flights(HAND_TUNED)
        )
        assert gain_of(found.scenario, "K")[3] == 40.0

    def test_says_so_where_there_are_no_such_gains(self) -> None:
        def hopeless(_: Task) -> Map:
            return lambda _, candidates: [_INFEASIBLE for _ in candidates]

        with pytest.raises(UsageError, match="no gains of attitude were found with a gain margin of 2 both ways"):
            search(scenario_of("flapper"), seed=1, flights=1, generations=1, mapping=hopeless)

    def test_a_law_without_these_gains_is_refused(self) -> None:
        with pytest.raises(UsageError, match="the law 'pd' does not have"):
            gains_of(scenario_of("flapper", law="pd"))
        assert gains_of(scenario_of("flapper", law="uncompensated")) == ("K", "Lambda", "N")

    def test_a_flight_too_short_to_judge_is_refused(self) -> None:
        with pytest.raises(UsageError, match="duration_s 3 is too short"):
            search(
                scenario_of("flapper", duration_s=3.0), seed=1, flights=1, generations=1,
                mapping=candidates_instead_of_flights(BETTER),
            )  # fmt: skip

    def test_bounds_hold_the_hand_tuned_gains_and_follow_the_link(self) -> None:
        limits = bounds(scenario_of("flapper"), NAMES)
        assert all(low < value < high for (low, high), value in zip(limits, HAND_TUNED, strict=True))
        slower = bounds(with_delay(scenario_of("flapper"), 0.030), NAMES)
        assert slower[0][1] < limits[0][1]  # K
        assert slower[2][1] > limits[2][1]  # T

    def test_gains_go_to_their_axes_only(self) -> None:
        changed = with_gains(scenario_of("flapper"), (0, 1, 2), ("K",), (7.0,))
        assert gain_of(changed, "K") == (7.0, 7.0, 7.0, 40.0, 40.0, 40.0)


def test_a_stop_is_heard_between_candidates() -> None:
    stop = StopFlag()
    stop.requested = True
    with mapping(1, stop) as candidates, pytest.raises(Interrupted):
        list(candidates(attitude_task())(lambda _: 0.0, [HAND_TUNED] * 3))


def test_processes_cost_the_same_as_this_one_and_hear_a_stop() -> None:
    task, stop = attitude_task(), StopFlag()
    here = [cost(task, HAND_TUNED), cost(task, BETTER)]  # first: what this compiles the processes need not
    with mapping(2, stop) as candidates:
        assert list(candidates(task)(lambda _: 0.0, [HAND_TUNED, BETTER])) == here
        workers = multiprocessing.active_children()
        assert workers
        stop.requested = True
        with pytest.raises(Interrupted):
            list(candidates(task)(lambda _: 0.0, [HAND_TUNED] * 50))
    assert not any(worker.is_alive() for worker in workers)


@cache
def finished() -> Design:
    start = scenario_of("flapper")
    found = Found(with_gains(start, (3, 4, 5), NAMES, np.exp(BETTER)), 7)
    return judge_design(start, found, stop=StopFlag(), seed=1, flights=1, generations=1)


class TestResult:
    def test_is_flown_over_seeds_that_no_search_has_seen(self) -> None:
        result = finished()
        assert result.improvement is not None
        assert result.improvement < 0.95
        assert result.improvement_by_axis is not None
        assert max(result.improvement_by_axis["beta"]) < 1.0
        assert result.verdict.verdict == "good"
        seen, _ = compare(result.designed, range(1, 3))
        assert seen != result.after

    @pytest.mark.parametrize("beside", [True, False])
    def test_is_a_scenario_file_that_says_where_its_numbers_come_from(self, beside: bool, tmp_path: Path) -> None:
        result = finished()
        base = tmp_path / ("flapper.toml" if beside else "elsewhere/flapper.toml")
        base.parent.mkdir(exist_ok=True)
        shutil.copy(find_scenario("flapper"), base)
        out = tmp_path / "Faster one.toml"
        out.write_text(scenario_text(result, base, out), encoding="utf-8")
        text = out.read_text()
        assert text.startswith("# K, Lambda, T, N of [gains] are designed")
        assert ("extends = " in text) == beside
        loaded = load_scenario(out)
        assert loaded.name == "flapper_designed"  # the file's name is no scenario's
        assert loaded.gains == result.designed.gains
        expected = msgspec.structs.replace(result.designed, name=loaded.name, description=loaded.description)
        assert loaded == expected

    def test_old_gains_that_do_not_hold_are_named(self) -> None:
        start = with_delay(scenario_of("flapper"), 0.030)
        result = judge_design(start, Found(start, 0), stop=StopFlag(), seed=1, flights=1, generations=1)
        assert result.before.lost
        assert result.improvement is None
        assert result.verdict.verdict == "unusable"

    @pytest.mark.parametrize(("delay_s", "samples", "seconds"), [(0.008, 2, 0.0), (0.009, 0, 0.009), (0.0, 0, 0.0)])
    def test_a_total_delay_is_samples_where_it_is_a_whole_number_of_them(
        self, delay_s: float, samples: int, seconds: float
    ) -> None:
        changed: Scenario = with_delay(scenario_of("flapper"), delay_s)
        assert (changed.delay.samples, changed.delay.seconds) == (samples, seconds)
        assert changed.delay_ns == round(delay_s * 1e9)


class TestCommand:
    def test_writes_a_scenario_that_is_no_worse(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A search of one generation: the start takes part in it, so even that cannot be worse on its own seeds."""
        out, short = tmp_path / "quick.toml", tmp_path / "short.toml"
        short.write_text(scenario_of("flapper", duration_s=4.0).to_toml(), encoding="utf-8")
        monkeypatch.setattr(design_result, "HELD_OUT", 5)
        monkeypatch.setattr(design, "_POPULATION", 2)
        arguments = ["design", str(short), "--out", str(out), "--generations", "1", "--flights", "1", "--workers", "1"]
        assert run_command(cli, "fwav-hil", [*arguments, "--json", "-"]) == 0
        shown = capsys.readouterr()
        result = json.loads(shown.out)
        assert "RMSE with the new gains" in shown.err
        loaded = load_scenario(out)
        assert (loaded.name, loaded.rate_hz, loaded.delay_ns) == ("quick", 250.0, 9_000_000)
        for axis, margin in linear_margins(loaded).items():
            assert (margin.gain_margin or 0.0) >= 2.0, axis
            assert (margin.max_delay_s or 1.0) >= 0.018, axis
        assert set(result["gains"]["position"]) == set(NAMES)
        assert result["gains"]["attitude"]["K"] == gain_of(loaded, "K")[3]
        assert result["improvement"] < 1.02
        assert result["file"] == str(out)

        assert run_command(cli, "fwav-hil", arguments) == 6
        assert "already exists" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("flapper", "--out", "nowhere/x.toml"), 6, "there is no folder nowhere"),
            (("flapper", "--law", "dob", "--out", "x.toml"), 2, "the law 'dob' does not have"),
            (("flapper", "--law", "lqr", "--out", "x.toml"), 2, "the law 'lqr' does not have"),
            (("nowhere", "--out", "x.toml"), 2, "there is no scenario nowhere"),
            (("flapper", "--delay-s", "-1", "--out", "x.toml"), 2, "--delay-s"),
            (("flapper",), 2, "--out"),
        ],
    )
    def test_what_makes_no_sense_is_refused_in_one_line(
        self,
        arguments: tuple[str, ...],
        code: int,
        words: str,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.chdir(tmp_path)
        assert run_command(cli, "fwav-hil", ["design", *arguments]) == code
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
        assert not list(tmp_path.iterdir())
