"""The results of a run: from its folder to summary.json, plots and a table; can be repeated at any time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bridge.summary import read_json, write_json
from fwav_hil import __version__
from fwav_hil.run_folder import FILES
from fwav_hil.score import scores
from plant_emulator.plant.truth import load_truth
from protocol.scenario import NANOSECONDS, Scenario, load_scenario

_DROPPED = (
    "bad_crc",
    "garbage_bytes",
    "truncated",
    "unknown_peer",
    "send_failed",
    "sequence_gaps",
    "tick_without_pose",
    "unsigned",
    "bad_signature",
    "old_signature",
    "unsealed",
)
_REFUSED = (
    "refused_commands",
    "bad_pose",
    "unknown_sender",
    "backwards",
    "old_commands",
    "unknown_flags",
    "unknown_echoes",
    "unknown_frames",
    "short_frames",
    "malformed_frames",
)


def summarise(folder: Path, *, placement: str = "", budget: dict[str, Any] | None = None) -> dict[str, Any]:
    """Score the run in `folder`, write summary.json there and return it. Raises RunFolderError, ScenarioError.

    `placement` and `budget` are known only to the run itself; without them the values in the summary are kept.
    """
    scenario = load_scenario(folder / FILES["scenario"])
    truth = load_truth(folder / FILES["ground_truth"])
    emulator, controller = read_json(folder / FILES["emulator"]), read_json(folder / FILES["controller"])
    before = read_json(folder / FILES["summary"])
    if not emulator and before.get("clock") == "simulated":
        return before  # no process wrote counters here: only the summary has the data of a simulation
    wall_s = emulator.get("wall_s")
    ends = {"emulator": emulator.get("counters", {}), "controller": controller.get("counters", {})}
    if motor := read_json(folder / FILES["motor"]):
        ends["motor"] = motor.get("counters", {})
    summary = {
        **head(scenario, truth),
        "clock": emulator.get("clock"),
        "ticks_per_s": len(truth) / wall_s if wall_s else None,
        **scores(scenario, truth["t_ns"], truth["q"]),
        "latency_us": emulator.get("latency_us", dict.fromkeys(("p50", "p99", "p999", "max"))),
        "tick_us": emulator.get("tick_us"),
        "trigger": controller.get("trigger"),
        "lateness_us": {"emulator": emulator.get("lateness_us"), "controller": controller.get("lateness_us")},
        "realtime": {"emulator": emulator.get("realtime") or [], "controller": controller.get("realtime") or []},
        "processor_share": {
            "emulator": emulator.get("processor_share"),
            "controller": controller.get("processor_share"),
        },
        "counters": {
            "missed": ends["controller"].get("missed_samples", 0) + ends["emulator"].get("unanswered", 0),
            "late": _total(ends, ("late", "late_samples")),
            "dropped": _total(ends, _DROPPED),
            "refused": _total(ends, _REFUSED),
            **ends,
        },
        "placement": placement or before.get("placement", ""),
        "budget": budget or before.get("budget"),
        "error": emulator.get("error") or controller.get("error"),
        "files": {name: str(folder / file) for name, file in FILES.items() if (folder / file).exists()},
    }
    if "can" in emulator:
        summary["can"] = emulator["can"]
    summary["files"]["summary"] = str(folder / FILES["summary"])
    write_json(folder / FILES["summary"], summary)
    return summary


def head(scenario: Scenario, truth: npt.NDArray[np.void]) -> dict[str, Any]:
    """The keys of a summary that identify the run."""
    return {
        "scenario": scenario.name,
        "law": scenario.law,
        "rate_hz": scenario.rate_hz,
        "seed": scenario.seed,
        "duration_s": len(truth) * scenario.period_ns / NANOSECONDS,
        "ticks": len(truth),
        "version": __version__,
    }


def _total(ends: dict[str, dict[str, int]], names: tuple[str, ...]) -> int:
    return sum(counters.get(name, 0) for counters in ends.values() for name in names)
