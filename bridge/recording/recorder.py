"""What both recorders do alike: a sidecar from the first moment to the last, and one sentence about a disk that refuses."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bridge.recording.sidecar import LinkOfLog, new_sidecar, write_sidecar
from protocol.errors import RunFolderError
from protocol.logs.tlog import TlogWriter

Tell = Callable[[str], None]


class SidecarLog(TlogWriter):
    """A log with its sidecar; how frames get to the disk is the recorder's own.

    sidecar   what the sidecar will hold; a caller may add to its "counters" until `close`
    lost      frames that are not, or will not be, in the log
    """

    def __init__(
        self,
        path: Path,
        links: tuple[LinkOfLog, ...],
        *,
        stamps: str,
        source: dict[str, Any],
        tell: Tell | None,
    ) -> None:
        """Open the log; see `new_sidecar`. Raises RunFolderError where that is not possible."""
        super().__init__(path)
        self.sidecar = new_sidecar(path, links, stamps=stamps, source=source)
        self.lost = 0
        self._tell = tell
        self._told = False

    @contextlib.contextmanager
    def _beginning(self) -> Iterator[None]:
        """Write the sidecar, and whatever else a recorder begins with in the block; where it fails, no log is left behind."""
        try:
            write_sidecar(self.path, self.sidecar)
            yield
        except (OSError, RunFolderError) as error:
            self._file.close()
            with contextlib.suppress(OSError):
                self.path.unlink()  # empty, and without its sidecar: no log
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise RunFolderError(f"cannot begin the log {self.path}: {reason}") from None

    def _end(self, problem: str, **content: Any) -> None:
        """Have the sidecar say how the log ended, and tell the user of a problem that has not been told."""
        self.sidecar |= {"complete": self.lost == 0, "lost": self.lost, **content}
        try:
            write_sidecar(self.path, self.sidecar)
        except RunFolderError as error:
            problem = problem or str(error)
        if problem:
            self._say(problem)

    def _say(self, sentence: str) -> None:
        """Tell what the disk refused, the first time: to `tell`, or by raising RunFolderError."""
        if self._told:
            return
        self._told = True
        if self._tell is None:
            raise RunFolderError(sentence)
        self._tell(sentence)
