"""The command line of `fwav-hil record`."""

from __future__ import annotations

from pathlib import Path

import click

from bridge.command_line import json_option, log_error_option, options, wait_option
from bridge.summary import is_stdout, show_json

EXAMPLE = """
\b
Example:
  fwav-hil record --link udpin://127.0.0.1:14550 --out flight.tlog
  fwav-hil record --link serial:///dev/ttyUSB0:57600 --link tcpout://127.0.0.1:5760 --duration 60
"""


@click.command("record", epilog=EXAMPLE)
@options(
    click.option(
        "--link", "links", multiple=True, required=True, metavar="URI",
        help="What to listen to: udpin://, tcpout://, tcpin://, serial:///dev/x:baud. Several: repeat the option.",
    ),
    click.option(
        "--out", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
        help="The log; by default a new one in this folder, named after the time.",
    ),
    click.option(
        "--duration", "duration_s", type=click.FloatRange(min=0.0, min_open=True), metavar="S",
        help="Stop after so many seconds; without it, at Ctrl-C.",
    ),
    wait_option,
    log_error_option,
    json_option,
)  # fmt: skip
def record_command(
    links: tuple[str, ...],
    out: Path | None,
    duration_s: float | None,
    wait_s: float,
    on_log_error: str,
    json_path: Path | None,
) -> None:
    """Record every frame of live links, with a sidecar that says which link each came by.

    Nothing is sent. Frames of unknown messages and of MAVLink 1 are kept. Ctrl-C ends the recording (exit code 0). Exit code
    4: nothing came.
    """
    from bridge.process import StopFlag
    from bridge.timing.clock import local_stamp
    from fwav_hil.record import record
    from protocol.errors import PeerMissingError

    stop = StopFlag()
    stop.install()
    log = out or Path(f"recording-{local_stamp()}.tlog")
    result = record(links, log, stop, duration_s=duration_s, wait_s=wait_s, goes_on=on_log_error == "continue")
    lost = f", {result['lost']} lost" if result["lost"] else ""
    click.echo(f"{log}: {result['frames']} frames in {result['duration_s']:.1f} s{lost}", err=is_stdout(json_path))
    show_json(json_path, result)
    if not result["frames"]:
        raise PeerMissingError(f"no frame came over {', '.join(links)}: see that something sends there")
