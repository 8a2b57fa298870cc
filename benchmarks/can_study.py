"""What a drive's lag, its encoder and a full bus cost: the figures of docs/can.md. `python -m benchmarks.can_study [FOLDER]`.

Flies `flapper` for 4 s with `--motor can`, ODrive unless said otherwise, and shows RMSE from 2 s on against the direct path.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any, Literal

import matplotlib
import msgspec
import numpy as np

from bridge.motor_bus.can_load import plan_bus
from fwav_hil.options import RunOptions
from fwav_hil.run import RunFailedError, run
from fwav_hil.run_folder import new_folder
from fwav_hil.score import scores
from fwav_hil.simulate import simulate
from plant_emulator.options import EmulatorOptions, MotorLink
from protocol.messages import AXES
from protocol.scenario import Scenario, find_scenario, load_scenario, with_overrides

LAGS_S = (0.0, 0.001, 0.004, 0.008, 0.012)
COUNTS = (128, 256, 512, 1024, 16384)
BITRATES = (1_000_000, 500_000, 250_000)
DEGREES = 180.0 / np.pi


def flapper(**motor: Any) -> Scenario:
    """The scenario with drives changed."""
    scenario = load_scenario(find_scenario("flapper"))
    return with_overrides(scenario, duration_s=4.0, motor=msgspec.to_builtins(scenario.motor) | motor)


def fly(scenario: Scenario, feedback: Literal["sync", "bus"] = "sync") -> list[float] | None:
    """Settled RMSE by axis (m, rad); None where the flight diverged."""
    with tempfile.TemporaryDirectory() as place:
        emulator = EmulatorOptions(motor="can", bus=MotorLink(can="virtual:study", feedback=feedback))
        options = RunOptions(link="udpin://127.0.0.1:0", show_progress=False, emulator=emulator)
        try:
            summary = run(scenario, new_folder(scenario, Path(place) / "run"), options)
        except RunFailedError as error:
            print(error)
            return None
    rmse = [summary["rmse_settled"][axis] for axis in AXES]
    print(
        scenario.motor.protocol, scenario.motor.lag_s, scenario.motor.encoder_counts, rmse, file=sys.stderr, flush=True
    )
    return rmse


def main() -> None:
    """Fly all, print the tables, draw."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/images")
    base = flapper(lag_s=0.0)
    simulated = simulate(base)
    direct = [scores(base, simulated.t_ns, simulated.q)["rmse_settled"][axis] for axis in AXES]
    found: dict[str, Any] = {"direct": direct}
    found["protocol"] = {name: fly(flapper(lag_s=0.0, protocol=name)) for name in ("odrive", "mit", "dronecan")}
    found["lag"] = {lag: fly(flapper(lag_s=lag)) for lag in LAGS_S}
    found["counts"] = {
        counts: fly(flapper(lag_s=0.0, protocol="mit", encoder_counts=counts), "bus") for counts in COUNTS
    }
    found["bitrate"] = {}
    for bitrate in BITRATES:
        slow = {"encoder_rate_hz": 25.0} if bitrate < 500_000 else {}
        scenario = flapper(lag_s=0.0, bitrate=bitrate, bus_delay=True, **slow)
        plan = plan_bus("odrive", scenario.motor, scenario.rate_hz)
        found["bitrate"][bitrate] = (plan.loads[bitrate], plan.response_s, fly(scenario))
    print(json.dumps(found, indent=1))
    draw(found, folder / "can_costs.png")


def draw(found: dict[str, Any], path: Path) -> None:
    """Lag and encoder, position and attitude."""
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    lags = [lag for lag, rmse in found["lag"].items() if rmse]
    counts = [count for count, rmse in found["counts"].items() if rmse]
    for panel, key, values, label in (
        (left, "lag", [1e3 * lag for lag in lags], "lag of the torque loop (ms)"),
        (right, "counts", counts, "encoder counts a turn, --feedback bus, MIT"),
    ):
        rmse = np.array([found[key][one] for one in (lags if key == "lag" else counts)])
        panel.plot(values, 1e3 * rmse[:, :3].max(axis=1), "o-", color="tab:blue", label="position, worst axis (mm)")
        panel.plot(values, DEGREES * rmse[:, 3:].max(axis=1), "s-", color="tab:red", label="attitude, worst axis (deg)")
        panel.axhline(1e3 * max(found["direct"][:3]), color="tab:blue", linestyle=":", linewidth=1)
        panel.axhline(DEGREES * max(found["direct"][3:]), color="tab:red", linestyle=":", linewidth=1)
        panel.set_xlabel(label)
        panel.set_yscale("log")
        panel.grid(visible=True, which="both", alpha=0.3)
    right.set_xscale("log", base=2)
    left.set_ylabel("RMSE from 2 s on")
    left.legend()
    figure.suptitle("flapper with drives on CAN, 250 Hz: RMSE from 2 s on (dotted: direct path)")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
