"""The drives as a process, or as a thread of the emulator where the bus exists only within one process."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Any

from bridge.motor_bus.can_bus import CanBus
from bridge.process import StopFlag, take_folder
from bridge.reporting import Report
from bridge.summary import write_json
from bridge.timing.clock import Clock, MonotonicClock
from plant_emulator.drives.motor_node import MotorNode, is_of_drives, warm_up
from plant_emulator.options import MotorOptions
from protocol.errors import FwavHilError, LinkInUseError
from protocol.scenario import NANOSECONDS, Scenario

RESULT = "motor.json"
LISTEN_S = 0.25
"""How long to listen for drives already on the bus: they send encoder frames far more often."""
LOCKSTEP_WAIT_S = 0.1
OWN_WAIT_S = 0.001


def run_motor(scenario: Scenario, options: MotorOptions, report: Report, stop: StopFlag) -> dict[str, Any]:
    """Run the six drives on a bus until asked to stop; returns the counters. Raises the errors of `protocol.errors`."""
    if options.out:
        take_folder(options.out, RESULT)
    warm_up(scenario, scenario.motor.protocol)
    with CanBus(options.can, scenario.motor.bitrate) as bus:
        clock = MonotonicClock()
        _refuse_other_drives(bus, clock)
        node = MotorNode(scenario, scenario.motor.protocol)
        report({"event": "waiting", "link": options.can})
        error: FwavHilError | None = None
        try:
            while not stop.requested:
                serve_once(node, bus, clock)
        except FwavHilError as stopped:
            error = stopped
        summary = {
            "protocol": scenario.motor.protocol,
            "can": options.can,
            "counters": {**bus.counters, **node.counters},
            "error": str(error) if error else None,
        }
    if options.out:
        write_json(options.out / RESULT, summary)
    report({"event": "ended", **summary})
    if error:
        raise error
    return summary


def serve_once(node: MotorNode, bus: CanBus, clock: Clock) -> None:
    """Handle the next frame, if one arrives soon, and advance time."""
    frame = bus.recv(LOCKSTEP_WAIT_S if node.in_lockstep else OWN_WAIT_S)
    now_ns = clock.now_ns()
    if frame is not None:
        for answer in node.receive(frame, now_ns):
            bus.send(answer)
    for cyclic in node.elapse(now_ns):
        bus.send(cyclic)


def _refuse_other_drives(bus: CanBus, clock: Clock) -> None:
    """Raise LinkInUseError where other drives already send on the bus."""
    until_ns = clock.now_ns() + round(LISTEN_S * NANOSECONDS)
    while (remaining_ns := until_ns - clock.now_ns()) > 0:
        frame = bus.recv(remaining_ns * 1e-9)
        if frame is not None and is_of_drives(frame):
            raise LinkInUseError(
                f"the CAN bus {bus.uri.text} already has drives ({frame}): stop those, or choose another bus with --can"
            )


class MotorThread:
    """The drives in a thread of this process, for `virtual:` buses and tests; `with` starts and ends it."""

    def __init__(self, scenario: Scenario, protocol: str, uri: str) -> None:
        warm_up(scenario, protocol)  # or the first tick waits for a compiler, and others for numba's lock on it
        self.node = MotorNode(scenario, protocol)
        self._bus = CanBus(uri, scenario.motor.bitrate)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="motors", daemon=True)

    def _serve(self) -> None:
        clock = MonotonicClock()
        while not self._ending.is_set():
            try:
                serve_once(self.node, self._bus, clock)
            except FwavHilError:
                return  # the emulator notices that its drives do not answer

    def __enter__(self) -> MotorThread:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join(10.0)
        self._bus.close()
