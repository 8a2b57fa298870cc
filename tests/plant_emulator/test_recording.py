"""What a run does where the disk refuses: it ends with what was recorded, or goes on, as the user chose."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import controller.process as controller_process
import plant_emulator.process
from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from bridge.recording.ring_recorder import RingRecorder
from bridge.recording.sidecar import read_sidecar
from bridge.shared_options import OnLogError
from controller.laws.law import make_law
from controller.options import ControllerOptions
from controller.process import serve
from plant_emulator.options import EmulatorOptions
from plant_emulator.plant.truth import load_truth
from plant_emulator.process import fly, warm_up
from protocol.errors import FwavHilError, RunFolderError
from protocol.logs.scan import scan_tlog
from protocol.logs.tlog import read_tlog
from tests.loop import scenario_of

SCENARIO = scenario_of("flapper", duration_s=8.0)
ROOM = 60_000
"""Bytes a file may have: far less than the 550 kB of log and 500 kB of ground truth that the run makes."""


class RecorderOnSmallDisk(RingRecorder):
    """A recorder whose files may not grow beyond ROOM: neither the writer's, nor from here on this process's."""

    def __init__(self, *values: Any, **names: Any) -> None:
        super().__init__(*values, **names)
        limit = (ROOM, resource.RLIM_INFINITY)
        resource.prlimit(self.writer_pid, resource.RLIMIT_FSIZE, limit)
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)  # `unlimited` takes it back


@pytest.fixture(autouse=True)
def unlimited(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(plant_emulator.process, "RingRecorder", RecorderOnSmallDisk)
    scan_tlog(b"\0" * 100)  # its compiled code, once made, is a file that would not fit either
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def fly_on_small_disk(folder: Path, on_log_error: OnLogError) -> tuple[dict[str, Any] | FwavHilError, list[str]]:
    """The emulator's summary or error, and its warnings."""
    ours, theirs = memory_pair()
    law, stop, warnings = make_law("ude", SCENARIO), StopFlag(), list[str]()

    def report(event: dict[str, Any]) -> None:
        if event["event"] == "warning":
            warnings.append(event["text"])

    warm_up(SCENARIO)
    controller_process.warm_up(SCENARIO, law)
    options = EmulatorOptions(link="-", out=folder, on_log_error=on_log_error)
    with ThreadPoolExecutor(1) as thread:
        service = thread.submit(
            lambda: serve(SCENARIO, law, theirs, ControllerOptions(link="-"), lambda _: None, StopFlag())
        )
        try:
            return fly(SCENARIO, ours, options, report, stop), warnings
        except FwavHilError as error:
            return error, warnings
        finally:
            service.result()
            ours.close()
            theirs.close()


class TestDiskThatFillsUp:
    def test_it_ends_the_run_with_what_was_recorded(self, tmp_path: Path) -> None:
        outcome, _ = fly_on_small_disk(tmp_path / "run", "stop")
        assert isinstance(outcome, RunFolderError)
        assert "File too large" in str(outcome)
        self._assert_a_part(tmp_path / "run")

    def test_or_the_run_goes_on_and_says_so_once_for_each_file(self, tmp_path: Path) -> None:
        outcome, warnings = fly_on_small_disk(tmp_path / "run", "continue")
        assert isinstance(outcome, dict), outcome
        assert (outcome["ticks"], outcome["error"]) == (2000, None)
        assert sorted("run.tlog" in text for text in warnings) == [False, True]
        assert all("File too large; the run continues" in text for text in warnings)
        self._assert_a_part(tmp_path / "run")

    @staticmethod
    def _assert_a_part(folder: Path) -> None:
        """Both files are readable, without a hole, and the sidecar does not call its log whole."""
        content = read_sidecar(folder / "run.tlog")
        records = list(read_tlog(folder / "run.tlog"))
        assert content["complete"] is False
        assert 0 < len(records) == content["frames"]
        assert sum(8 + len(frame.raw) for _, frame in records) == (folder / "run.tlog").stat().st_size
        truth = load_truth(folder / "ground_truth.npy")
        assert truth["t_ns"].tolist() == [4_000_000 * k for k in range(len(truth))]


class TestFolderThatCannotBeWritten:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / "file").write_text("no folder")
        return tmp_path / "file" / "run"

    def test_the_run_does_not_begin(self, folder: Path) -> None:
        ours, theirs = memory_pair()
        with ours, theirs, pytest.raises(RunFolderError, match="cannot create the folder"):
            fly(SCENARIO, ours, EmulatorOptions(link="-", out=folder), lambda _: None, StopFlag())

    def test_or_it_flies_without_a_record_and_tells_at_once(self, folder: Path) -> None:
        outcome, warnings = fly_on_small_disk(folder, "continue")
        assert "cannot create the folder" in warnings[0]
        # The flight is whole; that its counters cannot be kept is the one error at the end.
        assert isinstance(outcome, RunFolderError)
        assert "emulator.json" in str(outcome)
