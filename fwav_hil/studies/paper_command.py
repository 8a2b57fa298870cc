"""`fwav-hil paper`."""

from __future__ import annotations

import sys
from pathlib import Path

import click
import msgspec

from bridge.command_line import json_option, options
from bridge.summary import make_folder, show_json, write_json
from protocol.errors import RunFolderError
from protocol.scenario import find_scenario, load_scenario

SCENARIOS = ("paper", "paper_disturbed")


@click.command("paper", epilog="\b\nExample:\n  fwav-hil paper --out /tmp/paper --json /tmp/paper.json")
@options(
    click.option(
        "--out", type=click.Path(file_okay=False, path_type=Path), default=Path("paper_study"), show_default=True,
        metavar="DIR", help="Folder for the page (paper.md), tables (CSV, JSON) and figures (PNG, SVG).",
    ),
    json_option,
)  # fmt: skip
def paper_command(out: Path, json_path: Path | None) -> None:
    """Run the source paper's section IV again: tables II-IV, figures 3-8, its claims judged cell by cell."""
    from rich.console import Console
    from rich.progress import Progress

    from fwav_hil.studies.lyapunov import lyapunov
    from fwav_hil.studies.paper import ORDERINGS, conditions, fly_all, judge, rows_of
    from fwav_hil.studies.paper_figures import by_name, draw_comparisons, draw_hysteresis, draw_lyapunov
    from fwav_hil.studies.paper_page import csv_text, markdown_page

    make_folder(out)
    figures_folder = out / "images"
    make_folder(figures_folder)
    bases = [load_scenario(find_scenario(name)) for name in SCENARIOS]
    rows, bounds = [], {}
    figures = draw_hysteresis(figures_folder)
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("flying", total=sum(len(conditions(base)) for base in bases))
        for base in bases:
            flights = []
            for flight in fly_all(base, lambda name: bar.update(task, description=name)):
                flights.append(flight)
                rows += rows_of(flight)
                bar.advance(task)
            figures += draw_comparisons(figures_folder, by_name(flights))
            ude = by_name(flights)["UDE"]
            bounds[base.name] = lyapunov(ude.scenario, ude.result).held.mean(axis=0).tolist()
            figures.append(draw_lyapunov(figures_folder, ude))
    claims = judge(rows)
    result = {"rows": msgspec.to_builtins(rows), "claims": msgspec.to_builtins(claims), "bound_held": bounds}
    page = markdown_page(rows, claims, bounds, [figure.relative_to(out).as_posix() for figure in figures])
    try:
        (out / "paper.md").write_text(page, encoding="utf-8")
        (out / "tables.csv").write_text(csv_text(rows), encoding="utf-8")
    except OSError as error:
        raise RunFolderError(f"cannot write to {out}: {error.strerror}; choose another folder with --out") from None
    write_json(out / "paper.json", result)
    show_json(json_path, result)
    to_stderr = json_path is not None and str(json_path) == "-"
    for scenario in SCENARIOS:
        for name, *_ in ORDERINGS:
            cells = [claim for claim in claims if (claim.scenario, claim.claim) == (scenario, name)]
            held = f"paper {sum(c.paper for c in cells):2d}, ours {sum(c.ours for c in cells):2d} of {len(cells)} cells"
            click.echo(f"{scenario:16s} {name:30s} {held}", err=to_stderr)
    click.echo(f"page: {out / 'paper.md'}", err=to_stderr)
