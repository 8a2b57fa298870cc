"""The complete margin study of a scenario: linear, with the describing function, flown; as one result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fwav_hil.studies.describing import Gear, LimitCycle, amplitudes, describing_function, gears, limit_cycles
from fwav_hil.studies.flight_check import VARIANTS, FlownDelay, Oscillation, at_rest, flown_delay
from fwav_hil.studies.loop_model import Channel, channels, stable_gains
from fwav_hil.studies.margin import (
    RATES_HZ,
    ChannelMargin,
    RateRow,
    Verdict,
    channel_margin,
    judge,
    linear_margins,
    rate_row,
)
from protocol.messages import AXES, FloatArray
from protocol.scenario import NANOSECONDS, Scenario

_AMPLITUDES = 12
_REGION_DELAYS = 45
_KICK = 10.0


class AmplitudeRow(msgspec.Struct, frozen=True, kw_only=True):
    """A channel at one amplitude of tau (N, N m), N(A) in place of h: |N|/h, its lag, and the resulting margins."""

    amplitude: float
    relative_gain: float
    lag_rad: float
    stable: bool
    gain_margin_up: float | None
    gain_margin_down: float | None
    phase_margin_rad: float | None
    max_delay_s: float | None


class Region(NamedTuple):
    """The stable g/b over the delay: delay_s (n,), and the intervals at each."""

    delay_s: FloatArray
    intervals: list[list[tuple[float, float]]]


class Study(NamedTuple):
    """The result. Dictionaries are by axis; `groups` lists axes whose loops are the same, one tuple each."""

    scenario: Scenario
    groups: list[tuple[str, ...]]
    margins: dict[str, ChannelMargin]
    describing: dict[str, list[AmplitudeRow]]
    cycles: dict[str, list[LimitCycle]]
    simulated: dict[str, Oscillation]
    rates: list[RateRow]
    regions: dict[str, Region]
    flown: FlownDelay
    variants: dict[str, FlownDelay]
    verdict: Verdict

    @property
    def linear_delay_s(self) -> float | None:
        """The smallest of the channels' largest delays (s)."""
        return min((m.max_delay_s for m in self.margins.values() if m.max_delay_s is not None), default=None)


STEPS = 5 + len(RATES_HZ) + len(VARIANTS)
"""The number of calls of `progress`."""


def study(scenario: Scenario, progress: Callable[[str], None] = lambda _text: None) -> Study:
    """Everything `fwav-hil margin` shows; `progress` is called with the next step. Raises UsageError for an unknown law."""
    progress("linear margins")
    loops = channels(scenario)
    worn = dict(zip(AXES, gears(scenario.hysteresis), strict=True))
    delay_s = scenario.delay_ns / NANOSECONDS
    margins = linear_margins(scenario)
    groups = _groups(loops, worn)
    progress("describing function")
    describing, cycles, regions = {}, {}, {}
    for group in groups:
        first = group[0]
        rows = _amplitude_rows(loops[first], worn[first], delay_s)
        region = _region(loops[first], delay_s, margins[first].max_delay_s)
        for axis in group:
            scale = worn[axis].amplitude / worn[first].amplitude
            describing[axis] = [msgspec.structs.replace(row, amplitude=scale * row.amplitude) for row in rows]
            regions[axis] = region
    for i, axis in enumerate(AXES):
        cycles[axis] = limit_cycles(loops[axis], worn[axis], scenario.control.b[i], delay_s)
    progress("hold at rest")
    simulated = at_rest(scenario, _kick(cycles))
    rates = []
    for rate_hz in RATES_HZ:
        progress(f"{rate_hz:g} Hz")
        rates.append(rate_row(scenario, rate_hz))
    guess = min((m.max_delay_s for m in margins.values() if m.max_delay_s is not None), default=None)
    progress("flights over delay")
    flown = flown_delay(scenario, guess)
    variants = {}
    for name, change in VARIANTS:
        progress(f"flights over delay, {name}")
        variants[name] = flown_delay(change(scenario), guess)
    progress("verdict")
    verdict = judge(delay_s, margins, lost=flown.at_own_delay.lost, flown_delay_s=flown.max_delay_s)
    return Study(scenario, groups, margins, describing, cycles, simulated, rates, regions, flown, variants, verdict)


def _groups(loops: dict[str, Channel], worn: dict[str, Gear]) -> list[tuple[str, ...]]:
    groups: list[list[str]] = []
    for axis in AXES:
        for group in groups:
            if loops[axis].twin_of(loops[group[0]]) and worn[axis].alike(worn[group[0]]):
                group.append(axis)
                break
        else:
            groups.append([axis])
    return [tuple(group) for group in groups]


def _amplitude_rows(channel: Channel, gear: Gear, delay_s: float) -> list[AmplitudeRow]:
    rows = []
    for amplitude in amplitudes(gear, _AMPLITUDES):
        relative = describing_function(gear, float(amplitude)) / gear.h
        if abs(relative) < 1e-9:
            continue  # within its play a gear's output is zero
        margin = channel_margin(channel, delay_s, complex(channel.ratio * relative))
        rows.append(
            AmplitudeRow(
                amplitude=float(amplitude),
                relative_gain=abs(relative),
                lag_rad=float(-np.angle(relative)),
                stable=margin.stable,
                gain_margin_up=margin.gain_margin_up,
                gain_margin_down=margin.gain_margin_down,
                phase_margin_rad=margin.phase_margin_rad,
                max_delay_s=margin.max_delay_s,
            )
        )
    return rows


def _region(channel: Channel, delay_s: float, most: float | None) -> Region:
    """Up to a third beyond the largest delay, and beyond twice the loop's own."""
    end = max(1.35 * (most or 0.0), 2.3 * delay_s, 5.0 * channel.period)
    delays = np.linspace(0.0, end, _REGION_DELAYS)
    return Region(delays, [stable_gains(channel, float(delay)) for delay in delays])


def _kick(cycles: dict[str, list[LimitCycle]]) -> FloatArray:
    """The initial offset: well above every predicted limit cycle, 1 mm or .6 degrees where there is none."""
    kick = np.repeat((1e-3, 1e-2), 3)
    for i, axis in enumerate(AXES):
        kick[i] = max((_KICK * cycle.motion for cycle in cycles[axis] if cycle.attracting), default=kick[i])
    return np.asarray(np.minimum(kick, np.repeat((0.05, 0.2), 3)))


def as_json(result: Study) -> dict[str, Any]:
    """The study as `--json` writes it; s, rad, N, N m, rad/s."""
    scenario = result.scenario
    return {
        "scenario": scenario.name,
        "law": scenario.law,
        "rate_hz": scenario.rate_hz,
        "delay_s": scenario.delay_ns / NANOSECONDS,
        "verdict": result.verdict.verdict,
        "reasons": list(result.verdict.reasons),
        "max_delay_s": result.linear_delay_s,
        "channels": msgspec.to_builtins(result.margins),
        "describing_function": msgspec.to_builtins(result.describing),
        "limit_cycles": {
            axis: {
                "predicted": [cycle._asdict() for cycle in result.cycles[axis]],
                "simulated": msgspec.to_builtins(result.simulated[axis]),
            }
            for axis in AXES
        },
        "rates": msgspec.to_builtins(result.rates),
        "region": {
            axis: {
                "delay_s": region.delay_s.tolist(),
                "gain_ranges": [
                    [[low, high if np.isfinite(high) else None] for low, high in at_delay]
                    for at_delay in region.intervals
                ],
            }
            for axis, region in result.regions.items()
        },
        "nonlinear": {
            **msgspec.to_builtins(result.flown),
            "variants": {name: flown.max_delay_s for name, flown in result.variants.items()},
        },
    }
