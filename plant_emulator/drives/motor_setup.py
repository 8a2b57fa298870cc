"""What a run with `--motor can` opens before its first tick and closes at its end."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bridge.motor_bus.can_bus import CanBus
from bridge.motor_bus.can_load import plan_bus
from bridge.motor_bus.can_recorder import CanRecorder
from bridge.motor_bus.can_tap import CanTap
from bridge.motor_bus.drives import CanMotors
from bridge.process import StopFlag, open_patiently
from bridge.reporting import Report
from bridge.timing.clock import MonotonicClock
from plant_emulator.drives.motor_process import MotorThread
from protocol.can_frame import CanFrame
from protocol.motors.can_stuffing import exact_bits
from protocol.scenario import Scenario

if TYPE_CHECKING:
    from plant_emulator.options import MotorLink

LOG_NAME = "motor_bus.blf"


@contextlib.contextmanager
def open_motors(
    scenario: Scenario,
    link: MotorLink,
    out: Path | None,
    *,
    clock: str,
    wait_s: float,
    report: Report,
    stop: StopFlag,
    tell: Callable[[str], None] | None = None,
) -> Iterator[CanMotors]:
    """The connected drives of a run. On a `virtual:` bus they are a thread of this process. `tell`: see `CanRecorder`.

    Raises the errors of `CanBus`, `plan_bus`, `CanMotors.meet`.
    """
    exact_bits(CanFrame(0))  # compiles or loads its kernel before the first tick
    plan = plan_bus(scenario.motor.protocol, scenario.motor, scenario.rate_hz)
    wall = MonotonicClock()
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(CanBus(link.can, scenario.motor.bitrate))
        if bus.uri.interface == "virtual":
            stack.enter_context(MotorThread(scenario, plan.protocol, link.can))
        motors = CanMotors(
            scenario,
            bus,
            plan,
            lockstep=clock == "lockstep",
            feedback=link.feedback,
            clock=wall,
            stop=stop,
            report=report,
        )
        path = link.log or (out / LOG_NAME if out else None)
        if path:
            recorder = CanRecorder(path, tell)
            stack.callback(recorder.close)
            motors.watches.append(recorder.watch)
            motors.poll.append(recorder.settle)
        if link.tap:
            tap = CanTap(
                stack.enter_context(open_patiently(link.tap, wait_s, stop)), scenario.wire.emulator_component, wall
            )
            motors.watches.append(tap.watch)
            motors.poll.append(lambda: motors.inject(tap.poll()))
            motors.tap_counters = tap.counters
        motors.meet(wait_s)
        stack.callback(motors.close)
        yield motors
