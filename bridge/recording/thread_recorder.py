"""Recording of frames into a log while the loop runs, robust against a kill and write errors.

The loop only appends to a queue. A thread writes it to the system every 40 ms, where it is safe if the process dies: a
kill -9 loses less than the last 100 ms, and at most truncates the last record, which readers skip. Until `close` the
sidecar marks the log as incomplete.
"""

from __future__ import annotations

import contextlib
import os
import struct
import threading
from collections import deque
from pathlib import Path
from typing import Any, Final

from bridge.recording.recorder import SidecarLog, Tell
from bridge.recording.sidecar import INDEX_ENTRY, LinkOfLog, index_path, sidecar_path
from protocol.errors import RunFolderError

FLUSH_PERIOD_S: Final = 0.04
QUEUE_LIMIT: Final = 500_000
"""Frames that may wait for the thread while the disk blocks it; further ones are lost, and counted."""
PENDING_LIMIT_BYTES: Final = 64 << 20
"""Bytes that may wait during write errors; further frames are lost, and counted."""

_STAMP = struct.Struct(">Q")


class Recorder(SidecarLog):
    """A log that is written by a background thread, with its sidecar.

    After a write error `tell` is called with one message at the next `write`; the recorder continues, retries every
    40 ms, and counts frames that it cannot write in the end as lost. Without `tell` RunFolderError is raised, once.
    """

    def __init__(
        self,
        path: Path,
        links: tuple[LinkOfLog, ...],
        *,
        stamps: str,
        source: dict[str, Any],
        tell: Tell | None = None,
    ) -> None:
        """Begin the log with its sidecar; see `new_sidecar`. Raises RunFolderError where that fails."""
        super().__init__(path, links, stamps=stamps, source=source, tell=tell)
        self._news = ""
        self._queue: deque[tuple[int, bytes]] = deque()
        self._ends: deque[int] = deque()  # of the records on their way to the disk, as places in the log
        self._frames = self._accepted_bytes = self._whole_bytes = 0
        self._link = -1
        self._index = None
        self._index_pending = bytearray()
        with self._beginning():
            if len(links) > 1:
                self._index = index_path(path).open("wb", buffering=0)
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"recorder of {path.name}", daemon=True)
        self._thread.start()

    def write(self, t_us: int, frame: bytes, link: int = 0) -> None:
        """Record one frame of a link; never waits for the disk. May be called from several threads."""
        if self._news:
            self._say_news()
        if len(self._queue) < QUEUE_LIMIT:
            self._queue.append((link, _STAMP.pack(t_us) + frame))
        else:
            with self._lock:
                self.lost += 1

    def flush(self) -> None:
        """Report a write error that occurred meanwhile; never waits."""
        if self._news:
            self._say_news()

    def close(self) -> None:
        """Write the rest, and the end of the log to the sidecar; may be called again.

        After a write error the log ends with its last complete record; raises RunFolderError unless that was reported before.
        """
        if self._file.closed:
            return
        self._ending.set()
        self._thread.join()
        self._drain()
        if self._ends:
            self.lost += len(self._ends)
            with contextlib.suppress(OSError):
                os.ftruncate(self._file.fileno(), self._whole_bytes)
        self._file.close()
        if self._index:
            self._index.close()
        self._end(self._news, frames=self._frames - len(self._ends), bytes=self._whole_bytes)

    def _run(self) -> None:
        while not self._ending.wait(FLUSH_PERIOD_S):
            self._drain()

    def _drain(self) -> None:
        """Write the queue to the system; called by one thread at a time."""
        for _ in range(len(self._queue)):
            link, record = self._queue.popleft()
            if len(self._pending) > PENDING_LIMIT_BYTES:
                with self._lock:
                    self.lost += 1
                continue
            if link != self._link:
                self._index_pending += INDEX_ENTRY.pack(self._accepted_bytes << 8 | link)
                self._link = link
            self._pending += record
            self._accepted_bytes += len(record)
            self._ends.append(self._accepted_bytes)
            self._frames += 1
        try:
            self._write_index()
            super().flush()
        except RunFolderError as error:
            self.sidecar["error"] = self._news = str(error)
        written = self._accepted_bytes - len(self._pending)
        while self._ends and self._ends[0] <= written:
            self._whole_bytes = self._ends.popleft()

    def _write_index(self) -> None:
        """Write the index; before the frames, so that no frame is in the log without its link."""
        if not self._index:
            self._index_pending.clear()
            return
        try:
            while self._index_pending:
                del self._index_pending[: self._index.write(self._index_pending)]
        except OSError as error:
            raise RunFolderError(f"cannot write the links of the log {self.path}: {error.strerror}") from None

    def _say_news(self) -> None:
        """Report the write error that occurred meanwhile."""
        sentence, self._news = self._news, ""
        self._say(sentence)


def refuse_existing_log(path: Path) -> None:
    """Raise RunFolderError where a log, its sidecar or its index exists already: recorded data is never overwritten."""
    for taken in (path, sidecar_path(path), index_path(path)):
        if taken.exists():
            raise RunFolderError(f"{taken} exists and is not overwritten: choose another file with --out, or remove it")
