"""The paper's tables and claims, and what ours must hold of them."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bridge.command_line import run_command
from controller.laws.reference import reference_trajectory
from fwav_hil.cli import cli
from fwav_hil.simulate import Simulation, simulate
from fwav_hil.studies.lyapunov import lyapunov
from fwav_hil.studies.paper import (
    Claim,
    Flight,
    Row,
    conditions,
    conditions_on_the_wire,
    fly_all,
    fly_on_the_wire,
    judge,
    largest_difference,
    paper_cells,
    rows_of,
)
from protocol.messages import AXES
from protocol.scenario import Scenario, replace_gains
from tests.loop import scenario_of


@cache
def flights(name: str) -> tuple[Flight, ...]:
    return tuple(fly_all(scenario_of(name)))


@cache
def claims() -> tuple[Claim, ...]:
    return tuple(judge([row for flight in flights("paper") for row in rows_of(flight)]))


def of(claim: str) -> list[Claim]:
    return [one for one in claims() if one.claim == claim]


def test_ude_is_below_pd_in_all_cells() -> None:
    assert len(of("UDE < PD")) == 12
    assert all(one.ours for one in of("UDE < PD"))


def test_ude_is_below_dob_in_all_attitude_cells() -> None:
    attitude = [one for one in of("UDE < DOB") if one.channel in AXES[3:]]
    assert len(attitude) == 6
    assert all(one.ours for one in attitude)


def test_the_papers_own_numbers_do_not_hold_all_of_its_claims() -> None:
    assert sum(not one.paper for one in of("UDE < DOB")) == 5  # the DOB wins five position cells of Table II
    assert all(one.paper for one in claims() if one.claim != "UDE < DOB")


def test_each_condition_of_the_paper_has_its_cells() -> None:
    ours = {(c.table, c.name) for c in conditions(scenario_of("paper")) if c.table != "-"}
    assert ours == {(table, name) for table, name, _ in paper_cells()}
    assert len(paper_cells()) == len(ours) * len(AXES)


def test_judging_compares_the_smaller_with_the_larger() -> None:
    names = {(c.table, c.name) for c in conditions(scenario_of("paper"))}
    # The UDE's cells are the smallest in ours and the largest in the paper's; every other cell is equal.
    rows = [
        Row("s", table, name, axis, *((1.0, 1.0, 3.0, 3.0) if name == "UDE" else (2.0, 2.0, 2.0, 2.0)))
        for table, name in names
        for axis in AXES
    ]
    for claim in judge(rows):
        assert claim.ours == claim.claim.startswith("UDE")
        assert not claim.paper


def test_a_dob_with_equal_gains_and_feed_forward_is_the_ude() -> None:
    by_name = {flight.condition.name: flight for flight in flights("paper")}
    ude, dob = by_name["UDE"].result.q, by_name["DOB_equal_gains_feed_forward"].result.q
    # K Lambda / b, made a gain and multiplied by b again, may round: the motions agree to float32 on the wire.
    assert np.abs(ude - dob).max() < 1e-7


def test_the_bound_is_taken_from_the_run() -> None:
    flight = flights("paper")[2]
    bound = lyapunov(flight.scenario, flight.result)
    assert bound.v1.shape == bound.bound.shape == flight.result.q.shape
    assert (bound.v1 >= 0.0).all()
    assert np.array_equal(bound.held, bound.v1 <= bound.bound)
    assert (np.diff(bound.bound, axis=0) >= 0.0).all()  # the largest C_1 so far never shrinks


def test_the_bound_of_a_motion_worked_out_by_hand() -> None:
    """q_e = a e^(-t): q_z = (Lambda - 1) q_e, q_z' = -q_z, u~ = (K - 1) q_z."""
    flight = flights("paper")[2]
    scenario = replace_gains(flight.scenario, "ude", Lambda=(3.0,) * 6, K=(5.0,) * 6)
    t = flight.result.t_ns * 1e-9
    decay = 0.01 * np.exp(-t)[:, None] * np.ones(6)
    desired = reference_trajectory(scenario.reference, len(t), scenario.period_ns)
    moved = flight.result._replace(q=desired[:, 0] + decay, q_dot=desired[:, 1] - decay)
    bound = lyapunov(scenario, moved)
    q_z = 2.0 * decay
    assert bound.v1 == pytest.approx(0.5 * q_z**2, abs=1e-12)
    inner = slice(1, -1)  # the gradient is one-sided at the ends
    expected = 0.5 * q_z[0] ** 2 + 0.5 * (4.0 * q_z[0]) ** 2 / 9.0
    assert bound.bound[inner] == pytest.approx(np.broadcast_to(expected, bound.bound[inner].shape), rel=2e-2)


def test_the_comparison_solves_its_equation_for_a_constant_and_is_closer_than_the_bound() -> None:
    """q_e' = -Lambda q_e + c: q_z = c stays, u~ = K c, y -> (K c)^2 / 2 / rho from c^2 / 2."""
    flight = flights("paper")[2]
    scenario = replace_gains(flight.scenario, "ude", Lambda=(3.0,) * 6, K=(5.0,) * 6)
    t = flight.result.t_ns * 1e-9
    error = 0.01 * (1.0 - np.exp(-3.0 * t))[:, None] * np.ones(6)
    rate = 0.03 * np.exp(-3.0 * t)[:, None] * np.ones(6)
    desired = reference_trajectory(scenario.reference, len(t), scenario.period_ns)
    bound = lyapunov(scenario, flight.result._replace(q=desired[:, 0] + error, q_dot=desired[:, 1] + rate))
    start, level, rho = 0.5 * 0.03**2, 0.5 * (5.0 * 0.03) ** 2, 9.0
    expected = level / rho + (start - level / rho) * np.exp(-rho * t)
    assert bound.comparison == pytest.approx(np.broadcast_to(expected[:, None], error.shape), rel=1e-6)
    assert bound.comparison_held.all()
    assert (bound.comparison <= bound.bound * (1.0 + 1e-9)).all()


def test_conditions_that_are_the_same_are_flown_once() -> None:
    flown: list[Scenario] = []

    def fly(scenario: Scenario) -> Simulation:
        flown.append(scenario)
        return simulate(scenario)

    base = scenario_of("paper", duration_s=0.01)
    assert len(list(fly_all(base, fly=fly))) == len(conditions(base))
    assert len(flown) == len(conditions(base)) - 2  # the UDE stands in all three tables


@pytest.mark.processes
@pytest.mark.timeout(150)
def test_the_tables_of_the_wire_agree_with_those_in_process() -> None:
    base = scenario_of("paper", duration_s=0.5)
    flown = conditions_on_the_wire(base)
    assert [c.law for c in conditions(base) if c not in flown] == ["ude_state"]
    some = [condition for condition in flown if condition.name in ("PD", "UDE")]
    wire = [row for flight in fly_all(base, fly=fly_on_the_wire, flown=some) for row in rows_of(flight)]
    here = [row for flight in fly_all(base) for row in rows_of(flight)]
    assert len(wire) == 12
    assert largest_difference(wire, here) < 1e-9


def test_the_largest_difference_is_that_of_the_worst_cell_both_have() -> None:
    rows = [Row("s", "II", name, "x", 2.0, 4.0, None, None) for name in ("PD", "UDE")]
    others = [Row("s", "II", "PD", "x", 2.0, 5.0, None, None), Row("s", "II", "DOB", "x", 9.0, 9.0, None, None)]
    assert largest_difference(rows, rows) == 0.0
    assert largest_difference(rows, others) == pytest.approx(0.2)


def test_the_command_writes_page_tables_and_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fwav_hil.studies.paper_command.SCENARIOS", ("paper",))
    monkeypatch.setattr("fwav_hil.studies.paper.fly_on_the_wire", simulate)
    out = tmp_path / "study"
    assert (
        run_command(cli, "fwav-hil", ["paper", "--wire", "--out", str(out), "--json", str(tmp_path / "all.json")]) == 0
    )
    said = capsys.readouterr().out
    assert "UDE < PD" in said
    assert "largest difference of any cell 0 " in said
    result = json.loads((tmp_path / "all.json").read_text())
    assert set(result["rows"][0]) == set(Row.__struct_fields__)
    assert {"claim", "channel", "paper", "ours"} <= set(result["claims"][0])
    page = (out / "paper.md").read_text()
    for number in range(3, 9):
        assert f"images/paper_figure_{number}.png" in page
        assert (out / f"images/paper_figure_{number}.svg").exists()
    assert len((out / "tables.csv").read_text().splitlines()) == 1 + len(result["rows"])
