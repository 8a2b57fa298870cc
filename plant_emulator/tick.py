"""The emulator's part of a tick, always in this order: safety envelope, drives, record and move, due frames, measure, seal.

Time is kept by `pacing`, not here. Its only interface to the outside is messages. The live process and the
replay of a log into the plant call it; the in-process simulation calls the same kernels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bridge.endpoint import Endpoint
from bridge.requests import Requests
from bridge.station import Station
from plant_emulator.command_source import CommandSource
from plant_emulator.plant.integrate import (
    GOES_ON,
    TOO_MANY_PENDING,
    Plant,
    PlantState,
    push_command,
    record_and_advance,
    specific_force,
)
from plant_emulator.plant.rigid_body import body_rates
from plant_emulator.plant.safety import SafetyEnvelope, pass_command
from plant_emulator.plant.sensors import NOISE_BLOCK, InertialSensors, PositionSensor, add_noise, inertial_readings
from plant_emulator.plant.truth import TruthWriter
from plant_emulator.station import EmulatorStation
from protocol.compiled import Packed, compiled, entry_point, pack
from protocol.errors import DivergenceError
from protocol.messages import VEHICLE, FloatArray
from protocol.scenario import Scenario
from protocol.wire import mapping
from protocol.wire.codec import Frame
from protocol.wire.framing import LONGEST_FRAME, Output
from protocol.wire.schedule import Encoder, Saying, Schedule
from protocol.wire.tick_frames import write_tick
from protocol.wire.truth_mapping import ODOMETRY, RPM, STATE, encode_odometry, encode_rpm, encode_state

if TYPE_CHECKING:  # not needed for a run without a CAN bus
    from bridge.motor_bus.drives import CanMotors

TRUTH = (STATE, ODOMETRY)
ACT, MOVE, MEASURE = 1, 2, 4


@compiled
def act(envelope: Any, state: PlantState, t_ns: int, acts_ns: int, tau: FloatArray, armed: bool) -> bool:
    """Let a command received at t_ns, limited by the envelope, act from acts_ns on; False: too many commands are pending."""
    pass_command(envelope, t_ns, tau, armed)
    return push_command(state, acts_ns, envelope.allowed)


@compiled
def _steps(
    state: Packed, parameters: Packed, envelope: Packed, source: Packed, memory: Packed, steps: int, at: int,
    t_ns: int, end_ns: int, arrival_ns: int, acts_ns: int, sequence: int, system: int, component: int,
) -> tuple[int, int, int]:  # fmt: skip
    """Those `steps` of a tick that are wanted, in their one order: (outcome, where the frames of the next tick end).

    ACT lets the newest command act, MOVE notes the row of t_ns and moves the plant to end_ns, MEASURE measures it there, with
    the noise in row `at`, and seals pose and tick into `memory.out`.
    """
    s, p, m, newest = state[0], parameters[0], memory[0], source[0].newest
    if steps & ACT and not act(envelope[0], s, arrival_ns, acts_ns, newest, source[0].armed != 0):
        return TOO_MANY_PENDING, 0, 0
    if steps & MOVE:
        outcome = record_and_advance(s, p, t_ns, end_ns, newest, m.row)
        if outcome != GOES_ON:
            return outcome, 0, 0
    middle = end = 0
    if steps & MEASURE:
        add_noise(s.motion, m.noise[at], m.position, m.attitude, m.q)
        specific_force(end_ns * 1e-9, s.wrench, p, m.force)
        inertial_readings(s.motion, m.force, m.field, m.sea_level, m.readings)
        middle, end = write_tick(m, end_ns // 1000, m.q, m.readings, sequence, system, component)
    return GOES_ON, middle, end


class Emulator:
    """Plant, sensors and safety envelope of one run.

    motors     drives on a CAN bus, which then contain the gears; None: motors and gears are in the plant
    source     commands from the link                 schedule   messages sent on the loop's link besides the ticks
    station    requests of a ground station, on a link of its own
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
        readings = np.zeros(13)
        readings[12] = scenario.world.temperature_celsius
        self._memory = pack(
            {
                "position": scenario.noise.position,
                "attitude": scenario.noise.attitude,
                "noise": np.zeros((NOISE_BLOCK, 6)),
                "q": np.zeros(6),
                "force": np.zeros(3),
                "field": np.array(scenario.world.magnetic_field_ned),
                "sea_level": scenario.world.altitude,
                "readings": readings,
                "row": np.zeros(31),
                "out": np.zeros(2 * LONGEST_FRAME, dtype=np.uint8),
            },
            {"pose": mapping.POSE.dtype, "tick": mapping.TICK.dtype},
        )
        self._at = NOISE_BLOCK
        self._row: FloatArray = self._memory["row"][0]
        self._out: Output = self._memory["out"][0]
        plant, envelope = self.plant, self.safety.packed
        self._packed = (plant.state.packed, plant.parameters, envelope, self.source.memory, self._memory)
        self._steps = entry_point(_steps, *self._packed, *[0] * 9)
        self._waits = 0
        """ACT, where the newest command is to act before anything else happens to the plant."""
        self._arrival_ns = self._acts_ns = 0
        self._measured_ns, self._sequence, self._middle, self._end = -1, 0, 0, 0
        """Of the tick that is measured but not yet sent (-1: none): time, first sequence number, where its frames end."""
        self._due: list[bytes] = []
        self._sealed = b""

    def say_truth(self, rate_hz: float) -> None:
        """Send the true state on the loop's link from now on, as if the peer had requested it."""
        for message in TRUTH:
            self.schedule.set_rate(message.message_id, rate_hz)

    def hear(self, frames: list[Frame]) -> None:
        """React to frames that are no commands: requests are answered with the next tick."""
        for frame in frames:
            self.requests.handle(frame)

    def answers(self) -> list[Saying]:
        """Replies due before the first tick, when nothing else is due; the station's requests are handled too."""
        self.station.answer()
        return self.schedule.answers()

    def sense(self, t_ns: int) -> bytes:
        """The tick at t_ns as one datagram: the frames that are due, the pose, the tick; `frames` gives them one by one."""
        writer = self._endpoint.writer
        due: list[bytes] = []
        if t_ns >= self.schedule.next_ns:
            due = [writer.seal(*saying) for saying in self.schedule.due(t_ns)]
        if t_ns >= self.station.next_ns:
            self.station.poll(t_ns)
        if self._measured_ns != t_ns or self._sequence != writer.sequence:
            self._run(MEASURE, t_ns)
        self._at += 1
        self._measured_ns = -1
        writer.sequence = (writer.sequence + 2) & 0xFF
        self._due, self._sealed = due, self._out[: self._end].tobytes()
        return b"".join((*due, self._sealed)) if due else self._sealed

    def frames(self) -> list[bytes]:
        """The frames of the tick that `sense` gave last, in their order."""
        return [*self._due, self._sealed[: self._middle], self._sealed[self._middle :]]

    def act(self, arrival_ns: int, delay_ns: int) -> None:
        """Let the newest command, received at simulation time arrival_ns, act delay_ns later, within the envelope.

        It is applied by `advance`, or before, by `settle`. Raises DivergenceError, now or then, where too many commands are
        pending.
        """
        if self.motors:
            allowed = self.safety.pass_command(arrival_ns, self.source.newest, armed=self.source.armed)
            self._drive(arrival_ns, arrival_ns + delay_ns, allowed)
        else:
            self._arrival_ns, self._acts_ns = arrival_ns, arrival_ns + delay_ns
            self._waits = ACT

    def settle(self) -> None:
        """Let the newest command act now: another one may be read, or the staleness of commands be looked into."""
        if self._waits:
            self._run(0, self.plant.t_ns)

    def _run(self, steps: int, end_ns: int) -> None:
        """Have the kernel do what waits, then these steps. Raises DivergenceError."""
        writer, waits = self._endpoint.writer, self._waits
        if self._at == NOISE_BLOCK and steps & MEASURE:
            self._memory["noise"][0], self._at = self._position.draw(NOISE_BLOCK), 0
        self._waits = 0
        self._sequence = sequence = writer.sequence
        outcome, self._middle, self._end = self._steps(
            *self._packed, waits | steps, self._at, self.plant.t_ns, end_ns, self._arrival_ns, self._acts_ns, sequence,
            writer.system, writer.component,
        )  # fmt: skip
        self._measured_ns = end_ns if steps & MEASURE else -1
        if steps & MOVE or outcome != GOES_ON:
            self.plant.arrive(end_ns, outcome)

    def _drive(self, t_ns: int, acts_ns: int, tau: FloatArray) -> None:
        """Let tau (6,), commanded at t_ns, act from acts_ns on."""
        if self.motors:
            acts_ns += self.motors.delay_ns
            tau = self.motors.drive(t_ns, tau, acts_ns)  # the force after the gears, which acts on the plant as it is
        self.plant.command(acts_ns, tau)

    def check_staleness(self, t_ns: int, delay_ns: int = 0) -> None:
        """Switch to the safe output, with the delay of a command, when the last command is stale."""
        self.settle()
        stale = self.safety.stale_output(t_ns)
        if stale is not None:
            expired_ns, output = stale
            acts_ns = max(expired_ns + delay_ns, self.plant.t_ns)
            self._drive(acts_ns, acts_ns, output)

    def advance(self, end_ns: int) -> None:
        """Fill the tick's row and integrate to the next tick, which is measured too if nothing else is due with it.

        `record` follows. Raises DivergenceError, the row recorded.
        """
        t_ns = self.plant.t_ns
        alone = end_ns < self.schedule.next_ns and end_ns < self.station.next_ns
        try:
            self._run(MOVE | MEASURE if alone else MOVE, end_ns)
        except DivergenceError:
            self.record(t_ns)
            raise

    def hold(self, end_ns: int) -> None:
        """Fill the tick's row and let time pass with the plant held in place."""
        self._run(MOVE, self.plant.t_ns)
        self.plant.t_ns = end_ns

    def record(self, t_ns: int) -> None:
        """Write the row of the tick at t_ns, which `advance` or `hold` has filled."""
        if self.motors:
            self._row[19:25] = self.motors.tau_at(t_ns)
        if self._truth:
            self._truth.append(t_ns, self._row)

    def flush(self) -> None:
        """Flush the ground truth written so far to the operating system."""
        if self._truth:
            self._truth.flush()

    def all_counters(self) -> dict[str, int]:
        """All counters, by name."""
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
