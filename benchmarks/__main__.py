"""`make bench`: run the benchmarks, print them beside their anchors, write results.json and RESULTS.md here.

`python -m benchmarks can` measures the CAN protocols alone, and leaves the other rows as they were.

Machines are shared and noisy, so each figure is the best of three alternations with its anchor.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.can_protocols import can_protocols
from benchmarks.codec import codec
from benchmarks.loop import lockstep_tick, simulated_steps
from benchmarks.processor import processor_time
from benchmarks.read_log import read_log
from benchmarks.read_own_log import read_own_log
from benchmarks.replay_timing import replay_timing
from benchmarks.row import ALTERNATIONS
from benchmarks.start import start
from benchmarks.wake_up import wake_up_lateness
from fwav_hil.compile import compile_kernels
from protocol.scenario import find_scenario, load_scenario

HERE = Path(__file__).parent

BENCHMARKS: dict[str, Callable[[argparse.Namespace], dict[str, dict[str, Any]]]] = {
    "lockstep_tick": lambda _given: lockstep_tick(),
    "wake_up": lambda given: wake_up_lateness(given.wake_up_seconds),
    "codec": lambda _given: codec(),
    "simulated_steps": lambda given: simulated_steps(given.rotorpy_python),
    "processor": lambda _given: processor_time(),
    "start": lambda _given: start(),
    "read_log": lambda _given: read_log(),
    "read_own_log": lambda _given: read_own_log(),
    "replay_timing": lambda _given: replay_timing(),
    "can": lambda _given: can_protocols(),
}
"""By the name one calls it with: what it gives, by the names of its rows."""


def main() -> None:
    """Run all, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Benchmarks; without names, all of them.")
    parser.add_argument("names", nargs="*", choices=[*BENCHMARKS, []], metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--wake-up-seconds", type=float, default=60.0, help="length of a turn of wake_up (default 60)")
    parser.add_argument(
        "--rotorpy-python", default=sys.executable, help="a Python that has RotorPy (default: this one)"
    )
    given = parser.parse_args()
    compile_kernels(load_scenario(find_scenario("paper")))
    written = HERE / "results.json"
    results: dict[str, dict[str, Any]] = json.loads(written.read_text()) if given.names else {}
    for name in given.names or BENCHMARKS:
        results |= BENCHMARKS[name](given)
    lines = [
        "# Benchmarks",
        "",
        f"`make bench` on {time.strftime('%Y-%m-%d')}: {os.cpu_count()} cores, {platform.machine()}, "
        f"{platform.system()} {platform.release()}, Python {platform.python_version()}. Best of {ALTERNATIONS} alternations.",
        "",
        "| name | value | anchor | ratio | bar | ok |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, row in results.items():
        lines.append(
            f"| {name} | {row['value']:.4g} {row['unit']} | {row['anchor']}: {row['anchor_value']:.4g} | "
            f"{_shown(row['ratio'])} | {row['bar']} | {'yes' if row['ok'] else 'no'} |"
        )
    lines += ["", *(f"- {name}: {row['note']}." for name, row in results.items() if row.get("note"))]
    print("\n".join(lines))
    (HERE / "RESULTS.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (HERE / "results.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def _shown(ratio: float | None) -> str:
    return "-" if ratio is None else f"{ratio:.3g}"


if __name__ == "__main__":
    main()
