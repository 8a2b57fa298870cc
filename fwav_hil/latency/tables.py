"""Latency figures as tables on a terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.latency.analysis import LEGS
from fwav_hil.tables import show_error
from protocol.messages import AXES

COLUMNS = ("p50", "p90", "p99", "p999", "p9999", "max")
RMSE = ("run", "constant", "recorded")
HEADINGS = ("50 %", "90 %", "99 %", "99.9 %", "99.99 %", "max")


def print_report(result: dict[str, Any], console: Console) -> None:
    """A closed-loop study: latency segments, losses, comparisons, the prediction."""
    title = f"{result['scenario']}, law {result['law']}, {result['rate_hz']:g} Hz, real time; us"
    console.print(_table(title, {LEGS[name]: figures for name, figures in result["legs_us"].items()}))
    console.print(", ".join(f"{name.replace('_', ' ')} {count}" for name, count in result["losses"].items()))
    if result["negative_legs"]:
        console.print(f"{result['negative_legs']} durations were negative and count as 0, because of clock error")
    sync = result["time_sync"]
    if sync is None:
        console.print("TIMESYNC: no answer; where the ends have two clocks, the latency between them is unknown")
    elif "error_us" in sync:
        judged = "within" if sync["held"] else "BEYOND"
        console.print(
            f"TIMESYNC: offset wrong by {sync['error_us']:.1f} us against the shared clock, {judged} its bound of "
            f"{sync['bound_us']:.1f} us (half the round trip), {sync['answers']} answers"
        )
    else:
        console.print(
            f"TIMESYNC: the controller's clock is ahead by {sync['offset_us']:.1f} us at the start and "
            f"{sync['offset_at_end_us']:.1f} us at the end, within {sync['bound_us']:.1f} us; latencies between the machines "
            "have the same uncertainty"
        )
    if beside := result["beside"]:
        rows = {
            f"round trip, {name.replace('_', ' ')}": found["from_due"]
            for name, found in beside.items()
            if "from_due" in found
        }
        if "wake" in beside.get("cyclictest", {}):
            rows["wake-up, cyclictest"] = beside["cyclictest"]["wake"]
        console.print(_table("for comparison, measured one after the other, each from its due time; us", rows))
        for name, found in beside.items():
            gone = {key: found[key] for key in ("lost", "duplicate", "out_of_order", "unknown") if found.get(key)}
            if gone:
                told = ", ".join(f"{key.replace('_', ' ')} {number}" for key, number in gone.items())
                console.print(f"{name.replace('_', ' ')}: {told}")
        if "note" in beside.get("cyclictest", {}):
            console.print(beside["cyclictest"]["note"])
    if predicted := result["prediction"]:
        cells = ", ".join(
            f"{AXIS_NAMES[axis]} " + " / ".join(_show_error(axis, predicted[f"rmse_{which}"]) for which in RMSE)
            for axis in AXES
        )
        console.print(
            f"RMSE of the run / simulated with a constant delay of {1e3 * predicted['delay_s']:.3f} ms (the median) / with "
            f"the recorded delays: {cells}"
        )


def print_probes(result: dict[str, Any], console: Console) -> None:
    """Probes of a link by TIMESYNC."""
    rows = {"round trip from when due": result["round_trip_us"], "round trip from when sent": result["from_sent_us"]}
    console.print(_table(f"TIMESYNC on {result['link']} at {result['rate_hz']:g} Hz; us", rows))
    console.print(
        f"lost {result['lost']}, duplicate {result['duplicate']}, out of order {result['out_of_order']}, "
        f"unrequested {result['unknown']}"
    )
    console.print(
        f"the other clock is ahead by {result['clock_offset_us']:.1f} us, within {result['clock_offset_bound_us']:.1f} us"
    )


def _table(title: str, rows: dict[str, dict[str, float | int | None]]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("", no_wrap=True)
    table.add_column("count", justify="right")
    for heading in HEADINGS:
        table.add_column(heading, justify="right")
    for name, figures in rows.items():
        table.add_row(name, str(figures["count"]), *(_show(figures[column]) for column in COLUMNS))
    return table


def _show_error(axis: str, rmse: dict[str, float | None] | None) -> str:
    return "diverged" if rmse is None else show_error(axis, rmse[axis])


def _show(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 1e3 else f"{value:.1f}"
