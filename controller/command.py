"""The command line of the controller."""

from __future__ import annotations

from pathlib import Path

import click

from bridge.command_line import (
    DEFAULT_PORT,
    begin_process,
    chosen_scenario,
    clock_option,
    json_option,
    law_option,
    legs_option,
    options,
    process_options,
    rate_option,
    realtime_option,
    refuse_rate_that_cannot_fit,
    scenario_argument,
    signing_key_of,
    signing_option,
    spin_option,
    station_option,
    trigger_option,
    wait_option,
)
from bridge.summary import show_json
from bridge.timing.realtime import check_real_time, own_core
from controller.laws.registry import refuse_on_a_link
from protocol.scenario import find_scenario

EXAMPLE = """
\b
Example:
  fwav-hil controller scenarios/flapper.toml --link udpout://127.0.0.1:14560 --law ude --rate 500
"""


@click.command("controller", epilog=EXAMPLE)
@options(
    scenario_argument,
    click.option(
        "--link", default=f"udpout://127.0.0.1:{DEFAULT_PORT}", show_default=True, metavar="URI",
        help="Where the emulator is: udpout://, udpin://, tcpout://, tcpin://, serial:///dev/x:baud.",
    ),
    law_option,
    clock_option,
    realtime_option,
    trigger_option,
    spin_option,
    rate_option,
    click.option(
        "--arm/--no-arm", default=True, show_default=True,
        help="Arm as soon as the emulator shows the same scenario, or wait for MAV_CMD_COMPONENT_ARM_DISARM.",
    ),
    legs_option,
    wait_option,
    station_option,
    signing_option,
    click.option(
        "--out", type=click.Path(file_okay=False, path_type=Path), metavar="DIR", help="Folder for the counters.",
    ),
    json_option,
    process_options,
)  # fmt: skip
def controller(
    scenario: str,
    link: str,
    law: str | None,
    clock: str,
    realtime: bool,
    trigger: str,
    spin_us: int | None,
    rate: float | None,
    arm: bool,
    legs: bool,
    wait_s: float,
    station: str | None,
    signing_key: Path | None,
    out: Path | None,
    json_path: Path | None,
    status: str,
    core: int | None,
    with_parent: bool,
) -> None:
    """Run the controller alone: it looks for an emulator, then answers each of its samples with the law of SCENARIO."""
    chosen = chosen_scenario(scenario, rate_hz=rate, law=law)
    check_real_time(clock, realtime=realtime, trigger=trigger)
    if clock == "realtime":
        refuse_rate_that_cannot_fit(link, chosen.rate_hz)
    refuse_on_a_link(chosen, find_scenario(scenario))
    report, stop = begin_process(status, core, with_parent=with_parent)
    from controller.options import ControllerOptions
    from controller.process import run_controller

    run_options = ControllerOptions(
        link=link, clock=clock, arm=arm, out=out, wait_s=wait_s, spin_s=None if spin_us is None else spin_us * 1e-6,
        trigger=trigger, realtime=realtime, core=own_core(1) if core is None else core, legs=legs, station=station,
        key=signing_key_of(signing_key),
    )  # fmt: skip
    summary = run_controller(chosen, run_options, report, stop)
    show_json(json_path, {"scenario": chosen.name, "rate_hz": chosen.rate_hz, **summary})
