"""The loop itself: a lockstep tick against a bare ping-pong, and simulated steps beside another simulator's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.ping_pong import round_trip_us
from benchmarks.row import ALTERNATIONS, row
from fwav_hil.simulate import simulate
from protocol.scenario import find_scenario, load_scenario, with_overrides

TICK_RATIO_BAR, TICK_BAR_US = 3.2, 100.0
STEPS_BAR = 500_000.0

_ROTORPY = """
import time, numpy as np
from rotorpy.vehicles.multirotor import Multirotor
from rotorpy.vehicles.crazyflie_params import quad_params
from rotorpy.controllers.quadrotor_control import SE3Control
vehicle, control = Multirotor(quad_params), SE3Control(quad_params)
state = vehicle.initial_state
flat = {"x": np.zeros(3), "x_dot": np.zeros(3), "x_ddot": np.zeros(3), "x_dddot": np.zeros(3), "x_ddddot": np.zeros(3),
        "yaw": 0.0, "yaw_dot": 0.0, "yaw_ddot": 0.0}
def fly(steps):
    global state
    begun = time.perf_counter()
    for k in range(steps):
        state = vehicle.step(state, control.update(k * 1e-3, state, flat), 1e-3)
    return steps / (time.perf_counter() - begun)
fly(200)
print(max(fly(1000) for _ in range(3)))
"""


def lockstep_tick() -> dict[str, dict[str, Any]]:
    """A whole lockstep tick (out, back, stepped, recorded), median, against the bare ping-pong of the same bytes."""
    cores = sorted(os.sched_getaffinity(0))
    poll = len(cores) > 1
    pairs = []
    for _ in range(ALTERNATIONS):
        anchor = round_trip_us((cores[-1], cores[-2] if poll else cores[-1]), poll=poll)
        with tempfile.TemporaryDirectory() as folder:
            result = Path(folder) / "result.json"
            command = [sys.executable, "-m", "fwav_hil", "run", "paper", "--link", "udpin://127.0.0.1:0", "--no-plots"]
            command += ["--out", folder + "/run", "--json", str(result)]
            subprocess.run(command, check=True, capture_output=True)
            pairs.append((json.loads(result.read_text())["tick_us"]["p50"], anchor))
    tick, anchor = min(pairs, key=lambda pair: pair[0] / pair[1])
    bar = f"<= {TICK_RATIO_BAR:g} x the anchor and {TICK_BAR_US:g} us"
    seen = ", ".join(f"{one:.3g}/{other:.3g}" for one, other in pairs)
    placed = "a core each, polling" if poll else "one core, sleeping"
    ok = tick <= TICK_RATIO_BAR * anchor and tick <= TICK_BAR_US
    result_row = row(
        tick, "us", "bare UDP ping-pong, same placement", anchor, bar, ok=ok, note=f"{placed}; us, each pair: {seen}"
    )
    return {"lockstep_tick": result_row}


def simulated_steps(rotorpy_python: str) -> dict[str, dict[str, Any]]:
    """Closed-loop control steps a second: 1 kHz control, 4 plant sub-steps, the arrays of the run recorded; one core."""
    scenario = with_overrides(load_scenario(find_scenario("paper")), duration_s=100.0)
    simulate(scenario)
    rates = []
    for _ in range(2 * ALTERNATIONS):
        begun = time.perf_counter()
        simulate(scenario)
        rates.append(scenario.ticks / (time.perf_counter() - begun))
    best = max(rates)
    done = subprocess.run([rotorpy_python, "-c", _ROTORPY], capture_output=True, text=True, check=False)
    if done.returncode == 0:
        anchor, anchor_value, note = "RotorPy, one vehicle, 1 kHz", float(done.stdout.split()[-1]), ""
    else:
        anchor, anchor_value = "real time", scenario.rate_hz
        note = "RotorPy is not there: `pip install rotorpy` anywhere, and name that Python with --rotorpy-python"
    bar = f">= {STEPS_BAR:g} steps/s"
    return {"simulated_steps": row(best, "steps/s", anchor, anchor_value, bar, ok=best >= STEPS_BAR, note=note)}
