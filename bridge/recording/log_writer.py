"""The process that writes a log while the loop goes on: it empties a ring into a file until its parent closes its input.

`python -m bridge.recording.log_writer RING CAPACITY FILE`, the first and the last being inherited file descriptors. It
looks 50 times a second, at an ordinary priority and on any core, whatever its parent's are. When its standard input
ends, which a kill -9 of the parent brings about too, it writes the rest and ends: 0, or 1 where the file did not take all.
"""

from __future__ import annotations

import os
import select
import signal
import sys

from bridge.recording.ring import ByteRing

PERIOD_S = 0.02


def drain(ring: ByteRing, file: int) -> bool:
    """Empty the ring until standard input ends; whether the file took all."""
    seen = 0
    while not select.select([sys.stdin], [], [], PERIOD_S)[0]:
        ring.write_to(file, seen)
        seen = ring.put_bytes
    ring.write_to(file, ring.put_bytes)
    return ring.taken_bytes == ring.put_bytes


def become_ordinary() -> None:
    """Undo what a real-time parent hands down, and outlive its signals: a Ctrl-C is the parent's to answer."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if sys.platform == "linux":
        try:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            os.sched_setaffinity(0, range(os.cpu_count() or 1))
        except OSError:
            return  # where it is not allowed to, it was not raised either


if __name__ == "__main__":
    become_ordinary()
    sys.exit(0 if drain(ByteRing(int(sys.argv[1]), int(sys.argv[2])), int(sys.argv[3])) else 1)
