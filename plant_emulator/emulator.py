"""The emulator's side of one tick: measure and say it, take the answer, record, move the plant on.

It knows nothing of how time is kept; that is `pacing`. To the outside it speaks only messages.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bridge.endpoint import Endpoint
from bridge.station import Station
from plant_emulator.on_request import OnRequest
from plant_emulator.plant.integrate import Plant
from plant_emulator.plant.safety import SafetyEnvelope
from plant_emulator.plant.sensors import InertialSensors
from plant_emulator.plant.truth import TruthWriter
from plant_emulator.quick import QuickTicks
from protocol.errors import DivergenceError
from protocol.messages import ActuatorCommand, FloatArray
from protocol.scenario import Scenario
from protocol.wire import mapping
from protocol.wire.codec import Frame
from protocol.wire.streams import Due, stream

if TYPE_CHECKING:  # what a run without a CAN bus need not load
    from plant_emulator.drives.can_motors import CanMotors


class Emulator:
    """Plant, sensors and safety envelope of one run.

    motors     drives behind a CAN bus, which then have the gears; None: motors and gears are the plant's
    on_request what it says only when asked
    counters   of the safety envelope, and refused_commands: commands with a control that is not a number
    """

    def __init__(
        self,
        scenario: Scenario,
        endpoint: Endpoint,
        truth: TruthWriter | None,
        motors: CanMotors | None = None,
        station: Station | None = None,
    ) -> None:
        self.plant = Plant(scenario, gears_elsewhere=motors is not None)
        self.motors = motors
        self.safety = SafetyEnvelope(scenario.actuators)
        self._scale = np.array(scenario.actuators.scale)
        self._endpoint = endpoint
        self._truth = truth
        self._inertial = InertialSensors(scenario.body.mass, scenario.world)
        self.on_request = OnRequest(scenario, self.plant, self._inertial, motors, station)
        self._quick = QuickTicks(scenario, self.plant, self.safety, endpoint.writer, endpoint.reader)
        self._row = np.zeros(31)
        self._quiet_until_ns = 0
        self._heartbeat = Due(stream("HEARTBEAT").rate_hz or 1.0)
        self._gps = Due(stream("HIL_GPS").rate_hz or 1.0)
        self.counters = {"refused_commands": 0}

    def sense(self, t_ns: int) -> list[bytes]:
        """The frames of the tick at t_ns, in the order in which they travel: the tick itself comes last."""
        state, seal = self.plant.state, self._endpoint.seal
        frames = []
        if self._heartbeat.at(t_ns):
            frames.append(seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat()))
        if self._gps.at(t_ns):
            place = self._inertial.geodetic(state.motion)
            frames.append(seal(mapping.GPS, mapping.encode_gps(t_ns, *place, state.motion[6:9])))
        frames += [seal(*saying) for saying in self.on_request.due(t_ns)]
        frames.extend(self._quick.frames(t_ns))
        self._quiet_until_ns = min(self._heartbeat.next_ns, self._gps.next_ns, self.on_request.next_ns)
        return frames

    def take_request(self, frame: Frame) -> bool:
        """Obey or refuse a request over the loop's link; whether the frame was one. It is answered with the next tick."""
        taken = self.on_request.take(frame)
        if taken:
            self._quiet_until_ns = 0
        return taken

    def decode(self, payload: bytes) -> ActuatorCommand | None:
        """The command in a HIL_ACTUATOR_CONTROLS; None, counted, where a control is not a number."""
        command = mapping.decode_command(payload, self._scale)
        if command is None:
            self.counters["refused_commands"] += 1
        return command

    def go_on(self, datagram: bytes, t_ns: int, end_ns: int, delay_ns: int) -> tuple[bytes, int] | None:
        """`act`, `advance` and `sense` at once, where the datagram is just the armed answer to the tick at t_ns.

        Returns the two frames of the tick at end_ns as one, and where the first ends; send them, then `settle`. None, with
        nothing done, where the datagram is anything else or other frames are due too. Raises DivergenceError, the tick's row
        being recorded.
        """
        if end_ns >= self._quiet_until_ns or self.motors:
            return None
        try:
            return self._quick.go_on(datagram, self._row, t_ns, end_ns, delay_ns)
        except DivergenceError:
            self._record(t_ns)
            raise

    def settle(self, t_ns: int, arrival_ns: int) -> None:
        """What is left to do after `go_on`, while the next tick is on its way; the answer came at arrival_ns."""
        self._quick.settle(arrival_ns)
        self._record(t_ns)

    def _record(self, t_ns: int) -> None:
        if self._truth:
            self._truth.append(t_ns, self._row)

    def act(self, arrival_ns: int, delay_ns: int, command: ActuatorCommand) -> None:
        """Let a command that arrived at simulation time arrival_ns act delay_ns later, within the safety envelope."""
        self._quick.newest[:] = command.tau
        self._drive(arrival_ns, arrival_ns + delay_ns, self.safety.accept(arrival_ns, command))

    def _drive(self, t_ns: int, acts_ns: int, tau: FloatArray) -> None:
        """Let tau (6,), asked for at t_ns, act from acts_ns on."""
        if self.motors:
            acts_ns += self.motors.delay_ns
            tau = self.motors.drive(t_ns, tau, acts_ns)  # the force behind the gears: the plant takes it as it is
        self.plant.command(acts_ns, tau)

    def hold(self, end_ns: int) -> None:
        """Record the tick and let time pass with the plant where it is."""
        t_ns = self.plant.t_ns
        self.plant.record_and_advance(t_ns, self._quick.newest, self._row)
        self._record(t_ns)
        self.plant.t_ns = end_ns

    def check_staleness(self, t_ns: int, delay_ns: int = 0) -> None:
        """Turn to the safe output, as late as any command acts, where none has come for too long."""
        stale = self.safety.stale_output(t_ns)
        if stale is not None:
            expired_ns, output = stale
            acts_ns = max(expired_ns + delay_ns, self.plant.t_ns)
            self._drive(acts_ns, acts_ns, output)

    def advance(self, end_ns: int) -> None:
        """Record the tick and integrate to the next one. Raises DivergenceError, the tick's row being recorded."""
        t_ns = self.plant.t_ns
        try:
            self.plant.record_and_advance(end_ns, self._quick.newest, self._row)
        finally:
            if self.motors:
                self._row[19:25] = self.motors.tau_at(t_ns)
            self._record(t_ns)

    def flush(self) -> None:
        """Hand the ground truth so far to the system."""
        if self._truth:
            self._truth.flush()

    def all_counters(self) -> dict[str, int]:
        """Everything counted, by name."""
        of_motors = self.motors.counters if self.motors else {}
        return {
            **self._endpoint.counters(),
            **self.safety.counters,
            **self.counters,
            **self.on_request.counters(),
            **of_motors,
        }
