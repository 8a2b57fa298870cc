"""Are these gains stable on this link? The margins of each channel, the delay budget of a run, and a verdict.

The linear figures come from `loop_model`, those with the hysteresis from `describing`, the check on the whole plant from
`flight_check`. They are combined here; `docs/margins.md` explains them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec
import numpy as np

from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.studies.loop_model import (
    Channel,
    channels,
    crossovers,
    gain_ratios,
    largest_delay,
    range_around,
    stable_gains,
)
from protocol.messages import AXES
from protocol.scenario import NANOSECONDS, Backlash, Scenario, Vector6, replace_gains, with_overrides

LEAST_GAIN_MARGIN = 2.0
LEAST_DELAY_MARGIN = 2.0
WARN_BELOW = 1.0 / 3.0
"""`fwav-hil run` warns where less than this share of the largest delay is left."""


class ChannelMargin(msgspec.Struct, frozen=True, kw_only=True):
    """The linear loop of one channel at one delay, for the slope h of its gear.

    gain_ratio         g/b, the true input gain over the law's
    gain_range         range of g/b in which the loop is stable: around gain_ratio, or the nearest one; None: no such range
    gain_margin        the smaller of the two below; under 1 where unstable; 0: no gain is stable
    gain_margin_up     factor by which the gain may grow; None: any
    gain_margin_down   factor by which it may shrink; None: any
    phase_margin_rad   smallest phase shift at a crossover that makes the loop marginal; negative where unstable
    crossover_rad_s    the frequency of that crossover, |L| = 1
    max_delay_s        largest total delay, sample to action; 0: unstable without delay; None: no limit within 600 periods
    """

    gain_ratio: float
    gain_range: tuple[float, float | None] | None
    gain_margin: float | None
    gain_margin_up: float | None
    gain_margin_down: float | None
    phase_margin_rad: float | None
    max_delay_s: float | None
    max_delay_samples: float | None
    crossover_rad_s: float | None
    stable: bool


def channel_margin(channel: Channel, delay_s: float, gain: complex | None = None) -> ChannelMargin:
    """The margins of a channel; `gain` (complex: a describing function) in place of its own."""
    gain = channel.ratio if gain is None else gain
    size = abs(gain)
    turn = gain / size if np.iscomplexobj(gain) else 1.0
    stable = channel.stable(gain, delay_s)
    interval = range_around(stable_gains(channel, delay_s, turn), size)
    if interval:
        up, down = interval[1] / size, size / interval[0] if interval[0] > 0.0 else None
    else:
        up = down = 0.0
    margins = crossovers(channel, gain, delay_s)
    crossover, phase = min(margins, key=lambda one: abs(one[1]), default=(None, None))
    most = largest_delay(channel, gain)
    return ChannelMargin(
        gain_ratio=size,
        gain_range=(interval[0], _finite(interval[1])) if interval else None,
        gain_margin=min((x for x in (up, down) if x is not None and math.isfinite(x)), default=None),
        gain_margin_up=_finite(up),
        gain_margin_down=down,
        phase_margin_rad=None if phase is None else abs(phase) if stable else -abs(phase),
        max_delay_s=most,
        max_delay_samples=None if most is None else most / channel.period,
        crossover_rad_s=crossover,
        stable=stable,
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def linear_margins(scenario: Scenario) -> dict[str, ChannelMargin]:
    """The margins of all six channels at the delay of the scenario. Raises UsageError for an unknown law."""
    loops = channels(scenario)
    delay_s = scenario.delay_ns / NANOSECONDS
    margins: dict[str, ChannelMargin] = {}
    for axis, loop in loops.items():
        twin = next((one for one in margins if loop.twin_of(loops[one])), None)
        margins[axis] = margins[twin] if twin else channel_margin(loop, delay_s)
    return margins


def with_gain_ratio(scenario: Scenario, ratio: float) -> Scenario:
    """The scenario with gears that give every channel this g/b: u is scaled, the law is not."""
    factors = ratio / gain_ratios(scenario)
    gears = scenario.hysteresis

    def scaled(values: Vector6) -> Vector6:
        x, y, z, roll, pitch, yaw = (np.array(values) * factors).tolist()
        return (x, y, z, roll, pitch, yaw)

    changed: dict[str, Vector6] = {"h": scaled(gears.h)}
    if isinstance(gears, Backlash):
        changed["kappa"] = scaled(gears.kappa)
    return msgspec.structs.replace(scenario, hysteresis=msgspec.structs.replace(gears, **changed))


def with_derivative_pole(scenario: Scenario, pole: float) -> Scenario:
    """The scenario with N = pole (1/s) in every channel."""
    return replace_gains(scenario, "filters", N=(pole,) * 6)


def at_rate(scenario: Scenario, rate_hz: float) -> Scenario:
    """The scenario at another rate, with the longest step of the integrator that fits and is no longer than its own.

    Raises ScenarioError for an invalid rate.
    """
    substep_s = scenario.substep_s
    if 0.0 < rate_hz <= 1e6 and (period_ns := round(NANOSECONDS / rate_hz)) % 1000 == 0:
        steps = math.ceil(period_ns / scenario.substep_ns)
        while period_ns % steps:
            steps += 1
        substep_s = period_ns / steps / NANOSECONDS
    return with_overrides(scenario, rate_hz=rate_hz, substep_s=substep_s)


class Budget(msgspec.Struct, frozen=True, kw_only=True):
    """The share of the largest stable delay that a link uses.

    max_delay_s   smallest over the channels (s); None: no limit; `channel` is where it is
    delay_s       of this link and rate: the scenario's, or in real time one period, the most that an answer in time takes
    left_s        the difference; None: no limit          warn   less than a third of max_delay_s is left
    """

    max_delay_s: float | None
    channel: str | None
    delay_s: float
    left_s: float | None
    warn: bool
    sentence: str


def budget_line(scenario: Scenario, clock: str = "lockstep") -> Budget:
    """The delay budget of a run (clock: lockstep or realtime), in numbers and as one sentence. Takes a tenth of a second."""
    loops = channels(scenario)
    limits: dict[str, float | None] = {}
    for axis, loop in loops.items():
        twin = next((one for one in limits if loop.twin_of(loops[one])), None)
        limits[axis] = limits[twin] if twin else largest_delay(loop, loop.ratio)
    bounded = {axis: limit for axis, limit in limits.items() if limit is not None}
    period_s = scenario.period_ns / NANOSECONDS
    if clock == "realtime":
        delay_s = period_s
        taken = f"an answer in time takes up to one period, {_ms(delay_s)}"
    else:
        delay_s = scenario.delay_ns / NANOSECONDS
        samples = f"{scenario.delay.samples} sample{'s' if scenario.delay.samples != 1 else ''}"
        taken = f"this link's delay is {_ms(delay_s)} ({samples} at {scenario.rate_hz:g} Hz + {_ms(scenario.delay.seconds)})"
        if delay_s == 0.0:
            taken = "this link has no delay"
    head = f"delay budget ({scenario.law}, {scenario.rate_hz:g} Hz): "
    if not bounded:
        return Budget(
            max_delay_s=None,
            channel=None,
            delay_s=delay_s,
            left_s=None,
            warn=False,
            sentence=f"{head}the linear loop is stable at any delay; {taken}",
        )
    axis = min(bounded, key=lambda one: bounded[one])
    most = bounded[axis]
    left = most - delay_s
    warn = left < WARN_BELOW * most or most == 0.0
    if most == 0.0:
        sentence = f"{head}the gains are unstable even without delay ({AXIS_NAMES[axis]})"
    else:
        sentence = f"{head}the gains are stable up to {_ms(most)} ({AXIS_NAMES[axis]}), {taken}, "
        sentence += f"{_ms(left)} left" if left >= 0.0 else f"{_ms(-left)} too much: unstable"
    if warn:
        why = "" if most == 0.0 or left < 0.0 else ": less than a third"
        sentence += f"{why}; see `fwav-hil margin`, or try a higher rate or lower gains"
    return Budget(max_delay_s=most, channel=axis, delay_s=delay_s, left_s=left, warn=warn, sentence=sentence)


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"


RATES_HZ = (100.0, 125.0, 200.0, 250.0, 400.0, 500.0, 1000.0, 2000.0)


class RateRow(msgspec.Struct, frozen=True, kw_only=True):
    """The linear loop at another rate, worst over the channels; the delay is the scenario's at that rate."""

    rate_hz: float
    delay_s: float
    stable: bool
    gain_margin: float | None
    phase_margin_rad: float | None
    max_delay_s: float | None


def rate_row(scenario: Scenario, rate_hz: float) -> RateRow:
    """One row of the table over rates."""
    other = at_rate(scenario, rate_hz)
    margins = linear_margins(other).values()
    return RateRow(
        rate_hz=rate_hz,
        delay_s=other.delay_ns / NANOSECONDS,
        stable=all(one.stable for one in margins),
        gain_margin=_least(one.gain_margin for one in margins),
        phase_margin_rad=_least(one.phase_margin_rad for one in margins),
        max_delay_s=_least(one.max_delay_s for one in margins),
    )


def _least(values: Iterable[float | None]) -> float | None:
    return min((value for value in values if value is not None), default=None)


class Verdict(msgspec.Struct, frozen=True):
    """good, thin or unusable, and why."""

    verdict: str
    reasons: tuple[str, ...]


def judge(
    delay_s: float, margins: dict[str, ChannelMargin], *, lost: str | None, flown_delay_s: float | None
) -> Verdict:
    """The verdict on gains and link.

    unusable: a channel is unstable, or the flight at this delay is lost (`lost`: why, or None). thin: a gain margin under 2
    either way, or a largest delay, linear or flown (`flown_delay_s`), under twice the delay.
    """
    unstable = [AXIS_NAMES[axis] for axis in AXES if not margins[axis].stable]
    reasons = [f"linearly unstable in {', '.join(unstable)}"] if unstable else []
    if lost:
        reasons.append(f"the flight is lost: {lost}")
    if reasons:
        return Verdict("unusable", tuple(reasons))
    for axis in AXES:
        gain, most = margins[axis].gain_margin, margins[axis].max_delay_s
        if gain is not None and gain < LEAST_GAIN_MARGIN:
            reasons.append(f"the gain margin of {AXIS_NAMES[axis]} is {gain:.2f}")
        if most is not None and most < LEAST_DELAY_MARGIN * delay_s:
            reasons.append(f"{AXIS_NAMES[axis]} is stable up to {most / delay_s:.2f} times the delay only")
    if flown_delay_s is not None and flown_delay_s < LEAST_DELAY_MARGIN * delay_s:
        reasons.append(f"flights are lost beyond {flown_delay_s / delay_s:.2f} times the delay")
    return Verdict("thin" if reasons else "good", tuple(reasons))
