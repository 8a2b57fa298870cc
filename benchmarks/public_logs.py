"""Public logs read by us and by the reference readers: pymavlink (tlog), its DFReader (.BIN), pyulog (.ulg).

    python -m benchmarks.public_logs CLONES            # prints the table of docs/public_logs.md
    python -m benchmarks.public_logs CLONES --out docs/public_logs.md

CLONES holds clones of the repositories named below, as CLONES/owner/name. Nothing of them is part of this project.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import os
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from protocol.logs.files import Log, open_log

FILES = {
    "PX4/pyulog": [
        "test/sample.ulg", "test/sample_appended_multiple.ulg", "test/sample_log_small.ulg",
        "test/sample_logging_tagged_and_default_params.ulg", "test/sample_px4_events.ulg",
    ],
    "peterbarker/dataflash-logs": ["1.BIN", "3.BIN", "5.BIN", "6.BIN"],
    "erlerobot/logs": [
        "erlebrain/APM/7.BIN", "pxf/aux/Alt_Issue.BIN", "pxf/brain/3.BIN", "pxf/copter/18-03-2014/althold_error.BIN",
        "pxf/copter/19-4-2015/8.BIN", "pxf/copter/22-12-2014/41.BIN",
    ],
    "DaniGitman79/uav-sysid": ["logs/00000001.BIN", "logs/00000002.BIN", "mav.tlog", "mav.tlog.raw"],
    "clydemcqueen/ardusub_log_tools": [
        "pymavlink_bug/2023-04-18 11-03-34.tlog", "testing/small.BIN", "testing/small.tlog",
    ],
    "jschall/magfit_scaling": ["test.tlog"],
    "MarcusUWA/EAICS": ["flight.tlog", "flight.tlog.raw"],
}  # fmt: skip

_HEAD = """# Public logs, read by us and by others

Each file was read by us and by the reference reader of its format: pymavlink for telemetry, its DFReader for .BIN, pyulog for
.ulg. Compared were the messages of each kind, in order, and every value of every field.
`python -m benchmarks.public_logs CLONES --out docs/public_logs.md` makes this table again from clones of the repositories;
nothing of them is part of this project.

`more` are messages that we read and the reference does not, `fewer` the other way round; the note says why.

| repository | file | format | messages | more | fewer | values compared | different | note |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
"""


class Compared(NamedTuple):
    """How two readings of a log agree: messages of ours, those only one of them has, values compared and different."""

    messages: int
    more: int
    fewer: int
    values: int
    different: int


def compare(log: Log, theirs: dict[str, list[dict[str, Any]]]) -> Compared:
    """Our tables beside the reference's rows by message, in their order."""
    more = fewer = values = different = 0
    counts = log.counts()
    for name in {*counts, *theirs}:
        more += max(0, counts.get(name, 0) - len(theirs.get(name, ())))
        fewer += max(0, len(theirs.get(name, ())) - counts.get(name, 0))
    for name, rows in theirs.items():
        if counts.get(name) != len(rows):
            continue
        table = log.tables([name])[name]
        for field in rows[0]:
            if "_padding" in field:
                continue  # it means nothing, and has no column
            ours = table[field] if field in (table.dtype.names or ()) else None
            for at, row in enumerate(rows):
                if field not in row:
                    continue
                values += 1
                different += ours is None or not _same(ours[at], row[field])
    return Compared(sum(counts.values()), more, fewer, values, different)


def _same(ours: Any, theirs: Any) -> bool:
    if isinstance(theirs, str):
        theirs = theirs.encode("utf-8", "surrogateescape")
    if isinstance(theirs, bytes):
        mine = ours.tobytes() if isinstance(ours, np.void) else bytes(ours)
        return (
            mine.split(b"\0")[0] == theirs.split(b"\0")[0]
            if not isinstance(ours, np.void)
            else mine == theirs.ljust(len(mine), b"\0")
        )
    if isinstance(theirs, list | tuple) or (isinstance(theirs, np.ndarray) and theirs.ndim):
        return len(ours) == len(theirs) and all(map(_same, ours, theirs))
    one, other = float(ours), float(theirs)
    return one == other or (math.isnan(one) and math.isnan(other)) or math.isclose(one, other, rel_tol=1e-15)


def of_pymavlink(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The messages of a telemetry log by pymavlink."""
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil

    mavutil.set_dialect("all")
    log = mavutil.mavlogfile(str(path), robust_parsing=True, notimestamps=path.suffix == ".raw")
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    while (message := log.recv_msg()) is not None:
        name = message.get_type()
        if name != "BAD_DATA" and not name.startswith("UNKNOWN"):
            raw = {f"{f}": getattr(message, f"_{f}_raw", None) for f in message.get_fieldnames()}
            rows[name].append({f: raw[f] or getattr(message, f) for f in message.get_fieldnames()})
    log.close()
    return rows


def of_dfreader(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The messages of a .BIN by DFReader."""
    from pymavlink.DFReader import DFReader_binary

    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        reader = DFReader_binary(str(path))
        while (message := reader.recv_msg()) is not None:
            fields = message.get_fieldnames()
            rows[message.get_type()].append(
                {
                    f: e if isinstance(e := message._elements[i], bytes) else getattr(message, f)
                    for i, f in enumerate(fields)
                }
            )
        reader.close()
    return rows


def of_pyulog(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The topics of a .ulg by pyulog."""
    from pyulog import ULog

    rows: dict[str, list[dict[str, Any]]] = {}
    with contextlib.redirect_stdout(io.StringIO()):
        read = ULog(io.BytesIO(path.read_bytes()))
    for topic in read.data_list:
        name = topic.name if not topic.multi_id else f"{topic.name}_{topic.multi_id}"
        rows[name] = [dict(zip(topic.data, row, strict=True)) for row in zip(*topic.data.values(), strict=True)]
    return rows


def _arrays_taken_apart(log: Log, theirs: dict[str, list[dict[str, Any]]]) -> None:
    """pyulog names each element of an array: put them together as our tables have them, text too."""
    for name, rows in theirs.items():
        table = log.records.get(name)
        for field in table.dtype.names or () if table else ():
            first = f"{field}[0]"
            if rows and field not in rows[0] and first in rows[0]:
                parts = [key for key in rows[0] if key.startswith(f"{field}[") and key[len(field) + 1 : -1].isdigit()]
                for row in rows:
                    values = [row.pop(part) for part in parts]
                    is_text = table is not None and table.dtype[field].kind == "S"
                    row[field] = bytes(int(value) & 0xFF for value in values) if is_text else values


READERS: dict[str, tuple[str, Callable[[Path], dict[str, list[dict[str, Any]]]]]] = {
    ".tlog": ("MAVLink", of_pymavlink),
    ".raw": ("MAVLink, no stamps", of_pymavlink),
    ".bin": ("ArduPilot", of_dfreader),
    ".ulg": ("PX4", of_pyulog),
}


def table_rows(clones: Path) -> Iterator[str]:
    """A row of the table for each file that is there."""
    for repository, paths in FILES.items():
        for name in paths:
            path = clones / repository / name
            if not path.exists():
                continue
            kind, read = READERS[path.suffix.lower()]
            log, theirs = open_log(path), read(path)
            own = (
                {"logged_messages", "parameters", "parameter_defaults", "information", "dropouts"}
                if kind == "PX4"
                else set()
            )
            _arrays_taken_apart(log, theirs)
            shown = Log(
                log.path, log.kind, log.scan, log.counters, {n: t for n, t in log.records.items() if n not in own}
            )
            result = compare(shown, theirs)
            amiss = ", ".join(f"{what} {count}" for what, count in log.counters.items() if count) or "nothing amiss"
            numbers = f"{result.messages} | {result.more} | {result.fewer} | {result.values} | {result.different}"
            yield f"| {repository} | {name} | {kind} | {numbers} | {amiss} |"


def main() -> None:
    """Compare, and print or write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.public_logs", description=__doc__)
    parser.add_argument("clones", type=Path)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows = []
    for line in table_rows(given.clones):
        print(line, flush=True)
        rows.append(line)
    if given.out:
        given.out.write_text(_HEAD + "\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
