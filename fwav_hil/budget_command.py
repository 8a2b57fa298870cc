"""`fwav-hil budget`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import click

from bridge.options import Except, Option, command
from bridge.shared_options import JsonPath, ScenarioChoice
from bridge.summary import is_stdout, show_json
from protocol.errors import UsageError

if TYPE_CHECKING:
    from bridge.latency.budget import Budget


@command("budget", "fwav-hil budget --link serial:///dev/ttyUSB0:921600 --rate 500")
def budget(
    choice: Annotated[ScenarioChoice, Except("law", "duration_s", "seed")],
    link: Annotated[str, Option("--link", "The link, at either end: serial://, udpin://, tcpout:// ...", "URI")],
    json_path: JsonPath = None,
) -> None:
    """Compute whether SCENARIO's messages fit a link at a rate, and what each hop of the loop adds to the delay.

    No link is opened. In real time on a serial line `emulator` and `controller` make the same check at their start.

    \b
    Exit code: 0 where the rate fits, else 2.
    """
    scenario = choice.load()
    from bridge.latency.budget import link_budget

    found = link_budget(link, scenario.rate_hz)
    planned_s = scenario.delay_ns * 1e-9
    _print(found, planned_s, to_stderr=is_stdout(json_path))
    show_json(json_path, {"budget": found, "scenario": scenario.name, "scenario_delay_s": planned_s})
    if not found.fits:
        raise UsageError(found.sentence)
    click.echo(found.sentence, err=is_stdout(json_path))


def _print(found: Budget, planned_s: float, *, to_stderr: bool) -> None:
    from rich.table import Table

    from fwav_hil.tables import plain_console

    console = plain_console(to_stderr=to_stderr)
    table = Table("message", title=f"{found.link} at {found.rate_hz:g} Hz", title_justify="left")
    for column in ("bytes", "rate", "bytes/s", "share"):
        table.add_column(column, justify="right")
    for way in found.ways:
        capacity = way.capacity_bytes_per_s
        table.add_row(way.name, style="bold")
        for row in way.messages:
            size, often = str(row.frame_bytes), f"{row.rate_hz:g} Hz"
            table.add_row(
                f"  {row.message}", size, often, f"{row.bytes_per_s:.0f}", _percent(row.bytes_per_s / capacity)
            )
        if way.overhead_bytes_per_s:
            overhead = way.overhead_bytes_per_s
            table.add_row("  headers of datagrams", "", "", f"{overhead:.0f}", _percent(overhead / capacity))
        table.add_row(f"  total, of {capacity:.0f}", "", "", f"{way.bytes_per_s:.0f}", _percent(way.share))
    console.print(table)
    table = Table("hop", title="From a sample to its command", title_justify="left")
    table.add_column("delay", justify="right")
    table.add_column("")
    for hop in found.hops:
        table.add_row(hop.name, f"{1e3 * hop.delay_s:.3f} ms", hop.note)
    table.add_row("total", f"{1e3 * found.delay_s:.3f} ms", f"{found.delay_periods:.2f} periods")
    console.print(table)
    console.print(
        "The processes' computing time adds to this (`fwav-hil latency` measures it), and the plant holds each command for a "
        f"period. In lockstep and `simulate` the scenario's delay replaces all of this: {1e3 * planned_s:g} ms."
    )
    if found.delay_periods > 1:
        console.print(
            "A command arrives after the next tick was sent: it answers an older sample, and ticks count as unanswered."
        )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
