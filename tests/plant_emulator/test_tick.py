"""The emulator's part of a tick, driven by frames over a link: what acts, when, and within which limits; what is sent."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from plant_emulator.command_source import Found
from plant_emulator.plant.integrate import PENDING, Plant
from plant_emulator.plant.sensors import NOISE_BLOCK, InertialSensors, PositionSensor, add_noise
from plant_emulator.plant.truth import TruthWriter, load_truth
from plant_emulator.tick import TRUTH, Emulator
from protocol.errors import DivergenceError
from protocol.messages import FloatArray
from protocol.scenario import Scenario
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter
from tests.frames import EMULATOR, command_frame, emulator_writer, tick_frames, vehicle_writer
from tests.loop import scenario_of

FLAPPER = scenario_of("flapper", seed=3)
PERIOD_NS = FLAPPER.period_ns
SCALE = np.array(FLAPPER.actuators.scale)
LOWER, UPPER = np.array(FLAPPER.actuators.lower), np.array(FLAPPER.actuators.upper)
SAFE = np.array(FLAPPER.actuators.safe)
STALENESS_NS = round(FLAPPER.actuators.staleness_s * 1e9)
DELAY_NS = 5_000_000
INSIDE = 0.5 * np.minimum(UPPER, 0.5 * SCALE)


class Drives:
    """In place of drives on a bus: they note what they are told, and give half of it."""

    delay_ns = 300_000

    def __init__(self) -> None:
        self.counters = {"can_sent": 7}
        self.velocities = np.array([1.0, 2.0])
        self.told: list[tuple[int, list[float], int]] = []

    def drive(self, t_ns: int, tau: FloatArray, acts_ns: int) -> FloatArray:
        self.told.append((t_ns, tau.tolist(), acts_ns))
        return 0.5 * tau

    def tau_at(self, t_ns: int) -> FloatArray:
        return np.full(6, float(t_ns))


class End:
    """An emulator behind a link, and the controller's side of it."""

    def __init__(
        self, scenario: Scenario = FLAPPER, truth: TruthWriter | None = None, drives: Drives | None = None
    ) -> None:
        self.near, self.far = memory_pair()
        endpoint = Endpoint(self.far, *EMULATOR)
        self.emulator = Emulator(scenario, endpoint, truth, cast("Any", drives))
        self.emulator.source.expect(0, 10**12)
        self.writer = vehicle_writer()
        self.endpoint = endpoint

    def say(self, t_ns: int, tau: FloatArray, *, armed: bool = True, delay_ns: int = 0, came_ns: int = -1) -> None:
        """Answer the tick of t_ns; the command comes at came_ns (else t_ns) of simulation time."""
        self.near.send(command_frame(self.writer, t_ns, tau, SCALE, armed=armed))
        self.emulator.source.feed(self.far.recv(0.0) or b"")
        assert self.emulator.source.read() is Found.COMMAND
        self.emulator.act(came_ns if came_ns >= 0 else t_ns, delay_ns)
        self.emulator.settle()

    def tau_at(self, t_ns: int) -> list[float]:
        """What acts at the motors at t_ns; the plant itself stands still."""
        plant = self.emulator.plant
        plant.t_ns = t_ns
        plant.apply_due_commands()
        return cast("list[float]", plant.state.tau.tolist())

    def counted(self, *names: str) -> tuple[int, ...]:
        return tuple(self.emulator.safety.counters[name] for name in names)


def as_the_wire_has_it(tau: FloatArray) -> list[float]:
    return [float(np.float32(one / scale)) * scale for one, scale in zip(tau, SCALE, strict=True)]


class TestEnvelope:
    def test_a_command_within_it_acts_as_it_came_and_a_delay_later(self) -> None:
        end = End()
        initial = list(FLAPPER.initial.command)
        end.say(0, INSIDE, delay_ns=DELAY_NS)
        assert end.tau_at(DELAY_NS - 1) == initial
        assert end.tau_at(DELAY_NS) == as_the_wire_has_it(INSIDE)
        assert end.counted("clamped", "disarmed", "stale") == (0, 0, 0)

    def test_the_delay_counts_from_the_commands_arrival(self) -> None:
        end = End()
        end.say(0, INSIDE, came_ns=1_234_567, delay_ns=DELAY_NS)
        assert end.tau_at(DELAY_NS + 1_234_566) == list(FLAPPER.initial.command)
        assert end.tau_at(DELAY_NS + 1_234_567) == as_the_wire_has_it(INSIDE)

    @pytest.mark.parametrize("axis", range(6))
    @pytest.mark.parametrize("side", [-1.0, 1.0])
    def test_beyond_a_limit_the_limit_acts(self, axis: int, side: float) -> None:
        end = End()
        tau = INSIDE.copy()
        tau[axis] = side * 5.0 * SCALE[axis]
        end.say(0, tau)
        expected = as_the_wire_has_it(INSIDE)
        expected[axis] = float((UPPER if side > 0.0 else LOWER)[axis])
        assert end.tau_at(0) == expected
        assert end.counted("clamped", "disarmed") == (1, 0)

    def test_a_disarmed_command_acts_as_zeros(self) -> None:
        end = End()
        payload = mapping.COMMAND.pack_fields(time_usec=0, controls=[0.5] * 6, mode=0x7F)  # whatever it asks for
        end.near.send(end.writer.seal(mapping.COMMAND, payload))
        end.emulator.source.feed(end.far.recv(0.0) or b"")
        end.emulator.source.read()
        end.emulator.act(0, 0)
        end.emulator.settle()
        assert end.tau_at(0) == [0.0] * 6
        assert end.counted("clamped", "disarmed") == (0, 1)

    def test_more_commands_on_their_way_than_there_is_room_for_end_the_run(self) -> None:
        end = End()
        end.emulator.plant.state.queue[1] = PENDING - 1
        end.say(0, INSIDE)
        with pytest.raises(DivergenceError, match="delayed commands are pending"):
            end.say(PERIOD_NS, INSIDE)


class TestStaleness:
    def test_an_outage_turns_to_the_safe_output_once_and_from_when_the_command_expired(self) -> None:
        end = End()
        end.say(0, INSIDE)
        assert end.tau_at(0) == as_the_wire_has_it(INSIDE)
        end.emulator.check_staleness(STALENESS_NS)
        end.emulator.check_staleness(STALENESS_NS + 3_000_000)
        end.emulator.check_staleness(STALENESS_NS + 7_000_000)
        assert end.counted("stale") == (1,)
        assert end.emulator.plant.state.queue[1] == 1
        assert end.tau_at(STALENESS_NS - 1) == as_the_wire_has_it(INSIDE)
        assert end.tau_at(STALENESS_NS) == SAFE.tolist()

    def test_it_acts_as_late_as_any_command(self) -> None:
        end = End()
        end.say(0, INSIDE)
        end.emulator.check_staleness(STALENESS_NS + 1, DELAY_NS)
        assert end.tau_at(STALENESS_NS + DELAY_NS - 1) == as_the_wire_has_it(INSIDE)
        assert end.tau_at(STALENESS_NS + DELAY_NS) == SAFE.tolist()

    def test_seen_late_it_acts_now_and_not_in_the_past(self) -> None:
        end = End()
        end.say(0, INSIDE)
        now_ns = 4 * STALENESS_NS
        end.tau_at(now_ns)
        end.emulator.check_staleness(now_ns + PERIOD_NS)
        assert end.emulator.plant.state.pending_ns[end.emulator.plant.state.queue[0]] == now_ns

    def test_the_next_command_ends_the_outage_and_the_next_outage_is_one_of_its_own(self) -> None:
        end = End()
        end.say(0, INSIDE)
        end.emulator.check_staleness(STALENESS_NS + PERIOD_NS)
        later_ns = 2 * STALENESS_NS
        end.say(later_ns, 0.5 * INSIDE)
        assert end.tau_at(later_ns) == as_the_wire_has_it(0.5 * INSIDE)
        end.emulator.check_staleness(later_ns + STALENESS_NS)
        assert end.counted("stale") == (1,)
        end.emulator.check_staleness(later_ns + STALENESS_NS + 1)
        assert end.counted("stale") == (2,)
        assert end.tau_at(later_ns + STALENESS_NS) == SAFE.tolist()

    def test_a_first_command_that_never_comes_is_an_outage_too(self) -> None:
        end = End()
        end.emulator.check_staleness(STALENESS_NS + 1)
        assert end.tau_at(STALENESS_NS) == SAFE.tolist()


class TestDrivesOnABus:
    def test_they_get_what_the_envelope_leaves_and_the_plant_gets_what_they_give(self) -> None:
        drives = Drives()
        end = End(drives=drives)
        tau = INSIDE.copy()
        tau[2] = -9.0
        allowed = np.array(as_the_wire_has_it(INSIDE))
        allowed[2] = LOWER[2]
        end.say(0, tau, came_ns=1_000_000, delay_ns=DELAY_NS)
        acts_ns = 1_000_000 + DELAY_NS + Drives.delay_ns
        assert drives.told == [(1_000_000, allowed.tolist(), acts_ns)]
        assert end.tau_at(acts_ns - 1) != (0.5 * allowed).tolist()
        assert end.tau_at(acts_ns) == (0.5 * allowed).tolist()
        assert end.emulator.plant.state.u.tolist() == (0.5 * allowed).tolist(), "the gears are theirs"

    def test_disarmed_they_get_zeros(self) -> None:
        drives = Drives()
        End(drives=drives).say(0, INSIDE, armed=False)
        assert drives.told == [(0, [0.0] * 6, Drives.delay_ns)]

    def test_in_an_outage_they_get_the_safe_output(self) -> None:
        drives = Drives()
        end = End(drives=drives)
        end.emulator.check_staleness(STALENESS_NS + 1, DELAY_NS)
        acts_ns = STALENESS_NS + DELAY_NS
        assert drives.told == [(acts_ns, SAFE.tolist(), acts_ns + Drives.delay_ns)]

    def test_the_ground_truth_has_what_acts_at_them(self, tmp_path: Path) -> None:
        with TruthWriter(tmp_path / "truth.npy") as truth:
            end = End(truth=truth, drives=Drives())
            end.emulator.advance(PERIOD_NS)
            end.emulator.record(77)
        (row,) = load_truth(tmp_path / "truth.npy")
        assert row["tau"].tolist() == [77.0] * 6

    def test_their_counters_and_speeds_are_told(self) -> None:
        end = End(drives=Drives())
        assert end.emulator.all_counters()["can_sent"] == 7
        end.emulator.schedule.ask_once(339)  # RAW_RPM
        said = [one for one in end.emulator.schedule.due(0) if one[0].name == "RAW_RPM"]
        assert [message.unpack_fields(payload)["index"] for message, payload in said] == [0, 1]
        speeds = [message.unpack_fields(payload)["frequency"] for message, payload in said]
        assert speeds == pytest.approx([60.0 / (2.0 * np.pi), 120.0 / (2.0 * np.pi)])


class TestWhatIsSent:
    @pytest.mark.parametrize("ticks", [3, NOISE_BLOCK + 3])
    def test_pose_and_tick_are_those_of_the_plain_writer_and_sensors(self, ticks: int) -> None:
        """Over the end of a block of noise too: the numbers are those of one generator, in one go."""
        end, writer = End(), emulator_writer()
        plant, inertial = Plant(FLAPPER), InertialSensors(FLAPPER.world)
        noise, q = PositionSensor(FLAPPER.seed).draw(2 * NOISE_BLOCK), np.empty(6)
        for k in range(ticks):
            end.emulator.sense(k * PERIOD_NS)
            frames = end.emulator.frames()
            writer.sequence = frames[-2][4]
            add_noise(plant.state.motion, noise[k], FLAPPER.noise.position, FLAPPER.noise.attitude, q)
            readings = inertial.measure(plant.state.motion, plant.specific_force())
            assert b"".join(frames[-2:]) == tick_frames(writer, k * PERIOD_NS, q, readings)

    def test_what_is_due_travels_in_front_and_every_frame_has_its_number(self) -> None:
        end, reader = End(), FrameReader(is_datagram=True)
        fast, slow = [mapping.POSE.message_id, mapping.TICK.message_id], [mapping.GPS.message_id]
        numbers = []
        for t_ns in range(0, 2_000_000_000, PERIOD_NS):
            frames = reader.read(end.emulator.sense(t_ns))
            numbers += [frame.sequence for frame in frames]
            ids = [frame.message_id for frame in frames]
            if t_ns % 1_000_000_000 == 0:
                assert ids == [mapping.HEARTBEAT.message_id, *slow, *fast]
            else:
                assert ids == ([*slow, *fast] if t_ns % 100_000_000 == 0 else fast)
            assert {(frame.system, frame.component) for frame in frames} == {EMULATOR}
        assert numbers == [number % 256 for number in range(len(numbers))]

    def test_the_true_state_is_said_at_the_rate_asked_for(self) -> None:
        end, reader = End(), FrameReader(is_datagram=True)
        end.emulator.say_truth(50.0)
        times: dict[int, list[int]] = {message.message_id: [] for message in TRUTH}
        for t_ns in range(0, 100_000_000, PERIOD_NS):
            for frame in reader.read(end.emulator.sense(t_ns)):
                if frame.message_id in times:
                    times[frame.message_id].append(t_ns // 1_000_000)
        assert list(times.values()) == [[0, 20, 40, 60, 80]] * 2

    def test_a_request_is_answered_with_the_next_tick_and_before_the_first(self) -> None:
        end, reader = End(), FrameReader(is_datagram=True)
        request = mapping.COMMAND_LONG.pack_fields(command=511, param1=115.0, param2=-1.0)
        frame = FrameWriter(255, 190).seal(mapping.COMMAND_LONG, request)
        end.emulator.hear(reader.read(frame))
        ((message, _),) = end.emulator.answers()
        assert message is mapping.COMMAND_ACK
        assert end.emulator.answers() == []
        end.emulator.hear(reader.read(frame))
        first, *_ = FrameReader(is_datagram=True).read(end.emulator.sense(0))
        assert first.message_id == mapping.COMMAND_ACK.message_id
        assert end.emulator.all_counters()["requests"] == 2


class TestRows:
    def test_a_tick_is_recorded_as_it_was_before_the_plant_moved_on(self, tmp_path: Path) -> None:
        with TruthWriter(tmp_path / "truth.npy") as truth:
            end = End(truth=truth)
            motion = end.emulator.plant.state.motion.copy()
            end.say(0, INSIDE)
            end.emulator.advance(PERIOD_NS)
            end.emulator.record(0)
            moved = end.emulator.plant.state.motion.copy()
            end.emulator.hold(2 * PERIOD_NS)
            end.emulator.record(PERIOD_NS)
            end.emulator.flush()
            rows = load_truth(tmp_path / "truth.npy")
        assert rows["t_ns"].tolist() == [0, PERIOD_NS]
        assert rows["q"].tolist() == [motion[:6].tolist(), moved[:6].tolist()]
        assert rows["q_dot"].tolist() == [motion[6:].tolist(), moved[6:].tolist()]
        assert rows["command"].tolist() == rows["tau"].tolist() == [as_the_wire_has_it(INSIDE)] * 2
        assert end.emulator.plant.t_ns == 2 * PERIOD_NS
        assert end.emulator.plant.state.motion.tolist() == moved.tolist(), "held, it does not move"

    def test_where_the_plant_diverges_its_last_row_is_recorded(self, tmp_path: Path) -> None:
        with TruthWriter(tmp_path / "truth.npy") as truth:
            end = End(truth=truth)
            end.emulator.plant.state.motion[4] = 1.39
            end.emulator.plant.state.motion[10] = 50.0
            with pytest.raises(DivergenceError, match="pitch"):
                end.emulator.advance(PERIOD_NS)
        (row,) = load_truth(tmp_path / "truth.npy")
        assert row["t_ns"] == 0
        assert row["q"][4] == 1.39


def test_everything_counted_has_a_name_of_its_own() -> None:
    counters = End().emulator.all_counters()
    assert {"bad_crc", "clamped", "refused_commands", "requests", "received"} <= set(counters)
