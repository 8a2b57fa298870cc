"""What both recorders share: a sidecar from the beginning to the end of the log, and one message on a write error."""

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
    """A log with its sidecar; subclasses define how frames are written.

    sidecar   content of the sidecar; a caller may add to its "counters" until `close`
    lost      frames that are missing from the log
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
        """Open the log; see `new_sidecar`. Raises RunFolderError where that fails."""
        super().__init__(path)
        self.sidecar = new_sidecar(path, links, stamps=stamps, source=source)
        self.lost = 0
        self._tell = tell
        self._told = False

    @contextlib.contextmanager
    def _beginning(self) -> Iterator[None]:
        """Write the sidecar, then run the block with the recorder's own setup; after an error no log is left behind."""
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
        """Write the end of the log to the sidecar, and report a problem that was not reported before."""
        self.sidecar |= {"complete": self.lost == 0, "lost": self.lost, **content}
        try:
            write_sidecar(self.path, self.sidecar)
        except RunFolderError as error:
            problem = problem or str(error)
        if problem:
            self._say(problem)

    def _say(self, sentence: str) -> None:
        """Report the first write error: to `tell`, or by raising RunFolderError."""
        if self._told:
            return
        self._told = True
        if self._tell is None:
            raise RunFolderError(sentence)
        self._tell(sentence)
