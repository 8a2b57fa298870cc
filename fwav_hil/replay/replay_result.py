"""Recorded and replayed values compared: figures, a table and a plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rich.table import Table

from fwav_hil.tables import plain_console
from protocol.messages import AXES, AXIS_UNITS, FloatArray

_SHOWN = {
    "command": (("force x", 1e3, "mN"), ("force y", 1e3, "mN"), ("force z", 1e3, "mN"),
                ("torque roll", 1e6, "µN m"), ("torque pitch", 1e6, "µN m"), ("torque yaw", 1e6, "µN m")),
    "motion": (("x", 1e3, "mm"), ("y", 1e3, "mm"), ("z", 1e3, "mm"),
               ("roll", 180.0 / np.pi, "deg"), ("pitch", 180.0 / np.pi, "deg"), ("yaw", 180.0 / np.pi, "deg")),
}  # fmt: skip


class Difference(NamedTuple):
    """Two runs compared sample by sample.

    what       "command": tau, body frame (N, N m), or "motion": position and attitude as measured (m, rad)
    t_ns       (n,) times of the samples that both have; recorded, replayed (n, 6)
    equal      (n,) whether they are the same to the byte
    missing    samples that only one of them has
    """

    what: str
    t_ns: npt.NDArray[np.int64]
    recorded: FloatArray
    replayed: FloatArray
    equal: npt.NDArray[np.bool_]
    missing: int

    @property
    def is_zero(self) -> bool:
        """Whether no byte differs."""
        return bool(self.equal.all()) and self.missing == 0 and len(self.t_ns) > 0

    def figures(self) -> dict[str, Any]:
        """Maximum and RMS by axis, and the time of the first difference; SI units."""
        error = self.replayed - self.recorded
        apart = np.flatnonzero(~self.equal)
        units = ("N",) * 3 + ("N m",) * 3 if self.what == "command" else AXIS_UNITS
        return {
            "what": self.what,
            "samples": len(self.t_ns),
            "identical": int(self.equal.sum()),
            "missing": self.missing,
            "first_divergence_s": float(self.t_ns[apart[0]] * 1e-9) if len(apart) else None,
            "axes": {
                axis: {
                    "max": float(np.abs(error[:, i]).max()) if len(error) else None,
                    "rms": float(np.sqrt(np.mean(error[:, i] ** 2))) if len(error) else None,
                    "unit": units[i],
                }
                for i, axis in enumerate(AXES)
            },
        }


def print_difference(difference: Difference, title: str, *, to_stderr: bool) -> None:
    """Say in a line, or a table, how far the replay is from the record."""
    console = plain_console(to_stderr=to_stderr)
    figures = difference.figures()
    if difference.is_zero:
        console.print(f"{title}: no difference in {figures['samples']} samples, to the byte")
        return
    table = Table("axis", title=title, title_justify="left")
    for column in ("largest difference", "RMS"):
        table.add_column(column, justify="right")
    for axis, (name, factor, unit) in zip(AXES, _SHOWN[difference.what], strict=True):
        values = figures["axes"][axis]
        shown = ["-" if values[key] is None else f"{factor * values[key]:.4g} {unit}" for key in ("max", "rms")]
        table.add_row(name, *shown)
    console.print(table)
    first = figures["first_divergence_s"]
    console.print(
        f"{figures['samples']} samples, {figures['identical']} identical, {figures['missing']} in only one of the two"
        + (f"; first difference at t = {first:.3f} s" if first is not None else "")
    )


def plot_difference(difference: Difference, title: str, path: Path) -> None:
    """Plot recording, replay and their difference by axis, as PNG. Raises RunFolderError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from fwav_hil.plots import ACTUAL, EXTRA, REFERENCE
    from protocol.errors import RunFolderError

    figure = Figure(figsize=(13.0, 10.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    panels = figure.subplots(4, 3, sharex=True)
    t = difference.t_ns * 1e-9
    for axis, (name, factor, unit) in enumerate(_SHOWN[difference.what]):
        above, below = (panels[2 * (axis // 3) + row][axis % 3] for row in (0, 1))
        above.plot(
            t, factor * difference.recorded[:, axis], color=REFERENCE, linewidth=2.2, alpha=0.7, label="recorded"
        )
        above.plot(t, factor * difference.replayed[:, axis], color=ACTUAL, linewidth=0.8, label="replayed")
        above.set_title(f"{name} ({unit})")
        error = factor * (difference.replayed[:, axis] - difference.recorded[:, axis])
        below.plot(t, error, color=EXTRA, linewidth=0.8)
        below.set_title(f"{name}: replayed minus recorded ({unit})")
        for panel in (above, below):
            panel.grid(visible=True, alpha=0.3)
    panels[0][0].legend(loc="best")
    for panel in panels[3]:
        panel.set_xlabel("time of the sample (s)")
    try:
        figure.savefig(path, dpi=100)
    except OSError as error:
        raise RunFolderError(f"cannot write the plot {path}: {error.strerror}") from None
