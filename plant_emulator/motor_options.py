"""What the commands that deal with drives on a CAN bus share: options, and the scenario that they make."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import msgspec

from bridge.command_line import chosen_scenario, options
from protocol.motor_protocol import PROTOCOLS
from protocol.scenario import Scenario, with_overrides

DEFAULT_CAN = "udp_multicast:239.74.163.2"

can_option = click.option(
    "--can", default=DEFAULT_CAN, show_default=True, metavar="URI",
    help="The CAN bus: udp_multicast:group[:port], virtual:name, socketcan:can0, slcan:/dev/x.",
)  # fmt: skip
protocol_option = click.option(
    "--protocol", type=click.Choice(list(PROTOCOLS)), help="What the drives speak, instead of the scenario's protocol."
)
lag_option = click.option(
    "--lag",
    type=click.FloatRange(min=0.0),
    metavar="S",
    help="Lag of the drives' torque loop, instead of the scenario's.",
)


run_motor_options = options(
    click.option(
        "--motor", type=click.Choice(["direct", "can"]), default="direct", show_default=True,
        help="Motors and gears in the emulator, or in drives on a CAN bus.",
    ),
    can_option,
    protocol_option,
    lag_option,
    click.option(
        "--feedback", type=click.Choice(["sync", "bus"]), default="sync", show_default=True,
        help="What the plant gets: every bit of the force behind the gears, or what the protocol's own status shows of it.",
    ),
    click.option(
        "--can-log", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
        help="Record of the bus: .blf, .log, .asc or .csv; by default motor_bus.blf in the run folder.",
    ),
    click.option(
        "--tap", metavar="URI", help="Show the bus as CAN_FRAME to a station on this MAVLink link (udpin://, tcpin://).",
    ),
)  # fmt: skip
"""Options of `run` and `emulator`: see `chosen_link`."""


def chosen_motor_scenario(name: str, *, protocol: str | None, lag_s: float | None, **overrides: Any) -> Scenario:
    """`chosen_scenario`, with what the command line says of the drives. Raises ScenarioError."""
    scenario = chosen_scenario(name, **overrides)
    changes = {key: value for key, value in (("protocol", protocol), ("lag_s", lag_s)) if value is not None}
    if not changes:
        return scenario
    return with_overrides(scenario, motor=msgspec.to_builtins(scenario.motor) | changes)
