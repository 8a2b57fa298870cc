"""Processor time of each process of a run at 1 kHz in real time, without and with the spin."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.row import ALTERNATIONS, row
from bridge.timing.clock import MonotonicClock
from bridge.timing.wake_up import try_wake_ups

RATE_HZ, SECONDS = 1000, 5
BAR = 0.15


def processor_time() -> dict[str, dict[str, Any]]:
    """Shares of a core: both ends of `flapper`, recording, against a bare loop that only wakes at the same rate."""
    shares: dict[str, dict[str, float]] = {"emulator": {}, "controller": {}}
    bare = 1.0
    for _ in range(ALTERNATIONS):
        bare = min(bare, _bare_share())
        for how, options in (("asleep", ()), ("realtime", ("--realtime", "--spin-us", "0")), ("spin", ("--realtime",))):
            for end, share in _flown(*options).items():
                shares[end][how] = min(shares[end].get(how, 1.0), share)
    return {
        f"processor_{end}": row(
            share["realtime"], "of a core", "bare 1 kHz loop", bare, f"<= {BAR:g} of a core", ok=share["realtime"] <= BAR,
            note=f"--realtime without the spin; with it {share['spin']:.3f}; as an ordinary process {share['asleep']:.3f}",
        )
        for end, share in shares.items()
    }  # fmt: skip


def _flown(*options: str) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result.json"
        command = [sys.executable, "-m", "fwav_hil", "run", "flapper", "--clock", "realtime", "--rate", str(RATE_HZ)]
        command += ["--duration", str(SECONDS), "--link", "udpin://127.0.0.1:0", "--no-plots", *options]
        subprocess.run([*command, "--out", folder + "/run", "--json", str(result)], check=True, capture_output=True)
        share: dict[str, float] = json.loads(result.read_text())["processor_share"]
        return share


def _bare_share() -> float:
    begun = time.process_time()
    try_wake_ups(MonotonicClock(), RATE_HZ, SECONDS, None, realtime=False)
    return (time.process_time() - begun) / SECONDS
