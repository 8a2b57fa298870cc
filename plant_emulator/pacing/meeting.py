"""Before the first tick: the plant is held at its initial state until a controller, or an autopilot, has connected."""

from __future__ import annotations

from bridge.endpoint import Endpoint, refuse_other_scenario
from bridge.links.link import counterpart
from bridge.process import StopFlag
from bridge.timing.clock import MonotonicClock
from plant_emulator.tick import Emulator
from protocol.due import Due
from protocol.errors import PeerMissingError
from protocol.messages import VEHICLE
from protocol.scenario import NANOSECONDS, Scenario
from protocol.wire import mapping

HELLO_PERIOD_S = 0.1


def meet_controller(
    scenario: Scenario, wait_s: float, endpoint: Endpoint, stop: StopFlag, emulator: Emulator | None = None
) -> None:
    """Hold the plant at t = 0 until a controller with the same scenario reports armed. Raises PeerError, Interrupted."""
    digest = scenario.digest()
    agreed = heard = False
    clock = MonotonicClock()
    give_up_ns = clock.now_ns() + round(wait_s * NANOSECONDS)
    due = Due(1.0 / HELLO_PERIOD_S)
    while (now_ns := clock.now_ns()) < give_up_ns:
        stop.check()
        hello = [
            endpoint.seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat()),
            endpoint.seal(mapping.VERSION, mapping.encode_version(digest)),
        ]
        if heard and due.at(now_ns):
            endpoint.send(hello)
        received = endpoint.receive(HELLO_PERIOD_S)
        if emulator:
            emulator.hear(received)
            if answers := emulator.answers():
                endpoint.send(endpoint.seal(*answer) for answer in answers)
        for frame in received:
            if (frame.system, frame.component) != VEHICLE:
                continue
            if not heard:
                endpoint.send(hello)
            heard = True
            if frame.message_id == mapping.VERSION.message_id:
                refuse_other_scenario("controller", mapping.decode_version(frame.payload), digest)
                agreed = True
            elif (
                frame.message_id == mapping.HEARTBEAT.message_id
                and agreed
                and mapping.heartbeat_is_armed(frame.payload)
            ):
                endpoint.writer.sequence = 0  # the run's sequence numbers, and so its log, begin with the first tick
                return
    uri = endpoint.link.uri
    if heard:
        raise PeerMissingError(
            f"the controller at {endpoint.link.peer} did not arm within {wait_s:g} s: start it with --arm"
        )
    raise PeerMissingError(
        f"no controller connected to {uri} within {wait_s:g} s: start one with `fwav-hil controller "
        f"SCENARIO --link {counterpart(uri)}`, or wait longer with --wait"
    )


def meet_autopilot(wait_s: float, endpoint: Endpoint, stop: StopFlag, emulator: Emulator) -> None:
    """Send heartbeats until an autopilot (1/1) sends anything. Raises PeerMissingError, Interrupted.

    PX4 over TCP sends once its connection is accepted; over UDP it waits for a first frame.
    """
    clock = MonotonicClock()
    give_up_ns = clock.now_ns() + round(wait_s * NANOSECONDS)
    due = Due(1.0 / HELLO_PERIOD_S)
    while (now_ns := clock.now_ns()) < give_up_ns:
        stop.check()
        if due.at(now_ns):
            endpoint.send([endpoint.seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat())])
        received = endpoint.receive(HELLO_PERIOD_S)
        emulator.hear(received)  # requests are answered with the first tick
        if any((frame.system, frame.component) == VEHICLE for frame in received):
            endpoint.writer.sequence = 0
            return
    raise PeerMissingError(
        f"no autopilot connected to {endpoint.link.uri} within {wait_s:g} s: start one that connects to it (PX4: "
        "a TCP client of port 4560, so --link tcpin://127.0.0.1:4560), or wait longer with --wait"
    )
