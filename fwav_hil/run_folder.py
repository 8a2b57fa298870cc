"""The folder of a run.

scenario.toml      the full scenario              run.tlog            every frame, both directions; run.tlog.json: its sidecar
ground_truth.npy   one row per tick               emulator.json, controller.json   counters of each end
summary.json       scores, latency, counters      *.png               plots
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from bridge.summary import make_folder, refuse_existing_run, write_text
from bridge.timing.clock import local_stamp
from protocol.scenario import Scenario

FILES: Mapping[str, str] = MappingProxyType(
    {
        "log": "run.tlog",
        "sidecar": "run.tlog.json",
        "ground_truth": "ground_truth.npy",
        "scenario": "scenario.toml",
        "emulator": "emulator.json",
        "controller": "controller.json",
        "motor": "motor.json",
        "can_log": "motor_bus.blf",
        "summary": "summary.json",
    }
)


def new_folder(scenario: Scenario, out: Path | None) -> Path:
    """The folder of a new run: `out`, or one named after the scenario and the time. Raises RunFolderError."""
    folder = out or Path("runs") / f"{scenario.name}-{scenario.law}-{local_stamp()}"
    refuse_existing_run(folder)
    make_folder(folder)
    write_text(folder / FILES["scenario"], scenario.to_toml())
    return folder
