"""Where each sample and its command were, and when: rows of time stamps that either end gathers while it runs.

All stamps are of the end's own `MonotonicClock`, ns, and 0 where unknown. A sample is told by its simulation time, which the
command echoes, so the rows of both ends join; `TimeSync` says how their clocks relate where they run on two machines.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bridge.timesync import Estimate
from protocol.errors import RunFolderError

TICK_COLUMNS = ("t_ns", "due_ns", "woke_ns", "sent_ns")
"""Emulator, per tick: due by the schedule; begun; handed to the link, which is the sensor's stamp."""
ANSWER_COLUMNS = ("t_ns", "kernel_ns", "woke_ns", "applied_ns", "acts_ns")
"""Emulator, per command: received by the kernel; fetched from it; handed to the plant; simulation time it acts from."""
SAMPLE_COLUMNS = ("t_ns", "kernel_ns", "woke_ns", "computed_ns", "sent_ns")
"""Controller, per sample: received by the kernel; fetched from it; command computed; handed to the link."""
EMULATOR_FILE, CONTROLLER_FILE = "legs_emulator.npz", "legs_controller.npz"

Rows = npt.NDArray[np.int64]
_GROWTH = 65536


class LegTable:
    """Rows of stamps that grow in large steps, so that adding one allocates nothing as a rule."""

    def __init__(self, columns: tuple[str, ...]) -> None:
        self.columns = columns
        self._rows: Rows = np.zeros((_GROWTH, len(columns)), dtype=np.int64)
        self._count = 0

    def add(self, *stamps_ns: int) -> None:
        """Add a row."""
        if self._count == len(self._rows):
            self._rows = np.vstack([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = stamps_ns
        self._count += 1

    @property
    def rows(self) -> Rows:
        """What was added, a row each."""
        return self._rows[: self._count]


def save_legs(path: Path, tables: dict[str, LegTable], clock: Estimate | None) -> None:
    """Write tables by name, and how far the other end's clock is ahead of this one's. Raises RunFolderError."""
    offset = (clock.offset_ns, clock.round_trip_ns, clock.answers) if clock else (0, -1, 0)
    try:
        arrays: dict[str, Any] = {name: table.rows for name, table in tables.items()}
        np.savez(path, clock=np.array(offset, dtype=np.int64), **arrays)
    except OSError as error:
        raise RunFolderError(f"cannot write {path}: {error.strerror}; choose another folder with --out") from None


def load_legs(path: Path) -> tuple[dict[str, Rows], Estimate | None]:
    """The tables by name, and the clock's estimate; see `save_legs`. Raises RunFolderError where there are none."""
    try:
        with np.load(path) as file:
            tables = {name: np.asarray(file[name]) for name in file.files}
        offset_ns, round_trip_ns, answers = tables.pop("clock").tolist()
    except (OSError, EOFError, KeyError, ValueError) as error:
        raise RunFolderError(f"{path} holds no time stamps of a run ({error}): fly it with --legs") from None
    return tables, Estimate(offset_ns, round_trip_ns, answers) if round_trip_ns >= 0 else None
