"""The telemetry log: for each frame, 8 bytes of microseconds (big endian), then the frame as it was on the wire.

This is the .tlog of the ground stations; mavlogdump, MAVProxy and QGroundControl read it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from protocol.errors import RunFolderError
from protocol.log_scan import scan_tlog
from protocol.mavlink_codec import Frame

_STAMP = struct.Struct(">Q")
_FLUSH_BYTES = 1 << 16
_SIGNED = 0x01


class TlogWriter:
    """Writes frames, gathered into large writes. Raises `RunFolderError` where the file cannot be written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._pending = bytearray()
        try:
            self._file = path.open("wb", buffering=0)
        except OSError as error:
            raise RunFolderError(f"cannot write the log {path}: {error.strerror}") from None

    def write(self, t_us: int, frame: bytes) -> None:
        """Log one frame."""
        self._pending += _STAMP.pack(t_us)
        self._pending += frame
        if len(self._pending) >= _FLUSH_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand what is pending to the system."""
        try:
            while self._pending:  # a nearly full disk takes a part, and tells why only when asked again
                del self._pending[: self._file.write(self._pending)]
        except OSError as error:
            raise RunFolderError(f"cannot write the log {self.path}: {error.strerror}") from None

    def close(self) -> None:
        """Flush and close; may be called again."""
        if not self._file.closed:
            try:
                self.flush()
            finally:
                self._file.close()

    def __enter__(self) -> TlogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_tlog(path: Path) -> Iterator[tuple[int, Frame]]:
    """(time in us, frame) of each record, in order; stops at a record that is cut short or damaged.

    The strict reading, for logs of this project; `log_scan.scan_tlog` goes on behind damage. Raises LogError where the
    file cannot be read.
    """
    scan = scan_tlog(path)
    at = 0
    for row, found in enumerate(scan.frames):
        if found["offset"] != at + _STAMP.size or int(found["flags"]) & ~_SIGNED or not found["stamp_ok"]:
            return
        message_id, sequence = int(found["message_id"]), int(found["sequence"])
        sender = int(found["system"]), int(found["component"])
        yield int(found["stamp_us"]), Frame(message_id, sequence, *sender, scan.payload(row), scan.raw(row))
        at = int(found["offset"]) + int(found["length"])
