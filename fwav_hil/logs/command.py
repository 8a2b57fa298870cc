"""`fwav-hil log`: what is in a log, its messages, its plots, the log in other formats."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from bridge.command_line import json_option, options
from bridge.summary import is_stdout, show_json
from protocol.errors import UsageError

log_argument = click.argument("log", type=click.Path(path_type=Path))
system_option = click.option(
    "--system", "systems", multiple=True, metavar="N[/C]",
    help="Messages of this system, or of one component of it, only; may be repeated.",
)  # fmt: skip
from_option = click.option(
    "--from", "start", metavar="TIME", help="From here on: seconds since the log began, or HH:MM:SS (UTC)."
)
when_options = options(
    system_option, from_option, click.option("--to", "end", metavar="TIME", help="Up to here, as in --from.")
)
types_option = click.option(
    "--types", multiple=True, metavar="MSG,...", help="Messages of these names only; may be repeated."
)


@click.group("log", epilog="\b\nExample:\n  fwav-hil log info runs/flapper-ude-2026-11-22T14-05-09/run.tlog")
def log_group() -> None:
    """Read telemetry logs.

    LOG is MAVLink telemetry (.tlog of this project, QGroundControl, MAVProxy, mavlink-router, Mission Planner; or a raw
    stream), ArduPilot's .BIN or PX4's .ulg; its first bytes tell which. Damage is counted and passed over.
    """


@log_group.command("info", epilog="\b\nExample:\n  fwav-hil log info flight.tlog --json -")
@options(log_argument, json_option)
def info_command(log: Path, json_path: Path | None) -> None:
    """Say what is in LOG: senders, messages, rates, gaps, losses, damage."""
    from fwav_hil.logs.choice import open_with_progress
    from fwav_hil.logs.info import log_info, print_info

    info = log_info(open_with_progress(log))
    print_info(info, to_stderr=is_stdout(json_path))
    show_json(json_path, info)


@log_group.command("dump", epilog="\b\nExample:\n  fwav-hil log dump flight.tlog --types ATTITUDE --from 10 --to 12.5")
@options(
    log_argument,
    types_option,
    when_options,
    click.option("--json", "as_json", is_flag=True, help="One JSON object a line instead of text."),
)
def dump_command(
    log: Path, types: tuple[str, ...], systems: tuple[str, ...], start: str | None, end: str | None, as_json: bool
) -> None:
    """Print the messages of LOG, one a line, in their order."""
    from fwav_hil.logs.choice import choose, open_with_progress
    from fwav_hil.logs.dump import json_lines, text_lines
    from protocol.logs.files import messages

    opened = open_with_progress(log)
    choice = choose(opened, types, systems, start, end)
    chosen = messages(opened, choice.names, between_us=choice.between_us, senders=choice.senders)
    lines = json_lines(chosen) if as_json else text_lines(chosen, opened.span_us()[0])
    sys.stdout.writelines(lines)
    sys.stdout.flush()


@log_group.command("plot", epilog="\b\nExample:\n  fwav-hil log plot flight.tlog ATTITUDE.roll ATT_POS_MOCAP.q[2]")
@options(
    log_argument,
    click.argument("fields", nargs=-1, required=True, metavar="MSG.FIELD..."),
    click.option("--out", type=click.Path(dir_okay=False, path_type=Path), metavar="PNG",
                 help="File to draw into; by default the log's name with _plot.png, in this folder."),
    when_options,
)  # fmt: skip
def plot_command(
    log: Path,
    fields: tuple[str, ...],
    out: Path | None,
    systems: tuple[str, ...],
    start: str | None,
    end: str | None,
) -> None:
    """Draw fields of LOG over time: MSG.field, or MSG.field[i] for one element of an array."""
    from fwav_hil.logs.choice import choose, open_with_progress
    from fwav_hil.logs.plot import plot_log

    opened = open_with_progress(log)
    path = out or Path(f"{log.stem}_plot.png")
    plot_log(opened, fields, choose(opened, (), systems, start, end), path)
    click.echo(f"plot: {path}")


@log_group.command(
    "export", epilog="\b\nExample:\n  fwav-hil log export flight.tlog --to mcap --types ATTITUDE --from 10 --to 60"
)
@options(
    log_argument,
    click.option(
        "--to", "targets", multiple=True, required=True, metavar="FORMAT|TIME",
        help="mcap: one file for Foxglove and PlotJuggler. parquet, csv: a folder with one file for each message. "
        "A time: where to end, as --from.",
    ),
    types_option,
    system_option,
    from_option,
    click.option("--out", type=click.Path(path_type=Path), metavar="PATH",
                 help="File (mcap) or folder; by default named after the log, in this folder."),
    json_option,
)  # fmt: skip
def export_command(
    log: Path,
    targets: tuple[str, ...],
    types: tuple[str, ...],
    systems: tuple[str, ...],
    start: str | None,
    out: Path | None,
    json_path: Path | None,
) -> None:
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
    click.echo(f"{result['out']}: {messages} messages of {len(result['messages'])} kinds", err=is_stdout(json_path))
    show_json(json_path, result)
