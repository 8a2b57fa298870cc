"""Fields of a log over time, as PNG: `fwav-hil log plot`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fwav_hil.logs.choice import Choice, near_matches
from fwav_hil.logs.outputs import whole
from protocol.errors import UsageError
from protocol.logs.files import Log, fields_of

MOST_LINES = 16
_FIELD = re.compile(r"(?P<message>[^.]+)\.(?P<field>.+?)(?:\[(?P<index>\d+)\])?$")


class Line(NamedTuple):
    """One line of a plot: times (s from the log's beginning) and values, both of shape (rows,).

    `label` tells it from the other lines of its field: the element, and the sender where there are several.
    """

    label: str
    t_s: npt.NDArray[np.float64]
    values: npt.NDArray[np.float64]


def lines_of(log: Log, wanted: str, choice: Choice) -> list[Line]:
    """The lines that `MSG.field` or `MSG.field[i]` stands for: one for each element and each sender.

    Raises UsageError where the log has no such field, or it is no number.
    """
    parts = _FIELD.match(wanted)
    if parts is None:
        raise UsageError(f"{wanted} is no field: write MESSAGE.field or MESSAGE.field[index]")
    message, field, index = parts["message"], parts["field"], parts["index"]
    held = log.names()
    if message not in held:
        raise UsageError(f"{log.path} holds no message {message}{near_matches(message, held)}")
    table = log.tables([message], between_us=choice.between_us, senders=choice.senders).get(message)
    if table is None:
        raise UsageError(f"{log.path} holds no {message} of that time and system")
    if field not in (table.dtype.names or ()):
        raise UsageError(f"{message} has no field {field}{near_matches(field, fields_of(table))}")
    column, first_us = table[field], log.span_us()[0]
    if column.dtype.kind not in "iufb":
        raise UsageError(f"{wanted} is text, which has no plot; see `fwav-hil log dump {log.path} --types {message}`")
    if index is not None and (column.ndim == 1 or int(index) >= column.shape[1]):
        size = f"{column.shape[1]} elements" if column.ndim > 1 else "no elements"
        raise UsageError(f"{wanted}: {message}.{field} has {size}")
    elements: Sequence[int | None] = [None]
    if column.ndim > 1:
        elements = range(column.shape[1]) if index is None else [int(index)]
    return [
        Line(" ".join(filter(None, (f"[{element}]" if element is not None else "", sender))), times, values)
        for sender, rows in _senders(table)
        for times in [(table["t_us"][rows] - first_us) / 1e6]
        for element in elements[:MOST_LINES]
        for values in [(column[rows] if element is None else column[rows, element]).astype(np.float64)]
    ]


def _senders(table: npt.NDArray[np.void]) -> list[tuple[str, npt.NDArray[np.bool_]]]:
    """The rows of each sender, and how a label names it; one alone is not named."""
    if "frame_sequence" not in (table.dtype.names or ()):
        return [("", np.ones(len(table), dtype=np.bool_))]
    key = table["system"].astype(int) << 8 | table["component"]
    found = np.unique(key)
    names = [f"{number >> 8}.{number & 0xFF}" if len(found) > 1 else "" for number in found]
    return [(name, key == number) for name, number in zip(names, found, strict=True)]


def plot_log(log: Log, fields: Sequence[str], choice: Choice, path: Path) -> None:
    """Draw a panel for each field, one above the other, into `path`, which must not be there yet.

    Raises UsageError for a field that is none, RunFolderError where the file exists or cannot be written.
    """
    panels = [(wanted, lines_of(log, wanted, choice)) for wanted in fields]
    figure = Figure(figsize=(11.0, 1.2 + 2.2 * len(panels)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(log.path.name)
    axes: Any = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
    for panel, (wanted, lines) in zip(axes[:, 0], panels, strict=True):
        for line in lines:
            marker = "." if len(line.t_s) < 200 else None
            panel.plot(line.t_s, line.values, linewidth=0.9, marker=marker, label=line.label)
        message, _, field = wanted.partition(".")
        shown = str(log.unit(message, re.sub(r"\[\d+\]$", "", field)))
        panel.set_title(wanted + (f" ({shown})" if shown else ""), fontsize="medium")
        panel.grid(visible=True, alpha=0.3)
        if len(lines) > 1:
            columns = 1 + (len(lines) - 1) // 8
            panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize="x-small", ncols=columns)
    axes[-1, 0].set_xlabel("time from the log's beginning (s)")
    with whole(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
