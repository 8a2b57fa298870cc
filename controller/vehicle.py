"""The controller as a MAVLink vehicle: who it is, whether it is armed, whom it follows.

It starts disarmed. It arms when told to at its start (`--arm`) and the emulator holds the same scenario, or by
MAV_CMD_COMPONENT_ARM_DISARM from a ground station.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from bridge.endpoint import VEHICLE, Endpoint, refuse_other_scenario
from bridge.requests import Requests, Saying
from protocol import mavlink_map
from protocol.mavlink_codec import Frame
from protocol.requests import ARM_DISARM, Request, Result, wanted_arming
from protocol.streams import Due, stream

OFFERED: Mapping[int, float | None] = MappingProxyType(
    {mavlink_map.HEARTBEAT.message_id: None, mavlink_map.VERSION.message_id: None}
)
"""Messages that are sent on request."""


class Vehicle:
    """Heartbeats, arming and the scenario's digest.

    armed            commands are live        agreed   the emulator has shown the same scenario
    ended            the emulator has said that the run is over
    requests         what is asked of it on the loop's link
    quiet_until_ns   until then `due_frames` are none
    """

    def __init__(self, endpoint: Endpoint, digest: bytes, emulator_component: int, *, arm: bool) -> None:
        self._endpoint = endpoint
        self._digest = digest
        self._emulator = (VEHICLE[0], emulator_component)
        self._arm_at_start = arm
        self._heartbeat = Due(stream("HEARTBEAT").rate_hz or 1.0)
        self.requests = Requests(VEHICLE, OFFERED, {ARM_DISARM: self.arm_or_disarm})
        self.quiet_until_ns = 0
        self.armed = False
        self.agreed = False
        self.ended = False

    def hello(self) -> list[bytes]:
        """The frames that introduce the vehicle before the first tick."""
        seal = self._endpoint.seal
        frames = [seal(*self._heartbeat_saying()), seal(*self._version_saying())]
        return frames + [seal(*saying) for saying in self.requests.due(0, self._on_request)]

    def due_frames(self, t_ns: int) -> list[bytes]:
        """Heartbeat, answers, and what was asked for, as far as they are due at t_ns."""
        sayings = self.requests.due(t_ns, self._on_request)
        if self._heartbeat.at(t_ns):
            sayings.append(self._heartbeat_saying())
        self._plan()
        return [self._endpoint.seal(*saying) for saying in sayings]

    def take(self, frame: Frame) -> None:
        """React to a frame that is no telemetry. Raises ScenarioMismatchError."""
        if self.requests.take(frame):
            self._plan()
            return
        if (frame.system, frame.component) != self._emulator:
            return
        if frame.message_id == mavlink_map.VERSION.message_id:
            refuse_other_scenario("emulator", mavlink_map.decode_version(frame.payload), self._digest)
            if not self.agreed and self._arm_at_start:
                self.armed = True
            self.agreed = True
        elif frame.message_id == mavlink_map.HEARTBEAT.message_id and mavlink_map.heartbeat_is_ending(frame.payload):
            self.ended = True

    def arm_or_disarm(self, request: Request) -> Result:
        """Obey MAV_CMD_COMPONENT_ARM_DISARM: disarm at any time, arm once the emulator has shown the same scenario."""
        wanted = wanted_arming(request)
        if wanted is None or (wanted and not self.agreed):
            return Result.DENIED
        self.armed = wanted
        return Result.ACCEPTED

    def _plan(self) -> None:
        self.quiet_until_ns = min(self._heartbeat.next_ns, self.requests.next_ns)

    def _heartbeat_saying(self) -> Saying:
        return mavlink_map.HEARTBEAT, mavlink_map.encode_controller_heartbeat(armed=self.armed)

    def _version_saying(self) -> Saying:
        return mavlink_map.VERSION, mavlink_map.encode_version(self._digest)

    def _on_request(self, number: int, _t_ns: int) -> list[Saying]:
        return [self._version_saying() if number == mavlink_map.VERSION.message_id else self._heartbeat_saying()]
