"""The controller as a MAVLink vehicle: who it is, whether it is armed, whom it follows.

It starts disarmed. It arms when told to at its start (`--arm`) and the emulator holds the same scenario, or by
MAV_CMD_COMPONENT_ARM_DISARM from a ground station.
"""

from __future__ import annotations

from bridge.endpoint import VEHICLE, Endpoint, refuse_other_scenario
from protocol import mavlink_map
from protocol.mavlink_codec import Frame, Layout
from protocol.streams import Due, stream


class Vehicle:
    """Heartbeats, arming and the scenario's digest.

    armed    commands are live                agreed   the emulator has shown the same scenario
    ended    the emulator has said that the run is over
    """

    def __init__(self, endpoint: Endpoint, digest: bytes, emulator_component: int, *, arm: bool) -> None:
        self._endpoint = endpoint
        self._digest = digest
        self._emulator = (VEHICLE[0], emulator_component)
        self._arm_at_start = arm
        self._heartbeat = Due(stream("HEARTBEAT").rate_hz or 1.0)
        self._replies: list[tuple[Layout, bytes]] = []
        self.armed = False
        self.agreed = False
        self.ended = False

    def hello(self) -> list[bytes]:
        """The frames that introduce the vehicle before the first tick."""
        return [
            self._heartbeat_frame(),
            self._endpoint.seal(mavlink_map.VERSION, mavlink_map.encode_version(self._digest)),
            *self._take_replies(),
        ]

    def due_frames(self, t_ns: int) -> list[bytes]:
        """Heartbeat and replies that are due at t_ns."""
        frames = self._take_replies()
        if self._heartbeat.at(t_ns):
            frames.append(self._heartbeat_frame())
        return frames

    @property
    def quiet_until_ns(self) -> int:
        """Until then `due_frames` are none."""
        return 0 if self._replies else self._heartbeat.next_ns

    def take(self, frame: Frame) -> None:
        """React to a frame that is no telemetry. Raises ScenarioMismatchError."""
        number = frame.message_id
        if number == mavlink_map.COMMAND_LONG.message_id:
            self._take_command(frame)
        elif (frame.system, frame.component) != self._emulator:
            return
        elif number == mavlink_map.VERSION.message_id:
            refuse_other_scenario("emulator", mavlink_map.decode_version(frame.payload), self._digest)
            if not self.agreed and self._arm_at_start:
                self.armed = True
            self.agreed = True
        elif number == mavlink_map.HEARTBEAT.message_id and mavlink_map.heartbeat_is_ending(frame.payload):
            self.ended = True

    def _take_command(self, frame: Frame) -> None:
        request = mavlink_map.decode_arm_request(frame.payload)
        if request.target_system not in (0, VEHICLE[0]) or request.target_component not in (0, VEHICLE[1]):
            return
        accepted = request.arm is not None and (self.agreed or not request.arm)
        if accepted:
            self.armed = bool(request.arm)
        payload = mavlink_map.encode_acknowledgement(request.command, accepted=accepted)
        self._replies.append((mavlink_map.COMMAND_ACK, payload))

    def _heartbeat_frame(self) -> bytes:
        payload = mavlink_map.encode_controller_heartbeat(armed=self.armed)
        return self._endpoint.seal(mavlink_map.HEARTBEAT, payload)

    def _take_replies(self) -> list[bytes]:
        replies, self._replies = self._replies, []
        return [self._endpoint.seal(message, payload) for message, payload in replies]
