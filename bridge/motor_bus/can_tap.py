"""The tap: a CAN bus shown to a MAVLink station, and its frames put on the bus, while it asks for that.

Source: MAVLink common message set. MAV_CMD_CAN_FORWARD (32000), parameter 1: the bus from 1 on, 0 ends it; the request must
be renewed, since forwarding stops 5 s after the last. CAN_FRAME (386): bus from 0 on, bit 31 of the identifier marks 29
bits, bit 30 a remote frame. Stations: `dronecan`'s mavcan driver, the DroneCAN GUI, MAVProxy.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from bridge.links.link import Link
from bridge.requests import Requests
from bridge.station import Station
from bridge.timing.clock import Clock
from protocol.can_frame import CanFrame
from protocol.messages import VEHICLE
from protocol.scenario import NANOSECONDS
from protocol.wire import mapping
from protocol.wire.requests import CAN_FORWARD, Request, Result, wanted_bus
from protocol.wire.schedule import Schedule

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
        who = (VEHICLE[0], component)
        self._station = Station(link, who, clock, mapping.encode_emulator_heartbeat)
        self._answers = Schedule({})
        self._requests = Requests(who, self._answers, (), {CAN_FORWARD: self._forward})
        self._clock = clock
        self._until_ns: int | None = None
        self._departures = 0
        self._theirs: deque[CanFrame] = deque(maxlen=_MOST_AT_ONCE)
        self.counters = dict.fromkeys(("tap_sent", "tap_taken", "tap_requests", "tap_refused"), 0)

    @property
    def forwarding(self) -> bool:
        """Whether a station has asked for the bus within the last 5 s."""
        is_same = self._station.departures == self._departures  # who comes next must ask for itself
        return self._until_ns is not None and is_same and self._clock.now_ns() < self._until_ns

    def watch(self, _t_ns: int, frame: CanFrame) -> None:
        """Show a frame of the bus to the station, if it wants that."""
        if frame in self._theirs:
            self._theirs.remove(frame)  # what the station said itself
        elif self.forwarding:
            self._station.say(mapping.CAN_FRAME, mapping.encode_can_frame(frame))
            self.counters["tap_sent"] += 1

    def poll(self) -> list[CanFrame]:
        """Take what the station says, without waiting; returns its frames for the bus."""
        frames: list[CanFrame] = []
        if self._until_ns is not None and not self.forwarding:
            self._until_ns = None
            self._station.release()
        refused = self._requests.counters["requests_refused"]
        for message in self._station.poll():
            if message.message_id == mapping.CAN_FRAME.message_id:
                frame = mapping.decode_can_frame(message.payload)
                if frame is None or not self.forwarding:
                    self.counters["tap_refused"] += 1
                    continue
                self.counters["tap_taken"] += 1
                self._theirs.append(frame)
                frames.append(frame)
            else:
                self._requests.handle(message)
        self.counters["tap_refused"] += self._requests.counters["requests_refused"] - refused
        for saying in self._answers.answers():
            self._station.say(*saying)
        return frames

    def _forward(self, request: Request) -> Result:
        bus = wanted_bus(request)
        if bus not in (0, 1):
            return Result.DENIED
        self._until_ns = self._clock.now_ns() + RENEW_NS if bus else None
        self._departures = self._station.departures
        self.counters["tap_requests"] += 1
        return Result.ACCEPTED
