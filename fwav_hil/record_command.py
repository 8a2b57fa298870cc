"""The command line of `fwav-hil record`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click

from bridge.option_types import FILE
from bridge.options import Option, command
from bridge.shared_options import JsonPath, OnLogError, WaitS
from bridge.summary import is_stdout, show_json


@command(
    "record",
    "fwav-hil record --link udpin://127.0.0.1:14550 --out flight.tlog",
    "fwav-hil record --link serial:///dev/ttyUSB0:57600 --link tcpout://127.0.0.1:5760 --duration 60",
)
def record_command(
    links: Annotated[tuple[str, ...], Option(
        "--link",
        "What to listen to: udpin://, tcpout://, tcpin://, serial:///dev/x:baud. Several: repeat the option.", "URI"
    )],
    out: Annotated[Path | None, Option(
        "--out", "The log; by default a new one in this folder, named after the time.", "FILE", type=FILE
    )] = None,
    duration_s: Annotated[float | None, Option(
        "--duration", "Stop after so many seconds; without it, at Ctrl-C.", "S", min=0.0, min_open=True
    )] = None,
    wait_s: WaitS = 30.0,
    on_log_error: OnLogError = "stop",
    json_path: JsonPath = None,
) -> None:  # fmt: skip
    """Record every frame of live links, with a sidecar that says which link each came by.

    Nothing is sent. Every intact frame is kept, of MAVLink 1 and 2 and of whatever message; what the system dropped since it
    was not read in time is told, and counted as lost. Ctrl-C ends the recording (exit code 0). Exit code
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
    lost = f", {result['lost']} lost ({result['error']})" if result["lost"] else ""
    counted = result["counters"].values()
    damaged = sum(link["bad_crc"] + link["truncated"] for link in counted)
    left_out = f"; left out: {damaged} damaged frames" if damaged else ""
    click.echo(
        f"{log}: {result['frames']} frames in {result['duration_s']:.1f} s{lost}{left_out}", err=is_stdout(json_path)
    )
    show_json(json_path, result)
    if not result["frames"]:
        raise PeerMissingError(f"no frame came over {', '.join(links)}: see that something sends there")
