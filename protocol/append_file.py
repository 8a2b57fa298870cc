"""Base of files that grow during a run: unbuffered writes; closing flushes the rest."""

from __future__ import annotations

import abc
from pathlib import Path
from types import TracebackType
from typing import Self

from protocol.errors import RunFolderError


class AppendFile(abc.ABC):
    """A file that is written to the system at each `flush`; `what` is its name in error messages ("the log").

    Raises RunFolderError where it cannot be opened.
    """

    def __init__(self, path: Path, what: str) -> None:
        self.path = path
        self._what = what
        try:
            self._file = path.open("wb", buffering=0)
        except OSError as error:
            raise self._refused(error) from None

    def _refused(self, error: OSError) -> RunFolderError:
        return RunFolderError(f"cannot write {self._what} {self.path}: {error.strerror}")

    @abc.abstractmethod
    def flush(self) -> None:
        """Write pending data to the system. Raises RunFolderError."""

    def close(self) -> None:
        """Flush and close; may be called again."""
        if not self._file.closed:
            try:
                self.flush()
            finally:
                self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
