"""From time stamps to latency segments: the rows of both ends are joined by sample time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bridge.latency.segments import (
    ANSWER_COLUMNS,
    CONTROLLER_FILE,
    EMULATOR_FILE,
    SAMPLE_COLUMNS,
    TICK_COLUMNS,
    Rows,
    load_legs,
)
from bridge.timing.timesync import Estimate
from fwav_hil.latency.clocks import offset_at

LEGS = {
    "wake": "due -> emulator wakes",
    "sense": "-> measured, stamped",
    "to_kernel": "-> kernel (controller)",
    "to_controller": "-> controller wakes",
    "compute": "-> command computed",
    "hand_over": "-> sent",
    "back_to_kernel": "-> kernel (emulator)",
    "to_emulator": "-> emulator wakes",
    "apply": "-> applied",
    "age": "age: stamped -> applied",
}
"""Each latency segment by name, in the order of travel; `age` is that of the sample in the applied command."""


class Legs(NamedTuple):
    """The latency segments of a run.

    t_ns (n,)      simulation time of the samples that were answered
    durations_ns   segment -> (n,) ns; -1 where it is not known for a sample
    delay_ns (n,)  from the sample to the action of its command, in simulation time
    clock          TIMESYNC's estimate of the controller's clock minus the emulator's, None without an answer
    negative       number of negative durations, which count as 0: a measure of clock error
    offset_ns      with two clocks: the controller's minus the emulator's at each sample, and the bound of its error (n,) each;
    offset_error_ns    None with one clock, or without an answer
    """

    t_ns: Rows
    durations_ns: dict[str, Rows]
    delay_ns: Rows
    clock: Estimate | None
    negative: int
    offset_ns: Rows | None = None
    offset_error_ns: Rows | None = None

    def known(self, leg: str) -> Rows:
        """The known durations of a segment."""
        values = self.durations_ns[leg]
        return values[values >= 0]


def join_legs(folder: Path, controller_folder: Path | None = None) -> Legs:
    """The segments of a run: with one clock on one machine; with a controller_folder two clocks, related by TIMESYNC.

    Raises RunFolderError.
    """
    (samples,), _ = load_legs((controller_folder or folder) / CONTROLLER_FILE, "samples")
    if controller_folder is None:
        (ticks, answers), clock = load_legs(folder / EMULATOR_FILE, "ticks", "answers")
        return legs_of(ticks, answers, samples, clock)
    (ticks, answers, clocks), clock = load_legs(folder / EMULATOR_FILE, "ticks", "answers", "clocks")
    return legs_of(ticks, answers, samples, clock, clocks=clocks)


def legs_of(ticks: Rows, answers: Rows, samples: Rows, clock: Estimate | None, *, clocks: Rows | None = None) -> Legs:
    """The segments of rows as in `bridge.latency.segments`; samples whose command was never applied are left out.

    clocks: with two clocks, rows that relate them (CLOCK_COLUMNS); without a row, segments from one end to the other are
    unknown.
    """
    t_ns = np.intersect1d(np.intersect1d(ticks[:, 0], answers[:, 0]), samples[:, 0])
    tick = _columns(ticks, t_ns, TICK_COLUMNS)
    answer = _columns(answers, t_ns, ANSWER_COLUMNS)
    sample = _columns(samples, t_ns, SAMPLE_COLUMNS)
    sent, back = tick["sent_ns"], answer["kernel_ns"]
    offset_ns, offset_error_ns = None, None
    if clocks is not None and len(clocks):
        offset_ns, offset_error_ns = offset_at(clocks, sent)
    elif clocks is not None:
        sent, back = np.zeros_like(sent), np.zeros_like(back)
    route = (
        ("wake", tick["due_ns"], tick["woke_ns"]),
        ("sense", tick["woke_ns"], tick["sent_ns"]),
        ("to_kernel", sent, _shifted(sample["kernel_ns"], offset_ns)),
        ("to_controller", sample["kernel_ns"], sample["woke_ns"]),
        ("compute", sample["woke_ns"], sample["computed_ns"]),
        ("hand_over", sample["computed_ns"], sample["sent_ns"]),
        ("back_to_kernel", _shifted(sample["sent_ns"], offset_ns), back),
        ("to_emulator", answer["kernel_ns"], answer["woke_ns"]),
        ("apply", answer["woke_ns"], answer["applied_ns"]),
        ("age", tick["sent_ns"], answer["applied_ns"]),
    )
    durations, negative = {}, 0
    for name, begun, ended in route:
        known = (begun != 0) & (ended != 0)
        negative += int((known & (ended < begun)).sum())
        durations[name] = np.where(known, np.maximum(0, ended - begun), -1)
    return Legs(t_ns, durations, answer["acts_ns"] - t_ns, clock, negative, offset_ns, offset_error_ns)


def _shifted(stamps_ns: Rows, offset_ns: Rows | None) -> Rows:
    """Time stamps of the controller converted to the emulator's clock; unknown ones stay 0."""
    return stamps_ns if offset_ns is None else np.where(stamps_ns != 0, stamps_ns - offset_ns, 0)


def _columns(rows: Rows, t_ns: Rows, names: tuple[str, ...]) -> dict[str, npt.NDArray[np.int64]]:
    """The first row of each sample, by column."""
    _, first = np.unique(rows[:, 0], return_index=True)
    chosen = rows[first]
    chosen = chosen[np.searchsorted(chosen[:, 0], t_ns)]
    return {name: chosen[:, column] for column, name in enumerate(names)}


def clock_check(legs: Legs) -> dict[str, Any] | None:
    """TIMESYNC compared with the clock that both ends share on one machine: its error and its bound; us."""
    if legs.clock is None:
        return None
    return {
        "offset_us": legs.clock.offset_ns / 1e3,
        "true_offset_us": 0.0,
        "error_us": abs(legs.clock.offset_ns) / 1e3,
        "bound_us": legs.clock.error_ns / 1e3,
        "answers": legs.clock.answers,
        "held": abs(legs.clock.offset_ns) <= legs.clock.error_ns,
    }
