"""The tap: a CAN bus shown to a MAVLink station, and its frames put on the bus, while it asks for that.

Source: MAVLink common message set. MAV_CMD_CAN_FORWARD (32000), parameter 1: the bus from 1 on, 0 ends it; the request must
be renewed, since forwarding stops 5 s after the last. CAN_FRAME (386): bus from 0 on, bit 31 of the identifier marks 29
bits, bit 30 a remote frame. Stations: `dronecan`'s mavcan driver, the DroneCAN GUI, MAVProxy.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from bridge.clock import Clock
from bridge.endpoint import VEHICLE
from bridge.link import Link
from protocol import mavlink_map
from protocol.can_frame import CanFrame
from protocol.errors import LinkError
from protocol.mavlink_codec import FrameReader, FrameWriter, Layout
from protocol.scenario import NANOSECONDS
from protocol.streams import Due

RENEW_NS: Final = 5 * NANOSECONDS
_MOST_AT_ONCE = 64


class CanTap:
    """The tap of one station at a time on one bus.

    A station that hangs up, takes nothing or has not renewed its request for 5 s makes room for another. Whatever its link
    does, the flight goes on.

    counters   tap_sent       frames shown       tap_taken     frames of the station, for the bus
               tap_requests   times forwarding was asked for or renewed    tap_refused   frames and requests not for this bus
    """

    def __init__(self, link: Link, component: int, clock: Clock) -> None:
        self._link = link
        self._reader = FrameReader(is_datagram=link.is_datagram, follow_sequence=False)
        self._writer = FrameWriter(VEHICLE[0], component)
        self._clock = clock
        self._until_ns: int | None = None
        self._heartbeat = Due(1.0)
        self._theirs: deque[CanFrame] = deque(maxlen=_MOST_AT_ONCE)
        self.counters = dict.fromkeys(("tap_sent", "tap_taken", "tap_requests", "tap_refused"), 0)

    @property
    def forwarding(self) -> bool:
        """Whether a station has asked for the bus within the last 5 s."""
        return self._until_ns is not None and self._clock.now_ns() < self._until_ns

    def watch(self, _t_ns: int, frame: CanFrame) -> None:
        """Show a frame of the bus to the station, if it wants that."""
        if frame in self._theirs:
            self._theirs.remove(frame)  # what the station said itself
        elif self.forwarding:
            self._send(mavlink_map.CAN_FRAME, mavlink_map.encode_can_frame(frame))
            self.counters["tap_sent"] += 1

    def poll(self) -> list[CanFrame]:
        """Take what the station says, without waiting; returns its frames for the bus."""
        frames: list[CanFrame] = []
        if self._until_ns is not None and not self.forwarding:
            self._forget_station()
        for _ in range(_MOST_AT_ONCE):
            try:
                data = self._link.recv(0.0)
            except LinkError:
                self._forget_station()
                break
            if not data:
                break
            for message in self._reader.read(data):
                if message.message_id == mavlink_map.COMMAND_LONG.message_id:
                    self._take_command(message.payload)
                elif message.message_id == mavlink_map.CAN_FRAME.message_id:
                    frame = mavlink_map.decode_can_frame(message.payload)
                    if frame is None or not self.forwarding:
                        self.counters["tap_refused"] += 1
                        continue
                    self.counters["tap_taken"] += 1
                    self._theirs.append(frame)
                    frames.append(frame)
        if self.forwarding and self._heartbeat.at(self._clock.now_ns()):
            self._send(mavlink_map.HEARTBEAT, mavlink_map.encode_emulator_heartbeat())
        return frames

    def _take_command(self, payload: bytes) -> None:
        request = mavlink_map.decode_can_forward(payload)
        if request is None:
            self.counters["tap_refused"] += 1
            return
        accepted = request in (0, 1)
        if accepted:
            self._until_ns = self._clock.now_ns() + RENEW_NS if request else None
            self.counters["tap_requests"] += 1
        else:
            self.counters["tap_refused"] += 1
        self._send(mavlink_map.COMMAND_ACK, mavlink_map.encode_can_forward_acknowledgement(accepted=accepted))

    def _send(self, message: Layout, payload: bytes) -> None:
        try:
            self._link.send(self._writer.seal(message, payload))
        except LinkError:
            self._forget_station()

    def _forget_station(self) -> None:
        self._until_ns = None
        self._link.release_peer()
