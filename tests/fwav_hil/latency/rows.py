"""Stamps of a run in which every leg is known."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from bridge.latency.segments import (
    ANSWER_COLUMNS,
    CLOCK_COLUMNS,
    CONTROLLER_FILE,
    EMULATOR_FILE,
    SAMPLE_COLUMNS,
    TICK_COLUMNS,
    LegTable,
    save_legs,
)
from bridge.timing.timesync import Estimate

PERIOD_NS = 4_000_000
START_NS = 10**13
DURATIONS_NS = {
    "wake": 1_000,
    "sense": 20_000,
    "to_kernel": 3_000,
    "to_controller": 40_000,
    "compute": 15_000,
    "hand_over": 600,
    "back_to_kernel": 7_000,
    "to_emulator": 80_000,
    "apply": 9_000,
}
"""What each leg takes at tick 0; at tick k it takes k ns more."""
AGE_NS = sum(DURATIONS_NS.values()) - DURATIONS_NS["wake"] - DURATIONS_NS["sense"]
LEGS_WITHIN_AGE = 7
DELAY_NS = 250_000


class Stamps(NamedTuple):
    """Rows of both ends."""

    ticks: LegTable
    answers: LegTable
    samples: LegTable


def stamps(count: int, *, offset_ns: int = 0, stamped: bool = True) -> Stamps:
    """The rows of `count` ticks; offset_ns: the controller's clock less the emulator's; stamped: the kernel's are known."""
    made = Stamps(LegTable(TICK_COLUMNS), LegTable(ANSWER_COLUMNS), LegTable(SAMPLE_COLUMNS))
    for tick in range(count):
        t_ns = tick * PERIOD_NS
        due_ns = START_NS + t_ns
        times_ns = (due_ns + np.cumsum([duration + tick for duration in DURATIONS_NS.values()])).tolist()
        woke, sent, heard, looked, computed, said, came, fetched, applied = times_ns
        kernel = stamped * (heard + offset_ns), stamped * came
        made.ticks.add(t_ns, due_ns, woke, sent)
        made.samples.add(t_ns, kernel[0], looked + offset_ns, computed + offset_ns, said + offset_ns)
        made.answers.add(t_ns, kernel[1], fetched, applied, t_ns + DELAY_NS)
    return made


def save(stamped: Stamps, folder: Path, controller_folder: Path | None = None, clock: Estimate | None = None) -> None:
    """Write the files of a run."""
    clocks = LegTable(CLOCK_COLUMNS)
    if clock:
        clocks.add(START_NS, clock.offset_ns, clock.round_trip_ns)
    tables = {"ticks": stamped.ticks, "answers": stamped.answers, "clocks": clocks}
    save_legs(folder / EMULATOR_FILE, tables, clock)
    save_legs((controller_folder or folder) / CONTROLLER_FILE, {"samples": stamped.samples}, None)
