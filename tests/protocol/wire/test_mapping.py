"""Our messages on the wire and back: resolution, NaN policy, flags. pymavlink's parser says what was really sent.

The reference for a float32 is `struct`, which knows nothing of numpy or numba.
"""

from __future__ import annotations

import inspect
import math
import random
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from protocol.messages import ActuatorCommand, FloatArray, PositionSample
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter, Layout, layout

SCALE = np.array([0.04, 0.04, 0.12, 3e-4, 3e-4, 3e-4])
HALF_STEP = 2.0**-24
"""Relative rounding of a float32."""
INT32_MAX = 2**31 - 1
NOT_FINITE = [math.nan, -math.nan, math.inf, -math.inf]

times_ns = st.integers(0, 2**62)
metres = st.floats(-1e4, 1e4)
poses = st.tuples(metres, metres, metres, st.floats(-3.14, 3.14), st.floats(-1.4, 1.4), st.floats(-3.14, 3.14))
fractions = st.tuples(*[st.floats(-1.0, 1.0)] * 6)


def float32(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def bits(values: Sequence[float] | FloatArray) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def parsed(message: Layout, payload: bytes) -> Any:
    """What pymavlink makes of the sealed frame."""
    return common.MAVLink(None).parse_char(FrameWriter(1, 1).seal(message, payload))


def on_the_wire(message: Layout, payload: bytes) -> bytes:
    """The payload as a receiver gets it, without its trailing zeros."""
    (frame,) = FrameReader(is_datagram=True).read(FrameWriter(1, 1).seal(message, payload))
    return frame.payload


def pose_payload(**changes: Any) -> bytes:
    """A good ATT_POS_MOCAP from pymavlink, with some fields changed."""
    values = {"time_usec": 4000, "q": [1.0, 0.0, 0.0, 0.0], "x": 1.0, "y": 2.0, "z": 3.0} | changes
    message = common.MAVLink_att_pos_mocap_message(**values)
    (frame,) = FrameReader(is_datagram=True).read(message.pack(common.MAVLink(None)))
    return frame.payload


def command_payload(controls: Sequence[float], mode: int = 0x80) -> bytes:
    values = [*controls, *[0.0] * (16 - len(controls))]
    message = common.MAVLink_hil_actuator_controls_message(8000, values, mode, 0)
    (frame,) = FrameReader(is_datagram=True).read(message.pack(common.MAVLink(None)))
    return frame.payload


class TestPose:
    @settings(max_examples=100)
    @given(times_ns, poses)
    def test_a_pose_comes_back_within_the_resolution_of_float32(self, t_ns: int, pose: tuple[float, ...]) -> None:
        payload = mapping.encode_pose(t_ns, np.array(pose))
        sample = mapping.decode_pose(on_the_wire(mapping.POSE, payload))
        assert sample is not None
        assert sample.t_ns == t_ns // 1000 * 1000
        for sent, came in zip(pose[:3], sample.q[:3], strict=True):
            assert abs(came - sent) <= abs(sent) * HALF_STEP + 1e-45
        # Four components, each half a step off; the pitch's sine is flat near its end, by 1 / cos(1.4) at most.
        for sent, came in zip(pose[3:], sample.q[3:], strict=True):
            assert abs(came - sent) <= 4 * HALF_STEP / math.cos(1.4)

    @settings(max_examples=100)
    @given(times_ns, poses)
    def test_the_compiled_mapping_is_the_wire_to_the_bit(self, t_ns: int, pose: tuple[float, ...]) -> None:
        q, wire, straight = np.array(pose), np.empty(7), np.empty(6)
        mapping.pose_to_wire(q, wire)
        mapping.pose_from_wire(wire, straight)
        payload = mapping.encode_pose(t_ns, q)
        message = parsed(mapping.POSE, payload)
        assert bits(wire) == bits([*message.q, message.x, message.y, message.z])
        sample = mapping.decode_pose(payload)
        assert sample is not None
        assert bits(sample.q) == bits(straight)

    @settings(max_examples=100)
    @given(poses)
    def test_the_wire_carries_the_float32_of_each_number(self, pose: tuple[float, ...]) -> None:
        wire = np.empty(7)
        mapping.pose_to_wire(np.array(pose), wire)
        halves = [(math.cos(0.5 * angle), math.sin(0.5 * angle)) for angle in pose[3:]]
        (ca, sa), (cb, sb), (cg, sg) = halves
        w = ca * cb * cg + sa * sb * sg
        assert wire[0] == pytest.approx(float32(w), abs=2 * HALF_STEP)
        assert bits(wire[4:]) == bits([float32(value) for value in pose[:3]])
        assert bits(wire) == bits([float32(value) for value in wire])

    def test_the_covariance_is_unknown_and_the_time_is_whole_microseconds(self) -> None:
        message = parsed(mapping.POSE, mapping.encode_pose(1_234_567_890, np.arange(6.0) / 10))
        assert message.time_usec == 1_234_567
        assert math.isnan(message.covariance[0])
        assert message.covariance[1:] == [0.0] * 20

    def test_angles_come_back_within_half_a_turn(self) -> None:
        sample = mapping.decode_pose(mapping.encode_pose(0, np.array([0.0, 0.0, 0.0, 4.0, 0.2, -7.0])))
        assert sample is not None
        assert sample.q[3:] == pytest.approx([4.0 - 2 * math.pi, 0.2, -7.0 + 2 * math.pi], abs=1e-6)

    def test_it_has_no_place_for_velocity_and_takes_none(self) -> None:
        assert set(mapping.POSE.fields) == {"time_usec", "q", "x", "y", "z", "covariance"}
        assert list(inspect.signature(mapping.encode_pose).parameters) == ["t_ns", "q"]
        state = np.arange(12.0) / 20  # position, attitude, and what comes behind them in the plant
        assert mapping.encode_pose(5000, state) == mapping.encode_pose(5000, state[:6])
        assert PositionSample.__struct_fields__ == ("t_ns", "q")

    def test_a_good_pose_of_another_sender_is_taken(self) -> None:
        half = math.sqrt(0.5)
        sample = mapping.decode_pose(pose_payload(q=[half, 0.0, 0.0, half]))
        assert sample is not None
        assert sample.t_ns == 4_000_000
        assert sample.q == pytest.approx([1.0, 2.0, 3.0, 0.0, 0.0, math.pi / 2], abs=1e-6)

    @pytest.mark.parametrize("bad", NOT_FINITE)
    @pytest.mark.parametrize("field", ["x", "y", "z"])
    def test_a_position_that_is_no_number_is_refused(self, field: str, bad: float) -> None:
        assert mapping.decode_pose(pose_payload(**{field: bad})) is None

    @pytest.mark.parametrize("bad", NOT_FINITE)
    @pytest.mark.parametrize("place", range(4))
    def test_a_quaternion_that_is_no_number_is_refused(self, place: int, bad: float) -> None:
        q = [1.0, 0.0, 0.0, 0.0]
        q[place] = bad
        assert mapping.decode_pose(pose_payload(q=q)) is None

    @pytest.mark.parametrize("length", [0.0, 0.5, 0.998, 1.002, 2.0, 1e20, 1e38])
    def test_a_quaternion_that_is_not_unit_is_refused(self, length: float) -> None:
        assert mapping.decode_pose(pose_payload(q=[length * 0.6, 0.0, length * 0.8, 0.0])) is None

    @pytest.mark.parametrize("length", [0.9992, 1.0, 1.0008])
    def test_a_quaternion_that_is_nearly_unit_is_taken_as_its_direction(self, length: float) -> None:
        sample = mapping.decode_pose(pose_payload(q=[length * 0.8, length * 0.6, 0.0, 0.0]))
        assert sample is not None
        assert sample.q[3:] == pytest.approx([2 * math.asin(0.6), 0.0, 0.0], abs=1e-6)

    @pytest.mark.parametrize("value", [*NOT_FINITE, 0.5])
    def test_any_covariance_is_legal(self, value: float) -> None:
        plain = mapping.decode_pose(pose_payload())
        sample = mapping.decode_pose(pose_payload(covariance=[value] * 21))
        assert plain is not None
        assert sample is not None
        assert (sample.t_ns, bits(sample.q)) == (plain.t_ns, bits(plain.q))

    @given(st.binary(max_size=200))
    @settings(max_examples=50)
    def test_any_bytes_decode_to_a_finite_sample_or_none(self, payload: bytes) -> None:
        sample = mapping.decode_pose(payload)
        assert sample is None or np.isfinite(sample.q).all()


class TestTick:
    def test_every_reading_arrives_in_its_field(self) -> None:
        names = ["xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "xmag", "ymag", "zmag"]
        names += ["abs_pressure", "diff_pressure", "pressure_alt", "temperature"]
        readings = [0.1 * (number + 1) for number in range(13)]
        message = parsed(mapping.TICK, mapping.encode_tick(77_000_999, np.array(readings)))
        assert message.get_type() == "HIL_SENSOR"
        assert message.time_usec == 77_000
        assert message.id == 0
        assert bits([getattr(message, name) for name in names]) == bits([float32(value) for value in readings])
        # Bits of accelerometer, gyroscope, magnetometer (three each), two pressures, altitude, temperature.
        assert message.fields_updated == 2**13 - 1

    @settings(max_examples=50)
    @given(times_ns, st.binary(min_size=57, max_size=57), st.integers(8, 65))
    def test_only_the_time_of_a_tick_is_read(self, t_ns: int, rest: bytes, length: int) -> None:
        plain = mapping.encode_tick(t_ns, np.zeros(13))
        other = (plain[:8] + rest)[:length]
        assert mapping.decode_tick_time_ns(other) == t_ns // 1000 * 1000
        assert mapping.decode_tick_time_ns(on_the_wire(mapping.TICK, other)) == t_ns // 1000 * 1000

    def test_a_reading_too_large_for_its_field_is_infinite_and_no_exception(self) -> None:
        message = parsed(mapping.TICK, mapping.encode_tick(0, np.full(13, 1e39)))
        assert message.zacc == math.inf

    @pytest.mark.parametrize("t_us", [0, 1, 255, 256, 2**32, 2**40])
    def test_a_time_with_its_zeros_cut_off_is_read(self, t_us: int) -> None:
        cut = struct.pack("<Q", t_us).rstrip(b"\0")
        assert mapping.decode_tick_time_ns(cut) == t_us * 1000

    @pytest.mark.parametrize("sensor", [0, 1, 7, 255])
    def test_the_instance_is_read(self, sensor: int) -> None:
        payload = layout("HIL_SENSOR").pack_fields(id=sensor, zacc=1.0)
        assert mapping.tick_sensor_id(on_the_wire(mapping.TICK, payload)) == sensor
        assert mapping.tick_sensor_id(payload) == sensor


class TestGps:
    @staticmethod
    def encode(velocity: Sequence[float], place: tuple[float, float, float] = (47.4, 8.5, 488.0)) -> Any:
        payload = mapping.encode_gps(3_000_000_000, *place, np.array(velocity))
        return parsed(mapping.GPS, payload)

    def test_place_and_fix_are_in_the_units_of_the_message(self) -> None:
        message = self.encode([0.0, 0.0, 0.0])
        assert (message.time_usec, message.fix_type) == (3_000_000, 3)
        assert (message.lat, message.lon, message.alt) == (474_000_000, 85_000_000, 488_000)
        assert (message.eph, message.epv, message.satellites_visible) == (30, 40, 12)

    @settings(max_examples=60)
    @given(st.tuples(*[st.floats(-300.0, 300.0)] * 3))
    def test_velocity_is_in_centimetres_a_second(self, velocity: tuple[float, float, float]) -> None:
        message = self.encode(velocity)
        for value, field in zip(velocity, (message.vn, message.ve, message.vd), strict=True):
            assert abs(field - 100 * value) <= 0.5 + 1e-9
        speed = 100 * math.hypot(*velocity[:2])
        assert abs(message.vel - speed) <= 0.5 + 1e-9
        if message.vel == 0:
            assert message.cog == 65535  # unknown: who stands has no course
        else:
            assert 0 <= message.cog < 36000
            # The direction whose tangent is east over north, to half a hundredth of a degree.
            off = math.radians(message.cog / 100.0) - math.atan2(velocity[1], velocity[0])
            assert abs(math.sin(0.5 * off)) <= math.radians(0.005) / 2 + 1e-12

    @pytest.mark.parametrize(
        ("velocity", "degrees"), [((1, 0), 0), ((0, 1), 90), ((-1, 0), 180), ((0, -1), 270), ((1, -1e-9), 0)]
    )
    def test_course_runs_clockwise_from_north(self, velocity: tuple[float, float], degrees: int) -> None:
        assert self.encode([*velocity, 0.0]).cog == 100 * degrees

    @pytest.mark.parametrize("speed", [400.0, 1e6, 1e300])
    def test_velocity_beyond_the_fields_is_held_at_their_ends(self, speed: float) -> None:
        message = self.encode([speed, -speed, speed])
        assert (message.vn, message.ve, message.vd) == (32767, -32767, 32767)
        assert message.vel <= 65534  # 65535 would say: unknown
        assert message.cog == 31500

    def test_speed_beyond_its_field_does_not_read_as_unknown(self) -> None:
        assert self.encode([600.0, 600.0, 0.0]).vel == 65534

    @pytest.mark.parametrize("sign", [-1.0, 1.0])
    @pytest.mark.parametrize("far", [3e6, 1e300])
    def test_a_place_beyond_the_fields_is_held_at_their_ends(self, sign: float, far: float) -> None:
        message = self.encode([0.0] * 3, (sign * far, sign * far, sign * far))
        assert (message.lat, message.lon, message.alt) == (sign * INT32_MAX,) * 3


class TestCommand:
    @settings(max_examples=100)
    @given(times_ns, fractions)
    def test_a_command_comes_back_within_the_resolution_of_float32(self, t_ns: int, parts: tuple[float, ...]) -> None:
        tau = np.array(parts) * SCALE
        payload = mapping.encode_command(ActuatorCommand(t_ns, tau, True), SCALE, lockstep=True)
        command = mapping.decode_command(on_the_wire(mapping.COMMAND, payload), SCALE)
        assert command is not None
        assert (command.t_ns, command.armed) == (t_ns // 1000 * 1000, True)
        for sent, came, scale in zip(tau, command.tau, SCALE, strict=True):
            assert abs(came - sent) <= abs(sent) * (HALF_STEP + 2.0**-51) + scale * 1e-45

    @settings(max_examples=100)
    @given(fractions, st.sampled_from(SCALE.tolist()))
    def test_the_compiled_mapping_is_the_wire_to_the_bit(self, parts: tuple[float, ...], scale: float) -> None:
        tau = [part * scale for part in parts]
        straight = [mapping.command_to_wire(value, scale) for value in tau]
        assert bits(straight) == bits([float32(value / scale) for value in tau])
        payload = mapping.encode_command(ActuatorCommand(0, np.array(tau), True), np.full(6, scale), lockstep=True)
        assert bits(parsed(mapping.COMMAND, payload).controls[:6]) == bits(straight)
        command = mapping.decode_command(payload, np.full(6, scale))
        assert command is not None
        assert bits(command.tau) == bits([mapping.command_from_wire(value, scale) for value in straight])
        assert bits(command.tau) == bits([value * scale for value in straight])

    @pytest.mark.parametrize(("lockstep", "flags"), [(True, 1), (False, 0)])
    @pytest.mark.parametrize("armed", [True, False])
    def test_flags_and_mode_say_lockstep_and_armed(self, lockstep: bool, flags: int, armed: bool) -> None:
        command = ActuatorCommand(9_000_000, SCALE, armed)
        message = parsed(mapping.COMMAND, mapping.encode_command(command, SCALE, lockstep=lockstep))
        assert message.flags == flags
        assert bool(message.mode & 0x80) == armed
        assert message.mode & 0x20  # hardware in the loop
        assert message.controls[:6] == [1.0 if armed else 0.0] * 6
        assert message.controls[6:] == [0.0] * 10

    @pytest.mark.parametrize("value", [0.01, *NOT_FINITE])
    def test_a_disarmed_command_is_zeros_whatever_the_law_says(self, value: float) -> None:
        command = ActuatorCommand(5_000_000, np.full(6, value), False)
        back = mapping.decode_command(mapping.encode_command(command, SCALE, lockstep=True), SCALE)
        assert back is not None
        assert bits(back.tau) == bits([0.0] * 6)
        assert not back.armed

    @pytest.mark.parametrize("t_us", [0, 1, 4000, 2**40])
    def test_the_time_of_the_sample_is_echoed(self, t_us: int) -> None:
        sample = mapping.decode_pose(mapping.encode_pose(t_us * 1000, np.zeros(6)))
        assert sample is not None
        command = ActuatorCommand(sample.t_ns, np.zeros(6), True)
        payload = mapping.encode_command(command, SCALE, lockstep=True)
        assert parsed(mapping.COMMAND, payload).time_usec == t_us

    @pytest.mark.parametrize("bad", NOT_FINITE)
    @pytest.mark.parametrize("place", range(6))
    def test_a_control_that_is_no_number_is_refused(self, place: int, bad: float) -> None:
        controls = [0.5] * 6
        assert mapping.decode_command(command_payload(controls), SCALE) is not None
        controls[place] = bad
        assert mapping.decode_command(command_payload(controls), SCALE) is None

    def test_infinities_that_cancel_are_refused_too(self) -> None:
        assert mapping.decode_command(command_payload([math.inf, -math.inf]), SCALE) is None

    @pytest.mark.parametrize("value", NOT_FINITE)
    def test_controls_that_are_not_ours_may_hold_anything(self, value: float) -> None:
        command = mapping.decode_command(command_payload([0.25] * 6 + [value] * 10), SCALE)
        assert command is not None
        assert command.tau == pytest.approx([0.25 * scale for scale in SCALE], rel=1e-15)

    @pytest.mark.parametrize("value", [*NOT_FINITE, 1e300])
    def test_a_law_that_gives_no_number_is_refused_at_the_other_end(self, value: float) -> None:
        command = ActuatorCommand(0, np.full(6, value), True)
        assert mapping.decode_command(mapping.encode_command(command, SCALE, lockstep=True), SCALE) is None

    @given(st.binary(max_size=120))
    @settings(max_examples=50)
    def test_any_bytes_decode_to_a_finite_command_or_none(self, payload: bytes) -> None:
        command = mapping.decode_command(payload, SCALE)
        assert command is None or np.isfinite(command.tau).all()


class TestHeartbeat:
    @pytest.mark.parametrize("armed", [True, False])
    @pytest.mark.parametrize("ending", [True, False])
    def test_the_controller_is_a_flapping_wing_with_hil_on(self, armed: bool, ending: bool) -> None:
        payload = mapping.encode_controller_heartbeat(armed=armed, ending=ending)
        message = parsed(mapping.HEARTBEAT, payload)
        assert (message.type, message.autopilot) == (16, 0)  # FLAPPING_WING, GENERIC
        assert message.base_mode == (0x80 | 0x20 if armed else 0x20)
        assert message.system_status == (7 if ending else 4 if armed else 3)  # POWEROFF, ACTIVE, STANDBY
        assert message.mavlink_version == 3
        assert mapping.heartbeat_is_armed(payload) == armed
        assert mapping.heartbeat_is_ending(payload) == ending

    @pytest.mark.parametrize("ending", [True, False])
    def test_the_emulator_is_no_autopilot_and_never_armed(self, ending: bool) -> None:
        payload = mapping.encode_emulator_heartbeat(ending=ending)
        message = parsed(mapping.HEARTBEAT, payload)
        assert (message.type, message.autopilot, message.base_mode) == (0, 8, 0)  # GENERIC, INVALID
        assert not mapping.heartbeat_is_armed(payload)
        assert mapping.heartbeat_is_ending(payload) == ending

    @pytest.mark.parametrize("mode", [0x80, 0xFF, 0x81, 0x7F, 0x00])
    def test_only_one_bit_of_the_mode_says_armed(self, mode: int) -> None:
        payload = layout("HEARTBEAT").pack_fields(base_mode=mode, custom_mode=0x80808080, type=128)
        assert mapping.heartbeat_is_armed(payload) == (mode >= 0x80)


class TestVersion:
    @given(st.binary(min_size=8, max_size=8))
    @settings(max_examples=30)
    def test_the_eight_bytes_of_the_scenario_arrive(self, digest: bytes) -> None:
        payload = mapping.encode_version(digest)
        assert bytes(parsed(mapping.VERSION, payload).flight_custom_version) == digest
        assert mapping.decode_version(on_the_wire(mapping.VERSION, payload)) == digest

    def test_mavlink_2_is_a_capability(self) -> None:
        message = parsed(mapping.VERSION, mapping.encode_version(bytes(8)))
        assert message.capabilities & 8192

    def test_a_digest_that_does_not_fit_is_refused(self) -> None:
        with pytest.raises(struct.error):
            mapping.encode_version(bytes(9))


class TestReference:
    def test_the_position_target_holds_all_three_derivatives(self) -> None:
        q, q_dot, q_ddot = (np.array([number + 0.1 * axis for axis in range(6)]) for number in (1, 2, 3))
        payload = mapping.encode_position_target(2_345_999_999, q, q_dot, q_ddot)
        message = parsed(mapping.POSITION_TARGET, payload)
        assert message.time_boot_ms == 2345
        assert (message.coordinate_frame, message.type_mask) == (1, 0)  # LOCAL_NED, nothing ignored
        fields = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
        expected = [1.0, 1.1, 1.2, 2.0, 2.1, 2.2, 3.0, 3.1, 3.2, 1.5, 2.5]
        assert [getattr(message, field) for field in fields] == pytest.approx(expected, rel=2 * HALF_STEP)

    @settings(max_examples=30)
    @given(poses)
    def test_the_attitude_target_is_the_attitude_of_a_pose(self, pose: tuple[float, ...]) -> None:
        target = parsed(mapping.ATTITUDE_TARGET, mapping.encode_attitude_target(7_000_000, np.array(pose)))
        as_pose = parsed(mapping.POSE, mapping.encode_pose(0, np.array(pose)))
        assert target.time_boot_ms == 7
        assert target.q == as_pose.q
        # Ignore the three body rates (1, 2, 4) and the thrust (64), but not the attitude (128).
        assert target.type_mask == 1 + 2 + 4 + 64


def test_decoders_take_any_length_of_payload() -> None:
    # A foreign sender may cut a payload anywhere, or fill it with what its newer dialect has.
    payload = random.Random(1).randbytes(255)
    for length in range(256):
        for decode in (
            mapping.decode_pose,
            mapping.decode_tick_time_ns,
            mapping.tick_sensor_id,
            mapping.heartbeat_is_armed,
            mapping.heartbeat_is_ending,
            mapping.decode_version,
        ):
            decode(payload[:length])
        mapping.decode_command(payload[:length], SCALE)
