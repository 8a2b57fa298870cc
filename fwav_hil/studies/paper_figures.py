"""The figures of the paper's section IV, and of its hysteresis, from our own runs; PNG and SVG."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.score import tracking_error
from fwav_hil.studies.lyapunov import lyapunov
from fwav_hil.studies.paper import CENTIMETRES, Flight
from plant_emulator.plant.backlash import GearHysteresis
from protocol.errors import RunFolderError
from protocol.messages import AXES, FloatArray
from protocol.scenario import NANOSECONDS, Backlash, Play

COLOURS = ("#0b61a4", "#c2410c", "#3f7d20")


class Comparison(NamedTuple):
    """One figure: number in the paper, channel, and the conditions whose errors it shows."""

    number: int
    channel: str
    names: tuple[str, ...]


COMPARISONS = (
    Comparison(3, "z", ("PD", "DOB", "UDE")),
    Comparison(4, "gamma", ("PD", "DOB", "UDE")),
    Comparison(5, "x", ("without_compensation", "with_compensation")),
    Comparison(6, "alpha", ("without_compensation", "with_compensation")),
    Comparison(7, "x", ("T=1", "T=0.1", "T=0.01")),
    Comparison(8, "alpha", ("T=1", "T=0.1", "T=0.01")),
)


def draw_comparisons(folder: Path, flights: dict[str, Flight]) -> list[Path]:
    """Figures 3-8 of one scenario; `flights` by condition name. Returns the PNG files."""
    files = []
    for number, channel, names in COMPARISONS:
        figure, panel = _panel(
            f"Figure {number}: error of {AXIS_NAMES[channel]}", "time (s)", f"error ({_unit(channel)})"
        )
        for name, colour in zip(names, COLOURS, strict=False):
            flight = flights[name]
            error = tracking_error(flight.scenario, flight.result.q)[:, AXES.index(channel)]
            t = flight.result.t_ns / NANOSECONDS
            panel.plot(t, CENTIMETRES[channel] * error, color=colour, linewidth=0.9, label=name.replace("_", " "))
        panel.legend()
        scenario = next(iter(flights.values())).scenario.name
        files.append(_save(figure, folder / f"{scenario}_figure_{number}"))
    return files


def draw_hysteresis(folder: Path) -> list[Path]:
    """The curve of the paper's parameters (chi = 1, h = 3.15, kappa = .35, tau = x sin 2.3t), and the play operator's."""
    ones = (1.0,) * 6
    models: tuple[tuple[str, str, Backlash | Play], ...] = (
        ("hysteresis", "Backlash-like hysteresis (3)", Backlash(h=(3.15,) * 6, kappa=(0.35,) * 6, chi=ones)),
        ("play", "Play operator (2), h = 3.15, B = 1", Play(h=(3.15,) * 6, B=ones)),
    )
    t = np.arange(0.0, 8.0, 0.002)
    files = []
    for name, title, model in models:
        figure, panel = _panel(title, "tau", "u")
        for amplitude, colour in zip((2.5, 3.5, 4.5), COLOURS, strict=True):
            gears = GearHysteresis(model, np.zeros(6))
            tau = amplitude * np.sin(2.3 * t)
            u = [gears.step(np.full(6, value))[0] for value in tau]
            panel.plot(tau, u, color=colour, linewidth=1.0, label=f"tau = {amplitude} sin 2.3t")
        panel.legend()
        files.append(_save(figure, folder / name))
    return files


def draw_lyapunov(folder: Path, flight: Flight) -> Path:
    """Plot V_1 and its bound (30), per axis."""
    bound = lyapunov(flight.scenario, flight.result)
    figure = Figure(figsize=(13.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{flight.scenario.name}: V1 = q_z² / 2, its bound (30), and that by comparison, per axis")
    t = flight.result.t_ns / NANOSECONDS
    for axis, panel in enumerate(figure.subplots(2, 3).flat):
        panel.semilogy(t, _positive(bound.bound[:, axis]), color=COLOURS[1], label="bound (30)")
        panel.semilogy(t, _positive(bound.comparison[:, axis]), color=COLOURS[2], label="y' = -rho y + C1(t)")
        panel.semilogy(t, _positive(bound.v1[:, axis]), color=COLOURS[0], linewidth=0.7, label="V1")
        panel.set_title(AXIS_NAMES[AXES[axis]])
        panel.grid(visible=True, alpha=0.3)
        if axis >= 3:
            panel.set_xlabel("time (s)")
        if axis == 0:
            panel.legend(loc="upper right")
    return _save(figure, folder / f"{flight.scenario.name}_lyapunov")


def by_name(flights: Iterable[Flight]) -> dict[str, Flight]:
    """The flights of one scenario by condition name."""
    return {flight.condition.name: flight for flight in flights}


def _positive(values: FloatArray) -> FloatArray:
    return np.maximum(values, 1e-16)


def _unit(channel: str) -> str:
    return "cm" if channel in AXES[:3] else "rad"


def _panel(title: str, x_label: str, y_label: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    panel = figure.subplots()
    panel.set_title(title)
    panel.set_xlabel(x_label)
    panel.set_ylabel(y_label)
    panel.grid(visible=True, alpha=0.3)
    return figure, panel


def _save(figure: Figure, path: Path) -> Path:
    """Write PNG and SVG; returns the PNG. Raises RunFolderError."""
    try:
        figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})
        figure.savefig(path.with_suffix(".png"), dpi=90)
    except OSError as error:
        raise RunFolderError(f"cannot write the figure {path}: {error.strerror}") from None
    return path.with_suffix(".png")
