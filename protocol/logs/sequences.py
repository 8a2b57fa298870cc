"""Frames missing from a log, found from the sequence numbers of the others."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled
from protocol.logs.scan import Scan
from protocol.wire.framing import HALF_SEQUENCE


@compiled
def follow(frames: npt.NDArray[np.void], counts: npt.NDArray[np.int64]) -> None:
    """Check the numbers of each sender; row `system << 8 | component` of counts: frames, lost, out of order, next number.

    The same rule as in `codec.FrameReader`: a number up to 127 ahead of the expected one means that so many frames were
    lost, any other one that the frame is repeated or late.
    """
    for i in range(frames.shape[0]):
        frame = frames[i]
        row = np.int64(frame["system"]) << 8 | np.int64(frame["component"])
        sequence = np.int64(frame["sequence"])
        ahead = (sequence - counts[row, 3]) & 0xFF if counts[row, 0] else 0
        counts[row, 0] += 1
        if ahead < HALF_SEQUENCE:
            counts[row, 1] += ahead
            counts[row, 3] = (sequence + 1) & 0xFF
        else:
            counts[row, 2] += 1


def count_losses(scan: Scan) -> dict[tuple[int, int], tuple[int, int]]:
    """(lost, out of order) by (system, component) of all senders."""
    counts = np.zeros((1 << 16, 4), dtype=np.int64)
    follow(scan.frames, counts)
    return {
        (int(row) >> 8, int(row) & 0xFF): (int(counts[row, 1]), int(counts[row, 2]))
        for row in np.flatnonzero(counts[:, 0])
    }
