"""The motor bus of a run, recorded in a format that python-can reads back: .blf, .log (candump), .asc, .csv by suffix.

Stamps are the run's own time: simulation time in lockstep and real time alike, so that the log lies beside the tlog.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import can

from protocol.can_frame import CanFrame
from protocol.errors import RunFolderError, UsageError
from protocol.scenario import NANOSECONDS

SUFFIXES: Final = (".blf", ".log", ".asc", ".csv")
CHANNEL: Final = "motors"


def check_suffix(path: Path) -> None:
    """Raise UsageError where python-can has no writer for the file's suffix."""
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"the bus cannot be recorded to {path}: choose a name that ends in {', '.join(SUFFIXES)}")


class CanRecorder:
    """Keeps frames until `settle`, which is called where there is time. Raises RunFolderError where it cannot write."""

    def __init__(self, path: Path) -> None:
        check_suffix(path)
        self.path = path
        self._owed: list[tuple[int, CanFrame]] = []
        if path.exists():
            raise RunFolderError(f"{path} exists already, and stays: choose another name for the record of the bus")
        try:
            self._writer: Any = can.Logger(path)
        except OSError as error:
            raise RunFolderError(f"cannot write the record of the bus {path}: {error.strerror}") from None

    def watch(self, t_ns: int, frame: CanFrame) -> None:
        """Have a frame recorded under a time (ns)."""
        self._owed.append((t_ns, frame))

    def settle(self) -> None:
        """Write what is owed."""
        try:
            for t_ns, frame in self._owed:
                self._writer.on_message_received(
                    can.Message(
                        timestamp=t_ns / NANOSECONDS,
                        arbitration_id=frame.can_id,
                        data=frame.data,
                        is_extended_id=frame.extended,
                        is_remote_frame=frame.remote,
                        channel=0 if self.path.suffix.lower() in (".blf", ".asc") else CHANNEL,
                    )
                )
        except OSError as error:
            raise RunFolderError(f"cannot write the record of the bus {self.path}: {error.strerror}") from None
        finally:
            self._owed.clear()

    def close(self) -> None:
        """Write what is owed and close."""
        try:
            self.settle()
            self._writer.stop()
        except OSError as error:
            raise RunFolderError(f"cannot write the record of the bus {self.path}: {error.strerror}") from None
