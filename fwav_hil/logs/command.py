"""`fwav-hil log`: what is in a log, its messages, its plots, the log in other formats."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import click

from bridge.option_types import FILE
from bridge.options import Argument, Option, command
from bridge.shared_options import JsonPath
from bridge.summary import is_stdout, show_json
from fwav_hil.logs.dialect_option import Dialect
from protocol.errors import UsageError

LogPath = Annotated[Path, Argument()]
Systems = Annotated[tuple[str, ...], Option(
    "--system", "Messages of this system, or of one component of it, only; may be repeated.", "N[/C]"
)]  # fmt: skip
Start = Annotated[str | None, Option("--from", "From here on: seconds since the log began, or HH:MM:SS (UTC).", "TIME")]
End = Annotated[str | None, Option("--to", "Up to here, as in --from.", "TIME")]
Types = Annotated[tuple[str, ...], Option("--types", "Messages of these names only; may be repeated.", "MSG,...")]


@click.group("log", epilog="\b\nExample:\n  fwav-hil log info runs/flapper-ude-2026-11-22T14-05-09/run.tlog")
def log_group() -> None:
    """Read telemetry logs.

    LOG is MAVLink telemetry (.tlog of this project, QGroundControl, MAVProxy, mavlink-router, Mission Planner; or a raw
    stream), ArduPilot's .BIN or .log, PX4's .ulg, or of a CAN bus (candump's .log, .asc, .blf, .trc); its first bytes
    tell which. Damage is counted and passed over.
    """


@command("info", "fwav-hil log info flight.tlog --json -", group=log_group)
def info_command(log: LogPath, dialect: Dialect = None, json_path: JsonPath = None) -> None:
    """Say what is in LOG: senders, messages, rates, gaps, losses, damage."""
    from fwav_hil.logs.choice import open_with_progress
    from fwav_hil.logs.info import log_info, print_info

    info = log_info(open_with_progress(log))
    print_info(info, to_stderr=is_stdout(json_path))
    show_json(json_path, info)


@command("dump", "fwav-hil log dump flight.tlog --types ATTITUDE --from 10 --to 12.5", group=log_group)
def dump_command(
    log: LogPath,
    types: Types = (),
    systems: Systems = (),
    start: Start = None,
    end: End = None,
    dialect: Dialect = None,
    as_json: Annotated[bool, Option("--json", "One JSON object a line instead of text.")] = False,
) -> None:
    """Print the messages of LOG, one a line, in their order."""
    from fwav_hil.logs.choice import choose, open_with_progress
    from fwav_hil.logs.dump import json_lines, text_lines
    from protocol.logs.files import messages

    opened = open_with_progress(log)
    choice = choose(opened, types, systems, start, end)
    chosen = messages(opened, choice.names, between_us=choice.between_us, senders=choice.senders, for_json=as_json)
    lines = json_lines(chosen) if as_json else text_lines(chosen, opened.span_us()[0])
    sys.stdout.writelines(lines)
    sys.stdout.flush()


@command("plot", "fwav-hil log plot flight.tlog ATTITUDE.roll ATT_POS_MOCAP.q[2]", group=log_group)
def plot_command(
    log: LogPath,
    fields: Annotated[tuple[str, ...], Argument("MSG.FIELD...")],
    out: Annotated[Path | None, Option(
        "--out", "File to draw into; by default the log's name with _plot.png, in this folder.", "PNG", type=FILE
    )] = None,
    systems: Systems = (),
    start: Start = None,
    end: End = None,
    dialect: Dialect = None,
) -> None:  # fmt: skip
    """Draw fields of LOG over time: MSG.field, or MSG.field[i] for one element of an array."""
    from fwav_hil.logs.choice import choose, open_with_progress
    from fwav_hil.logs.plot import plot_log

    opened = open_with_progress(log)
    path = out or Path(f"{log.stem}_plot.png")
    plot_log(opened, fields, choose(opened, (), systems, start, end), path)
    click.echo(f"plot: {path}")


@command("export", "fwav-hil log export flight.tlog --to mcap --types ATTITUDE --from 10 --to 60", group=log_group)
def export_command(
    log: LogPath,
    targets: Annotated[tuple[str, ...], Option(
        "--to",
        "mcap: one file for Foxglove and PlotJuggler. parquet, csv: a folder with one file for each message. A time: "
        "where to end, as --from.", "FORMAT|TIME"
    )],
    types: Types = (),
    systems: Systems = (),
    start: Start = None,
    out: Annotated[
        Path | None, Option("--out", "File (mcap) or folder; by default named after the log, in this folder.", "PATH")
    ] = None,
    dialect: Dialect = None,
    json_path: JsonPath = None,
) -> None:  # fmt: skip
    """Write LOG in a format of other programs. What is there already is never overwritten."""
    from fwav_hil.logs.choice import choose, choose_frames, open_with_progress
    from fwav_hil.logs.export import SUFFIXES, default_output, export_log

    kinds = [target for target in targets if target in SUFFIXES]
    ends = [target for target in targets if target not in SUFFIXES]
    if len(kinds) != 1 or len(ends) > 1:
        raise UsageError(f"say what to write once: --to {', '.join(SUFFIXES)} (and --to TIME for the end)")
    opened = open_with_progress(log)
    choice = choose(opened, types, systems, start, ends[0] if ends else None)
    if choice.names and all(name.startswith("UNKNOWN_") for name in choice.names):
        raise UsageError(f"nothing says what is in {', '.join(choice.names)}: `fwav-hil log dump` shows the bytes")
    if opened.scan is not None:
        choose_frames(opened, opened.scan, choice)  # says so where nothing is left
    result = export_log(opened, kinds[0], out or default_output(log, kinds[0]), choice)
    messages = sum(result["messages"].values())
    unknown = f"; left out: {result['unknown_frames']} frames of unknown messages" if result["unknown_frames"] else ""
    kinds_written = f"{messages} messages of {len(result['messages'])} kinds"
    click.echo(f"{result['out']}: {kinds_written}{unknown}", err=is_stdout(json_path))
    show_json(json_path, result)
