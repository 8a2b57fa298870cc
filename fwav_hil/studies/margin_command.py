"""`fwav-hil margin`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import click
import msgspec

from bridge.extras import require
from bridge.options import Except, Option, command
from bridge.shared_options import JsonPath, ScenarioChoice, folder_option
from bridge.summary import is_stdout, make_folder, show_json, write_json
from protocol.errors import RunFolderError

RESULT = "margin.json"


@command("margin", "fwav-hil margin flapper --rate 500 --out margins --json margins.json")
def margin_command(
    choice: Annotated[ScenarioChoice, Except("duration_s", "seed")],
    gain_ratio: Annotated[float | None, Option(
        "--gain-ratio",
        "True input gain over the law's, g/b, in every channel instead of the scenario's: its gears are scaled.", "R",
        min=0.0, min_open=True
    )] = None,
    n_filter: Annotated[float | None, Option(
        "--n-filter", "Derivative pole N (1/s) in every channel instead of the scenario's.", "N", min=0.0,
        min_open=True
    )] = None,
    out: Annotated[
        Path | None, folder_option("Folder for the figures and margin.json; nothing is written without it.")
    ] = None,
    json_path: JsonPath = None,
) -> None:  # fmt: skip
    """Compute whether the gains of SCENARIO are stable on its link: margins of gain, phase and delay, then in simulated flight.

    Verdict: good; thin (a gain margin under 2, or a largest delay under twice the loop's); unusable (unstable, or the flight
    is lost). A command that ran to its end exits with 0 for every verdict.
    """
    from rich.console import Console
    from rich.progress import Progress

    from controller.laws.registry import check_law
    from fwav_hil.studies.margin import at_rate, with_derivative_pole, with_gain_ratio
    from fwav_hil.studies.margin_study import STEPS, as_json, study
    from fwav_hil.studies.margin_tables import print_study

    scenario = msgspec.structs.replace(choice, rate_hz=None).load()
    check_law(scenario, choice.path)
    if choice.rate_hz is not None:
        scenario = at_rate(scenario, choice.rate_hz)
    if gain_ratio is not None:
        scenario = with_gain_ratio(scenario, gain_ratio)
    if n_filter is not None:
        scenario = with_derivative_pole(scenario, n_filter)
    if out:
        require("plots")
        if (out / RESULT).exists():
            raise RunFolderError(f"{out} already holds a margin study: choose another folder with --out")
        make_folder(out)
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("margins", total=STEPS)

        def progress(text: str) -> None:
            bar.update(task, description=text, advance=1)

        result = study(scenario, progress)
    content = as_json(result)
    if out:
        from fwav_hil.studies.margin_figures import draw_study

        content["files"] = {name: str(path) for name, path in draw_study(out, result).items()}
        write_json(out / RESULT, content)
    print_study(result, to_stderr=is_stdout(json_path))
    if out:
        click.echo(f"figures: {out}", err=is_stdout(json_path))
    show_json(json_path, content)
