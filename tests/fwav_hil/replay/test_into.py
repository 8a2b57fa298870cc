"""Recorded runs given to a controller or a plant once more: no difference, or the difference there is."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from controller.laws.law import make_law
from controller.options import ControllerOptions
from controller.process import serve
from fwav_hil.replay import into_controller, into_emulator
from fwav_hil.replay.recorded_run import Recorded, recorded_run
from fwav_hil.replay.replay_result import Difference
from plant_emulator.options import EmulatorOptions
from plant_emulator.process import fly
from protocol.errors import LogError, PeerLostError, UsageError
from protocol.logs.tlog import TlogWriter, read_tlog
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from tests.fwav_hil.replay.conftest import Command
from tests.loop import fly_both, scenario_of

WAIT_S = 20.0


def silent(_event: dict[str, Any]) -> None:
    pass


@pytest.fixture(scope="module")
def run(run_folder: Path) -> Recorded:
    return recorded_run(run_folder, None, None)


def live_controller(run: Recorded) -> Difference:
    """A controller in a thread, asked as a process of its own would be."""
    ours, theirs = memory_pair()
    options = ControllerOptions(link="-", wait_s=WAIT_S)
    law = make_law(run.scenario.law, run.scenario)
    with ThreadPoolExecutor(1) as thread, ours, theirs:
        service = thread.submit(lambda: serve(run.scenario, law, theirs, options, silent, StopFlag()))
        answers = into_controller.ask_controller(run, ours, WAIT_S, StopFlag())
        service.result()
    return into_controller.compare_commands(run, answers)


def live_emulator(run: Recorded) -> Difference:
    ours, theirs = memory_pair()
    options = EmulatorOptions(link="-", wait_s=WAIT_S)
    with ThreadPoolExecutor(1) as thread, ours, theirs:
        flight = thread.submit(lambda: fly(run.scenario, theirs, options, silent, StopFlag()))
        sent = into_emulator.answer_emulator(run, ours, WAIT_S, StopFlag())
        flight.result()
    return into_emulator.compare_motion(run, sent)


WAYS = [into_controller.replay_in_process, live_controller, into_emulator.replay_in_process, live_emulator]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: f"{way.__module__.rpartition('.')[2]}.{way.__name__}")
class TestEveryWay:
    def test_of_a_lockstep_log_there_is_no_difference(
        self, way: Callable[[Recorded], Difference], run: Recorded
    ) -> None:
        difference = way(run)
        assert difference.is_zero
        assert len(difference.t_ns) == 100
        assert difference.missing == 0
        assert np.array_equal(difference.recorded, difference.replayed)
        figures = difference.figures()
        assert figures["identical"] == 100
        assert figures["first_divergence_s"] is None
        assert all(axis["max"] == axis["rms"] == 0.0 for axis in figures["axes"].values())

    def test_a_changed_byte_in_the_log_is_seen(
        self, way: Callable[[Recorded], Difference], run: Recorded, run_folder: Path, tmp_path: Path
    ) -> None:
        """Change what the way compares with, in the last tick, so that nothing is fed differently before it."""
        wanted = mapping.COMMAND if "command" in way(run).what else mapping.POSE
        frames = [(t_us, frame) for t_us, frame in read_tlog(run_folder / "run.tlog")]
        last = max(k for k, (_, frame) in enumerate(frames) if frame.message_id == wanted.message_id)
        with TlogWriter(tmp_path / "run.tlog") as log:
            for k, (t_us, frame) in enumerate(frames):
                raw = frame.raw
                if k == last:
                    writer = FrameWriter(frame.system, frame.component)
                    writer.sequence = frame.sequence
                    payload = bytearray(frame.payload)
                    payload[28 if wanted is mapping.POSE else 16] ^= 1
                    raw = writer.seal(wanted, bytes(payload))
                log.write(t_us, raw)
        shutil.copy(run_folder / "scenario.toml", tmp_path)
        difference = way(recorded_run(tmp_path, None, None))
        assert not difference.is_zero
        assert np.flatnonzero(~difference.equal).tolist() == [99]
        assert difference.figures()["first_divergence_s"] == pytest.approx(0.396)


class TestDifference:
    def test_another_law_differs_and_the_report_shows_where(
        self, fwav_hil: Command, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        arguments = ("replay", run_folder, "--into", "controller", "--fast", "--law", "pd", "--out", "report")
        assert fwav_hil(*arguments, "--json", "-") == 1
        result = json.loads(capsys.readouterr().out)
        assert (result["law"], result["difference"], result["samples"]) == ("pd", True, 100)
        assert result["first_divergence_s"] == 0.0
        assert json.loads((tmp_path / "report" / "difference.json").read_text()) == result
        assert (tmp_path / "report" / "difference.png").read_bytes().startswith(b"\x89PNG")
        # What the report says, from the two laws stepped by hand.
        expected = self._commands(run_folder, "pd") - self._commands(run_folder, "ude")
        for axis, column in zip(result["axes"].values(), expected.T, strict=True):
            assert axis["max"] == pytest.approx(np.abs(column).max(), rel=1e-6)
            assert axis["rms"] == pytest.approx(np.sqrt(np.mean(column**2)), rel=1e-6)
        assert fwav_hil(*arguments) == 6
        assert "report already holds a report" in capsys.readouterr().err

    @staticmethod
    def _commands(run_folder: Path, name: str) -> np.typing.NDArray[np.float64]:
        scenario = scenario_of("flapper", law=name)
        law = make_law(name, scenario)
        state, commands = law.start(), []
        for _, frame in read_tlog(run_folder / "run.tlog"):
            if frame.message_id == mapping.POSE.message_id:
                sample = mapping.decode_pose(frame.payload)
                assert sample is not None
                commands.append(law.step(state, sample.t_ns, sample.q))
        return np.array(commands)

    def test_other_gains_from_a_scenario_of_their_own(
        self, fwav_hil: Command, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = (run_folder / "scenario.toml").read_text()
        assert "T = [\n    0.05" in text
        (tmp_path / "other.toml").write_text(text.replace("T = [\n    0.05", "T = [\n    0.06", 1))
        arguments = ("--into", "controller", "--fast", "--scenario", "other.toml", "--no-plots", "--json", "-")
        assert fwav_hil("replay", run_folder, *arguments) == 1
        axes = json.loads(capsys.readouterr().out)["axes"]
        assert axes["x"]["max"] > 0.0
        assert axes["alpha"]["max"] == 0.0, "only the filter of x is another one"

    def test_another_seed_gives_the_plant_another_noise(self, run: Recorded) -> None:
        other = run._replace(scenario=scenario_of("flapper", duration_s=0.4, seed=2))
        difference = into_emulator.replay_in_process(other)
        assert not difference.is_zero
        assert 1e-4 < difference.figures()["axes"]["x"]["rms"] < 5e-3  # two draws of 1 mm

    def test_of_a_real_time_log_the_law_gives_the_same_and_the_plant_nearly(self, tmp_path: Path) -> None:
        ends = fly_both(scenario_of("flapper", duration_s=0.2), *memory_pair(), tmp_path, clock="realtime")
        assert isinstance(ends.emulator, dict), ends.emulator
        run = recorded_run(tmp_path, None, None)
        assert not run.lockstep
        difference = into_emulator.replay_in_process(run)
        assert len(difference.t_ns) == len(run.ticks) == 50
        answered = into_controller.replay_in_process(run)
        # Ticks that came too late were not answered; where one was, what the law makes of it is in the log.
        assert len(answered.t_ns) + answered.missing == 50


class TestProcess:
    @pytest.mark.processes
    def test_into_a_controller_process(
        self, fwav_hil: Command, run_folder: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert fwav_hil("replay", run_folder, "--into", "controller", "--wait", "60") == 0
        assert "no difference in 100 samples, to the byte" in capsys.readouterr().out


class TestTrouble:
    def test_without_a_scenario_it_says_which_option_names_one(self, run_folder: Path, tmp_path: Path) -> None:
        shutil.copy(run_folder / "run.tlog", tmp_path / "a.tlog")
        with pytest.raises(UsageError, match=r"no scenario\.toml beside .*--scenario"):
            recorded_run(tmp_path / "a.tlog", None, None)
        assert into_controller.replay_in_process(recorded_run(tmp_path / "a.tlog", "flapper", None)).is_zero

    def test_a_log_without_samples_is_told(self, tmp_path: Path) -> None:
        with TlogWriter(tmp_path / "run.tlog") as log:
            log.write(0, FrameWriter(1, 1).seal(mapping.HEARTBEAT, b"\1"))
        with pytest.raises(LogError, match="has no sample"):
            recorded_run(tmp_path, "flapper", None)

    def test_a_law_that_needs_velocities_is_refused(self, fwav_hil: Command, run_folder: Path, capsys: Any) -> None:
        for more in ([], ["--fast"]):
            assert fwav_hil("replay", run_folder, "--into", "controller", "--law", "ude_state", *more) == 2
            assert "needs velocities" in capsys.readouterr().err

    def test_a_log_that_ends_early_is_told_by_the_live_emulator(self, run: Recorded) -> None:
        with pytest.raises(PeerLostError, match=r"no command for t = 0\.200 s"):
            _stop_in_time(run._replace(ticks=run.ticks[:50]))


def _stop_in_time(run: Recorded) -> None:
    """`live_emulator`, but that the emulator is told to stop once the replay has failed."""
    ours, theirs = memory_pair()
    stop = StopFlag()
    with ThreadPoolExecutor(1) as thread, ours, theirs:
        options = EmulatorOptions(link="-", wait_s=WAIT_S)
        thread.submit(lambda: fly(run.scenario, theirs, options, silent, stop))
        try:
            into_emulator.answer_emulator(run, ours, WAIT_S, StopFlag())
        finally:
            stop.requested = True
