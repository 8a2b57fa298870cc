"""The controller as a MAVLink vehicle: who it is, whether it is armed, whom it follows.

It starts disarmed. It arms when told to at its start (`--arm`) and the emulator holds the same scenario, or by
MAV_CMD_COMPONENT_ARM_DISARM from a ground station.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from types import MappingProxyType

from bridge.endpoint import Endpoint, refuse_other_scenario
from bridge.requests import Handler, Requests, Saying
from controller.parameters import Parameters
from protocol.messages import VEHICLE
from protocol.wire import mapping
from protocol.wire.codec import Frame
from protocol.wire.requests import ARM_DISARM, Request, Result, wanted_arming
from protocol.wire.streams import Due, stream

OFFERED: Mapping[int, float | None] = MappingProxyType(
    {mapping.HEARTBEAT.message_id: None, mapping.VERSION.message_id: None}
)
"""Messages that are sent on request."""
PARAMETERS_HZ = 50.0
"""How many parameters a second are said at the start of a run, one with an answer at most."""


class Vehicle:
    """Heartbeats, arming, the scenario's digest; and each parameter once from the first tick on, so that a log explains itself.

    armed            commands are live        agreed   the emulator has shown the same scenario
    ended            the emulator has said that the run is over
    offered, commands   what it sends on request, and obeys, on any link
    requests         what is asked of it on the loop's link
    quiet_until_ns   until then `due_frames` are none
    """

    def __init__(
        self,
        endpoint: Endpoint,
        digest: bytes,
        emulator_component: int,
        *,
        arm: bool,
        parameters: Parameters | None = None,
    ) -> None:
        self._endpoint = endpoint
        self._digest = digest
        self._emulator = (VEHICLE[0], emulator_component)
        self._arm_at_start = arm
        self._heartbeat = Due(stream("HEARTBEAT").rate_hz or 1.0)
        self._parameters = parameters
        self._unsaid = deque(range(len(parameters.table)) if parameters else ())
        self._changed: list[int] = []
        self._values = Due(PARAMETERS_HZ)
        self.offered: Mapping[int, float | None] = OFFERED
        self.commands: Mapping[int, Handler] = {ARM_DISARM: self.arm_or_disarm}
        self.requests = Requests(VEHICLE, self.offered, self.commands)
        self.quiet_until_ns = 0
        self.armed = False
        self.agreed = False
        self.ended = False

    def hello(self) -> list[bytes]:
        """The frames that introduce the vehicle before the first tick."""
        seal = self._endpoint.seal
        frames = [seal(*self._heartbeat_saying()), seal(*self._version_saying())]
        return frames + [seal(*saying) for saying in self.requests.due(0, self.on_request)]

    def due_frames(self, t_ns: int) -> list[bytes]:
        """Heartbeat, answers, and what was asked for, as far as they are due at t_ns."""
        sayings = self.requests.due(t_ns, self.on_request)
        if self._heartbeat.at(t_ns):
            sayings.append(self._heartbeat_saying())
        sayings += self._due_parameters(t_ns)
        self._plan()
        return [self._endpoint.seal(*saying) for saying in sayings]

    def take(self, frame: Frame) -> None:
        """React to a frame that is no telemetry. Raises ScenarioMismatchError."""
        if self.requests.take(frame):
            self._plan()
            return
        if (frame.system, frame.component) != self._emulator:
            return
        if frame.message_id == mapping.VERSION.message_id:
            refuse_other_scenario("emulator", mapping.decode_version(frame.payload), self._digest)
            if not self.agreed and self._arm_at_start:
                self.armed = True
            self.agreed = True
        elif frame.message_id == mapping.HEARTBEAT.message_id and mapping.heartbeat_is_ending(frame.payload):
            self.ended = True

    def say_parameter(self, index: int) -> None:
        """Say a parameter that was changed on the loop's link, and so in the run's log, with the next answer."""
        self._changed.append(index)
        self._plan()

    def arm_or_disarm(self, request: Request) -> Result:
        """Obey MAV_CMD_COMPONENT_ARM_DISARM: disarm at any time, arm once the emulator has shown the same scenario."""
        wanted = wanted_arming(request)
        if wanted is None or (wanted and not self.agreed):
            return Result.DENIED
        self.armed = wanted
        return Result.ACCEPTED

    def _plan(self) -> None:
        self.quiet_until_ns = 0 if self._changed else min(self._heartbeat.next_ns, self.requests.next_ns)
        if self._unsaid:
            self.quiet_until_ns = min(self.quiet_until_ns, self._values.next_ns)

    def _due_parameters(self, t_ns: int) -> list[Saying]:
        if self._parameters is None:
            return []
        indices, self._changed = self._changed, []
        if self._unsaid and self._values.at(t_ns):
            indices.append(self._unsaid.popleft())
        return [self._parameters.saying(index) for index in indices]

    def _heartbeat_saying(self) -> Saying:
        return mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=self.armed)

    def _version_saying(self) -> Saying:
        return mapping.VERSION, mapping.encode_version(self._digest, has_parameters=True)

    def on_request(self, number: int, _t_ns: int) -> list[Saying]:
        """The message of an id that is `offered`."""
        return [self._version_saying() if number == mapping.VERSION.message_id else self._heartbeat_saying()]
