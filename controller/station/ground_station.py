"""The controller towards a ground station: a vehicle with parameters."""

from __future__ import annotations

from bridge.requests import Requests, Saying
from bridge.station import POLL_HZ, Station
from controller.parameters import Parameters
from controller.station.parameter_server import ParameterServer
from controller.vehicle import Vehicle
from protocol.messages import VEHICLE
from protocol.wire import mapping
from protocol.wire.file_transfer import FILE_TRANSFER, encode_refusal
from protocol.wire.requests import REQUEST_CAPABILITIES, Request, Result
from protocol.wire.streams import Due


class GroundStation:
    """Answers a station on its own link: commands as on the loop's, parameters, and no to files.

    next_ns   simulation time at which to poll next
    """

    def __init__(self, station: Station, vehicle: Vehicle, parameters: Parameters) -> None:
        self._station = station
        self._vehicle = vehicle
        self._requests = Requests(
            VEHICLE, vehicle.offered, {**vehicle.commands, REQUEST_CAPABILITIES: self._say_version}
        )
        self._parameters = ParameterServer(parameters, lambda: vehicle.armed, vehicle.say_parameter)
        self._look = Due(POLL_HZ)
        self.next_ns = 0

    def poll_if_due(self, t_ns: int) -> None:
        """`poll`, as often as `POLL_HZ` says."""
        if self._look.at(t_ns):
            self.next_ns = self._look.next_ns
            self.poll(t_ns)

    def poll(self, t_ns: int) -> None:
        """Hear the station, at simulation time t_ns, and answer it."""
        self._station.t_us = max(0, t_ns) // 1000
        sayings: list[Saying] = []
        for frame in self._station.poll():
            if frame.message_id == FILE_TRANSFER.message_id:
                refusal = encode_refusal(frame.payload, VEHICLE, (frame.system, frame.component))
                sayings += [(FILE_TRANSFER, refusal)] if refusal else []
            elif not self._requests.take(frame):
                self._parameters.take(frame)
        for saying in (*sayings, *self._requests.due(max(0, t_ns), self._vehicle.on_request), *self._parameters.due()):
            self._station.say(*saying)

    def counters(self) -> dict[str, int]:
        """What was asked for, and what the link has counted."""
        return {**self._requests.counters, **self._station.counters()}

    def _say_version(self, _request: Request) -> Result:
        self._requests.ask_once(mapping.VERSION.message_id)
        return Result.ACCEPTED
