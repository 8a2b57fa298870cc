"""`fwav-hil margin`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from bridge.command_line import json_option, law_option, options, rate_option, scenario_argument
from bridge.option_types import FiniteRange
from bridge.summary import is_stdout, make_folder, show_json, write_json
from protocol.errors import RunFolderError
from protocol.scenario import find_scenario, load_scenario, with_overrides

RESULT = "margin.json"


@click.command("margin", epilog="\b\nExample:\n  fwav-hil margin flapper --rate 500 --out margins --json margins.json")
@options(
    scenario_argument,
    law_option,
    rate_option,
    click.option(
        "--gain-ratio", type=FiniteRange(min=0.0, min_open=True), metavar="R",
        help="True input gain over the law's, g/b, in every channel instead of the scenario's: its gears are scaled.",
    ),
    click.option(
        "--n-filter", type=FiniteRange(min=0.0, min_open=True), metavar="N",
        help="Derivative pole N (1/s) in every channel instead of the scenario's.",
    ),
    click.option(
        "--out", type=click.Path(file_okay=False, path_type=Path), metavar="DIR",
        help="Folder for the figures and margin.json; nothing is written without it.",
    ),
    json_option,
)  # fmt: skip
def margin_command(
    scenario: str,
    law: str | None,
    rate: float | None,
    gain_ratio: float | None,
    n_filter: float | None,
    out: Path | None,
    json_path: Path | None,
) -> None:
    """Say whether the gains of SCENARIO stand its link: margins of gain, phase and delay, then the same flown.

    Verdict: good; thin (a gain margin under 2, or a largest delay under twice the loop's); unusable (unstable, or the flight
    is lost). A command that ran to its end exits with 0, whatever the verdict.
    """
    from rich.console import Console
    from rich.progress import Progress

    from controller.laws.registry import check_law
    from fwav_hil.studies.margin import at_rate, with_derivative_pole, with_gain_ratio
    from fwav_hil.studies.margin_study import STEPS, as_json, study
    from fwav_hil.studies.margin_tables import print_study

    path = find_scenario(scenario)
    chosen = with_overrides(load_scenario(path), law=law)
    check_law(chosen, path)
    if rate is not None:
        chosen = at_rate(chosen, rate)
    if gain_ratio is not None:
        chosen = with_gain_ratio(chosen, gain_ratio)
    if n_filter is not None:
        chosen = with_derivative_pole(chosen, n_filter)
    if out:
        if (out / RESULT).exists():
            raise RunFolderError(f"{out} holds a margin study already, which stays: choose another folder with --out")
        make_folder(out)
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("margins", total=STEPS)

        def progress(text: str) -> None:
            bar.update(task, description=text, advance=1)

        result = study(chosen, progress)
    content = as_json(result)
    if out:
        from fwav_hil.studies.margin_figures import draw_study

        content["files"] = {name: str(path) for name, path in draw_study(out, result).items()}
        write_json(out / RESULT, content)
    print_study(result, to_stderr=is_stdout(json_path))
    if out:
        click.echo(f"figures: {out}", err=is_stdout(json_path))
    show_json(json_path, content)
