"""The tap: forwards CAN frames between the motor bus and a MAVLink station, while the station requests it.

Source: MAVLink common message set. MAV_CMD_CAN_FORWARD (32000), parameter 1: number of the bus, counted from 1; 0 stops.
Forwarding stops 5 s after the last request. CAN_FRAME (386): bus counted from 0; bit 31 of the identifier marks 29
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
    """The tap on one bus, for one station at a time.

    A station that disconnects, does not read or has not renewed its request for 5 s is replaced by the next one. Errors of
    its link never end the run.

    counters   tap_sent       frames sent to the station          tap_taken     frames of the station sent on the bus
               tap_requests   requests and renewals of forwarding tap_refused   frames and requests not for this bus
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
        """Whether a station has requested the bus within the last 5 s."""
        is_same = self._station.departures == self._departures  # the next station must send its own request
        return self._until_ns is not None and is_same and self._clock.now_ns() < self._until_ns

    def watch(self, _t_ns: int, frame: CanFrame) -> None:
        """Send a frame of the bus to the station, while forwarding is on."""
        if frame in self._theirs:
            self._theirs.remove(frame)  # the station sent it itself
        elif self.forwarding:
            self._station.say(mapping.CAN_FRAME, mapping.encode_can_frame(frame))
            self.counters["tap_sent"] += 1

    def poll(self) -> list[CanFrame]:
        """Handle the station's messages without waiting; returns its frames for the bus."""
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
