"""`fwav-hil design`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from bridge.command_line import json_option, law_option, options, rate_option
from bridge.option_types import FiniteRange
from bridge.summary import is_stdout, show_json
from protocol.errors import RunFolderError
from protocol.scenario import find_scenario, load_scenario, with_overrides


@click.command(
    "design", epilog="\b\nExample:\n  fwav-hil design flapper --rate 500 --delay-s 0.004 --out flapper_500.toml"
)
@options(
    click.argument("scenario", default="flapper"),
    law_option,
    rate_option,
    click.option(
        "--delay-s", type=FiniteRange(min=0.0, max=1.0), metavar="S",
        help="Total delay, sample to action, instead of the scenario's.",
    ),
    click.option(
        "--out", type=click.Path(dir_okay=False, path_type=Path), required=True, metavar="FILE.toml",
        help="The scenario file to write; one that exists is left alone.",
    ),
    click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the optimiser."),
    click.option(
        "--flights", type=click.IntRange(min=1), default=4, show_default=True, metavar="N",
        help="Flights per set of gains, each with noise of its own.",
    ),
    click.option(
        "--generations", type=click.IntRange(min=1), default=20, show_default=True, metavar="N",
        help="Generations of the search, for attitude and for position.",
    ),
    click.option(
        "--workers", type=click.IntRange(min=1), metavar="N", help="Processes to search on; by default one a core.",
    ),
    json_option,
)  # fmt: skip
def design_command(
    scenario: str,
    law: str | None,
    rate: float | None,
    delay_s: float | None,
    out: Path,
    seed: int,
    flights: int,
    generations: int,
    workers: int | None,
    json_path: Path | None,
) -> None:
    """Search gains K, Lambda, T and N for the link of SCENARIO: its rate, delay, noise and limits.

    Least tracking error with a gain margin of at least 2 both ways and stability at twice the delay. The result is a scenario
    file; what it gains over the scenario's own gains is flown over seeds that the search has not seen.
    """
    from bridge.process import StopFlag
    from controller.laws.registry import check_law
    from fwav_hil.studies.design import gains_of, search
    from fwav_hil.studies.design_pool import cores, mapping
    from fwav_hil.studies.design_result import judge_design, print_design, scenario_text, with_delay
    from fwav_hil.studies.margin import at_rate

    base_path = find_scenario(scenario)
    start = with_overrides(load_scenario(base_path), law=law)
    if rate is not None:
        start = at_rate(start, rate)
    if delay_s is not None:
        start = with_delay(start, delay_s)
    gains_of(start)
    check_law(start, base_path)
    refuse(out)
    stop = StopFlag()
    stop.install()
    to_stderr = is_stdout(json_path)
    with _Shown(2 * generations) as shown, mapping(workers or cores(), stop) as candidates:
        found = search(
            start, seed=seed, flights=flights, generations=generations, mapping=candidates, progress=shown.generation
        )
        shown.text("flying seeds that the search has not seen")
        result = judge_design(start, found, stop=stop, seed=seed, flights=flights, generations=generations)
    text = scenario_text(result, base_path, out)
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise RunFolderError(f"cannot write {out}: {error.strerror}; choose another file with --out") from None
    load_scenario(out)
    content: dict[str, Any] = {**result.as_json(), "file": str(out)}
    print_design(result, to_stderr=to_stderr)
    click.echo(f"scenario: {out}", err=to_stderr)
    show_json(json_path, content)


def refuse(out: Path) -> None:
    """Raise RunFolderError, before the search, where the file exists already or has no folder to go to."""
    if out.exists():
        raise RunFolderError(f"{out} exists already and stays: choose another file with --out, or remove it")
    if not out.parent.is_dir():
        raise RunFolderError(
            f"cannot write {out}: there is no folder {out.parent}; make it, or choose another with --out"
        )


class _Shown:
    """How far the search is, on standard error: a bar on a terminal, a line every few generations elsewhere."""

    _EVERY = 5

    def __init__(self, generations: int) -> None:
        from rich.console import Console
        from rich.progress import Progress

        self._is_terminal = sys.stderr.isatty()
        self._bar = Progress(console=Console(stderr=True), disable=not self._is_terminal)
        self._task = self._bar.add_task("searching", total=generations)
        self._count = 0

    def generation(self, group: str, cost: float) -> None:
        """One generation of a group is done; `cost` is the best so far."""
        from fwav_hil.studies.design_result import show_cost

        self._count += 1
        self._bar.update(self._task, advance=1, description=f"{group}, {show_cost(cost)}")
        if not self._is_terminal and self._count % self._EVERY == 0:
            click.echo(f"{group}, generation {self._count}: {show_cost(cost)}", err=True)

    def text(self, text: str) -> None:
        """What is done after the search."""
        self._bar.update(self._task, description=text)
        if not self._is_terminal:
            click.echo(text, err=True)

    def __enter__(self) -> _Shown:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
