"""The command line: every command of the project under one name. Modules load when a command runs, not for --help."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import click

from bridge.extras import left_out_if_missing
from bridge.option_types import EXISTING_FOLDER, check_speed
from bridge.options import Argument, Option, command
from bridge.shared_options import JsonPath, Plots, ScenarioChoice, folder_option
from bridge.summary import is_stdout, show_json
from fwav_hil import __version__
from fwav_hil.options import RunFolder, RunOptions
from plant_emulator.options import MotorScenarioChoice

COMMANDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "run": ("fwav_hil.cli:run_command", "Fly a scenario: emulator and controller as two processes on a link."),
        "simulate": ("fwav_hil.cli:simulate_command", "Fly a scenario in this process, without a link."),
        "emulator": ("fwav_hil.commands.emulator:emulator", "Run the plant emulator alone."),
        "controller": ("fwav_hil.commands.controller:controller", "Run the controller alone."),
        "latency": ("fwav_hil.latency.command:latency", "Measure the latency of the loop or of a link."),
        "motor": ("fwav_hil.commands.motor:motor", "Run six simulated drives on a CAN bus."),
        "paper": ("fwav_hil.studies.paper_command:paper_command", "Reproduce section IV of the source paper."),
        "margin": ("fwav_hil.studies.margin_command:margin_command", "Stability margins of the gains on a link."),
        "design": ("fwav_hil.studies.design_command:design_command", "Search for gains for a link."),
        "record": ("fwav_hil.record_command:record_command", "Record what arrives on a live link, sending nothing."),
        "replay": (
            "fwav_hil.replay.command:replay_command",
            "Replay a log: to a link, into a controller, into the plant.",
        ),
        "diff": ("fwav_hil.replay.diff_command:diff_command", "Compare two logs, sample by sample."),
        "doctor": ("fwav_hil.doctor_command:doctor", "Test which rates this machine keeps in real time."),
        "budget": ("fwav_hil.budget_command:budget", "Check that a rate fits a link; the delay of each hop."),
        "report": ("fwav_hil.cli:report_command", "Score and plot a run folder again."),
        "log": ("fwav_hil.logs.command:log_group", "Read telemetry logs: info, dump, plot, export."),
    }
)

EXAMPLE = """
\b
Example:
  fwav-hil run                                 the default scenario, 10 s
  fwav-hil run paper --law pd --json pd.json
  fwav-hil simulate flapper --seeds 20
"""


class _LazyGroup(click.Group):
    """A group whose commands are imported when they are called; their help lines are in the table above."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, _, name = COMMANDS[cmd_name][0].partition(":")
        command: click.Command = getattr(importlib.import_module(module), name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])


@click.group("fwav-hil", cls=_LazyGroup, epilog=EXAMPLE)
@click.version_option(__version__, package_name="fwav-hil", prog_name="fwav-hil")
def cli() -> None:
    """Hardware-in-the-loop MAVLink bridge and flight controller for a flapping-wing aerial vehicle.

    SCENARIO is a file, or the name of one that comes with the project: flapper, paper, paper_disturbed.

    \b
    Exit codes: 0 done, 2 wrong argument or scenario, 3 link, 4 the other end, 5 the flight diverged, 6 results cannot
    be written or a log not read, 130 interrupted.
    """


@command("run", "fwav-hil run scenarios/flapper.toml --law ude --clock lockstep --json result.json")
def run_command(
    choice: MotorScenarioChoice,
    options: RunOptions,
    out: RunFolder = None,
    plots: Plots = True,
    json_path: JsonPath = None,
) -> None:
    """Fly SCENARIO with the emulator and the controller as two processes that exchange MAVLink over a link.

    With --motor can the drives are a third process, on a CAN bus.
    """
    scenario = choice.load()
    from bridge.command_line import refuse_rate_that_cannot_fit
    from bridge.timing.realtime import check_real_time
    from controller.laws.registry import refuse_on_a_link
    from fwav_hil.compile import compile_kernels
    from fwav_hil.run import check_link, check_motors, run
    from fwav_hil.run_folder import new_folder
    from protocol.errors import FwavHilError, UsageError

    refuse_on_a_link(scenario, choice.path)
    check_real_time(options.clock, realtime=options.realtime, trigger=options.controller.trigger)
    check_speed(options.clock, options.emulator.speed, scenario.rate_hz)
    check_link(options.link)
    if options.clock == "realtime":
        refuse_rate_that_cannot_fit(options.link, scenario.rate_hz)
    elif options.emulator.delay_ns or options.legs:
        raise UsageError(
            "--delay and --legs need real time: add --clock realtime (in lockstep the scenario's [delay] applies)"
        )
    if options.emulator.motors:
        check_motors(scenario, options.emulator.motors)
    compile_kernels(scenario)
    folder = new_folder(scenario, out)
    try:
        run(scenario, folder, options)
    except FwavHilError:
        # The run's own error is reported, even if reading its folder fails too.
        with contextlib.suppress(FwavHilError):
            _finish(folder, json_path, plots=plots)
        raise
    _finish(folder, json_path, plots=plots)


@command("simulate", "fwav-hil simulate flapper --rate 500 --seeds 20 --json spread.json")
def simulate_command(
    choice: ScenarioChoice,
    seeds: Annotated[
        int | None, Option("--seeds", "Fly N seeds, beginning with the scenario's, and show the spread.", "N", min=1)
    ] = None,
    out: Annotated[
        Path | None,
        folder_option("Folder for the ground truth, the summary and the plots; nothing is written without it."),
    ] = None,
    plots: Plots = True,
    json_path: JsonPath = None,
) -> None:
    """Fly SCENARIO in this process: the same laws, plant, sampling, delays and noise, compiled, without a link."""
    scenario = choice.load()
    from controller.laws.registry import check_law
    from fwav_hil.run_folder import new_folder
    from fwav_hil.simulation_results import simulate_run, simulate_spread
    from fwav_hil.tables import print_spread, print_summary
    from protocol.errors import DivergenceError, UsageError

    check_law(scenario, choice.path)

    if seeds and out:
        raise UsageError("--seeds saves no run: leave out --out, or fly one --seed at a time")
    if seeds:
        spread = simulate_spread(scenario, seeds)
        print_spread(spread, to_stderr=is_stdout(json_path))
        show_json(json_path, spread)
        return
    folder = new_folder(scenario, out) if out else None
    summary = simulate_run(scenario, folder)
    if folder:
        _finish(folder, json_path, plots=plots)
    else:
        print_summary(summary, to_stderr=is_stdout(json_path))
        show_json(json_path, summary)
    if summary["error"]:
        raise DivergenceError(summary["error"])


@command("report", "fwav-hil report runs/flapper-ude-2026-11-22T14-05-09")
def report_command(
    folder: Annotated[Path, Argument(type=EXISTING_FOLDER)], plots: Plots = True, json_path: JsonPath = None
) -> None:
    """Score and plot the run in FOLDER again, also after a run that failed or was interrupted."""
    from fwav_hil.report import summarise

    summarise(folder)
    _finish(folder, json_path, plots=plots)


def _finish(folder: Path, json_path: Path | None, *, plots: bool) -> None:
    """Draw, print and return the results in a run folder; prints its path even where it holds no results."""
    from bridge.summary import read_json, write_json
    from fwav_hil.run_folder import FILES
    from fwav_hil.tables import print_summary

    path = folder / FILES["summary"]
    summary: dict[str, Any] = read_json(path)
    if not summary:
        click.echo(f"run folder: {folder} (it holds no tick)", err=is_stdout(json_path))
        return
    if plots:
        with left_out_if_missing("plots"):
            summary["files"] |= _draw(folder, summary)
            write_json(path, summary)
    print_summary(summary, to_stderr=is_stdout(json_path))
    click.echo(f"run folder: {folder}", err=is_stdout(json_path))
    show_json(json_path, summary)


def _draw(folder: Path, summary: dict[str, Any]) -> dict[str, str]:
    """Draw the plots of a run; name -> file."""
    from fwav_hil.plots import plot_run
    from fwav_hil.run_folder import FILES
    from plant_emulator.plant.truth import load_truth
    from protocol.scenario import load_scenario

    scenario = load_scenario(folder / FILES["scenario"])
    title = f"{summary['scenario']}, {summary['law']}, {summary['rate_hz']:g} Hz"
    drawn = plot_run(folder, scenario, load_truth(folder / FILES["ground_truth"]), title)
    if (folder / FILES["can_log"]).exists():
        from fwav_hil.bus_plot import plot_bus

        drawn["hysteresis_bus"] = plot_bus(folder / FILES["can_log"], scenario, title)
    return {name: str(file) for name, file in drawn.items()}
