"""Reading an ArduPilot log (.BIN) into tables beside pymavlink's DFReader; exporting a telemetry log as MCAP beside Parquet."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.read_log import write_log
from benchmarks.row import ALTERNATIONS, row
from fwav_hil.logs.choice import Choice
from fwav_hil.logs.export import export_log
from protocol.logs.files import open_log

BAR_RATIO, BAR_MEMORY, BAR_EXPORT = 20.0, 3.0, 3.0
RECORDS, RECORDS_FOR_MEMORY, EXPORTED = 100_000, 2_000_000, 400_000
_MEMORY = """
import resource, sys
from pathlib import Path
from benchmarks.read_own_log import write_ardupilot
from protocol.logs.files import open_log
peak = lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
path = Path(sys.argv[1])
small = path.with_name("small.BIN")
write_ardupilot(small, 100)
open_log(small).tables()
before = peak()
made = open_log(path).tables()
print((peak() - before) / path.stat().st_size)
"""


def read_own_log() -> dict[str, dict[str, Any]]:
    """Records a second of a .BIN into tables, the memory that takes, and MCAP's time in Parquet's."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / "flight.BIN"
        write_ardupilot(path, RECORDS)
        ours_per_s(path)
        ours = theirs = 0.0
        for _ in range(ALTERNATIONS):
            theirs = max(theirs, dfreader_per_s(path))
            ours = max(ours, *(ours_per_s(path) for _ in range(5)))
        write_ardupilot(path, RECORDS_FOR_MEMORY)
        memory = float(
            subprocess.run([sys.executable, "-c", _MEMORY, str(path)], check=True, capture_output=True).stdout
        )
        write_log(folder / "flight.tlog", EXPORTED)
        times = {kind: export_time_s(folder, kind) for kind in ("parquet", "mcap")}
    ratio = times["mcap"] / times["parquet"]
    bar = f">= {BAR_RATIO:g} x the anchor"
    return {
        "read_own_log": row(ours, "records/s", "DFReader's recv_msg loop", theirs, bar, ok=ours >= BAR_RATIO * theirs),
        "read_own_log_memory": row(memory, "x the file", "the file", 1.0, f"<= {BAR_MEMORY:g}", ok=memory <= BAR_MEMORY),
        "export_mcap": row(
            times["mcap"], f"s for {EXPORTED} messages", "the same as Parquet", times["parquet"],
            f"<= {BAR_EXPORT:g} x the anchor", ok=ratio <= BAR_EXPORT,
        ),
    }  # fmt: skip


def write_ardupilot(path: Path, count: int) -> None:
    """A log of about `count` records of six kinds."""
    from tests.protocol.logs.own_logs import FORMATS, ardupilot_log

    whole = ardupilot_log()
    formats = len(FORMATS) * 89
    records = 20 + 3 * 4 + 1
    with path.open("wb") as file:
        file.write(whole)
        for _ in range(count // records):
            file.write(whole[formats:])


def ours_per_s(path: Path) -> float:
    """Records a second from the file into tables."""
    begun = time.perf_counter()
    made = open_log(path).tables()
    return sum(map(len, made.values())) / (time.perf_counter() - begun)


def dfreader_per_s(path: Path) -> float:
    """Records a second of DFReader's loop, its look for an index included."""
    from pymavlink.DFReader import DFReader_binary

    begun = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        reader = DFReader_binary(str(path))
        count = 0
        while reader.recv_msg() is not None:
            count += 1
        reader.close()
    return count / (time.perf_counter() - begun)


def export_time_s(folder: Path, kind: str) -> float:
    """How long it takes to read a log and export it whole, the best of several times."""
    best = float("inf")
    for attempt in range(ALTERNATIONS):
        begun = time.perf_counter()
        log = open_log(folder / "flight.tlog")
        export_log(log, kind, folder / f"{kind}{attempt}{os.getpid()}", Choice())
        best = min(best, time.perf_counter() - begun)
    return best
