"""Section IV of the source paper, reproduced: its tables beside ours, its claims checked cell by cell.

Conditions are simulated in process (`fwav_hil.simulate`), at the scenario's rate and duration; errors are in the paper's
units, cm and rad, over the whole run, as in (34) and (35).
"""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import numpy as np

from controller.laws.law import make_law
from controller.laws.ude import UdeGains
from fwav_hil.options import RunOptions
from fwav_hil.run import run
from fwav_hil.run_folder import FILES, new_folder
from fwav_hil.score import scores
from fwav_hil.simulate import Simulation, simulate
from plant_emulator.plant.truth import load_truth
from protocol.messages import AXES
from protocol.scenario import Scenario, replace_gains

PAPER_TABLES = Path(__file__).with_name("paper_tables.csv")
CENTIMETRES = {axis: 100.0 if axis in AXES[:3] else 1.0 for axis in AXES}
MEASURES = ("rmse", "mae")


class Condition(NamedTuple):
    """One column of a table: the paper's table and name for it, the law, and the changes to its tables of gains."""

    table: str
    name: str
    law: str
    gains_table: str = ""
    changed: Mapping[str, Any] = MappingProxyType({})

    def scenario(self, base: Scenario) -> Scenario:
        """The scenario of this condition."""
        scenario: Scenario = msgspec.structs.replace(base, law=self.law)
        return replace_gains(scenario, self.gains_table, **self.changed) if self.changed else scenario


def conditions(base: Scenario) -> tuple[Condition, ...]:
    """Every column of tables II, III and IV, and two of our own (table "-") for which the paper has no numbers."""
    gains = base.read_gains("ude", UdeGains)
    products = tuple(k * lam / b for k, lam, b in zip(gains.K, gains.Lambda, base.control.b, strict=True))
    sums = tuple((k + lam) / b for k, lam, b in zip(gains.K, gains.Lambda, base.control.b, strict=True))
    return (
        Condition("II", "PD", "pd"),
        Condition("II", "DOB", "dob"),
        Condition("II", "UDE", "ude"),
        Condition("III", "with_compensation", "ude"),
        Condition("III", "without_compensation", "uncompensated"),
        Condition("IV", "T=0.01", "ude", "filters", {"T": (0.01,) * 6}),
        Condition("IV", "T=0.1", "ude", "filters", {"T": (0.1,) * 6}),
        Condition("IV", "T=1", "ude", "filters", {"T": (1.0,) * 6}),
        Condition("-", "DOB_equal_gains_feed_forward", "dob_ff", "pd", {"Kp": products, "Kd": sums}),
        Condition("-", "UDE_state_feedback", "ude_state"),
    )


class Row(msgspec.Struct, frozen=True):
    """One cell pair: our RMSE and MAE of a channel under a condition, and the paper's (None where it has none)."""

    scenario: str
    table: str
    condition: str
    channel: str
    rmse: float
    mae: float
    paper_rmse: float | None
    paper_mae: float | None


class Claim(msgspec.Struct, frozen=True):
    """An ordering that the paper states, for one channel and measure: whether its own numbers hold it, and ours."""

    scenario: str
    claim: str
    channel: str
    measure: str
    paper: bool
    ours: bool


class Flight(NamedTuple):
    """A condition and its flight."""

    condition: Condition
    scenario: Scenario
    result: Simulation


def fly_all(
    base: Scenario,
    progress: Callable[[str], None] = lambda _name: None,
    fly: Callable[[Scenario], Simulation] = simulate,
    flown: Sequence[Condition] | None = None,
) -> Iterator[Flight]:
    """Fly the conditions of a scenario (by default all) by `fly`; identical conditions are flown once.

    `progress` is called with the name of each before it starts.
    """
    results: list[tuple[Scenario, Simulation]] = []
    for condition in conditions(base) if flown is None else flown:
        progress(f"{base.name}: {condition.name}")
        scenario = condition.scenario(base)
        result = next((result for known, result in results if known == scenario), None)
        if result is None:
            result = fly(scenario)
            results.append((scenario, result))
        yield Flight(condition, scenario, result)


def conditions_on_the_wire(base: Scenario) -> list[Condition]:
    """The conditions that can be flown over a link: all except state feedback."""
    return [c for c in conditions(base) if not make_law(c.law, c.scenario(base)).needs_velocity]


def fly_on_the_wire(scenario: Scenario) -> Simulation:
    """Fly a scenario as two processes in lockstep; the recording is then deleted. Raises what `run` raises."""
    with tempfile.TemporaryDirectory(prefix="fwav-hil-") as temporary:
        folder = new_folder(scenario, Path(temporary) / "run")
        summary = run(scenario, folder, RunOptions(link="udpin://127.0.0.1:0", show_progress=False))
        rows = load_truth(folder / FILES["ground_truth"])
    columns = {name: np.array(rows[name]) for name in ("t_ns", "q", "q_dot", "command", "tau", "u")}
    return Simulation(**columns, law_counts=summary["counters"]["controller"], divergence=None)


def largest_difference(rows: Iterable[Row], others: Iterable[Row]) -> float:
    """The largest difference of any cell, as a fraction of the larger one, among the cells that both have."""
    known = {(row.scenario, row.table, row.condition, row.channel): row for row in others}
    largest = 0.0
    for row in rows:
        other = known.get((row.scenario, row.table, row.condition, row.channel))
        for measure in MEASURES if other else ():
            one, two = getattr(row, measure), getattr(other, measure)
            if one != two:
                largest = max(largest, abs(one - two) / max(one, two))
    return largest


def paper_cells() -> dict[tuple[str, str, str], tuple[float, float]]:
    """(table, condition, channel) -> (RMSE, MAE) as printed in the paper."""
    with PAPER_TABLES.open(encoding="utf-8", newline="") as file:
        return {
            (cell["table"], cell["condition"], cell["channel"]): (float(cell["rmse"]), float(cell["mae"]))
            for cell in csv.DictReader(file)
        }


def rows_of(flight: Flight) -> list[Row]:
    """The cells of a flight, in the paper's units."""
    printed = paper_cells()
    score = scores(flight.scenario, flight.result.t_ns, flight.result.q)
    rows = []
    for axis in AXES:
        paper_rmse, paper_mae = printed.get((flight.condition.table, flight.condition.name, axis), (None, None))
        rmse, mae = (CENTIMETRES[axis] * score[measure][axis] for measure in MEASURES)
        rows.append(
            Row(
                flight.scenario.name,
                flight.condition.table,
                flight.condition.name,
                axis,
                rmse,
                mae,
                paper_rmse,
                paper_mae,
            )
        )
    return rows


ORDERINGS = (
    ("UDE < PD", "II", "UDE", "PD"),
    ("UDE < DOB", "II", "UDE", "DOB"),
    ("DOB < PD", "II", "DOB", "PD"),
    ("with < without compensation", "III", "with_compensation", "without_compensation"),
    ("T = 0.01 < T = 0.1", "IV", "T=0.01", "T=0.1"),
    ("T = 0.1 < T = 1", "IV", "T=0.1", "T=1"),
)
"""What the text of section IV claims about its tables: (claim, table, the smaller, the larger)."""


def judge(rows: list[Row]) -> list[Claim]:
    """Each ordering of the paper, channel by channel, on the paper's numbers and on ours."""
    cells = {(row.scenario, row.table, row.condition, row.channel): row for row in rows}
    claims = []
    for scenario in dict.fromkeys(row.scenario for row in rows):
        for claim, table, smaller, larger in ORDERINGS:
            for channel in AXES:
                low, high = cells[scenario, table, smaller, channel], cells[scenario, table, larger, channel]
                for measure in MEASURES:
                    printed = getattr(low, f"paper_{measure}"), getattr(high, f"paper_{measure}")
                    ours = getattr(low, measure) < getattr(high, measure)
                    claims.append(Claim(scenario, claim, channel, measure, printed[0] < printed[1], ours))
    return claims
