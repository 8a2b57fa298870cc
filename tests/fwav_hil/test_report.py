"""From a run folder, written here by hand, to its summary: the keys others rely on, and totals that add up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from controller.laws.reference import reference_trajectory
from fwav_hil.report import summarise
from plant_emulator.plant.truth import ROW
from protocol.errors import RunFolderError, ScenarioError
from protocol.messages import AXES
from protocol.scenario import find_scenario, load_scenario

SCENARIO = msgspec.structs.replace(
    load_scenario(find_scenario("flapper")), rate_hz=500.0, duration_s=9.0, seed=42, law="pd"
)
TICKS = 1100
"""2.2 s at 500 Hz: the run ended early, but has a settled part."""
OFF = np.array([0.001, -0.002, 0.003, 0.01, -0.02, 0.03])
STABLE_KEYS = {
    *("scenario", "law", "clock", "rate_hz", "seed", "duration_s", "ticks", "ticks_per_s", "rmse", "mae"),
    *("latency_us", "counters", "files"),
}
LATENCY = {"p50": 80.0, "p99": 120.0, "p999": 300.0, "max": 950.0}
EMULATOR: dict[str, Any] = {
    "clock": "realtime",
    "ticks": TICKS,
    "wall_s": 4.0,
    "latency_us": LATENCY,
    "tick_us": {"p50": 200.0, "p99": 210.0, "p999": 220.0, "max": 230.0},
    "counters": {
        **{"unanswered": 1, "late": 2, "slipped": 1000, "sent": 1000, "received": 1000, "clamped": 1000},
        **{"bad_crc": 4, "truncated": 8, "unknown_peer": 16, "send_failed": 32, "sequence_gaps": 64},
        **{"refused_commands": 128, "old_commands": 256},
    },
    "error": None,
}
CONTROLLER: dict[str, Any] = {
    "law": "pd",
    "counters": {
        **{"missed_samples": 512, "late_samples": 1024, "steps": 9000, "saturated": 9000, "sent": 9000},
        **{"bad_crc": 2048, "sequence_gaps": 4096},
        **{"bad_pose": 8192, "unknown_sender": 16384, "backwards": 32768},
    },
    "error": None,
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run that stayed OFF beside its reference."""
    rows = np.zeros(TICKS, dtype=ROW)
    rows["t_ns"] = np.arange(TICKS) * SCENARIO.period_ns
    rows["q"] = reference_trajectory(SCENARIO.reference, TICKS, SCENARIO.period_ns)[:, 0] + OFF
    np.save(tmp_path / "ground_truth.npy", rows)
    (tmp_path / "scenario.toml").write_text(SCENARIO.to_toml(), encoding="utf-8")
    (tmp_path / "emulator.json").write_text(json.dumps(EMULATOR))
    (tmp_path / "controller.json").write_text(json.dumps(CONTROLLER))
    (tmp_path / "run.tlog").touch()
    return tmp_path


def read_summary(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return content


def test_the_keys_that_others_rely_on(folder: Path) -> None:
    summary = summarise(folder)
    assert set(summary) >= STABLE_KEYS
    assert set(summary["latency_us"]) == {"p50", "p99", "p999", "max"}
    assert set(summary["rmse"]) == set(summary["mae"]) == set(AXES)
    assert set(summary["counters"]) == {"missed", "late", "dropped", "refused", "emulator", "controller"}


def test_which_run_it_was(folder: Path) -> None:
    summary = summarise(folder, placement="side by side")
    expected = {
        **{"scenario": "flapper", "law": "pd", "rate_hz": 500.0, "seed": 42, "clock": "realtime"},
        **{"ticks": TICKS, "duration_s": 2.2, "ticks_per_s": 275.0, "placement": "side by side", "error": None},
        **{"latency_us": LATENCY, "tick_us": EMULATOR["tick_us"]},
    }
    assert {key: summary[key] for key in expected} == expected


def test_what_only_the_run_knew_stands_when_it_is_scored_again(folder: Path) -> None:
    budget = {"max_delay_s": 0.024, "warn": False}
    summarise(folder, placement="side by side", budget=budget)
    again = summarise(folder)
    assert (again["placement"], again["budget"]) == ("side by side", budget)


def test_how_well_it_flew(folder: Path) -> None:
    summary = summarise(folder)
    for name in ("rmse", "mae", "rmse_settled", "mae_settled"):
        assert summary[name] == pytest.approx(dict(zip(AXES, np.abs(OFF), strict=True))), name


def test_the_counters_add_up_and_are_there_one_by_one(folder: Path) -> None:
    """Powers of two: each total tells which counters are in it, and that none is in it twice."""
    counters = summarise(folder)["counters"]
    assert counters["missed"] == 1 + 512
    assert counters["late"] == 2 + 1024
    assert counters["dropped"] == 4 + 8 + 16 + 32 + 64 + 2048 + 4096
    assert counters["refused"] == 128 + 256 + 8192 + 16384 + 32768
    assert counters["emulator"] == EMULATOR["counters"]
    assert counters["controller"] == CONTROLLER["counters"]


def test_the_files_are_those_there_are(folder: Path) -> None:
    (folder / "run.tlog").unlink()
    (folder / "controller.json").unlink()
    files = summarise(folder)["files"]
    names = {"scenario": "scenario.toml", "ground_truth": "ground_truth.npy", "emulator": "emulator.json"}
    expected = {name: str(folder / file) for name, file in (names | {"summary": "summary.json"}).items()}
    assert files == expected


def test_what_is_returned_is_what_is_written_and_it_can_be_done_again(folder: Path) -> None:
    first = summarise(folder)
    assert read_summary(folder) == first
    again = summarise(folder)
    assert again == first
    assert sorted(again["files"]) == ["controller", "emulator", "ground_truth", "log", "scenario", "summary"]


@pytest.mark.parametrize(
    ("of_emulator", "of_controller", "told"),
    [("the plant", None, "the plant"), (None, "the law", "the law"), ("the plant", "the law", "the plant")],
)
def test_why_it_ended_is_told(folder: Path, of_emulator: str | None, of_controller: str | None, told: str) -> None:
    (folder / "emulator.json").write_text(json.dumps(EMULATOR | {"error": of_emulator}))
    (folder / "controller.json").write_text(json.dumps(CONTROLLER | {"error": of_controller}))
    assert summarise(folder)["error"] == told


def test_an_emulator_that_was_killed_leaves_a_run_that_can_be_scored(folder: Path) -> None:
    (folder / "emulator.json").unlink()
    summary = summarise(folder)
    assert set(summary) >= STABLE_KEYS
    assert (summary["clock"], summary["ticks_per_s"], summary["ticks"]) == (None, None, TICKS)
    assert summary["latency_us"] == dict.fromkeys(("p50", "p99", "p999", "max"))
    assert summary["counters"]["emulator"] == {}
    assert summary["counters"]["missed"] == 512
    assert summary["rmse"] == pytest.approx(dict(zip(AXES, np.abs(OFF), strict=True)))


@pytest.mark.parametrize("file", ["emulator.json", "controller.json"])
@pytest.mark.parametrize("damage", ["", '{"counters": {', "[]"])
def test_counters_that_are_damaged_are_named_and_nothing_is_written(folder: Path, file: str, damage: str) -> None:
    (folder / file).write_text(damage)
    with pytest.raises(RunFolderError, match=rf"cannot read .*{file.replace('.', '[.]')}: "):
        summarise(folder)
    assert not (folder / "summary.json").exists()


@pytest.mark.parametrize("data", [None, b"", b"no array", b"\x93NUMPY\x01\x00"])
def test_a_ground_truth_that_is_missing_or_damaged_is_named(folder: Path, data: bytes | None) -> None:
    path = folder / "ground_truth.npy"
    path.unlink()
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(RunFolderError, match=r"cannot read the ground truth .*ground_truth\.npy"):
        summarise(folder)


def test_a_folder_that_holds_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"cannot read the scenario .*scenario\.toml"):
        summarise(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_run_without_a_tick_has_no_figures(folder: Path) -> None:
    np.save(folder / "ground_truth.npy", np.empty(0, dtype=ROW))
    summary = summarise(folder)
    assert (summary["ticks"], summary["duration_s"]) == (0, 0.0)
    assert summary["rmse"] == summary["mae"] == dict.fromkeys(AXES)
    assert summary["rmse_settled"] is None
    assert read_summary(folder) == summary
