"""The command line of the controller."""

from __future__ import annotations

from typing import Annotated

import msgspec

from bridge.command_line import begin_process, refuse_rate_that_cannot_fit
from bridge.options import Except, command
from bridge.shared_options import JsonPath, ScenarioChoice
from bridge.summary import show_json
from bridge.timing.realtime import check_real_time, own_core
from controller.laws.registry import refuse_on_a_link
from controller.options import ControllerOptions


@command(
    "controller", "fwav-hil controller scenarios/flapper.toml --link udpout://127.0.0.1:14560 --law ude --rate 500"
)
def controller(
    choice: Annotated[ScenarioChoice, Except("duration_s", "seed")],
    options: ControllerOptions,
    json_path: JsonPath = None,
) -> None:
    """Run the controller alone: it looks for an emulator, then answers each of its samples with the law of SCENARIO."""
    scenario = choice.load()
    check_real_time(options.clock, realtime=options.realtime, trigger=options.trigger)
    if options.clock == "realtime":
        refuse_rate_that_cannot_fit(options.link, scenario.rate_hz)
    refuse_on_a_link(scenario, choice.path)
    report, stop = begin_process()
    from controller.process import run_controller

    summary = run_controller(scenario, msgspec.structs.replace(options, core=own_core(1)), report, stop)
    show_json(json_path, {"scenario": scenario.name, "rate_hz": scenario.rate_hz, **summary})
