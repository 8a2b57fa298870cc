"""Both ends in one process, each in a thread, on links of the test's choosing."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import controller.process as controller_process
import plant_emulator.process
from bridge.links.link import Link
from bridge.process import StopFlag
from bridge.shared_options import ClockMode
from controller.laws.law import make_law
from controller.options import ControllerOptions, Trigger
from controller.process import serve
from plant_emulator.options import EmulatorOptions, MotorLink
from plant_emulator.process import fly
from protocol.errors import FwavHilError
from protocol.scenario import Scenario, find_scenario, load_scenario, with_overrides

Outcome = dict[str, Any] | FwavHilError


class Ends(NamedTuple):
    """How each end came out: its summary, or the error it raised."""

    emulator: Outcome
    controller: Outcome


def scenario_of(name: str, **overrides: Any) -> Scenario:
    """A scenario of the project with top-level keys changed."""
    return with_overrides(load_scenario(find_scenario(name)), **overrides)


def fly_both(
    scenario: Scenario,
    emulator_link: Link,
    controller_link: Link,
    out: Path | None = None,
    *,
    controller_scenario: Scenario | None = None,
    clock: ClockMode = "lockstep",
    arm: bool = True,
    legs: bool = False,
    wait_s: float = 20.0,
    motors: MotorLink | None = None,
    trigger: Trigger = "sample",
    spin_s: float | None = None,
    station: str | None = None,
    truth_hz: float | None = None,
    controller_station: str | None = None,
) -> Ends:
    """Run both ends to their end."""
    theirs = controller_scenario or scenario
    emulator = EmulatorOptions(
        link="-", clock=clock, out=out, wait_s=wait_s, legs=legs, motor="can" if motors else "direct",
        bus=motors or MotorLink(), spin_s=spin_s, station=station, truth_hz=truth_hz,
    )  # fmt: skip
    service_options = ControllerOptions(
        link="-", clock=clock, out=out, wait_s=wait_s, arm=arm, legs=legs, trigger=trigger, spin_s=spin_s,
        station=controller_station,
    )  # fmt: skip
    law = make_law(theirs.law, theirs)
    plant_emulator.process.warm_up(scenario)
    controller_process.warm_up(theirs, law)
    with ThreadPoolExecutor(2) as threads:
        flight = threads.submit(lambda: fly(scenario, emulator_link, emulator, _silent, StopFlag()))
        service = threads.submit(lambda: serve(theirs, law, controller_link, service_options, _silent, StopFlag()))
        return Ends(_outcome(flight.result), _outcome(service.result))


def _outcome(result: Callable[[], dict[str, Any]]) -> Outcome:
    try:
        return result()
    except FwavHilError as error:
        return error


def _silent(_event: dict[str, Any]) -> None:
    pass
