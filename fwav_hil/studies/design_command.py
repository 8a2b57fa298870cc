"""`fwav-hil design`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import click
import msgspec

from bridge.option_types import FILE
from bridge.options import Except, Option, command
from bridge.shared_options import JsonPath, ScenarioChoice
from bridge.summary import is_stdout, show_json
from protocol.errors import RunFolderError
from protocol.scenario import find_scenario, load_scenario


@command("design", "fwav-hil design flapper --rate 500 --delay-s 0.004 --out flapper_500.toml")
def design_command(
    choice: Annotated[ScenarioChoice, Except("duration_s", "seed")],
    out: Annotated[
        Path, Option("--out", "The scenario file to write; it must not exist.", "FILE.toml", type=FILE)
    ],
    delay_s: Annotated[float | None, Option(
        "--delay-s", "Total delay from sample to action, instead of the scenario's.", "S", min=0.0, max=1.0
    )] = None,
    seed: Annotated[int, Option("--seed", "Seed of the optimiser.", min=0)] = 1,
    flights: Annotated[
        int, Option("--flights", "Flights per set of gains, each with another noise seed.", "N", min=1)
    ] = 4,
    generations: Annotated[
        int, Option("--generations", "Generations of the search, for attitude and for position.", "N", min=1)
    ] = 20,
    workers: Annotated[
        int | None, Option("--workers", "Number of search processes; by default one per core.", "N", min=1)
    ] = None,
    json_path: JsonPath = None,
) -> None:  # fmt: skip
    """Search for gains K, Lambda, T and N for the link of SCENARIO: its rate, delay, noise and limits.

    The search minimises the tracking error with a gain margin of at least 2 both ways and stability at twice the delay. The
    result is a scenario file; old and new gains are then compared over seeds not used in the search.
    """
    from bridge.process import StopFlag
    from controller.laws.registry import check_law
    from fwav_hil.studies.design import gains_of, search
    from fwav_hil.studies.design_pool import cores, mapping
    from fwav_hil.studies.design_result import judge_design, print_design, scenario_text, with_delay
    from fwav_hil.studies.margin import at_rate

    base_path = find_scenario(choice.scenario)
    start = msgspec.structs.replace(choice, rate_hz=None).load()
    if choice.rate_hz is not None:
        start = at_rate(start, choice.rate_hz)
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
        shown.text("flying seeds not used in the search")
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
        raise RunFolderError(f"{out} already exists: choose another file with --out, or remove it")
    if not out.parent.is_dir():
        raise RunFolderError(
            f"cannot write {out}: there is no folder {out.parent}; make it, or choose another with --out"
        )


class _Shown:
    """Progress of the search, on standard error: a bar on a terminal, a line every few generations elsewhere."""

    _EVERY = 5

    def __init__(self, generations: int) -> None:
        from rich.console import Console
        from rich.progress import Progress

        self._is_terminal = sys.stderr.isatty()
        self._bar = Progress(console=Console(stderr=True), disable=not self._is_terminal)
        self._task = self._bar.add_task("searching", total=generations)
        self._count = 0

    def generation(self, group: str, cost: float) -> None:
        """Called after each generation of a group; `cost` is the best so far."""
        from fwav_hil.studies.design_result import show_cost

        self._count += 1
        self._bar.update(self._task, advance=1, description=f"{group}, {show_cost(cost)}")
        if not self._is_terminal and self._count % self._EVERY == 0:
            click.echo(f"{group}, generation {self._count}: {show_cost(cost)}", err=True)

    def text(self, text: str) -> None:
        """Show the step after the search."""
        self._bar.update(self._task, description=text)
        if not self._is_terminal:
            click.echo(text, err=True)

    def __enter__(self) -> _Shown:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
