"""The figures of the margin study, as PNG: stability regions, describing function, a gear at a reversal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.studies.describing import Gear, describing_function, gears
from fwav_hil.studies.margin_study import Region, Study
from plant_emulator.plant.backlash import gear_step
from protocol.errors import RunFolderError
from protocol.messages import FloatArray
from protocol.scenario import NANOSECONDS

BLUE, ORANGE, GREY = "#0b61a4", "#c2410c", "#7a7a7a"


def draw_study(folder: Path, result: Study) -> dict[str, Path]:
    """Draw all figures into `folder`; returns them by name. Raises RunFolderError."""
    gear = gears(result.scenario.hysteresis)[0]
    return {
        "stability_region": draw_regions(folder / "stability_region.png", result),
        "describing_function": draw_describing_function(folder / "describing_function.png", gear),
        "reversal": draw_reversal(folder / "reversal.png", gear),
    }


def draw_regions(path: Path, result: Study) -> Path:
    """The stable g/b over the total delay, one panel for each group of channels with the same loop."""
    scenario = result.scenario
    delay_ms = 1e3 * scenario.delay_ns / NANOSECONDS
    count = len(result.groups)
    figure = Figure(figsize=(max(6.0, 4.6 * count), 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{scenario.name}, law {scenario.law}, {scenario.rate_hz:g} Hz: where the linear loop is stable")
    for panel, group in zip(np.atleast_1d(figure.subplots(1, count)), result.groups, strict=True):
        axis = group[0]
        margin, region = result.margins[axis], result.regions[axis]
        bottom, top = _fill(panel, region, margin.gain_ratio)
        least = min((row.relative_gain for row in result.describing[axis]), default=1.0)
        panel.plot([delay_ms] * 2, [least * margin.gain_ratio, margin.gain_ratio], color=ORANGE, linewidth=1.2,
                   label="|N|, small amplitude up to h")  # fmt: skip
        panel.plot([delay_ms], [margin.gain_ratio], "o", color=ORANGE, label="this loop, slope h")
        if delay_ms > 0.0:
            panel.plot(
                [2.0 * delay_ms], [margin.gain_ratio], "o", color=ORANGE, fillstyle="none", label="twice the delay"
            )
        if margin.max_delay_s:
            panel.plot([1e3 * margin.max_delay_s], [margin.gain_ratio], "|", color="black", markersize=12,
                       label=f"largest delay, {1e3 * margin.max_delay_s:.1f} ms")  # fmt: skip
        panel.set_yscale("log")
        panel.set_ylim(min(bottom, 0.7 * least * margin.gain_ratio), top)
        panel.set_xlim(-0.02e3 * region.delay_s[-1], 1e3 * region.delay_s[-1])
        panel.set_title(", ".join(AXIS_NAMES[axis] for axis in group))
        panel.set_xlabel("total delay (ms)")
        panel.set_ylabel("input gain g/b")
        panel.grid(visible=True, which="both", alpha=0.25)
        panel.legend(loc="upper right", fontsize="small")
    return _save(figure, path)


def _fill(panel: Any, region: Region, ratio: float) -> tuple[float, float]:
    """Fill every stable interval of each delay; returns limits for the gain's axis."""
    ends = [end for intervals in region.intervals for pair in intervals for end in pair if 0.0 < end < np.inf]
    bottom, top = 0.7 * min([ratio, *ends]), 2.5 * max([ratio, *ends])
    delays = 1e3 * region.delay_s
    # An interval represents the delays around it; overlapping neighbours are drawn as one area.
    most = max((len(intervals) for intervals in region.intervals), default=0)
    for number in range(most):
        low = np.full(len(delays), np.nan)
        high = np.full(len(delays), np.nan)
        for i, intervals in enumerate(region.intervals):
            if number < len(intervals):
                low[i] = max(bottom, intervals[number][0])
                high[i] = min(top, intervals[number][1])
        panel.fill_between(delays, low, high, color=BLUE, alpha=0.22, linewidth=0.0)
        panel.plot(delays, low, color=BLUE, linewidth=1.0)
        panel.plot(delays, high, color=BLUE, linewidth=1.0)
    return bottom, top


def draw_describing_function(path: Path, gear: Gear) -> Path:
    """|N|/h and the phase lag over the amplitude of tau, in widths of the hysteresis."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    panel = figure.subplots()
    relative = np.geomspace(1.01 if gear.reversal_slope == 0.0 else 0.02, 200.0, 160)
    values = np.array([describing_function(gear, float(a) * gear.amplitude) / gear.h for a in relative])
    panel.semilogx(relative, np.abs(values), color=BLUE, label="|N| / h")
    panel.set_xlabel("amplitude of tau, in 1/chi (play: in B)")
    panel.set_ylabel("|N| / h")
    panel.set_ylim(0.0, 1.05)
    panel.grid(visible=True, alpha=0.3)
    other = panel.twinx()
    other.semilogx(relative, -np.degrees(np.angle(values)), color=ORANGE, label="phase lag")
    other.set_ylabel("phase lag (deg)")
    other.set_ylim(bottom=0.0)
    panel.set_title(f"Describing function, h = {gear.h:.3g}, kappa or B = {gear.p:.3g}, chi = {gear.chi:.3g}")
    lines = [*panel.get_lines(), *other.get_lines()]
    panel.legend(handles=lines, loc="center right")
    return _save(figure, path)


def draw_reversal(path: Path, gear: Gear) -> Path:
    """u against tau along a long stroke, its reversal, and the return; the slopes h and just after the reversal."""
    tau = gear.amplitude * np.concatenate((np.linspace(0.0, 8.0, 400), np.linspace(8.0, 0.0, 400)[1:]))
    u = _follow(gear, tau)
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    panel = figure.subplots()
    panel.plot(tau[:400], u[:400], color=BLUE, label="up")
    panel.plot(tau[399:], u[399:], color=ORANGE, label="back")
    reach = 0.9 * gear.amplitude
    corner, height = tau[399], u[399]
    panel.plot([corner - reach, corner], [height - gear.reversal_slope * reach, height], color="black", linestyle="--",
               linewidth=1.0, label=f"slope just after the reversal: {gear.reversal_slope:.3g}")  # fmt: skip
    panel.plot([0.0, corner], [height - gear.h * corner, height], color=GREY, linestyle=":",
               label=f"slope far along a stroke: h = {gear.h:.3g}")  # fmt: skip
    panel.set_xlabel("motor command tau")
    panel.set_ylabel("u, after the gear")
    panel.set_title("A reversal: at first u moves the wrong way" if gear.reversal_slope < 0.0 else "A reversal")
    panel.grid(visible=True, alpha=0.3)
    panel.legend(loc="upper left")
    return _save(figure, path)


def _follow(gear: Gear, tau: FloatArray) -> FloatArray:
    model, h, p, chi = gear
    u = np.empty(len(tau))
    u[0], d = h * tau[0], 0.0
    for k in range(1, len(tau)):
        u[k], d = gear_step(model, tau[k - 1], tau[k], u[k - 1], d, h, p, chi)
    return u


def _save(figure: Figure, path: Path) -> Path:
    try:
        figure.savefig(path, dpi=100)
    except OSError as error:
        raise RunFolderError(f"cannot write the figure {path}: {error.strerror}") from None
    return path
