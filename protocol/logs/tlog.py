"""The telemetry log: for each frame, 8 bytes of microseconds (big endian), then the frame as it was on the wire.

This is the .tlog of the ground stations; mavlogdump, MAVProxy and QGroundControl read it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from protocol.append_file import AppendFile
from protocol.logs.scan import scan_tlog
from protocol.wire.codec import Frame

_STAMP = struct.Struct(">Q")
_FLUSH_BYTES = 1 << 16
_SIGNED = 0x01


class TlogWriter(AppendFile):
    """Writes frames in large blocks. Raises `RunFolderError` where the file cannot be written."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "the log")
        self._pending = bytearray()

    def write(self, t_us: int, frame: bytes) -> None:
        """Log one frame."""
        self._append(t_us, frame)
        if len(self._pending) >= _FLUSH_BYTES:
            self.flush()

    def _append(self, t_us: int, frame: bytes) -> None:
        self._pending += _STAMP.pack(t_us)
        self._pending += frame

    def hand_over(self) -> None:
        """Pass the frames so far to a separate writer, where there is one; here they wait for `flush`."""

    def flush(self) -> None:
        """Write pending data to the system."""
        try:
            while self._pending:  # a nearly full disk takes a part, and reports the error only at the next write
                del self._pending[: self._file.write(self._pending)]
        except OSError as error:
            raise self._refused(error) from None


def read_tlog(path: Path) -> Iterator[tuple[int, Frame]]:
    """(time in us, frame) of each record, in order; stops at a truncated or damaged record.

    For logs of this project; `scan.scan_tlog` continues after damage. Raises LogError where the file cannot be read.
    """
    scan = scan_tlog(path)
    at = 0
    for row, found in enumerate(scan.frames):
        if found["offset"] != at + _STAMP.size or int(found["flags"]) & ~_SIGNED or not found["stamp_ok"]:
            return
        number, sequence, system, component = (
            int(found[name]) for name in ("message_id", "sequence", "system", "component")
        )
        frame = Frame(number, sequence, system, component, scan.payload(row), scan.raw(row))
        yield int(found["stamp_us"]), frame
        at = int(found["offset"]) + int(found["length"])
