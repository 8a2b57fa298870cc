"""The command line, called in this process: help, wrong arguments, results as JSON, and what it must not overwrite."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

import fwav_hil.compile
import fwav_hil.plots
import fwav_hil.run
from bridge.command_line import run_command
from fwav_hil import __version__
from fwav_hil.__main__ import main
from fwav_hil.cli import COMMANDS, cli
from fwav_hil.simulate import simulate
from protocol.messages import AXES
from protocol.scenario import Delay, Scenario, find_scenario, load_scenario

ROOT = Path(str(fwav_hil.__file__)).resolve().parent.parent
FLAPPER = load_scenario(find_scenario("flapper"))
STABLE_KEYS = {
    *("scenario", "law", "clock", "rate_hz", "seed", "duration_s", "ticks", "ticks_per_s", "rmse", "mae"),
    *("latency_us", "counters", "files"),
}


class Ended(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    err: str

    @property
    def sentence(self) -> str:
        """The one line on standard error, without the name of the program; nothing else was said."""
        (line,) = self.err.splitlines()
        assert self.out == ""
        assert line.startswith("fwav-hil: ")
        return line.removeprefix("fwav-hil: ")


class Shell:
    """Calls `fwav-hil` in this process, in an empty folder."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: str) -> Ended:
        code = run_command(cli, "fwav-hil", arguments)
        return Ended(code, *self._capsys.readouterr())


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Shell]:
    """In tmp_path, without a terminal; signal handlers are given back afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield Shell(capsys)
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """`run` gets as far as where it would start them."""

    def refuse(*_: object) -> None:
        raise AssertionError("a run was started")

    monkeypatch.setattr(fwav_hil.run, "run", refuse)
    monkeypatch.setattr(fwav_hil.compile, "compile_kernels", lambda _: None)


def write_scenario(path: Path, **changes: Any) -> str:
    scenario: Scenario = msgspec.structs.replace(FLAPPER, **changes)
    path.write_text(scenario.to_toml(), encoding="utf-8")
    return str(path)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class TestHelp:
    @pytest.mark.parametrize("command", COMMANDS)
    def test_every_command_has_one_with_an_example(self, shell: Shell, command: str) -> None:
        ended = shell(command, "--help")
        assert (ended.code, ended.err) == (0, "")
        _, _, example = ended.out.partition("Example:\n")
        assert example.strip().startswith(f"fwav-hil {command}")

    @pytest.mark.parametrize("command", COMMANDS)
    def test_every_option_shown_has_words(self, command: str, shell: Shell) -> None:
        """Each line of the options either goes on from the one above or names an option and says what it does."""
        options = shell(command, "--help").out.partition("Options:\n")[2].partition("Example:")[0]
        named = [line for line in options.splitlines() if line.startswith("  -")]
        assert any("--help" in line for line in named)
        for line, below in zip(options.splitlines(), [*options.splitlines()[1:], ""], strict=True):
            if line.startswith("  -"):
                has_words = "  " in line.strip() or below.startswith("          ")
                assert has_words, line

    def test_of_all_commands_at_one_look(self, shell: Shell) -> None:
        ended = shell("--help")
        assert (ended.code, ended.err) == (0, "")
        assert "Example:" in ended.out
        listed = [line.split()[0] for line in ended.out.partition("Commands:\n")[2].splitlines() if line[2:3].strip()]
        assert [name for name in listed if name in COMMANDS] == list(COMMANDS)

    def test_the_version(self, shell: Shell) -> None:
        assert shell("--version") == (0, f"fwav-hil, version {__version__}\n", "")

    def test_as_a_process_of_its_own_it_ends_with_the_code(
        self, shell: Shell, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        for arguments, code in ((["--help"], 0), (["simulate", "nowhere.toml"], 2)):
            monkeypatch.setattr(sys, "argv", ["fwav-hil", *arguments])
            with pytest.raises(SystemExit) as ended:
                main()
            assert ended.value.code == code
        assert "there is no scenario nowhere.toml" in capsys.readouterr().err

    def test_it_loads_no_slow_module(self) -> None:
        code = """
import sys
from bridge.command_line import run_command
from fwav_hil.cli import COMMANDS, cli
slow = ["numpy", "numba", "matplotlib", "pymavlink", "scipy", "rich"]
def loaded(): return [name for name in slow if name in sys.modules]
at_import = loaded()
codes = [run_command(cli, "fwav-hil", arguments) for arguments in (["--help"], *([name, "--help"] for name in COMMANDS))]
print("RESULT", at_import, loaded(), codes)
"""
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        ended = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60, check=True
        )
        assert ended.stdout.splitlines()[-1] == f"RESULT [] [] {[0] * (1 + len(COMMANDS))}"
        assert ended.stderr == ""


class TestWrongArguments:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["fly"], "No such command 'fly'"),
            (["--fly"], "No such option"),
            *(([command, "--fly"], "No such option") for command in COMMANDS),
            (["simulate", "flapper", "paper"], "unexpected extra argument"),
            (["simulate", "--rate", "fast"], "'fast' is not a valid float"),
            (["simulate", "--seeds", "0"], "--seeds"),
            (["simulate", "--seed", "-1"], "--seed"),
            (["run", "--clock", "sundial"], "'sundial' is not one of"),
            (["run", "--speed", "0"], "--speed"),
            (["report"], "Missing argument 'FOLDER'"),
            (["report", "nowhere"], "'nowhere' does not exist"),
        ],
    )  # fmt: skip
    def test_are_2_and_named(self, shell: Shell, tmp_path: Path, arguments: list[str], words: str) -> None:
        ended = shell(*arguments)
        assert ended.code == 2
        assert ended.out == ""
        assert words in ended.err.splitlines()[-1]
        assert "Traceback" not in ended.err
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("command", ["run", "simulate", "controller"])
    def test_an_unknown_law_is_refused_with_those_there_are(self, shell: Shell, tmp_path: Path, command: str) -> None:
        ended = shell(command, "--law", "guess")
        assert ended.code == 2
        assert "there is no law 'guess': choose one of ude, " in ended.sentence
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("command", ["run", "controller"])
    def test_a_law_that_needs_velocities_is_refused_where_there_is_a_link(
        self, shell: Shell, tmp_path: Path, no_processes: None, command: str
    ) -> None:
        ended = shell(command, "--law", "ude_state")
        assert ended.code == 2
        assert "'ude_state' needs velocities, which the link does not carry" in ended.sentence
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("command", ["run", "simulate", "emulator", "controller"])
    def test_an_unknown_scenario_is_refused_with_those_there_are(self, shell: Shell, command: str) -> None:
        ended = shell(command, "flaper")
        assert ended.code == 2
        assert "there is no scenario flaper" in ended.sentence
        assert "flapper" in ended.sentence

    @pytest.mark.parametrize(
        ("right", "typo", "key", "meant"),
        [("rate_hz =", "rate_h =", "rate_h", "rate_hz"), ("gravity =", "gravty =", "body.gravty", "gravity")],
    )
    @pytest.mark.parametrize("command", ["run", "simulate", "emulator", "controller"])
    def test_a_typo_in_a_scenario_is_named_with_what_was_meant(
        self, shell: Shell, tmp_path: Path, command: str, right: str, typo: str, key: str, meant: str
    ) -> None:
        text = find_scenario("flapper").read_text(encoding="utf-8")
        assert text.count(right) == 1
        (tmp_path / "mine.toml").write_text(text.replace(right, typo), encoding="utf-8")
        ended = shell(command, "mine.toml")
        assert ended.code == 2
        assert ended.sentence == f"mine.toml: unknown key '{key}': did you mean '{meant}'?"

    @pytest.mark.parametrize("command", ["run", "simulate", "controller", "latency", "margin", "design"])
    @pytest.mark.parametrize("law", ["ude", "pd"])
    def test_a_wrong_gain_is_refused_whichever_law_flies_before_anything_starts(
        self, shell: Shell, tmp_path: Path, no_processes: None, command: str, law: str
    ) -> None:
        if command == "design":
            law = "ude"  # which searches for no other's gains
        file = write_scenario(tmp_path / "mine.toml", law=law, gains={**FLAPPER.gains, "ude": {"Lamda": [1.0] * 6}})
        ended = shell(command, file, *(("--out", "designed.toml") if command == "design" else ()))
        assert ended.code == 2
        assert ended.sentence == f"{file}: unknown key 'gains.ude.Lamda': did you mean 'Lambda'?"
        assert set(contents(tmp_path)) == {"mine.toml"}

    def test_an_emulator_has_no_use_for_gains(self, shell: Shell, tmp_path: Path) -> None:
        file = write_scenario(tmp_path / "mine.toml", gains={"another": {"gain": 1.0}})
        ended = shell("emulator", file, "--link", "mem://an-emulator-alone", "--wait", "0.1")
        assert (ended.code, ended.out) == (4, "")

    @pytest.mark.parametrize("command", ["run", "simulate", "emulator", "controller"])
    def test_a_rate_that_makes_no_sense_is_refused(self, shell: Shell, command: str) -> None:
        ended = shell(command, "--rate", "333")
        assert ended.code == 2
        assert ended.sentence.startswith("the command line: rate_hz 333 has a period of ")


class TestSimulate:
    def test_the_result_as_json_has_standard_output_for_itself(self, shell: Shell, tmp_path: Path) -> None:
        ended = shell("simulate", "flapper", "--duration", "1", "--json", "-")
        assert ended.code == 0
        summary = json.loads(ended.out)
        assert set(summary) >= STABLE_KEYS
        assert set(summary["latency_us"]) == {"p50", "p99", "p999", "max"}
        assert set(summary["rmse"]) == set(summary["mae"]) == set(AXES)
        expected = {
            **{"scenario": "flapper", "law": FLAPPER.law, "rate_hz": FLAPPER.rate_hz, "seed": FLAPPER.seed},
            **{"duration_s": 1.0, "ticks": 250, "error": None},
        }
        assert {key: summary[key] for key in expected} == expected
        assert "RMSE" in ended.err, "the table"
        assert not list(tmp_path.iterdir())

    def test_options_replace_what_the_scenario_says(self, shell: Shell) -> None:
        options = {"--law": "pd", "--rate": "500", "--duration": "0.5", "--seed": "9"}
        ended = shell("simulate", "flapper", *(word for pair in options.items() for word in pair), "--json", "-")
        summary = json.loads(ended.out)
        expected = {"law": "pd", "rate_hz": 500.0, "duration_s": 0.5, "seed": 9, "ticks": 250}
        assert {key: summary[key] for key in expected} == expected

    def test_a_file_is_a_scenario_too(self, shell: Shell, tmp_path: Path) -> None:
        file = write_scenario(tmp_path / "mine.toml", name="mine", duration_s=0.2)
        summary = json.loads(shell("simulate", file, "--json", "-").out)
        assert (summary["scenario"], summary["ticks"]) == ("mine", 50)

    def test_the_json_may_go_to_a_file_beside_the_table(self, shell: Shell, tmp_path: Path) -> None:
        ended = shell("simulate", "--duration", "0.5", "--json", "result.json")
        assert (ended.code, ended.err) == (0, "")
        assert "RMSE" in ended.out
        assert list(contents(tmp_path)) == ["result.json"]
        assert set(json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))) >= STABLE_KEYS

    def test_a_file_that_cannot_be_written_is_6(self, shell: Shell) -> None:
        ended = shell("simulate", "--duration", "0.2", "--json", "nowhere/result.json")
        assert ended.code == 6
        assert "cannot write nowhere/result.json" in ended.err

    def test_a_spread_over_seeds(self, shell: Shell) -> None:
        ended = shell("simulate", "--duration", "0.5", "--seeds", "2", "--seed", "7", "--json", "-")
        assert ended.code == 0
        spread = json.loads(ended.out)
        assert (spread["seeds"], spread["first_seed"]) == (2, 7)
        assert all(spread["rmse_worst"][axis] >= spread["rmse_median"][axis] > 0.0 for axis in AXES)
        assert "2 seeds" in ended.err

    def test_a_spread_as_a_table(self, shell: Shell) -> None:
        ended = shell("simulate", "--duration", "0.5", "--seeds", "2")
        assert (ended.code, ended.err) == (0, "")
        assert "2 seeds" in ended.out
        assert "RMSE, worst" in ended.out

    def test_a_flight_that_diverges_is_5_and_its_result_is_shown_all_the_same(
        self, shell: Shell, tmp_path: Path
    ) -> None:
        file = write_scenario(tmp_path / "mine.toml", delay=Delay(samples=1, seconds=0.06))
        divergence = simulate(load_scenario(Path(file))).divergence
        ended = shell("simulate", file, "--json", "-")
        assert ended.code == 5
        assert json.loads(ended.out)["error"] == divergence
        assert ended.err.splitlines()[-1] == f"fwav-hil: {divergence}"
        ended = shell("simulate", file, "--seeds", "2")
        assert ended.code == 5
        assert ended.sentence == f"seed {FLAPPER.seed}: {divergence}"

    def test_a_run_folder_keeps_its_run(self, shell: Shell, tmp_path: Path) -> None:
        arguments = ("simulate", "--duration", "0.2", "--out", "mine", "--no-plots")
        assert shell(*arguments).code == 0
        before = contents(tmp_path / "mine")
        assert sorted(before) == ["ground_truth.npy", "scenario.toml", "summary.json"]
        ended = shell(*arguments, "--seed", "2")
        assert ended.code == 6
        assert "mine holds a run already" in ended.sentence
        assert contents(tmp_path / "mine") == before


class TestRun:
    @pytest.mark.parametrize("file", ["run.tlog", "ground_truth.npy"])
    def test_a_run_folder_keeps_its_run(self, shell: Shell, tmp_path: Path, no_processes: None, file: str) -> None:
        (tmp_path / "mine").mkdir()
        for name in (file, "scenario.toml", "summary.json"):
            (tmp_path / "mine" / name).write_text(f"{name} of an earlier run")
        before = contents(tmp_path / "mine")
        ended = shell("run", "--out", "mine")
        assert ended.code == 6
        assert "mine holds a run already" in ended.sentence
        assert "--out" in ended.sentence
        assert contents(tmp_path / "mine") == before
        assert [path.name for path in tmp_path.iterdir()] == ["mine"]

    def test_a_folder_that_cannot_be_made_is_6(self, shell: Shell, tmp_path: Path, no_processes: None) -> None:
        (tmp_path / "file").write_text("mine")
        ended = shell("run", "--out", "file/folder")
        assert ended.code == 6
        assert "cannot create the folder file/folder" in ended.sentence
        assert (tmp_path / "file").read_text() == "mine"


class TestReport:
    def test_an_empty_folder_is_named_and_left_empty(self, shell: Shell, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        ended = shell("report", "empty")
        assert ended.code == 2
        assert ended.sentence.startswith("cannot read the scenario empty/scenario.toml: ")
        assert contents(tmp_path / "empty") == {}

    def test_a_folder_without_a_tick_is_6(self, shell: Shell, tmp_path: Path) -> None:
        (tmp_path / "begun").mkdir()
        write_scenario(tmp_path / "begun" / "scenario.toml")
        ended = shell("report", "begun")
        assert ended.code == 6
        assert ended.sentence.startswith("cannot read the ground truth begun/ground_truth.npy: ")
        assert list(contents(tmp_path / "begun")) == ["scenario.toml"]

    def test_a_flight_is_scored_and_drawn_again(
        self, shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def draw(folder: Path, scenario: Scenario, truth: npt.NDArray[np.void], title: str) -> dict[str, Path]:
            assert (len(truth), scenario.name, title) == (125, "flapper", "flapper, ude, 250 Hz")
            (folder / "tracking.png").touch()
            return {"tracking": folder / "tracking.png"}

        monkeypatch.setattr(fwav_hil.plots, "plot_run", draw)
        flown = json.loads(shell("simulate", "--duration", "0.5", "--out", "mine", "--no-plots", "--json", "-").out)
        ended = shell("report", "mine", "--json", "-")
        assert ended.code == 0
        reported = json.loads(ended.out)
        again = ("scenario", "law", "rate_hz", "seed", "duration_s", "ticks", "rmse", "mae")
        assert {key: reported[key] for key in again} == {key: flown[key] for key in again}
        assert "run folder: mine" in ended.err
        files = {name: Path(file) for name, file in reported["files"].items()}
        assert set(files) == {"tracking", "scenario", "ground_truth", "summary"}
        assert all(path.is_file() for path in files.values())
        assert json.loads((tmp_path / "mine" / "summary.json").read_text(encoding="utf-8")) == reported
