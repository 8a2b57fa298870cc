"""The command line of the drives."""

from __future__ import annotations

from typing import Annotated

from bridge.command_line import begin_process
from bridge.options import Except, command
from bridge.shared_options import JsonPath
from bridge.summary import show_json
from plant_emulator.options import MotorOptions, MotorScenarioChoice


@command(
    "motor",
    "fwav-hil motor flapper --can udp_multicast:239.74.163.2 --protocol odrive",
    "fwav-hil motor flapper --can socketcan:can0 --protocol dronecan",
)
def motor(
    choice: Annotated[MotorScenarioChoice, Except("law", "duration_s", "seed")],
    options: MotorOptions,
    json_path: JsonPath = None,
) -> None:
    """Run six simulated drives on a CAN bus, with the limits and gears of SCENARIO, for any controller of such drives.

    Ctrl-C ends it.
    """
    scenario = choice.load()
    report, stop = begin_process()
    from plant_emulator.drives.motor_process import run_motor

    show_json(json_path, {"scenario": scenario.name, **run_motor(scenario, options, report, stop)})
