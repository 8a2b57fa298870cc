"""Recording of a run's motor bus in a format that python-can reads back: .blf, .log (candump), .asc, .csv by suffix.

Stamps are simulation time, in lockstep and in real time, as in the tlog.
candump's .log has them 1 s later, because can-utils' log2asc takes second 0 for no time at all.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import can

from protocol.can_frame import CanFrame
from protocol.errors import RunFolderError, UsageError
from protocol.scenario import NANOSECONDS

SUFFIXES: Final = (".blf", ".log", ".asc", ".csv")
CHANNEL: Final = "motors"
CANDUMP_START_NS: Final = NANOSECONDS
"""The stamp of t = 0 in candump's .log."""


def check_record(path: Path) -> None:
    """Raise UsageError where python-can has no writer for the file's suffix, RunFolderError where the file exists."""
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"cannot record the bus to {path}: choose a name that ends in {', '.join(SUFFIXES)}")
    if path.exists():
        raise RunFolderError(f"{path} exists already and is not overwritten: choose another name for the bus log")


class CanRecorder:
    """Collects frames; `settle`, called outside the time-critical part of a tick, writes them.

    A write error raises RunFolderError; with `tell`, that is called once with the message instead, and the log ends there.
    """

    def __init__(self, path: Path, tell: Callable[[str], None] | None = None) -> None:
        check_record(path)
        self.path = path
        self._start_ns = CANDUMP_START_NS if path.suffix.lower() == ".log" else 0
        self._tell = tell
        self._is_full = False
        self._owed: list[tuple[int, CanFrame]] = []
        try:
            self._writer: Any = can.Logger(path)
        except OSError as error:
            raise self._refused(error) from None

    def watch(self, t_ns: int, frame: CanFrame) -> None:
        """Record a frame with its time (ns)."""
        if not self._is_full:
            self._owed.append((t_ns, frame))

    def settle(self) -> None:
        """Write the collected frames."""
        try:
            for t_ns, frame in self._owed:
                self._writer.on_message_received(
                    can.Message(
                        timestamp=(self._start_ns + t_ns) / NANOSECONDS,
                        arbitration_id=frame.can_id,
                        data=frame.data,
                        is_extended_id=frame.extended,
                        is_remote_frame=frame.remote,
                        channel=0 if self.path.suffix.lower() in (".blf", ".asc") else CHANNEL,
                    )
                )
        except OSError as error:
            self._give_up(error)
        finally:
            self._owed.clear()

    def close(self) -> None:
        """Write the collected frames and close the file."""
        self.settle()
        try:
            self._writer.stop()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        if self._is_full:
            return  # reported already
        self._is_full = True
        if self._tell is None:
            raise self._refused(error) from None
        self._tell(str(self._refused(error)))

    def _refused(self, error: OSError) -> RunFolderError:
        return RunFolderError(f"cannot write the bus log {self.path}: {error.strerror}")
