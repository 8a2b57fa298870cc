"""The emulator's part of a tick, in its one order: envelope, drives, record and move, frames that are due, measure and seal.

It knows nothing of how time is kept; that is `pacing`. To the outside it speaks only messages. The live process and the
replay of a log into the plant call it; the simulation in one process strings the same kernels together.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bridge.endpoint import Endpoint
from bridge.requests import Requests
from bridge.station import Station
from plant_emulator.command_source import CommandSource
from plant_emulator.plant.integrate import Plant, PlantState, push_command, specific_force
from plant_emulator.plant.rigid_body import body_rates
from plant_emulator.plant.safety import SafetyEnvelope, pass_command
from plant_emulator.plant.sensors import NOISE_BLOCK, InertialSensors, PositionSensor, add_noise, inertial_readings
from plant_emulator.plant.truth import TruthWriter
from plant_emulator.station import EmulatorStation
from protocol.compiled import Packed, compiled, pack
from protocol.errors import DivergenceError
from protocol.messages import VEHICLE, FloatArray
from protocol.scenario import Scenario
from protocol.wire import mapping
from protocol.wire.codec import Frame
from protocol.wire.framing import LONGEST_FRAME, Output
from protocol.wire.schedule import Encoder, Saying, Schedule
from protocol.wire.tick_frames import write_tick
from protocol.wire.truth_mapping import ODOMETRY, RPM, STATE, encode_odometry, encode_rpm, encode_state

if TYPE_CHECKING:  # what a run without a CAN bus need not load
    from bridge.motor_bus.drives import CanMotors

TRUTH = (STATE, ODOMETRY)


@compiled
def act(envelope: Any, state: PlantState, t_ns: int, acts_ns: int, tau: FloatArray, armed: bool) -> bool:
    """Let what the envelope leaves of a command that came at t_ns act from acts_ns on; False: too many are on their way."""
    pass_command(envelope, t_ns, tau, armed)
    return push_command(state, acts_ns, envelope.allowed)


@compiled
def _act_packed(envelope: Packed, state: Packed, t_ns: int, acts_ns: int, tau: FloatArray, armed: bool) -> bool:
    return act(envelope[0], state[0], t_ns, acts_ns, tau, armed)


@compiled
def _measure_and_seal(
    state: Packed, parameters: Packed, sensors: Packed, t_ns: int, sequence: int, system: int, component: int
) -> tuple[int, int]:
    """Measure the plant at t_ns and write both frames of the tick into `sensors.out`; returns where each ends."""
    s, body, motion = sensors[0], parameters[0], state[0].motion
    add_noise(motion, s.noise[s.at], s.position, s.attitude, s.q)
    s.at += 1
    specific_force(t_ns * 1e-9, state[0].wrench, body, s.force)
    inertial_readings(motion, s.force, s.field, s.sea_level, s.readings)
    return write_tick(s, t_ns // 1000, s.q, s.readings, sequence, system, component)


class Emulator:
    """Plant, sensors and safety envelope of one run.

    motors     drives behind a CAN bus, which then have the gears; None: motors and gears are the plant's
    source     commands from the link                 schedule   what is said on the loop's link besides the ticks
    station    what a ground station asks for, on a link of its own
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
        scale = np.array(scenario.actuators.scale)
        self.source = CommandSource(endpoint.reader, VEHICLE, scale, scenario.period_ns)
        who = (endpoint.writer.system, endpoint.writer.component)
        on_request: dict[str, Encoder] = {"HIL_STATE_QUATERNION": self._state, "ODOMETRY": self._odometry}
        if motors:
            on_request["RAW_RPM"] = self._rpm
        heartbeat = (mapping.HEARTBEAT, mapping.encode_emulator_heartbeat())
        self.schedule = Schedule({"HEARTBEAT": lambda _t_ns: [heartbeat], "HIL_GPS": self._gps, **on_request})
        self.requests = Requests(who, self.schedule, on_request)
        self.station = EmulatorStation(station, who, on_request)
        self._endpoint = endpoint
        self._truth = truth
        self._inertial = InertialSensors(scenario.world)
        self._position = PositionSensor(scenario.seed)
        self._row = np.zeros(31)
        readings = np.zeros(13)
        readings[12] = scenario.world.temperature_celsius
        self._sensors = pack(
            {
                "position": scenario.noise.position,
                "attitude": scenario.noise.attitude,
                "noise": np.zeros((NOISE_BLOCK, 6)),
                "at": NOISE_BLOCK,
                "q": np.zeros(6),
                "force": np.zeros(3),
                "field": np.array(scenario.world.magnetic_field_ned),
                "sea_level": scenario.world.altitude,
                "readings": readings,
                "out": np.zeros(2 * LONGEST_FRAME, dtype=np.uint8),
            },
            {"pose": mapping.POSE.dtype, "tick": mapping.TICK.dtype},
        )
        self._left_in_block = 0
        self._out: Output = self._sensors["out"][0]
        self._packed = (self.plant.state.packed, self.plant.parameters, self._sensors)

    def say_truth(self, rate_hz: float) -> None:
        """Have the true state said on the loop's link from now on, as if its peer had asked for that."""
        for message in TRUTH:
            self.schedule.set_rate(message.message_id, rate_hz)

    def hear(self, frames: list[Frame]) -> None:
        """React to frames that are no commands: requests are answered with the next tick."""
        for frame in frames:
            self.requests.handle(frame)

    def answers(self) -> list[Saying]:
        """What is to be answered before the first tick, where nothing else is due; the station is seen to as well."""
        self.station.answer()
        return self.schedule.answers()

    def sense(self, t_ns: int) -> list[bytes]:
        """The frames of the tick at t_ns, in the order in which they travel: those that are due, the pose, the tick."""
        writer = self._endpoint.writer
        frames: list[bytes] = []
        if t_ns >= self.schedule.next_ns:
            frames = [writer.seal(*saying) for saying in self.schedule.due(t_ns)]
        if t_ns >= self.station.next_ns:
            self.station.poll(t_ns)
        if not self._left_in_block:
            self._sensors["noise"][0], self._sensors["at"][0] = self._position.draw(NOISE_BLOCK), 0
            self._left_in_block = NOISE_BLOCK
        self._left_in_block -= 1
        middle, end = _measure_and_seal(*self._packed, t_ns, writer.sequence, writer.system, writer.component)
        writer.sequence = (writer.sequence + 2) & 0xFF
        sealed = self._out[:end].tobytes()
        frames += (sealed[:middle], sealed[middle:])
        return frames

    def act(self, arrival_ns: int, delay_ns: int) -> None:
        """Let the newest command, which came at simulation time arrival_ns, act delay_ns later, within the envelope.

        Raises DivergenceError where too many commands are on their way.
        """
        newest, armed = self.source.newest, self.source.armed
        acts_ns = arrival_ns + delay_ns
        if self.motors:
            self._drive(arrival_ns, acts_ns, self.safety.pass_command(arrival_ns, newest, armed=armed))
        elif not _act_packed(self.safety.packed, self._packed[0], arrival_ns, acts_ns, newest, armed):
            self.plant.refuse_more()

    def _drive(self, t_ns: int, acts_ns: int, tau: FloatArray) -> None:
        """Let tau (6,), asked for at t_ns, act from acts_ns on."""
        if self.motors:
            acts_ns += self.motors.delay_ns
            tau = self.motors.drive(t_ns, tau, acts_ns)  # the force behind the gears: the plant takes it as it is
        self.plant.command(acts_ns, tau)

    def check_staleness(self, t_ns: int, delay_ns: int = 0) -> None:
        """Turn to the safe output, as late as any command acts, where none has come for too long."""
        stale = self.safety.stale_output(t_ns)
        if stale is not None:
            expired_ns, output = stale
            acts_ns = max(expired_ns + delay_ns, self.plant.t_ns)
            self._drive(acts_ns, acts_ns, output)

    def advance(self, end_ns: int) -> None:
        """Note the tick's row and integrate to the next one; `record` follows. Raises DivergenceError, the row recorded."""
        t_ns = self.plant.t_ns
        try:
            self.plant.record_and_advance(end_ns, self.source.newest, self._row)
        except DivergenceError:
            self.record(t_ns)
            raise

    def hold(self, end_ns: int) -> None:
        """Note the tick's row and let time pass with the plant where it is."""
        self.plant.record_and_advance(self.plant.t_ns, self.source.newest, self._row)
        self.plant.t_ns = end_ns

    def record(self, t_ns: int) -> None:
        """Keep the row of the tick at t_ns, which `advance` or `hold` has noted."""
        if self.motors:
            self._row[19:25] = self.motors.tau_at(t_ns)
        if self._truth:
            self._truth.append(t_ns, self._row)

    def flush(self) -> None:
        """Hand the ground truth so far to the system."""
        if self._truth:
            self._truth.flush()

    def all_counters(self) -> dict[str, int]:
        """Everything counted, by name."""
        asked = {name: count + self.station.requests.counters[name] for name, count in self.requests.counters.items()}
        return {
            **self._endpoint.counters(),
            **self.safety.counters,
            **self.source.counters(),
            **asked,
            **self.station.counters(),
            **(self.motors.counters if self.motors else {}),
        }

    def _gps(self, t_ns: int) -> list[Saying]:
        motion = self.plant.state.motion
        return [(mapping.GPS, mapping.encode_gps(t_ns, *self._inertial.geodetic(motion), motion[6:9]))]

    def _state(self, t_ns: int) -> list[Saying]:
        motion = self.plant.state.motion
        rates, place = np.array(body_rates(motion)), self._inertial.geodetic(motion)
        return [(STATE, encode_state(t_ns, motion, rates, place, self.plant.specific_force()))]

    def _odometry(self, t_ns: int) -> list[Saying]:
        motion = self.plant.state.motion
        return [(ODOMETRY, encode_odometry(t_ns, motion, np.array(body_rates(motion))))]

    def _rpm(self, _t_ns: int) -> list[Saying]:
        velocities = self.motors.velocities if self.motors else np.empty(0)
        return [(RPM, encode_rpm(drive, float(velocity))) for drive, velocity in enumerate(velocities)]
