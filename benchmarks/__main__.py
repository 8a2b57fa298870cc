"""`make bench`: run the benchmarks, print them beside their anchors, write results.json and RESULTS.md here.

`python -m benchmarks can` measures the CAN protocols alone, and leaves the other rows as they were.

Machines are shared and noisy, so each figure is the best of three alternations with its anchor.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks import can_protocols
from benchmarks.ping_pong import round_trip_us
from fwav_hil.compile import compile_kernels
from fwav_hil.simulate import simulate
from protocol.scenario import find_scenario, load_scenario, with_overrides

HERE = Path(__file__).parent
ALTERNATIONS = 3
TICK_BAR_US = 100.0
SIMULATE_BAR = 300_000.0


def lockstep_tick() -> dict[str, Any]:
    """A whole lockstep tick (out, back, stepped, recorded), median, against the bare ping-pong of the same bytes."""
    cores = sorted(os.sched_getaffinity(0))
    poll = len(cores) > 1
    best = (float("inf"), float("inf"))
    for _ in range(ALTERNATIONS):
        anchor = round_trip_us((cores[-1], cores[-2] if poll else cores[-1]), poll=poll)
        with tempfile.TemporaryDirectory() as folder:
            result = Path(folder) / "result.json"
            command = [sys.executable, "-m", "fwav_hil", "run", "paper", "--link", "udpin://127.0.0.1:0", "--no-plots"]
            command += ["--out", folder + "/run", "--json", str(result)]
            subprocess.run(command, check=True, capture_output=True)
            best = min(best, (json.loads(result.read_text())["tick_us"]["p50"], anchor))
    return _row(
        best[0], "us", "bare UDP ping-pong, same placement", best[1], f"<= {TICK_BAR_US:g} us", best[0] <= TICK_BAR_US
    )


def simulated_steps() -> dict[str, Any]:
    """Closed-loop control steps a second: 1 kHz control, 4 plant sub-steps, the arrays of the run recorded; one core."""
    scenario = with_overrides(load_scenario(find_scenario("paper")), duration_s=100.0)
    simulate(scenario)
    rates = []
    for _ in range(2 * ALTERNATIONS):
        begun = time.perf_counter()
        simulate(scenario)
        rates.append(scenario.ticks / (time.perf_counter() - begun))
    best = max(rates)
    return _row(best, "steps/s", "real time", scenario.rate_hz, f">= {SIMULATE_BAR:g} steps/s", best >= SIMULATE_BAR)


def _row(value: float, unit: str, anchor: str, anchor_value: float, bar: str, ok: bool) -> dict[str, Any]:
    return {
        "value": value,
        "unit": unit,
        "anchor": anchor,
        "anchor_value": anchor_value,
        "ratio": value / anchor_value,
        "bar": bar,
        "ok": ok,
    }


def main() -> None:
    """Run all, print and write."""
    results: dict[str, Any] = {}
    if sys.argv[1:] == ["can"]:
        results |= json.loads((HERE / "results.json").read_text(encoding="utf-8"))
    else:
        compile_kernels(load_scenario(find_scenario("paper")))
        results |= {"lockstep_tick": lockstep_tick(), "simulated_steps": simulated_steps()}
    results |= can_protocols.rows(_row)
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
            f"{row['ratio']:.3g} | {row['bar']} | {'yes' if row['ok'] else 'no'} |"
        )
    print("\n".join(lines))
    (HERE / "RESULTS.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (HERE / "results.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
