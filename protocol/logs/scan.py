"""Every intact frame of a telemetry log, by a compiled scanner: `scan_tlog(path)`.

    scan = scan_tlog(Path("flight.tlog"))
    scan.frames["message_id"], scan.frames["stamp_us"]     # columns, one row a frame, in the order of the file
    scan.raw(7)                                            # the 8th frame as it was on the wire
    scan.counters["damaged_bytes"]

Columns of `Scan.frames` (dtype `log_log_frames.FRAME`):

    stamp_us    time of the record; that of the record before where it is damaged, 0 in a raw stream
    offset      where the frame begins in the file, behind its stamp
    message_id  -
    length      of the whole frame: header, payload, checksum, signature
    system, component, sequence
    version     1 or 2, of MAVLink
    signed      1 where a signature is behind the frame (whether it is a good one, only the key's owner can tell)
    flags       incompatibility flags (MAVLink 2)
    known       1: the dialect has the message and the checksum holds; 0: the dialect lacks it, so there is no definition
    stale_checksum  1 where trailing zeros were cut off behind the checksum (`records.untrimmed_length`); payloads are right
    stamp_ok    0 where the frame has no stamp of its own, or a damaged one

What is damaged is counted, never an error: bytes inserted, removed or changed cost the frames that they hit, no other.
Read logs of QGroundControl, MAVProxy, mavlink-router, pymavlink and this project so, and raw streams without stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.errors import LogError
from protocol.logs import records, scan_kernels
from protocol.logs.dialect import layouts, of_dialect
from protocol.logs.rows import mend_stamps
from protocol.wire.framing import KNOWN, SIZE_SHIFT, Table

Progress = Callable[[int, int], None]
"""Is told how much of how much is done."""

COUNTERS = (
    "damaged_bytes",
    "crc_failures",
    "resynchronisations",
    "cut_signatures",
    "unstamped_frames",
    "damaged_stamps",
    "truncated_tail",
    "unknown_frames",
    "unknown_flags",
    "stale_checksums",
)

STAMP_SIZE = 8
_SLICE = 1 << 24
_SIGNED = 1


@dataclass(frozen=True)
class Scan:
    """What is in a log.

    data        the bytes of the file, read-only, shape (bytes,)
    frames      one row a frame, see above
    stamp_size  8; 0 for a raw stream without stamps
    counters    damaged_bytes       bytes that belong to no record (the truncated tail apart)
                crc_failures        frames where one was expected whose checksum failed
                resynchronisations  times the next record was found by searching
                cut_signatures      frames whose signature is not whole
                unstamped_frames    frames that follow another under one stamp, as in a record of several
                damaged_stamps      frames whose stamp was lost or absurd
                truncated_tail      bytes of a record that the end of the file cuts short
                unknown_frames      frames of messages the dialect lacks (kept)
                stale_checksums     frames whose trailing zeros were cut off and whose checksum is the one before that (kept)
                unknown_flags       frames with incompatibility flags of unknown meaning (kept here, left out of tables)
    """

    path: Path | None
    data: npt.NDArray[np.uint8]
    frames: npt.NDArray[np.void]
    stamp_size: int
    counters: Mapping[str, int]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.frames)

    def raw(self, row: int) -> bytes:
        """The frame of that row as it was on the wire."""
        frame = self.frames[row]
        return self.data[frame["offset"] : frame["offset"] + frame["length"]].tobytes()

    def payload(self, row: int) -> bytes:
        """Payload of that row; trailing zeros may be cut off."""
        at = int(self.frames[row]["offset"])
        first = at + (10 if self.frames[row]["version"] == 2 else 6)
        return self.data[first : first + int(self.data[at + 1])].tobytes()

    def part(self, rows: npt.NDArray[np.int64]) -> Scan:
        """The scan of these frames only; its counters are those of the whole."""
        return Scan(self.path, self.data, self.frames[rows], self.stamp_size, self.counters)

    def ends(self) -> npt.NDArray[np.int64]:
        """Where the frame of each row ends in the file."""
        ends: npt.NDArray[np.int64] = self.frames["offset"] + self.frames["length"]
        return ends


@of_dialect
def _known_messages() -> npt.NDArray[np.int32]:
    """The ids that the dialect has, and the entry of each in the kernel's table: shape (2, messages)."""
    entries = [(number, KNOWN | message.size << SIZE_SHIFT | message.crc_seed) for number, message in layouts().items()]
    return np.array(entries, dtype=np.int32).T


def scan_tlog(source: Path | str | bytes, *, progress: Progress | None = None) -> Scan:
    """Find every intact frame of a log (a path, or its bytes).

    Raises LogError where the file cannot be read. A file without any frame gives an empty scan.
    """
    path = None if isinstance(source, bytes) else Path(source)
    data = np.frombuffer(source, dtype=np.uint8) if isinstance(source, bytes) else _bytes_of(Path(source))
    table = np.zeros(records.IDS, dtype=np.int32)
    numbers, entries = _known_messages()
    table[numbers] = entries
    stamp_size = STAMP_SIZE
    frames, state = _scan(data, stamp_size, table, progress)
    if _is_raw(frames):
        stamp_size = 0
        frames, state = _scan(data, stamp_size, table, progress)
    while state[scan_kernels.LEARNT] and (state[scan_kernels.RESYNCHRONISATIONS] or state[scan_kernels.CRC_FAILURES]):
        # Seeds learned on the way find frames between damage that came before.
        frames, state = _scan(data, stamp_size, table, progress)
    return Scan(path, data, frames, stamp_size, _count(data, frames, stamp_size, state))


def _bytes_of(path: Path) -> npt.NDArray[np.uint8]:
    """The file's bytes, read rather than mapped: a mapped file that shrinks meanwhile would end the process."""
    try:
        return np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from None


def _scan(
    data: npt.NDArray[np.uint8], stamp_size: int, table: Table, progress: Progress | None
) -> tuple[npt.NDArray[np.void], records.State]:
    frames: npt.NDArray[Any] = np.empty(len(data) // 48 + 1024, dtype=records.FRAME)
    votes = np.zeros(records.IDS, dtype=np.int32)
    state = np.zeros(scan_kernels.STATE_SIZE, dtype=np.int64)
    state[[scan_kernels.SEARCH, scan_kernels.LAST_STAMP, scan_kernels.RAW_STAMP]] = -1
    for start in range(0, len(data), _SLICE):
        until = min(start + _SLICE, len(data))
        while not scan_kernels.scan_slice(data, until, stamp_size, table, votes, state, frames):
            frames.resize(len(frames) * 3 // 2, refcheck=False)  # in place where the system can
        if progress:
            progress(until, len(data))
    frames.resize(int(state[scan_kernels.COUNT]), refcheck=False)
    return frames, state


def _is_raw(frames: npt.NDArray[np.void]) -> bool:
    """Whether frame follows on frame: a stream that was written without stamps."""
    if len(frames) == 1:
        return bool(frames["offset"][0] == 0)
    gaps = frames["offset"][1:] - (frames["offset"] + frames["length"])[:-1]
    return bool(np.count_nonzero(gaps == 0) > 9 * np.count_nonzero(gaps == STAMP_SIZE))


def _count(
    data: npt.NDArray[np.uint8], frames: npt.NDArray[np.void], stamp_size: int, state: records.State
) -> dict[str, int]:
    counters = dict.fromkeys(COUNTERS, 0)
    counters["damaged_bytes"] = int(state[scan_kernels.DAMAGED])
    counters["crc_failures"] = int(state[scan_kernels.CRC_FAILURES])
    counters["resynchronisations"] = int(state[scan_kernels.RESYNCHRONISATIONS])
    counters["cut_signatures"] = int(state[scan_kernels.CUT])
    rest = len(data) - int(state[scan_kernels.POSITION])
    tail = (
        "truncated_tail"
        if scan_kernels.is_cut_short(data, int(state[scan_kernels.POSITION]), stamp_size)
        else "damaged_bytes"
    )
    counters[tail] += rest
    if stamp_size:
        counters["unstamped_frames"] = int(state[scan_kernels.UNSTAMPED])
        counters["damaged_stamps"] = int(mend_stamps(frames)) - counters["unstamped_frames"]
    else:
        frames["stamp_us"] = 0
    counters["unknown_frames"] = int(np.count_nonzero(frames["known"] == 0))
    counters["stale_checksums"] = int(np.count_nonzero(frames["stale_checksum"]))
    counters["unknown_flags"] = int(np.count_nonzero(frames["flags"] & ~np.uint8(_SIGNED)))
    return counters
