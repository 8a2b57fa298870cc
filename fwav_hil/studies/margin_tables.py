"""The margin study as tables on a terminal."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.studies.margin import ChannelMargin
from fwav_hil.studies.margin_study import Study
from fwav_hil.tables import plain_console
from protocol.messages import AXES
from protocol.scenario import NANOSECONDS


def print_study(result: Study, *, to_stderr: bool = False) -> None:
    """Print all tables, and the verdict last."""
    console = plain_console(to_stderr=to_stderr)
    scenario = result.scenario
    delay_s = scenario.delay_ns / NANOSECONDS
    console.print(_channel_table(result, delay_s))
    console.print(_amplitude_table(result))
    console.print(_cycle_table(result))
    console.print(_rate_table(result))
    console.print(_flight_table(result))
    _print_difference(console, result)
    console.print(f"verdict: {result.verdict.verdict}" + "".join(f"\n  {why}" for why in result.verdict.reasons))


def _table(title: str, *columns: str) -> Table:
    table = Table(columns[0], title=title, title_justify="left")
    for column in columns[1:]:
        table.add_column(column, justify="right")
    return table


def _channel_table(result: Study, delay_s: float) -> Table:
    scenario = result.scenario
    table = _table(
        f"{scenario.name}, law {scenario.law}, {scenario.rate_hz:g} Hz, delay {_ms(delay_s)}: linear, slope h",
        "channel", "g/b", "stable g/b", "gain margin up", "down", "phase margin", "crossover", "largest delay", "samples",
    )  # fmt: skip
    for axis in AXES:
        margin = result.margins[axis]
        table.add_row(
            AXIS_NAMES[axis] if margin.stable else f"{AXIS_NAMES[axis]}: unstable",
            f"{margin.gain_ratio:.3f}",
            _range(margin),
            _factor(margin.gain_margin_up),
            _factor(margin.gain_margin_down),
            _degrees(margin.phase_margin_rad),
            "-" if margin.crossover_rad_s is None else f"{margin.crossover_rad_s:.1f} rad/s",
            _limit(margin.max_delay_s),
            "-" if margin.max_delay_samples is None else f"{margin.max_delay_samples:.1f}",
        )
    return table


def _amplitude_table(result: Study) -> Table:
    table = _table(
        "with the hysteresis: N(A) of its describing function in place of h",
        "channels", "A of tau", "N/h", "lag", "gain margin up", "down", "phase margin", "largest delay",
    )  # fmt: skip
    for group in _tightest(result):
        for number, row in enumerate(result.describing[group[0]]):
            name = ", ".join(AXIS_NAMES[axis] for axis in group) if number == 0 else ""
            table.add_row(
                name,
                f"{row.amplitude:.2e} {_unit(group[0])}",
                f"{row.relative_gain:.3f}",
                _degrees(row.lag_rad),
                _factor(row.gain_margin_up) if row.stable else "grows",
                _factor(row.gain_margin_down) if row.stable else "",
                _degrees(row.phase_margin_rad) if row.stable else "",
                _limit(row.max_delay_s) if row.stable else "",
                end_section=number == len(result.describing[group[0]]) - 1,
            )
    return table


def _tightest(result: Study) -> list[tuple[str, ...]]:
    """The group of position and the group of attitude with the smallest largest delay; the JSON has all groups."""
    shown = []
    for axes in (AXES[:3], AXES[3:]):
        groups = [group for group in result.groups if group[0] in axes]
        shown.append(min(groups, key=lambda group: _or_infinite(result.margins[group[0]].max_delay_s)))
    return shown


def _cycle_table(result: Study) -> Table:
    table = _table(
        "limit cycles: predicted by harmonic balance, and simulated (at rest, no noise)",
        "channel", "predicted A of tau", "frequency", "motion", "simulated A of tau", "frequency", "motion",
    )  # fmt: skip
    for axis in AXES:
        shown = result.simulated[axis]
        seen = ("-", "-", "diverges") if shown.motion is None else ("-", "-", "comes to rest")
        if shown.motion and shown.amplitude is not None:
            seen = (
                f"{shown.amplitude:.2e} {_unit(axis)}",
                f"{shown.frequency_rad_s:.1f} rad/s",
                _motion(axis, shown.motion),
            )
        cycles = [cycle for cycle in result.cycles[axis] if cycle.attracting]
        if not cycles:
            table.add_row(AXIS_NAMES[axis], "none", "-", "-", *seen)
        for cycle in cycles:
            table.add_row(
                AXIS_NAMES[axis],
                f"{cycle.amplitude:.2e} {_unit(axis)}",
                f"{cycle.frequency_rad_s:.1f} rad/s",
                _motion(axis, cycle.motion),
                *seen,
            )
    return table


def _rate_table(result: Study) -> Table:
    table = _table(
        "other rates, linear, worst channel; delay as the scenario gives it",
        "rate", "delay", "gain margin", "phase margin", "largest delay", "stable",
    )  # fmt: skip
    for row in result.rates:
        table.add_row(
            f"{row.rate_hz:g} Hz",
            _ms(row.delay_s),
            _factor(row.gain_margin),
            _degrees(row.phase_margin_rad),
            _limit(row.max_delay_s),
            "yes" if row.stable else "no",
        )
    return table


def _flight_table(result: Study) -> Table:
    table = _table(
        "largest delay: linear, and flown until the flight is lost", "what", "largest delay", "of the linear"
    )
    linear = result.linear_delay_s
    table.add_row("linear, smallest of the channels", _limit(linear), "")
    for name, flown in {"whole plant": result.flown, **result.variants}.items():
        share = f"{100.0 * flown.max_delay_s / linear:.0f} %" if linear else "-"
        table.add_row(name, _ms(flown.max_delay_s), share)
    return table


def _print_difference(console: Console, result: Study) -> None:
    linear, flown = result.linear_delay_s, result.flown
    own = flown.at_own_delay
    state = f"lost: {own.lost}" if own.lost else f"held, {100.0 * own.saturated:.1f} % of the commands at a limit"
    console.print(f"flown at the loop's own delay: {state}")
    if linear and flown.max_delay_s > 0.0:
        gains = {name: variant.max_delay_s - flown.max_delay_s for name, variant in result.variants.items()}
        single = {name: gain for name, gain in list(gains.items())[:-1] if gain > 0.05 * flown.max_delay_s}
        if single:
            most = max(single, key=lambda name: single[name])
            console.print(f"largest single cause of the difference: {most} would give {_ms(single[most])} more")
    if flown.why_lost:
        console.print(f"beyond {_ms(flown.max_delay_s)}: {flown.why_lost}")


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value


def _range(margin: ChannelMargin) -> str:
    if margin.gain_range is None:
        return "none"
    low, high = margin.gain_range
    return f"{low:.3f} to {high:.3f}" if high is not None else f"from {low:.3f}"


def _factor(value: float | None) -> str:
    return "any" if value is None else f"{value:.2f}"


def _degrees(value: float | None) -> str:
    return "-" if value is None else f"{math.degrees(value):.1f} deg"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f} ms"


def _limit(seconds: float | None) -> str:
    return "none" if seconds is None else _ms(seconds)


def _unit(axis: str) -> str:
    return "N" if axis in AXES[:3] else "N m"


def _motion(axis: str, value: float) -> str:
    return f"{1e3 * value:.3g} mm" if axis in AXES[:3] else f"{math.degrees(value):.3g} deg"
