"""The command line of the emulator."""

from __future__ import annotations

from typing import Annotated

import msgspec

from bridge.command_line import begin_process, refuse_rate_that_cannot_fit
from bridge.option_types import check_speed
from bridge.options import Except, command
from bridge.shared_options import JsonPath
from bridge.summary import show_json
from bridge.timing.realtime import check_real_time, own_core
from plant_emulator.options import EmulatorOptions, MotorScenarioChoice


@command("emulator", "fwav-hil emulator scenarios/flapper.toml --link udpin://127.0.0.1:14560 --out /tmp/run")
def emulator(
    choice: Annotated[MotorScenarioChoice, Except("law")], options: EmulatorOptions, json_path: JsonPath = None
) -> None:
    """Run the plant emulator alone: it waits for a controller, then flies SCENARIO (a file or a name) with it."""
    scenario = choice.load()
    check_real_time(options.clock, realtime=options.realtime)
    check_speed(options.clock, options.speed, scenario.rate_hz)
    if options.clock == "realtime" or options.speed:
        refuse_rate_that_cannot_fit(options.link, scenario.rate_hz * (options.speed or 1.0))
    report, stop = begin_process()
    from plant_emulator.process import run_emulator

    summary = run_emulator(scenario, msgspec.structs.replace(options, core=own_core(0)), report, stop)
    show_json(json_path, {"scenario": scenario.name, "rate_hz": scenario.rate_hz, "seed": scenario.seed, **summary})
