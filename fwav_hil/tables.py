"""Results as tables on a terminal."""

from __future__ import annotations

import math
from typing import Any

from rich.console import Console
from rich.table import Table

from fwav_hil.axis_names import AXIS_NAMES
from protocol.messages import AXES

DEGREES = 180.0 / math.pi


def plain_console(*, to_stderr: bool = False, width: int | None = None) -> Console:
    """A console that prints text unchanged: `[x]` or `:b:` in a path or a URI is neither markup nor emoji."""
    return Console(highlight=False, markup=False, emoji=False, soft_wrap=True, stderr=to_stderr, width=width)


def print_summary(summary: dict[str, Any], *, to_stderr: bool = False) -> None:
    """Print the result of a run: tracking by axis, then one line each for counters and measurements."""
    console = plain_console(to_stderr=to_stderr)
    console.print(_tracking_table(summary))
    rate, lockstep = summary["ticks_per_s"], summary["clock"] == "lockstep"
    mode = f", {summary['clock']}" if summary["clock"] else ""
    console.print(
        f"{summary['ticks']} ticks at {summary['rate_hz']:g} Hz ({summary['duration_s']:g} s{mode})"
        + (f", {rate:.0f} ticks/s of wall time" if rate else "")
    )
    for name, what in (("latency_us", "loop latency"), ("tick_us", "whole tick")):
        figures = summary.get(name) or {}
        if figures.get("p50") is not None:
            shown = ", ".join(f"{key} {figures[key]:.0f} us" for key in ("p50", "p99", "max"))
            note = (
                " (lockstep waits for every answer, so this is not the latency of a real-time loop)"
                if lockstep and name == "latency_us"
                else ""
            )
            console.print(f"{what} {shown}{note}")
    _print_real_time(console, summary)
    if can := summary.get("can"):
        counted = summary["counters"]["emulator"]
        bitrate = str(can["bitrate"])
        console.print(
            f"{can['protocol']} drives on {can['uri']}: {can['measured_load_percent'][bitrate]:.0f} % of "
            f"{can['bitrate'] / 1000:g} kbit/s ({can['load_percent'][bitrate]:.0f} % computed worst case), "
            f"outages {counted['motor_outages']}, recoveries {counted['motor_recoveries']}"
        )
    if counters := summary.get("counters"):
        console.print(", ".join(f"{name} {counters[name]}" for name in ("missed", "late", "dropped", "refused")))


def _print_real_time(console: Console, summary: dict[str, Any]) -> None:
    """The lateness of a real-time run's ticks, and the settings that the system granted or refused each process."""
    for end, late in (summary.get("lateness_us") or {}).items():
        if late and late["p50"] is not None:
            shown = ", ".join(f"{key} {late[key]:.1f} us" for key in ("p50", "p99", "p999", "max"))
            console.print(f"{end} wakes late by {shown} (polling the last {late['spin']:.0f} us)")
    for end, settings in (summary.get("realtime") or {}).items():
        granted = [setting["name"] for setting in settings if setting["granted"]]
        if settings:
            console.print(f"{end} was granted: {', '.join(granted) or 'nothing'}")
        for setting in settings:
            if not setting["granted"]:
                remedy = f"; to fix: {setting['remedy']}" if setting["remedy"] else ""
                console.print(f"{end} was refused: {setting['name']} ({setting['said']}{remedy})")


def _tracking_table(summary: dict[str, Any]) -> Table:
    settled = summary.get("rmse_settled")
    title = f"{summary['scenario']}, law {summary['law']}, seed {summary['seed']}"
    table = Table("axis", title=title, title_justify="left")
    for column in ("RMSE", "MAE", *(("RMSE from 2 s", "MAE from 2 s") if settled else ())):
        table.add_column(column, justify="right")
    for axis in AXES:
        values = [summary["rmse"][axis], summary["mae"][axis]]
        if settled:
            values += [settled[axis], summary["mae_settled"][axis]]
        table.add_row(AXIS_NAMES[axis], *(show_error(axis, value) for value in values))
    return table


def show_error(axis: str, value: float | None) -> str:
    """An error in mm or degrees."""
    if value is None:
        return "-"
    return f"{1e3 * value:.2f} mm" if axis in AXES[:3] else f"{DEGREES * value:.3f} deg"


def print_spread(spread: dict[str, Any], *, to_stderr: bool = False) -> None:
    """Print the spread of RMSE over seeds."""
    title = f"{spread['scenario']}, law {spread['law']}, {spread['rate_hz']:g} Hz, {spread['seeds']} seeds"
    columns = [name for name in spread if name.startswith("rmse") and spread[name]]
    table = Table("axis", title=title, title_justify="left")
    for name in columns:
        table.add_column(
            name.replace("rmse_settled", "RMSE from 2 s").replace("rmse", "RMSE").replace("_", ", "), justify="right"
        )
    for axis in AXES:
        table.add_row(AXIS_NAMES[axis], *(show_error(axis, spread[name][axis]) for name in columns))
    plain_console(to_stderr=to_stderr).print(table)
