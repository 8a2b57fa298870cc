"""The controller as a ground station sees it: a vehicle with parameters."""

from __future__ import annotations

from bridge.parameter_server import ParameterServer
from bridge.requests import Requests
from bridge.station import POLL_HZ, Station
from controller.parameters import Parameters
from controller.session import OFFERED, HilSession
from protocol.due import Due
from protocol.wire.file_transfer import FILE_TRANSFER, encode_refusal
from protocol.wire.mapping import VERSION
from protocol.wire.requests import REQUEST_CAPABILITIES, Request, Result
from protocol.wire.schedule import Schedule


class GroundStation:
    """Answers a station on its own link: commands as on the loop's link, and parameters; file transfers are rejected.

    next_ns   simulation time at which to poll next
    """

    def __init__(self, station: Station, session: HilSession, parameters: Parameters) -> None:
        self._station = station
        self._who = session.who
        self._schedule = Schedule(
            session.encoders, {"HEARTBEAT": None}
        )  # the station's link has a heartbeat of its own
        self._requests = Requests(
            session.who, self._schedule, OFFERED, {**session.commands, REQUEST_CAPABILITIES: self._say_version}
        )
        self._parameters = ParameterServer(parameters, session.who, lambda: session.armed, session.say_parameter)
        self._look = Due(POLL_HZ)
        self.next_ns = 0

    def poll_if_due(self, t_ns: int) -> None:
        """`poll`, as often as `POLL_HZ` says."""
        if self._look.at(t_ns):
            self.next_ns = self._look.next_ns
            self.poll(t_ns)

    def poll(self, t_ns: int) -> None:
        """Handle the station's frames, at simulation time t_ns, and answer them."""
        t_ns = max(0, t_ns)
        self._station.t_us = t_ns // 1000
        for frame in self._station.poll():
            if frame.message_id == FILE_TRANSFER.message_id:
                refusal = encode_refusal(frame.payload, self._who, (frame.system, frame.component))
                if refusal:
                    self._schedule.answer((FILE_TRANSFER, refusal))
            elif not self._requests.handle(frame):
                self._parameters.handle(frame)
        for saying in (*self._schedule.due(t_ns), *self._parameters.due()):
            self._station.say(*saying)

    def counters(self) -> dict[str, int]:
        """Counters of the requests and of the link."""
        return {**self._requests.counters, **self._station.counters()}

    def _say_version(self, _request: Request) -> Result:
        self._schedule.ask_once(VERSION.message_id)
        return Result.ACCEPTED
