"""What the emulator says only when asked: the true state, and how fast the drives turn. On the loop's link and a station's.

Who asks on the loop's link is answered there, in the datagram of a tick and so in the run's log; what a ground station asks
for goes over its own link and burdens the loop with nothing. The truth is not for the controller, which reads none of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from bridge.requests import Requests, Saying
from bridge.station import POLL_HZ, Station
from plant_emulator.plant.integrate import Plant
from plant_emulator.plant.rigid_body import body_rates
from plant_emulator.plant.sensors import InertialSensors
from protocol.messages import VEHICLE
from protocol.scenario import Scenario
from protocol.wire.codec import Frame
from protocol.wire.streams import Due
from protocol.wire.truth_mapping import ODOMETRY, RPM, STATE, encode_odometry, encode_rpm, encode_state

if TYPE_CHECKING:
    from plant_emulator.drives.can_motors import CanMotors

RPM_HZ = 10.0
"""Of RAW_RPM to a ground station, unless it asks for another rate."""
TRUTH = (STATE.message_id, ODOMETRY.message_id)


class OnRequest:
    """The requests of both links, and the messages that they ask for.

    motors    drives behind a CAN bus: RAW_RPM is offered only then
    next_ns   until then nothing is due
    """

    def __init__(
        self,
        scenario: Scenario,
        plant: Plant,
        inertial: InertialSensors,
        motors: CanMotors | None,
        station: Station | None,
    ) -> None:
        self._plant, self._inertial, self._motors = plant, inertial, motors
        who = (VEHICLE[0], scenario.wire.emulator_component)
        offered: Mapping[int, float | None] = dict.fromkeys(TRUTH)
        self._loop = Requests(who, {**offered, RPM.message_id: None} if motors else offered)
        self._station = station
        self._theirs = Requests(who, {**offered, RPM.message_id: RPM_HZ} if motors else offered)
        self._look = Due(POLL_HZ)
        self.next_ns = 0

    def ask_for_truth(self, rate_hz: float) -> None:
        """Have the true state said on the loop's link from now on, as if its peer had asked for that."""
        for number in TRUTH:
            self._loop.stream(number, rate_hz)

    def take(self, frame: Frame) -> bool:
        """Obey or refuse a request that came over the loop's link; whether the frame was one."""
        taken = self._loop.take(frame)
        self.next_ns = 0 if taken else self.next_ns
        return taken

    def replies(self) -> list[Saying]:
        """The answers for the loop's link alone: before the first tick, where nothing else is due."""
        self._hear_station(0)
        self._tell_station(self._theirs.replies())
        return self._loop.replies()

    def due(self, t_ns: int) -> list[Saying]:
        """What is due on the loop's link at t_ns; the station's is sent."""
        if self._station:
            if self._look.at(t_ns):
                self._hear_station(t_ns)
            self._tell_station(self._theirs.due(t_ns, self._sayings))
        sayings = self._loop.due(t_ns, self._sayings)
        self.next_ns = self._loop.next_ns
        if self._station:
            self.next_ns = min(self.next_ns, self._theirs.next_ns, self._look.next_ns)
        return sayings

    def counters(self) -> dict[str, int]:
        """What both links have asked for, and the station's link has counted."""
        counted = {name: count + self._theirs.counters[name] for name, count in self._loop.counters.items()}
        return {**counted, **(self._station.counters() if self._station else {})}

    def _hear_station(self, t_ns: int) -> None:
        if self._station:
            self._station.t_us = t_ns // 1000
            for frame in self._station.poll():
                self._theirs.take(frame)

    def _tell_station(self, sayings: list[Saying]) -> None:
        if self._station:
            for saying in sayings:
                self._station.say(*saying)

    def _sayings(self, number: int, t_ns: int) -> list[Saying]:
        motion = self._plant.state.motion
        if number == RPM.message_id:
            velocities = self._motors.velocities if self._motors else np.empty(0)
            return [(RPM, encode_rpm(drive, float(velocity))) for drive, velocity in enumerate(velocities)]
        rates = np.array(body_rates(motion))
        if number == ODOMETRY.message_id:
            return [(ODOMETRY, encode_odometry(t_ns, motion, rates))]
        force = self._inertial.measure(motion, self._plant.state.u)[:3]
        return [(STATE, encode_state(t_ns, motion, rates, self._inertial.geodetic(motion), force))]
