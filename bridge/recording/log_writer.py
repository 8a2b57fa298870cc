"""The process that writes a log while the loop runs: it copies a ring buffer to a file until its parent closes its stdin.

`python -m bridge.recording.log_writer RING CAPACITY FILE`; RING and FILE are inherited file descriptors. It polls 50 times
per second, at ordinary priority and on any core, whatever the parent's settings. When its standard input ends (also after
a kill -9 of the parent) it writes the rest and exits with 0, or with 1 where not all could be written.
"""

from __future__ import annotations

import os
import select
import signal
import sys

from bridge.recording.ring import ByteRing

PERIOD_S = 0.02


def drain(ring: ByteRing, file: int) -> bool:
    """Copy the ring to the file until standard input ends; whether all was written."""
    seen = 0
    while not select.select([sys.stdin], [], [], PERIOD_S)[0]:
        ring.write_to(file, seen)
        seen = ring.put_bytes
    ring.write_to(file, ring.put_bytes)
    return ring.taken_bytes == ring.put_bytes


def become_ordinary() -> None:
    """Undo real-time settings inherited from the parent, and ignore stop signals: only the parent handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if sys.platform == "linux":
        try:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            os.sched_setaffinity(0, range(os.cpu_count() or 1))
        except OSError:
            return  # without permission to change them, the parent's settings were ordinary too


if __name__ == "__main__":
    become_ordinary()
    sys.exit(0 if drain(ByteRing(int(sys.argv[1]), int(sys.argv[2])), int(sys.argv[3])) else 1)
