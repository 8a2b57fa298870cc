"""The command line of the emulator."""

from __future__ import annotations

from pathlib import Path

import click

from bridge.command_line import (
    DEFAULT_PORT,
    begin_process,
    clock_option,
    delay_option,
    duration_option,
    json_option,
    legs_option,
    log_error_option,
    options,
    process_options,
    rate_option,
    realtime_option,
    refuse_rate_that_cannot_fit,
    scenario_argument,
    seed_option,
    signing_key_of,
    signing_option,
    spin_option,
    station_option,
    truth_option,
    wait_option,
)
from bridge.option_types import check_speed, speed_option
from bridge.summary import show_json
from bridge.timing.realtime import check_real_time, own_core
from plant_emulator.drives.motor_options import chosen_motor_scenario, run_motor_options

EXAMPLE = """
\b
Example:
  fwav-hil emulator scenarios/flapper.toml --link udpin://127.0.0.1:14560 --out /tmp/run
"""


@click.command("emulator", epilog=EXAMPLE)
@options(
    scenario_argument,
    click.option(
        "--link", default=f"udpin://127.0.0.1:{DEFAULT_PORT}", show_default=True, metavar="URI",
        help="Where the controller is: udpin://, udpout://, tcpin://, tcpout://, serial:///dev/x:baud.",
    ),
    clock_option,
    speed_option,
    click.option(
        "--profile", type=click.Choice(["exact", "tolerant"]), default="exact", show_default=True,
        help="Lockstep that waits for each answer of our controller, or bears with an autopilot that answers in its own time.",
    ),
    realtime_option,
    spin_option,
    rate_option,
    duration_option,
    seed_option,
    delay_option,
    legs_option,
    wait_option,
    station_option,
    signing_option,
    truth_option,
    run_motor_options,
    click.option(
        "--out", type=click.Path(file_okay=False, path_type=Path), metavar="DIR",
        help="Folder for the log, the ground truth and the counters.",
    ),
    log_error_option,
    json_option,
    process_options,
)  # fmt: skip
def emulator(
    scenario: str,
    link: str,
    clock: str,
    speed: float | None,
    profile: str,
    realtime: bool,
    spin_us: int | None,
    rate: float | None,
    duration: float | None,
    seed: int | None,
    delay_ns: int,
    legs: bool,
    wait_s: float,
    station: str | None,
    signing_key: Path | None,
    truth_hz: float | None,
    motor: str,
    can: str,
    protocol: str | None,
    lag: float | None,
    feedback: str,
    can_log: Path | None,
    tap: str | None,
    out: Path | None,
    on_log_error: str,
    json_path: Path | None,
    status: str,
    core: int | None,
    with_parent: bool,
) -> None:
    """Run the plant emulator alone: it waits for a controller, then flies SCENARIO (a file or a name) with it."""
    chosen = chosen_motor_scenario(scenario, protocol=protocol, lag_s=lag, rate_hz=rate, duration_s=duration, seed=seed)
    check_real_time(clock, realtime=realtime)
    check_speed(clock, speed, chosen.rate_hz)
    if clock == "realtime" or speed:
        refuse_rate_that_cannot_fit(link, chosen.rate_hz * (1.0 if clock == "realtime" else speed or 1.0))
    report, stop = begin_process(status, core, with_parent=with_parent)
    from plant_emulator.options import EmulatorOptions, MotorLink
    from plant_emulator.process import run_emulator

    motors = MotorLink(can=can, feedback=feedback, log=can_log, tap=tap) if motor == "can" else None
    run_options = EmulatorOptions(
        link=link, clock=clock, speed=speed, out=out, wait_s=wait_s, spin_s=None if spin_us is None else spin_us * 1e-6,
        realtime=realtime, core=own_core(0) if core is None else core, delay_ns=delay_ns, legs=legs,
        on_log_error=on_log_error, motors=motors, station=station, key=signing_key_of(signing_key), truth_hz=truth_hz,
        profile=profile,
    )  # fmt: skip
    summary = run_emulator(chosen, run_options, report, stop)
    show_json(json_path, {"scenario": chosen.name, "rate_hz": chosen.rate_hz, "seed": chosen.seed, **summary})
