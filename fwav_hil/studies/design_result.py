"""The result of a design: compared over seeds not used in the search, judged, as a scenario file, a table and JSON."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w
from rich.table import Table

from bridge.process import StopFlag
from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.studies.design import (
    GROUPS,
    TABLES,
    Comparison,
    Found,
    at_twice_the_delay,
    compare,
    flown_error,
    gain_of,
    gains_of,
)
from fwav_hil.studies.margin import ChannelMargin, Verdict, judge, linear_margins
from fwav_hil.tables import plain_console, show_error
from protocol.messages import AXES
from protocol.scenario import NANOSECONDS, Delay, Scenario

HELD_OUT = 20
_FAR = 100_000
"""Offset of the comparison's seeds from the scenario's, beyond any seed that a search flies."""


class Design(msgspec.Struct, frozen=True, kw_only=True):
    """A finished design; `improvement`: RMSE with the new gains over that with the old, mean in the logarithm; None: no old.

    improvement_by_axis: the same for each axis, over the whole flight and from 2 s on.
    """

    start: Scenario
    designed: Scenario
    margins: dict[str, ChannelMargin]
    start_margins: dict[str, ChannelMargin]
    verdict: Verdict
    before: Comparison
    after: Comparison
    improvement: float | None
    improvement_by_axis: dict[str, list[float]] | None
    evaluations: int
    seed: int
    flights: int
    generations: int

    def as_json(self) -> dict[str, Any]:
        """The result as `--json` writes it."""
        return {
            "scenario": self.start.name,
            "law": self.designed.law,
            "rate_hz": self.designed.rate_hz,
            "delay_s": self.designed.delay_ns / NANOSECONDS,
            "seed": self.seed,
            "flights": self.flights,
            "generations": self.generations,
            "evaluations": self.evaluations,
            "gains": {
                group.name: {name: gain_of(self.designed, name)[group.axes[0]] for name in gains_of(self.designed)}
                for group in GROUPS
            },
            "verdict": self.verdict.verdict,
            "reasons": list(self.verdict.reasons),
            "channels": msgspec.to_builtins(self.margins),
            "channels_before": msgspec.to_builtins(self.start_margins),
            "held_out_seeds": HELD_OUT,
            "before": msgspec.to_builtins(self.before),
            "after": msgspec.to_builtins(self.after),
            "improvement": self.improvement,
            "improvement_by_axis": self.improvement_by_axis,
        }


def with_delay(scenario: Scenario, delay_s: float) -> Scenario:
    """The scenario with this total delay (s): given in samples where it is a whole number of them."""
    samples = round(delay_s * NANOSECONDS) / scenario.period_ns
    delay = Delay(samples=int(samples)) if samples == int(samples) <= 1000 else Delay(samples=0, seconds=delay_s)
    return msgspec.structs.replace(scenario, delay=delay)


def judge_design(start: Scenario, found: Found, *, stop: StopFlag, seed: int, flights: int, generations: int) -> Design:
    """Fly old and new gains over the same held-out seeds, with the verdict of `margin`. Raises Interrupted."""
    first = start.seed + _FAR
    seeds = range(first, first + HELD_OUT)
    before, old = compare(start, seeds)
    stop.check()
    after, new = compare(found.scenario, seeds)
    stop.check()
    ratio = None if old is None or new is None else np.exp(new - old)
    margins = linear_margins(found.scenario)
    delay_s = start.delay_ns / NANOSECONDS
    twice_lost = flown_error(at_twice_the_delay(found.scenario), (first,))[1]
    return Design(
        start=start,
        designed=found.scenario,
        margins=margins,
        start_margins=linear_margins(start),
        verdict=judge(delay_s, margins, lost=after.lost, flown_delay_s=delay_s if twice_lost else None),
        before=before,
        after=after,
        improvement=None if old is None or new is None else float(np.exp((new - old).mean())),
        improvement_by_axis=None if ratio is None else {axis: ratio[:, i].tolist() for i, axis in enumerate(AXES)},
        evaluations=found.evaluations,
        seed=seed,
        flights=flights,
        generations=generations,
    )


def scenario_text(result: Design, base_path: Path, out: Path) -> str:
    """The scenario file, with comments on its origin: only differences where the base file is beside it, else all keys."""
    designed, start = result.designed, result.start
    stem = out.stem.lower()
    name = stem if re.fullmatch(r"[a-z0-9][a-z0-9_\-]*", stem) else f"{start.name}_designed"
    delay_ms = 1e3 * start.delay_ns / NANOSECONDS
    description = f"{start.name} with gains designed for {start.rate_hz:g} Hz and {delay_ms:g} ms of delay"
    named = msgspec.structs.replace(designed, name=name, description=description)
    names = gains_of(designed)
    lines = [
        f"# {', '.join(names)} of [gains] are designed, by `fwav-hil design`, for a link of {start.rate_hz:g} Hz with",
        f"# {delay_ms:g} ms of total delay, and {start.name}'s noise and limits; optimiser seed {result.seed}, "
        f"{result.generations} generations, {result.flights} flights each.",
        f"# Gain margin at least {_least(m.gain_margin for m in result.margins.values()):.2f} both ways, largest delay "
        f"{1e3 * _least(m.max_delay_s for m in result.margins.values()):.1f} ms. Everything else is {start.name}'s.",
    ]
    if result.improvement is not None:
        lines.append(
            f"# RMSE over {HELD_OUT} seeds not used in the search: {result.improvement:.3f} of that with the old gains."
        )
    whole = msgspec.to_builtins(named)
    if base_path.resolve().parent != out.resolve().parent:
        return "\n".join(lines) + "\n\n" + tomli_w.dumps(whole)
    changes: dict[str, Any] = {"extends": base_path.name}
    changes |= {key: whole[key] for key in ("name", "description", "rate_hz", "law", "substep_s", "delay")}
    changes["gains"] = {}
    for name in names:
        changes["gains"].setdefault(TABLES[name], {})[name] = whole["gains"][TABLES[name]][name]
    return "\n".join(lines) + "\n\n" + tomli_w.dumps(changes)


def _least(values: Any) -> float:
    return min((value for value in values if value is not None), default=math.inf)


def show_cost(cost: float) -> str:
    """A cost of the search as text."""
    if cost >= 1000.0:
        return "no gains with the margins yet"
    return "every flight lost yet" if cost >= 100.0 else f"log RMSE {cost:.4f}"


def print_design(result: Design, *, to_stderr: bool = False) -> None:
    """Print gains, margins and errors, old and new."""
    console = plain_console(to_stderr=to_stderr)
    start, designed = result.start, result.designed
    title = f"{start.name}, law {start.law}, {start.rate_hz:g} Hz, delay {1e3 * start.delay_ns / NANOSECONDS:g} ms"
    gains = Table("gains", title=title, title_justify="left")
    for column in (*gains_of(designed), "gain margin", "largest delay"):
        gains.add_column(column, justify="right")
    for group in reversed(GROUPS):
        for what, scenario, margins in (("old", start, result.start_margins), ("new", designed, result.margins)):
            axes = [AXES[axis] for axis in group.axes]
            gains.add_row(
                f"{group.name}, {what}",
                *(f"{gain_of(scenario, name)[group.axes[0]]:.3g}" for name in gains_of(designed)),
                f"{_least(margins[axis].gain_margin for axis in axes):.2f}",
                f"{1e3 * _least(margins[axis].max_delay_s for axis in axes):.1f} ms",
            )
    console.print(gains)
    errors = Table("axis", title=f"RMSE, median of {HELD_OUT} seeds not used in the search", title_justify="left")
    for column in ("old", "new", "old, from 2 s", "new, from 2 s"):
        errors.add_column(column, justify="right")
    for axis in AXES:
        cells = [
            show_error(axis, values[axis]) if values else "-"
            for values in (
                result.before.rmse_median, result.after.rmse_median,
                result.before.rmse_settled_median, result.after.rmse_settled_median,
            )
        ]  # fmt: skip
        errors.add_row(AXIS_NAMES[axis], *cells)
    console.print(errors)
    if result.before.lost:
        console.print(f"a flight with the old gains is lost on this link: {result.before.lost}")
    if result.improvement is not None:
        console.print(
            f"RMSE with the new gains is {result.improvement:.3f} of that with the old, in the geometric mean"
        )
    console.print(
        f"verdict on the new gains: {result.verdict.verdict}" + "".join(f"\n  {w}" for w in result.verdict.reasons)
    )
