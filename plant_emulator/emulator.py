"""The emulator's side of one tick: measure and say it, take the answer, record, move the plant on.

It knows nothing of how time is kept; that is `pacing`. To the outside it speaks only messages.
"""

from __future__ import annotations

import numpy as np

from bridge.endpoint import VEHICLE, Endpoint
from plant_emulator.integrate import Plant
from plant_emulator.safety import SafetyEnvelope
from plant_emulator.sensors import InertialSensors, PositionSensor
from plant_emulator.truth import TruthWriter
from protocol import mavlink_map
from protocol.messages import ActuatorCommand
from protocol.scenario import Scenario
from protocol.streams import Due, stream
from protocol.tick_frames import TickWriter, read_command


class Emulator:
    """Plant, sensors and safety envelope of one run.

    counters   of the safety envelope, and refused_commands: commands with a control that is not a number
    """

    def __init__(self, scenario: Scenario, endpoint: Endpoint, truth: TruthWriter | None) -> None:
        self.plant = Plant(scenario)
        self.safety = SafetyEnvelope(scenario.actuators)
        self._scale = np.array(scenario.actuators.scale)
        self._endpoint = endpoint
        self._truth = truth
        self._position = PositionSensor(scenario.noise, scenario.seed)
        self._inertial = InertialSensors(scenario.body.mass, scenario.world)
        self._command = np.zeros(6)
        self._tick = TickWriter(endpoint.writer)
        self._unrecorded = np.zeros(31)
        self._heartbeat = Due(stream("HEARTBEAT").rate_hz or 1.0)
        self._gps = Due(stream("HIL_GPS").rate_hz or 1.0)
        self.counters = {"refused_commands": 0}

    def sense(self, t_ns: int) -> list[bytes]:
        """The frames of the tick at t_ns, in the order in which they travel: the tick itself comes last."""
        state, seal = self.plant.state, self._endpoint.seal
        frames = []
        if self._heartbeat.at(t_ns):
            frames.append(seal(mavlink_map.HEARTBEAT, mavlink_map.encode_emulator_heartbeat()))
        if self._gps.at(t_ns):
            place = self._inertial.geodetic(state.motion)
            frames.append(seal(mavlink_map.GPS, mavlink_map.encode_gps(t_ns, *place, state.motion[6:9])))
        sample = self._position.measure(t_ns, state.motion)
        frames.extend(self._tick.frames(t_ns, sample.q, self._inertial.measure(state.motion, state.u)))
        return frames

    def decode(self, payload: bytes) -> ActuatorCommand | None:
        """The command in a HIL_ACTUATOR_CONTROLS; None, counted, where a control is not a number."""
        command = mavlink_map.decode_command(payload, self._scale)
        if command is None:
            self.counters["refused_commands"] += 1
        return command

    def decode_answer(self, datagram: bytes, t_ns: int) -> ActuatorCommand | None:
        """The command in a datagram that holds just the answer to the tick at t_ns; None where it is anything else."""
        return read_command(datagram, VEHICLE, self._endpoint.reader, self._scale, t_ns)

    def act(self, arrival_ns: int, delay_ns: int, command: ActuatorCommand) -> None:
        """Let a command that arrived at simulation time arrival_ns act delay_ns later, within the safety envelope."""
        self._command = command.tau
        self.plant.command(arrival_ns + delay_ns, self.safety.accept(arrival_ns, command))

    def check_staleness(self, t_ns: int) -> None:
        """Turn to the safe output where no command has come for too long."""
        stale = self.safety.stale_output(t_ns)
        if stale is not None:
            expired_ns, output = stale
            self.plant.command(max(expired_ns, self.plant.t_ns), output)

    def advance(self, end_ns: int) -> None:
        """Record the tick and integrate to the next one. Raises DivergenceError, the tick's row being recorded."""
        t_ns = self.plant.t_ns
        row = self._truth.next_row(t_ns) if self._truth else self._unrecorded
        self.plant.record_and_advance(end_ns, self._command, row)

    def flush(self) -> None:
        """Hand the ground truth so far to the system."""
        if self._truth:
            self._truth.flush()

    def all_counters(self) -> dict[str, int]:
        """Everything counted, by name."""
        return {**self._endpoint.counters(), **self.safety.counters, **self.counters}
