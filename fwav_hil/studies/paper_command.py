"""`fwav-hil paper`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click
import msgspec

from bridge.options import Option, command
from bridge.shared_options import JsonPath, folder_option
from bridge.summary import make_folder, show_json, write_json, write_text
from protocol.messages import AXES
from protocol.scenario import Scenario, find_scenario, load_scenario

if TYPE_CHECKING:
    from rich.progress import Progress

    from fwav_hil.studies.paper import Flight

SCENARIOS = ("paper", "paper_disturbed")


@command("paper", "fwav-hil paper --out /tmp/paper --json /tmp/paper.json", "fwav-hil paper --wire --out /tmp/wire")
def paper_command(
    out: Annotated[
        Path, folder_option("Folder for the page (paper.md), tables (CSV, JSON) and figures (PNG, SVG).")
    ] = Path("paper_study"),
    wire: Annotated[bool, Option(
        "--wire",
        "Fly as two processes in lockstep, and compare with the in-process simulation; without state feedback."
    )] = False,
    json_path: JsonPath = None,
) -> None:  # fmt: skip
    """Reproduce section IV of the source paper: tables II-IV, figures 3-8, its claims checked cell by cell."""
    from rich.console import Console
    from rich.progress import Progress

    from fwav_hil.studies.lyapunov import lyapunov
    from fwav_hil.studies.paper import ORDERINGS, judge, largest_difference, rows_of
    from fwav_hil.studies.paper_figures import by_name, draw_comparisons, draw_hysteresis, draw_lyapunov
    from fwav_hil.studies.paper_page import csv_text, lyapunov_csv, markdown_page

    make_folder(out)
    figures_folder = out / "images"
    make_folder(figures_folder)
    bases = [load_scenario(find_scenario(name)) for name in SCENARIOS]
    rows, in_process, bounds = [], [], {}
    figures = draw_hysteresis(figures_folder)
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        for base in bases:
            flights = _fly(base, bar, wire=wire)
            rows += [row for flight in flights for row in rows_of(flight)]
            if wire:
                in_process += [row for flight in _fly(base, bar, wire=False) for row in rows_of(flight)]
            figures += draw_comparisons(figures_folder, by_name(flights))
            ude = by_name(flights)["UDE"]
            bound = lyapunov(ude.scenario, ude.result)
            bounds[base.name] = {
                "bound": dict(zip(AXES, bound.held.mean(axis=0).tolist(), strict=True)),
                "comparison": dict(zip(AXES, bound.comparison_held.mean(axis=0).tolist(), strict=True)),
            }
            write_text(out / f"lyapunov_{base.name}.csv", lyapunov_csv(ude.result.t_ns, bound))
            figures.append(draw_lyapunov(figures_folder, ude))
    claims = judge(rows)
    result: dict[str, Any] = {
        "rows": msgspec.to_builtins(rows),
        "claims": msgspec.to_builtins(claims),
        "bound_held": bounds,
        "wire_difference": largest_difference(rows, in_process) if wire else None,
    }
    page = markdown_page(rows, claims, bounds, [figure.relative_to(out).as_posix() for figure in figures])
    write_text(out / "paper.md", page)
    write_text(out / "tables.csv", csv_text(rows))
    write_json(out / "paper.json", result)
    show_json(json_path, result)
    to_stderr = json_path is not None and str(json_path) == "-"
    for scenario in SCENARIOS:
        for name, *_ in ORDERINGS:
            cells = [claim for claim in claims if (claim.scenario, claim.claim) == (scenario, name)]
            held = f"paper {sum(c.paper for c in cells):2d}, ours {sum(c.ours for c in cells):2d} of {len(cells)} cells"
            click.echo(f"{scenario:16s} {name:30s} {held}", err=to_stderr)
    if wire:
        difference = result["wire_difference"]
        click.echo(
            f"wire against in-process: largest difference of any cell {difference:.2g} of its value", err=to_stderr
        )
    click.echo(f"page: {out / 'paper.md'}", err=to_stderr)


def _fly(base: Scenario, bar: Progress, *, wire: bool) -> list[Flight]:
    """Every condition of a scenario, shown on the bar."""
    from fwav_hil.simulate import simulate
    from fwav_hil.studies.paper import conditions, conditions_on_the_wire, fly_all, fly_on_the_wire

    flown = conditions_on_the_wire(base) if wire else conditions(base)
    task = bar.add_task(base.name, total=len(flown))
    flights = []
    for flight in fly_all(
        base, lambda name: bar.update(task, description=name), fly_on_the_wire if wire else simulate, flown
    ):
        flights.append(flight)
        bar.advance(task)
    return flights
