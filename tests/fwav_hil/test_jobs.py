"""What the processes of a run are told, and that one declaration of an option is enough for all of them."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Annotated, Any

import click
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.command_line import run_command
from bridge.options import Except, Option, command
from bridge.reporting import report_json
from controller.options import ControllerOptions
from fwav_hil.children import Child, listen
from fwav_hil.cli import cli
from fwav_hil.jobs import PROCESSES, Job, decode_job
from fwav_hil.options import RunOptions
from fwav_hil.placement import Placement
from plant_emulator.options import EmulatorOptions, MotorLink, MotorOptions
from protocol.errors import Interrupted
from tests.loop import scenario_of

PLACEMENT = Placement("a core each", 1, 0, 0.25)


class TestJob:
    @given(
        st.builds(
            EmulatorOptions,
            clock=st.sampled_from(["lockstep", "realtime"]),
            spin_s=st.none() | st.floats(0.0, 1.0),
            speed=st.none() | st.floats(0.001, allow_infinity=False),
            key=st.none() | st.binary(min_size=32, max_size=32),
            out=st.none() | st.text("ab /.\u00e4\n", min_size=1).map(Path),
            bus=st.builds(MotorLink, log=st.none() | st.just(Path("/x/y.blf"))),
            delay_ns=st.integers(0, 10**9),
        ),
        st.none() | st.integers(0, 63),
    )
    def test_it_comes_out_as_it_went_in(self, options: EmulatorOptions, core: int | None) -> None:
        job = Job(scenario_of("paper_disturbed"), options, core)
        line = job.encode()
        assert "\n" not in line
        assert decode_job(line + "\n", EmulatorOptions) == job

    @pytest.mark.parametrize("name", ["flapper", "paper", "paper_disturbed"])
    def test_both_ends_of_a_run_agree_on_its_scenario(self, name: str) -> None:
        scenario = scenario_of(name)
        told = decode_job(Job(scenario, MotorOptions()).encode(), MotorOptions).scenario
        assert told == scenario
        assert (told.digest(), told.drive_digest()) == (scenario.digest(), scenario.drive_digest())

    @pytest.mark.parametrize("options", [EmulatorOptions(), ControllerOptions(), MotorOptions()])
    def test_every_process_has_a_type_of_options(self, options: msgspec.Struct) -> None:
        assert any(place.endswith(f":{type(options).__name__}") for place, _ in PROCESSES.values())

    def test_a_parent_that_ends_before_it_says_a_word_ends_its_child(self) -> None:
        with pytest.raises(Interrupted):
            decode_job("", MotorOptions)


class TestOptionsOfEnds:
    def test_what_both_share_is_what_the_run_says(self) -> None:
        run = RunOptions(
            link="tcpin://127.0.0.1:0",
            clock="realtime",
            wait_s=3.0,
            emulator=EmulatorOptions(truth_hz=5.0, wait_s=99.0),
            controller=ControllerOptions(trigger="clock", station="udpin://127.0.0.1:0", clock="lockstep"),
        )
        emulator, controller = run.of_ends(Path("run"), PLACEMENT)
        shared: dict[str, Any] = {"clock": "realtime", "wait_s": 3.0, "spin_s": 0.25, "out": Path("run")}
        assert emulator == EmulatorOptions(link="tcpin://127.0.0.1:0", truth_hz=5.0, core=1, **shared)
        assert controller == ControllerOptions(
            link="-", trigger="clock", station="udpin://127.0.0.1:0", core=0, **shared
        )


class WindyEmulator(EmulatorOptions, frozen=True, kw_only=True):
    """An emulator with an option more, which this field alone declares."""

    wind_m_s: Annotated[float, Option("--wind", "Mean speed of the wind.", "M/S", min=0.0)] = 0.0


class RunInWind(RunOptions, frozen=True, kw_only=True):
    """A run of it, which says nothing of the new option."""

    emulator: Annotated[WindyEmulator, Except("link", "out", "station")] = WindyEmulator()


@command("emulator")
def windy_emulator(options: WindyEmulator) -> None:
    """Be the emulator."""


@command("run")
def run_in_wind(options: RunInWind) -> None:
    """Start the emulator as `run` does, in a process that says what it was told."""
    of_emulator, _ = options.of_ends(Path("run"), PLACEMENT)
    child = Child("windy", Job(scenario_of("flapper"), of_emulator), "tests.fwav_hil.test_jobs")
    told.extend(event for one, event in listen([child]) if one)
    child.end()


told: list[dict[str, Any]] = []


class TestOneDeclaration:
    @pytest.mark.parametrize("made", [windy_emulator, run_in_wind], ids=["emulator", "run"])
    def test_is_enough_for_the_command_of_the_end_and_for_run(
        self, made: click.Command, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert run_command(made, "fwav-hil", ["--help"]) == 0
        assert re.search(r"--wind M/S +Mean speed of the wind\.", capsys.readouterr().out)

    def test_is_enough_for_the_child_process(self) -> None:
        told.clear()
        assert run_command(run_in_wind, "fwav-hil", ["--wind", "2.5", "--truth", "7"]) == 0
        assert told == [{"event": "told", "wind_m_s": 2.5, "truth_hz": 7.0}]

    @pytest.mark.parametrize(("end", "not_of_a_run"), [("emulator", {"--profile"}), ("controller", {"--arm"})])
    def test_run_offers_what_each_end_does(
        self, end: str, not_of_a_run: set[str], capsys: pytest.CaptureFixture[str]
    ) -> None:
        def offered(name: str) -> set[str]:
            assert run_command(cli, "fwav-hil", [name, "--help"]) == 0
            return set(re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, re.MULTILINE))

        assert offered(end) - offered("run") == not_of_a_run


if __name__ == "__main__":
    job = decode_job(sys.stdin.readline(), WindyEmulator)
    report_json(sys.stdout)({"event": "told", "wind_m_s": job.options.wind_m_s, "truth_hz": job.options.truth_hz})
