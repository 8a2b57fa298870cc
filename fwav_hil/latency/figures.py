"""The plot of a latency study: percentile curves and the age over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from protocol.errors import RunFolderError

COLOURS = ("#0b61a4", "#c2410c", "#3f7d20", "#7a4fa3", "#7a7a7a", "#b8860b")
STYLES = ("-", "--", ":")
_TICKS = (0.5, 0.9, 0.99, 0.999, 0.9999)


def draw(
    path: Path,
    title: str,
    curves: dict[str, npt.NDArray[np.int64]],
    series: tuple[npt.NDArray[Any], str, npt.NDArray[np.int64]],
) -> Path:
    """Draw percentile curves (name -> ns) and one series (t in s, its name, ns) over time. Raises RunFolderError."""
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    left, right = figure.subplots(1, 2)
    for number, (name, values) in enumerate(curves.items()):
        ordered = np.sort(values) / 1e3
        if not ordered.any():
            continue  # nothing, or zeros only, which a logarithmic axis cannot show
        share = (np.arange(len(ordered)) + 0.5) / len(ordered)
        style = {"color": COLOURS[number % len(COLOURS)], "linestyle": STYLES[number // len(COLOURS) % len(STYLES)]}
        left.plot(1.0 / (1.0 - share), ordered, linewidth=1.3, label=name, **style)
    left.set_xscale("log")
    left.set_yscale("log")
    left.set_xticks([1.0 / (1.0 - share) for share in _TICKS], [f"{100 * share:g} %" for share in _TICKS])
    left.minorticks_off()
    left.set_xlabel("percentile")
    left.set_ylabel("us")
    if left.lines:
        left.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    t, name, values = series
    right.plot(t, values / 1e3, ".", color=COLOURS[0], markersize=2)
    right.set_xlabel("time (s)")
    right.set_ylabel("us")
    right.set_title(name)
    right.set_ylim(bottom=0.0)
    for panel in (left, right):
        panel.grid(visible=True, alpha=0.3)
    try:
        figure.savefig(path, dpi=90)
    except OSError as error:
        raise RunFolderError(f"cannot write the figure {path}: {error.strerror}") from None
    return path
