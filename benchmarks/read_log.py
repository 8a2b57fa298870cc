"""Reading a log into tables, against pymavlink's `recv_msg` loop over the same file on the same core."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.row import ALTERNATIONS, row
from protocol.logs.dialect import layouts_by_name
from protocol.logs.scan import scan_tlog
from protocol.logs.tables import tables
from protocol.wire.codec import FrameWriter

# What a vehicle's telemetry is made of, by how often it comes.
MIX = {
    "ATTITUDE": 10, "HIL_SENSOR": 5, "LOCAL_POSITION_NED": 5, "GLOBAL_POSITION_INT": 4, "VFR_HUD": 2, "RAW_IMU": 2,
    "SYS_STATUS": 1, "HEARTBEAT": 1, "SCALED_PRESSURE": 1, "RC_CHANNELS": 1, "SERVO_OUTPUT_RAW": 1, "BATTERY_STATUS": 1,
    "ATTITUDE_TARGET": 1, "GPS_RAW_INT": 1, "VIBRATION": 1, "TIMESYNC": 1,
}  # fmt: skip
BAR_PER_S, BAR_RATIO, BAR_MEMORY = 5e6, 100.0, 3.0
MESSAGES, MESSAGES_FOR_MEMORY = 100_000, 2_000_000
_DAY_US = 1_700_000_000_000_000
_MEMORY = """
import resource, sys
from pathlib import Path
from protocol.logs.scan import scan_tlog
from protocol.logs.tables import tables
peak = lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
path = Path(sys.argv[1])
tables(scan_tlog(path.open("rb").read(5000)))
before = peak()
made = tables(scan_tlog(path))
print((peak() - before) / path.stat().st_size)
"""


def read_log() -> dict[str, dict[str, Any]]:
    """Messages a second from a log into tables, and the memory that takes; one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "flight.tlog"
            write_log(path, MESSAGES)
            ours_per_s(path)
            ours = theirs = 0.0
            for _ in range(ALTERNATIONS):
                theirs = max(theirs, pymavlink_per_s(path))
                ours = max(ours, *(ours_per_s(path) for _ in range(5)))
            write_log(path, MESSAGES_FOR_MEMORY)
            memory = memory_ratio(path)
    finally:
        os.sched_setaffinity(0, before)
    fast = ours >= BAR_PER_S and ours >= BAR_RATIO * theirs
    bar = f">= {BAR_PER_S:g} messages/s, {BAR_RATIO:g} x the anchor"
    return {
        "read_log": row(ours, "messages/s", "pymavlink's recv_msg loop", theirs, bar, ok=fast),
        "read_log_memory": row(memory, "x the file", "the file", 1.0, f"<= {BAR_MEMORY:g}", ok=memory <= BAR_MEMORY),
    }


def write_log(path: Path, count: int) -> None:
    """A log of `count` messages with random content, a millisecond apart."""
    names, weights = list(MIX), np.array(list(MIX.values()), dtype=float)
    random, writer = np.random.default_rng(1), FrameWriter(1, 1)
    layouts = layouts_by_name()
    frames = [
        writer.seal(layouts[name], random.integers(0, 256, layouts[name].size, dtype=np.uint8).tobytes())
        for name in random.choice(names, 256 * 40, p=weights / weights.sum())
    ]
    with path.open("wb") as file:
        for row in range(count):
            file.write(struct.pack(">Q", _DAY_US + 1000 * row) + frames[row % len(frames)])


def ours_per_s(path: Path) -> float:
    """Messages a second from the file into tables."""
    begun = time.perf_counter()
    scan = scan_tlog(path)
    made = tables(scan)
    rate = sum(map(len, made.values())) / (time.perf_counter() - begun)
    del scan, made
    return rate


def pymavlink_per_s(path: Path) -> float:
    """Messages a second of pymavlink's loop."""
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil

    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    begun = time.perf_counter()
    count = 0
    while log.recv_msg() is not None:
        count += 1
    rate = count / (time.perf_counter() - begun)
    log.close()
    return rate


def memory_ratio(path: Path) -> float:
    """Peak memory of reading the file into tables, in sizes of the file; in a process of its own."""
    return float(subprocess.run([sys.executable, "-c", _MEMORY, str(path)], check=True, capture_output=True).stdout)
