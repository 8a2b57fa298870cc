"""Results of in-process simulations, in the same form as those of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from bridge.summary import write_json
from bridge.timing.clock import MonotonicClock
from fwav_hil.report import head
from fwav_hil.run_folder import FILES
from fwav_hil.score import scores
from fwav_hil.simulate import Simulation, simulate
from plant_emulator.plant.truth import ROW
from protocol.errors import DivergenceError, RunFolderError
from protocol.messages import AXES
from protocol.scenario import NANOSECONDS, Scenario


def simulate_run(scenario: Scenario, folder: Path | None) -> dict[str, Any]:
    """Simulate a scenario; returns its summary and writes it, with the ground truth, to `folder` if given."""
    clock = MonotonicClock()
    simulate(msgspec.structs.replace(scenario, duration_s=scenario.period_ns / NANOSECONDS))  # loads the kernels
    begun_ns = clock.now_ns()
    result = simulate(scenario)
    wall_s = (clock.now_ns() - begun_ns) / NANOSECONDS
    rows = ground_truth(result)
    files = {name: str(folder / FILES[name]) for name in ("scenario", "ground_truth", "summary")} if folder else {}
    summary = {
        **head(scenario, rows),
        "clock": "simulated",
        "ticks_per_s": len(rows) / wall_s,
        **scores(scenario, result.t_ns, result.q),
        "latency_us": dict.fromkeys(("p50", "p99", "p999", "max")),
        "counters": {"missed": 0, "late": 0, "dropped": 0, "refused": 0, "controller": result.law_counts},
        "error": result.divergence,
        "files": files,
    }
    if folder:
        try:
            np.save(folder / FILES["ground_truth"], rows)
        except OSError as error:
            raise RunFolderError(f"cannot write to {folder}: {error.strerror}") from None
        write_json(folder / FILES["summary"], summary)
    return summary


def ground_truth(result: Simulation) -> npt.NDArray[np.void]:
    """The rows that the emulator would have written."""
    rows = np.empty(len(result.t_ns), dtype=ROW)
    for name in ROW.names or ():
        rows[name] = getattr(result, name)
    return rows


def simulate_spread(scenario: Scenario, seeds: int) -> dict[str, Any]:
    """RMSE over `seeds` seeds from the scenario's on: per axis the median and the worst, whole and settled.

    Raises DivergenceError, naming the seed, where a flight diverges.
    """
    whole, settled = [], []
    for seed in range(scenario.seed, scenario.seed + seeds):
        one = msgspec.structs.replace(scenario, seed=seed)
        result = simulate(one)
        if result.divergence:
            raise DivergenceError(f"seed {seed}: {result.divergence}")
        score = scores(one, result.t_ns, result.q)
        whole.append([score["rmse"][axis] for axis in AXES])
        if score["rmse_settled"]:
            settled.append([score["rmse_settled"][axis] for axis in AXES])
    return {
        "scenario": scenario.name,
        "law": scenario.law,
        "clock": "simulated",
        "rate_hz": scenario.rate_hz,
        "duration_s": scenario.duration_s,
        "first_seed": scenario.seed,
        "seeds": seeds,
        "rmse_median": _by_axis(np.median(whole, axis=0)),
        "rmse_worst": _by_axis(np.max(whole, axis=0)),
        "rmse_settled_median": _by_axis(np.median(settled, axis=0)) if settled else None,
        "rmse_settled_worst": _by_axis(np.max(settled, axis=0)) if settled else None,
    }


def _by_axis(values: npt.NDArray[np.float64]) -> dict[str, float]:
    return dict(zip(AXES, values.tolist(), strict=True))
