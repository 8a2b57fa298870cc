"""Ground truth on disk: one row per tick, in a growing NumPy file that can be read at any time.

`numpy.load("ground_truth.npy")` gives a structured array. It holds velocities, so it is never sent to a controller.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from protocol.append_file import AppendFile
from protocol.errors import RunFolderError
from protocol.messages import FloatArray

ROW = np.dtype(
    [
        ("t_ns", "<i8"),
        ("q", "<f8", 6),
        ("q_dot", "<f8", 6),
        ("command", "<f8", 6),
        ("tau", "<f8", 6),
        ("u", "<f8", 6),
    ]
)
"""t_k (ns); true position, attitude and their rates at t_k; the newest command; tau acting at the motors; u after the gears."""

_BLOCK = 1024


class TruthWriter(AppendFile):
    """Appends rows; the file's header is rewritten at each flush, so the file is valid up to the last flush.

    Where writing fails, RunFolderError is raised; with `tell`, that is called once instead, and no further rows are written
    (`lost`), so that the file has no gap in time.
    """

    def __init__(self, path: Path, tell: Callable[[str], None] | None = None) -> None:
        super().__init__(path, "the ground truth")
        self.lost = 0
        self._tell = tell
        self._block = np.zeros(_BLOCK, dtype=ROW)
        self._numbers: FloatArray = self._block.view("<f8").reshape(_BLOCK, -1)
        self._times = self._block["t_ns"]
        self._pending = 0
        self._count = 0
        try:
            self._write(_header(0))
        except OSError as error:
            self._file.close()
            raise self._refused(error) from None

    def append(self, t_ns: int, row: FloatArray) -> None:
        """Add the row of time t_ns: the numbers (31,) of `integrate.fill_row`, whose first is left out."""
        if self._pending == _BLOCK:
            self.flush()
        self._numbers[self._pending] = row
        self._times[self._pending] = t_ns
        self._pending += 1

    def flush(self) -> None:
        """Write the pending rows and update the header."""
        if not self._pending:
            return
        if self.lost:
            self._leave_out()
            return
        try:
            self._file.seek(len(_header(0)) + self._count * ROW.itemsize)  # a failed flush may have written a part
            self._write(self._block[: self._pending].tobytes())
            self._count += self._pending
            self._pending = 0
            self._file.seek(0)
            self._write(_header(self._count))
        except OSError as error:
            if self._tell is None:
                raise self._refused(error) from None
            self._leave_out()
            self._tell(str(self._refused(error)))

    def _leave_out(self) -> None:
        self.lost += self._pending
        self._pending = 0

    def _write(self, data: bytes) -> None:
        """Write all of it: one unbuffered write may be short, as on a disk that is nearly full."""
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]


def _header(count: int) -> bytes:
    """A NumPy header for `count` rows, of the same length for every count."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": np.lib.format.dtype_to_descr(ROW), "fortran_order": False, "shape": (count,)}
    )
    return buffer.getvalue()


def load_truth(path: Path) -> npt.NDArray[np.void]:
    """The rows of a ground truth file. Raises RunFolderError where it cannot be read."""
    try:
        rows: npt.NDArray[np.void] = np.load(path)
    except (OSError, EOFError, ValueError) as error:
        raise RunFolderError(f"cannot read the ground truth {path}: {error}") from None
    if rows.dtype != ROW:
        raise RunFolderError(f"cannot read the ground truth {path}: its columns are not those of a run")
    return rows
