"""Latency segments: time stamps of each sample and its command, recorded by both ends as rows of a table.

All stamps are of the end's own `MonotonicClock`, in ns, and 0 where unknown. A sample is identified by its simulation time,
which the command echoes, so that the rows of both ends can be joined. Between two machines TIMESYNC relates the clocks.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bridge.timing.timesync import Estimate
from protocol.errors import RunFolderError

TICK_COLUMNS = ("t_ns", "due_ns", "woke_ns", "sent_ns")
"""Emulator, per tick: due by the schedule; begun; handed to the link, which is the sensor's stamp."""
ANSWER_COLUMNS = ("t_ns", "kernel_ns", "woke_ns", "applied_ns", "acts_ns")
"""Emulator, per command: received by the kernel; fetched from it; handed to the plant; simulation time it acts from."""
SAMPLE_COLUMNS = ("t_ns", "kernel_ns", "woke_ns", "computed_ns", "sent_ns")
"""Controller, per sample: received by the kernel; fetched from it; command computed; handed to the link."""
CLOCK_COLUMNS = ("at_ns", "offset_ns", "round_trip_ns")
"""Emulator, per answer to TIMESYNC: how far the controller's clock was ahead, and twice the error bound of that."""
EMULATOR_FILE, CONTROLLER_FILE = "legs_emulator.npz", "legs_controller.npz"

Rows = npt.NDArray[np.int64]
_TABLES = {"ticks": TICK_COLUMNS, "answers": ANSWER_COLUMNS, "samples": SAMPLE_COLUMNS, "clocks": CLOCK_COLUMNS}
_BLOCK = 65536


class LegTable:
    """Rows of stamps in large blocks: adding a row rarely allocates memory, and never copies existing rows."""

    def __init__(self, columns: tuple[str, ...]) -> None:
        self.columns = columns
        self._blocks: list[Rows] = []
        self._count = _BLOCK
        self._begin_block()

    def _begin_block(self) -> None:
        self._blocks.append(np.zeros((_BLOCK, len(self.columns)), dtype=np.int64))
        self._count = 0

    def add(self, *stamps_ns: int) -> None:
        """Add a row."""
        if self._count == _BLOCK:
            self._begin_block()
        self._blocks[-1][self._count] = stamps_ns
        self._count += 1

    @property
    def rows(self) -> Rows:
        """All rows (n, columns)."""
        return np.vstack([*self._blocks[:-1], self._blocks[-1][: self._count]])


def save_legs(path: Path, tables: dict[str, LegTable], clock: Estimate | None) -> None:
    """Write tables by name, and the estimated offset of the other end's clock. Raises RunFolderError."""
    offset = (clock.offset_ns, clock.round_trip_ns, clock.answers) if clock else (0, -1, 0)
    try:
        arrays: dict[str, Any] = {name: table.rows for name, table in tables.items()}
        np.savez(path, clock=np.array(offset, dtype=np.int64), **arrays)
    except OSError as error:
        raise RunFolderError(f"cannot write {path}: {error.strerror}; choose another folder with --out") from None


def load_legs(path: Path, *names: str) -> tuple[list[Rows], Estimate | None]:
    """The tables of these names (ticks, answers, samples, clocks) and the clock estimate; see `save_legs`.

    Raises RunFolderError where the file is missing or damaged.
    """
    try:
        with path.open("rb") as opened, np.load(opened) as file:  # numpy leaves open what it cannot read
            arrays = {name: np.asarray(file[name]) for name in file.files}
        offset_ns, round_trip_ns, answers = map(int, arrays["clock"])
        tables = [arrays[name] for name in names]
    except FileNotFoundError:
        raise RunFolderError(f"there is no {path}: fly the run with --legs, which records latency segments") from None
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise _damaged(path, error) from None
    for name, table in zip(names, tables, strict=True):
        if table.dtype != np.int64 or table.ndim != 2 or table.shape[1] != len(_TABLES[name]):
            raise _damaged(path, f"{name} is {table.dtype} {table.shape}")
    return tables, Estimate(offset_ns, round_trip_ns, answers) if round_trip_ns >= 0 else None


def _damaged(path: Path, why: object) -> RunFolderError:
    return RunFolderError(f"{path} is damaged, or holds no time stamps ({why}): fly the run again with --legs")
