"""Damaged logs without end, for the readers: `python -m tests.fuzz`, or `make fuzz`.

Each input is a small log of one format with some of its bytes changed, removed, inserted or put twice, by a seed. The reader
must give tables or one sentence (LogError), soon, in bounded memory; the tables must be usable: every table of every
tenth input is exported as CSV, which must stay in its folder.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from fwav_hil.logs.choice import Choice
from fwav_hil.logs.export import export_log
from fwav_hil.logs.info import log_info
from protocol.errors import LogError
from protocol.logs.files import messages, open_log
from tests.cases import FOLDER
from tests.protocol.logs.log_records import mixed_records
from tests.protocol.logs.own_logs import ardupilot_log, ardupilot_text_log, px4_log

MOST_S = 5.0
"""No small damaged log takes more processor time than this."""
MOST_GROWTH_BYTES = 512 << 20
"""Nor does the process grow by more than this, over all of them."""

_EXPORTED = 10


def seeds_of(kind: str) -> list[bytes]:
    """Small logs of a format, whole and odd ones, to be damaged."""
    made: Mapping[str, Callable[[], bytes]] = {
        "tlog": lambda: b"".join(record.data for record in mixed_records(60)),
        "raw": lambda: b"".join(record.frame for record in mixed_records(60)),
        "bin": ardupilot_log,
        "ulg": px4_log,
        "log": ardupilot_text_log,
    }
    suffix = {"tlog": ".tlog", "bin": ".bin", "ulg": ".ulg"}.get(kind)
    cases = [path.read_bytes() for path in sorted(FOLDER.rglob("*")) if path.suffix.lower() == suffix]
    return [made[kind](), *cases]


def damaged(data: bytes, chance: np.random.Generator) -> bytes:
    """The bytes with one to eight places damaged."""
    content = bytearray(data)
    for _ in range(int(chance.integers(1, 9))):
        at = int(chance.integers(0, len(content) + 1))
        size = int(chance.choice([1, 2, 4, 16, 100, 1000]))
        match int(chance.integers(0, 6)):
            case 0:
                content[at : at + size] = chance.bytes(min(size, max(0, len(content) - at)))
            case 1:
                del content[at : at + size]
            case 2:
                content[at:at] = chance.bytes(size)
            case 3:
                content[at:at] = content[at : at + size]
            case 4 if at < len(content):
                content[at] ^= 1 << int(chance.integers(0, 8))
            case _ if at < len(content):
                content[at] = int(chance.choice([0, 1, 0x7F, 0x80, 0xFF]))
    return bytes(content)


def read_all(path: Path, *, out: Path | None) -> str:
    """Read a log as the commands do; returns "tables" or "refused". Whatever else is raised is a fault of ours."""
    try:
        log = open_log(path)
    except LogError as refusal:
        if "\n" in str(refusal) or not str(refusal).isprintable():
            raise AssertionError(f"the sentence is no single line: {refusal!r}") from None
        return "refused"
    log_info(log)
    rows = log.counts()
    if {name: len(table) for name, table in log.tables().items()} != rows:
        raise AssertionError("tables and counts differ")
    if sum(1 for _ in messages(log, unknown=False)) != sum(rows.values()):
        raise AssertionError("messages and counts differ")
    if out is not None:
        for kind in ("csv", "mcap", "parquet"):
            export_log(log, kind, out / kind, Choice())
    return "tables"


def fuzz(kind: str, count: int, seed: int, *, tell: Callable[[str], None] = print) -> int:
    """Try so many damaged inputs of a format; returns how many faults were found, each of which is kept and told."""
    chance, wholes = np.random.default_rng(seed), seeds_of(kind)
    outcomes = {"tables": 0, "refused": 0}
    faults, slowest_s, begun_kb = 0, 0.0, _memory_kb()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "keep_me").write_text("mine")
        for number in range(count):
            data = damaged(wholes[int(chance.integers(0, len(wholes)))], chance)
            path, out = folder / f"in.{kind}", folder / "out"
            path.write_bytes(data)
            out.mkdir()
            begun = time.process_time()
            try:
                outcomes[read_all(path, out=out if number % _EXPORTED == 0 else None)] += 1
                if sorted(entry.name for entry in folder.iterdir()) != ["in." + kind, "keep_me", "out"]:
                    raise AssertionError("a file lies outside the folder")
            except Exception as error:  # noqa: BLE001  (it is what is looked for)
                faults += 1
                kept = Path(f"fuzz-{kind}-{seed}-{number}.{kind}")
                kept.write_bytes(data)
                tell(f"{kept}: {type(error).__name__}: {error}")
            slowest_s = max(slowest_s, time.process_time() - begun)
            shutil.rmtree(out)
    if slowest_s > MOST_S:
        faults += 1
    growth = (_memory_kb() - begun_kb) << 10
    if growth > MOST_GROWTH_BYTES:
        faults += 1
    tell(
        f"{kind}: {count} damaged inputs (seed {seed}), {outcomes['tables']} gave tables, {outcomes['refused']} a sentence, "
        f"{faults} faults; slowest {slowest_s:.2f} s of processor time, memory grew by {growth >> 20} MB"
    )
    return faults


def _memory_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> int:
    """Fuzz each reader; exit code 1 where one has a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="damaged inputs of each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", default="tlog,raw,bin,ulg,log")
    options = parser.parse_args()
    faults = sum(fuzz(kind, options.count, options.seed) for kind in options.kinds.split(","))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
