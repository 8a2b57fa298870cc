"""How soon the command line is there, and how soon a run has closed its first tick."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.row import ALTERNATIONS, row

HELP_BAR_S, TICK_BAR_S, PATIENCE_S = 0.3, 2.0, 300.0


def start() -> dict[str, dict[str, Any]]:
    """Seconds to `--help`, and to the first tick in the log, each against a bare interpreter; a first run ever in the note."""
    command = str(Path(sys.executable).with_name("fwav-hil"))
    helped, ticked, bare = [], [], []
    for _ in range(ALTERNATIONS):
        bare.append(_seconds([sys.executable, "-c", "pass"]))
        helped.append(_seconds([command, "--help"]))
        ticked.append(_first_tick_s(command, dict(os.environ)))
    with tempfile.TemporaryDirectory() as cache:
        cold = _first_tick_s(command, os.environ | {"XDG_CACHE_HOME": cache})
    return {
        "start_help": row(
            min(helped), "s", "bare interpreter", min(bare), f"< {HELP_BAR_S:g} s", ok=min(helped) < HELP_BAR_S
        ),
        "start_first_tick": row(
            min(ticked), "s", "bare interpreter", min(bare), f"< {TICK_BAR_S:g} s", ok=min(ticked) < TICK_BAR_S,
            note=f"the first run after an installation, which compiles: {cold:.0f} s",
        ),
    }  # fmt: skip


def _seconds(command: list[str]) -> float:
    begun = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - begun


def _first_tick_s(command: str, environment: dict[str, str]) -> float:
    """From the command to the moment the first tick, answered, is in the log: it is flushed there at once."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run" / "run.tlog"
        options = ["--duration", "0.2", "--link", "udpin://127.0.0.1:0", "--no-plots", "--out", folder + "/run"]
        begun = time.perf_counter()
        with subprocess.Popen(
            [command, "run", "flapper", *options], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as process:
            while not (log.exists() and log.stat().st_size) and time.perf_counter() - begun < PATIENCE_S:
                time.sleep(0.001)
            seconds = time.perf_counter() - begun
            process.wait(PATIENCE_S)
        return seconds
