"""The emulator's part of a tick in one compiled call: read the answer, let it act, record, move on, measure, write.

The kernels are those that everything else is made of (`safety`, `integrate`, `sensors`, `protocol.wire.tick_frames`), called
one after the other without the way through Python. What can wait until the next tick is on its way, waits (`settle`).
"""

from __future__ import annotations

import numpy as np

from plant_emulator.plant.integrate import GOES_ON, Plant, advance, apply_due_commands, fill_row, push_command
from plant_emulator.plant.safety import SafetyEnvelope, clamp
from plant_emulator.plant.sensors import PositionSensor, add_noise, inertial_readings
from protocol.compiled import Packed, compiled, pack
from protocol.messages import VEHICLE, FloatArray
from protocol.scenario import Scenario
from protocol.wire.codec import FrameReader, FrameWriter
from protocol.wire.framing import Bytes
from protocol.wire.mapping import ARMED
from protocol.wire.tick_frames import TickWriter, parse_command, write_tick

_NOT_PLAIN = -1


@compiled
def _measure_and_write(
    pose: Packed, pose_payload: Bytes, tick: Packed, tick_payload: Bytes, out: Bytes, state: Packed, run: Packed,
    normal: FloatArray, t_us: int, sequence: int, system: int, component: int,
) -> tuple[int, int]:  # fmt: skip
    """What `add_noise` and `inertial_readings` make of the state, by `write_tick` into `out`."""
    r, motion = run[0], state[0].motion
    add_noise(motion, normal, r.position, r.attitude, r.q)
    inertial_readings(motion, state[0].u, r.mass, r.field, r.sea_level, r.readings)
    return write_tick(
        pose, pose_payload, tick, tick_payload, out, t_us, r.q, r.readings, sequence, system, component
    )  # fmt: skip


@compiled
def _go_on(
    pose: Packed, pose_payload: Bytes, tick: Packed, tick_payload: Bytes, out: Bytes, state: Packed, run: Packed,
    normal: FloatArray, data: Bytes, parameters: Packed, row: FloatArray, t_ns: int, end_ns: int, acts_ns: int,
    expected: int, sequence: int, system: int, component: int,
) -> tuple[int, int, int]:  # fmt: skip
    """(outcome of `advance`, where the frames of the next tick end); (_NOT_PLAIN, 0, 0) with nothing changed."""
    s, r, p = state[0], run[0], parameters[0]
    echo_us, number, mode = parse_command(data, VEHICLE[0], VEHICLE[1], r.scale, r.tau)
    if echo_us * 1000 != t_ns or number != expected or mode & ARMED == 0:
        return _NOT_PLAIN, 0, 0
    r.excess[0] = clamp(r.tau, r.lower, r.upper, r.allowed)
    if not push_command(s, acts_ns, r.allowed):
        return _NOT_PLAIN, 0, 0
    for i in range(6):
        r.newest[i] = r.tau[i]
    apply_due_commands(s, p, t_ns)
    fill_row(s, r.newest, row)
    outcome = advance(s, p, p, t_ns, end_ns, p.substep_ns)
    if outcome != GOES_ON:
        return outcome, 0, 0
    middle, end = _measure_and_write(
        pose, pose_payload, tick, tick_payload, out, state, run, normal, end_ns // 1000, sequence, system, component
    )  # fmt: skip
    return outcome, middle, end


class QuickTicks:
    """Measures the plant into frames; takes plain answers all the way to the next tick's frames.

    newest   (6,) the command that came last, as it stands in the ground truth
    """

    def __init__(
        self, scenario: Scenario, plant: Plant, safety: SafetyEnvelope, writer: FrameWriter, reader: FrameReader
    ) -> None:
        self._plant, self._safety, self._writer, self._reader = plant, safety, writer, reader
        self._frames = TickWriter(writer)
        self._position = PositionSensor(scenario.noise, scenario.seed)
        readings = np.zeros(13)
        readings[12] = scenario.world.temperature_celsius
        self._run = pack(
            {
                "position": scenario.noise.position,
                "attitude": scenario.noise.attitude,
                "q": np.zeros(6),
                "mass": scenario.body.mass,
                "field": np.array(scenario.world.magnetic_field_ned),
                "sea_level": scenario.world.altitude,
                "readings": readings,
                "scale": np.array(scenario.actuators.scale),
                "lower": safety.lower,
                "upper": safety.upper,
                "tau": np.zeros(6),
                "allowed": np.zeros(6),
                "excess": np.zeros(1),
                "newest": np.zeros(6),
            }
        )
        self.newest: FloatArray = self._run["newest"][0]
        self._excess: FloatArray = self._run["excess"][0]
        self._arguments = (*self._frames.buffers, plant.state.packed, self._run)
        self._normal = self._position.next_normal()
        self._sequence = -1

    def frames(self, t_ns: int) -> tuple[bytes, bytes]:
        """ATT_POS_MOCAP and HIL_SENSOR of the plant's state at t_ns; to be asked for once for every tick."""
        writer = self._writer
        middle, end = _measure_and_write(
            *self._arguments, self._normal, t_ns // 1000, writer.sequence, writer.system, writer.component
        )
        self._normal = self._position.next_normal()
        sealed = self._frames.taken(end)
        return sealed[:middle], sealed[middle:]

    def go_on(
        self, datagram: bytes, row: FloatArray, t_ns: int, end_ns: int, delay_ns: int
    ) -> tuple[bytes, int] | None:
        """Where the datagram is just the armed answer to the tick at t_ns: the frames of the tick at end_ns.

        The answer then acts delay_ns later, the row (31,) is that of t_ns, the plant has moved to end_ns, and `settle` must
        follow. Returns both frames as one and where the first ends; None where the datagram is anything else, with nothing
        done. Raises DivergenceError, with the row filled and the state the last one computed.
        """
        writer = self._writer
        self._sequence = self._reader.expected(VEHICLE)
        outcome, middle, end = _go_on(
            *self._arguments, self._normal, np.frombuffer(datagram, np.uint8), self._plant.parameters, row, t_ns, end_ns,
            t_ns + delay_ns, self._sequence, writer.sequence, writer.system, writer.component,
        )  # fmt: skip
        if outcome == _NOT_PLAIN:
            return None
        self._plant.arrive(end_ns, outcome)
        return self._frames.taken(end), middle

    def settle(self, arrival_ns: int) -> None:
        """Take note of the answer that `go_on` took and when it came, and make ready for the next."""
        self._reader.expect(VEHICLE, self._sequence + 1)
        self._safety.accepted(arrival_ns, self._excess[0])
        self._normal = self._position.next_normal()
