"""The emulator as a ground station sees it: its requests are polled without waiting and answered on its own link.

Requests on the loop's link are answered there, in the datagram of a tick and so in the run's log; a ground station's
requests add nothing to the loop's link.
"""

from __future__ import annotations

from collections.abc import Mapping

from bridge.requests import Requests
from bridge.station import POLL_HZ, Station
from protocol.due import NEVER, Due
from protocol.wire.schedule import Encoder, Saying, Schedule

RPM_HZ = 10.0
"""Rate of RAW_RPM to a ground station, unless it requests another."""


class EmulatorStation:
    """Answers the requests of a ground station, if there is one.

    encoders   of the messages that it may request
    next_ns    time before which there is nothing to do
    """

    def __init__(self, station: Station | None, who: tuple[int, int], encoders: Mapping[str, Encoder]) -> None:
        self._station = station
        self._schedule = Schedule(encoders, {name: RPM_HZ if name == "RAW_RPM" else None for name in encoders})
        self.requests = Requests(who, self._schedule, encoders)
        self._look = Due(POLL_HZ)
        self.next_ns = 0 if station else NEVER

    def answer(self) -> None:
        """Handle and answer the station's requests before the first tick, when nothing else is due."""
        if self._station:
            self._hear(self._station, 0)
            self._tell(self._station, self._schedule.answers())

    def poll(self, t_ns: int) -> None:
        """Handle the station's requests at POLL_HZ, and send it the messages due at t_ns."""
        if self._station:
            if self._look.at(t_ns):
                self._hear(self._station, t_ns)
            self._tell(self._station, self._schedule.due(t_ns))
            self.next_ns = min(self._schedule.next_ns, self._look.next_ns)

    def _hear(self, station: Station, t_ns: int) -> None:
        station.t_us = t_ns // 1000
        for frame in station.poll():
            self.requests.handle(frame)

    def _tell(self, station: Station, sayings: list[Saying]) -> None:
        for saying in sayings:
            station.say(*saying)

    def counters(self) -> dict[str, int]:
        """The counters of the station's link."""
        return self._station.counters() if self._station else {}
