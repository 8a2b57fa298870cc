"""The plots of a run, as PNG: tracking, error, command, and the gears' u against tau."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fwav_hil.score import desired_positions, tracking_error
from protocol.errors import RunFolderError
from protocol.messages import FloatArray
from protocol.scenario import NANOSECONDS, Scenario

REFERENCE, ACTUAL, EXTRA = "#7a7a7a", "#0b61a4", "#c2410c"
_SHOWN = (
    ("x", 100.0, "cm"),
    ("y", 100.0, "cm"),
    ("z (down)", 100.0, "cm"),
    ("roll", 180.0 / np.pi, "deg"),
    ("pitch", 180.0 / np.pi, "deg"),
    ("yaw", 180.0 / np.pi, "deg"),
)
_FORCES = (
    ("force x", 1e3, "mN"),
    ("force y", 1e3, "mN"),
    ("force z", 1e3, "mN"),
    ("torque roll", 1e6, "µN m"),
    ("torque pitch", 1e6, "µN m"),
    ("torque yaw", 1e6, "µN m"),
)


def plot_run(folder: Path, scenario: Scenario, truth: npt.NDArray[np.void], title: str) -> dict[str, Path]:
    """Draw the plots of a run into `folder`; returns them by name. Raises RunFolderError."""
    t = truth["t_ns"] / NANOSECONDS
    q, error = truth["q"], tracking_error(scenario, truth["q"])
    desired = desired_positions(scenario, len(q))
    plots = {name: folder / f"{name}.png" for name in ("tracking", "error", "command", "hysteresis")}

    with _grid(plots["tracking"], f"{title}: reference and actual", "time (s)") as axes:
        for axis, (panel, (name, factor, unit)) in enumerate(zip(axes, _SHOWN, strict=True)):
            panel.plot(t, factor * desired[:, axis], color=REFERENCE, linewidth=2.5, alpha=0.7, label="reference")
            panel.plot(t, factor * q[:, axis], color=ACTUAL, linewidth=1.0, label="actual")
            panel.set_title(f"{name} ({unit})")
        axes[0].figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)

    with _grid(plots["error"], f"{title}: error (true state minus reference)", "time (s)") as axes:
        for axis, (panel, (name, factor, unit)) in enumerate(zip(axes, _SHOWN, strict=True)):
            finer, unit_name = (10.0, "mm") if unit == "cm" else (1.0, unit)
            panel.axhline(0.0, color=REFERENCE, linewidth=0.8)
            panel.plot(t, finer * factor * error[:, axis], color=ACTUAL, linewidth=0.8)
            panel.set_title(f"{name} ({unit_name})")

    with _grid(plots["command"], f"{title}: command of the law, body frame", "time (s)") as axes:
        for axis, (panel, (name, factor, unit)) in enumerate(zip(axes, _FORCES, strict=True)):
            panel.plot(t, factor * truth["command"][:, axis], color=ACTUAL, linewidth=0.7, label="tau")
            _show_limits(panel, factor, scenario, axis, truth["command"][:, axis])
            panel.set_title(f"{name} ({unit})")

    curves = [np.stack((truth["tau"][:, axis], truth["u"][:, axis]), axis=1) for axis in range(6)]
    gear_panels(plots["hysteresis"], f"{title}: gears, u against tau", curves)
    return plots


def gear_panels(path: Path, title: str, curves: Sequence[FloatArray]) -> None:
    """u against tau of six axes; curves: (n, 2) each, tau and u."""
    with _grid(path, title, "motor command tau") as axes:
        for curve, panel, (name, factor, unit) in zip(curves, axes, _FORCES, strict=True):
            panel.plot(factor * curve[:, 0], factor * curve[:, 1], color=EXTRA, linewidth=0.5)
            panel.set_title(f"{name}: u over tau ({unit})")


def _show_limits(panel: Any, factor: float, scenario: Scenario, axis: int, values: FloatArray) -> None:
    """Draw only limits that the command came near to: distant ones would flatten the curve."""
    for limit in (scenario.actuators.lower[axis], scenario.actuators.upper[axis]):
        if len(values) and np.min(np.abs(values - limit)) < 0.1 * abs(limit):
            panel.axhline(factor * limit, color=EXTRA, linewidth=0.8, linestyle="--")


@contextmanager
def _grid(path: Path, title: str, x_label: str) -> Iterator[list[Any]]:
    """Six panels: translation above, rotation below; saved to `path` at the end."""
    figure = Figure(figsize=(13.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    panels = list(figure.subplots(2, 3).flat)
    for panel in panels:
        panel.grid(visible=True, alpha=0.3)
    for panel in panels[3:]:
        panel.set_xlabel(x_label)
    yield panels
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise RunFolderError(f"cannot write the plot {path}: {error.strerror}") from None
