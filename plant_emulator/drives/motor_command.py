"""The command line of the drives: `fwav-hil motor`, and `python -m plant_emulator.drives.motor_command` for `run`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from bridge.command_line import begin_process, json_option, options, process_options, run_command, scenario_argument
from bridge.summary import show_json
from plant_emulator.drives.motor_options import can_option, chosen_motor_scenario, lag_option, protocol_option

EXAMPLE = """
\b
Example:
  fwav-hil motor flapper --can udp_multicast:239.74.163.2 --protocol odrive
  fwav-hil motor flapper --can socketcan:can0 --protocol dronecan
"""


@click.command("motor", epilog=EXAMPLE)
@options(
    scenario_argument,
    can_option,
    protocol_option,
    lag_option,
    click.option("--rate", type=float, metavar="HZ", hidden=True),
    click.option(
        "--out", type=click.Path(file_okay=False, path_type=Path), metavar="DIR", help="Folder for the counters.",
    ),
    json_option,
    process_options,
)  # fmt: skip
def motor(
    scenario: str,
    can: str,
    protocol: str | None,
    lag: float | None,
    rate: float | None,
    out: Path | None,
    json_path: Path | None,
    status: str,
    core: int | None,
    with_parent: bool,
) -> None:
    """Be six simulated drives on a CAN bus, with the limits and gears of SCENARIO, for whatever controller commands them.

    Ctrl-C ends it.
    """
    chosen = chosen_motor_scenario(scenario, protocol=protocol, lag_s=lag, rate_hz=rate)
    report, stop = begin_process(status, core, with_parent=with_parent)
    from plant_emulator.drives.motor_process import MotorOptions, run_motor

    summary = run_motor(chosen, MotorOptions(can=can, protocol=chosen.motor.protocol, out=out), report, stop)
    show_json(json_path, {"scenario": chosen.name, **summary})


if __name__ == "__main__":
    sys.exit(run_command(motor, "motor"))
