"""What the commands that deal with drives on a CAN bus share: options, and the scenario that they make."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import msgspec

from bridge.command_line import chosen_scenario, options
from protocol.errors import UsageError
from protocol.motors.motor_protocol import PROTOCOLS
from protocol.scenario import Scenario, with_overrides

DEFAULT_CAN = "udp_multicast:239.74.163.2"


def _of_drives_on_a_bus(context: click.Context, parameter: click.Parameter, value: Any) -> Any:
    """Refuse an option of the bus where the command has `--motor` and it says that there is none."""
    given = context.get_parameter_source(parameter.name or "") is not click.core.ParameterSource.DEFAULT
    if given and context.params.get("motor") == "direct":
        raise UsageError(f"{parameter.opts[0]} is of drives on a CAN bus: add --motor can, or leave it out")
    return value


can_option = click.option(
    "--can", default=DEFAULT_CAN, show_default=True, metavar="URI", callback=_of_drives_on_a_bus,
    help="The CAN bus: udp_multicast:group[:port], virtual:name, socketcan:can0, slcan:/dev/x.",
)  # fmt: skip
protocol_option = click.option(
    "--protocol",
    type=click.Choice(list(PROTOCOLS)),
    callback=_of_drives_on_a_bus,
    help="What the drives speak, instead of the scenario's protocol.",
)
lag_option = click.option(
    "--lag",
    type=click.FloatRange(min=0.0),
    metavar="S",
    callback=_of_drives_on_a_bus,
    help="Lag of the drives' torque loop, instead of the scenario's.",
)


run_motor_options = options(
    click.option(
        "--motor", type=click.Choice(["direct", "can"]), default="direct", show_default=True, is_eager=True,
        help="Motors and gears in the emulator, or in drives on a CAN bus.",
    ),
    can_option,
    protocol_option,
    lag_option,
    click.option(
        "--feedback", type=click.Choice(["sync", "bus"]), default="sync", show_default=True, callback=_of_drives_on_a_bus,
        help="What the plant gets: every bit of the force behind the gears, or what the protocol's own status shows of it.",
    ),
    click.option(
        "--can-log", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE", callback=_of_drives_on_a_bus,
        help="Record of the bus: .blf, .log, .asc or .csv; by default motor_bus.blf in the run folder.",
    ),
    click.option(
        "--tap", metavar="URI", callback=_of_drives_on_a_bus,
        help="Show the bus as CAN_FRAME to a station on this MAVLink link (udpin://, tcpin://).",
    ),
)  # fmt: skip
"""Options of `run` and `emulator`; those of the bus are refused without `--motor can`, where they would do nothing."""


def chosen_motor_scenario(name: str, *, protocol: str | None, lag_s: float | None, **overrides: Any) -> Scenario:
    """`chosen_scenario`, with what the command line says of the drives. Raises ScenarioError."""
    scenario = chosen_scenario(name, **overrides)
    changes = {key: value for key, value in (("protocol", protocol), ("lag_s", lag_s)) if value is not None}
    if not changes:
        return scenario
    return with_overrides(scenario, motor=msgspec.to_builtins(scenario.motor) | changes)
