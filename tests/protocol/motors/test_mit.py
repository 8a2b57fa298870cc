"""MIT: our bytes against our DBC, every raw number there and back, and a motor library's words to our drives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.can_frame import CanFrame
from protocol.errors import ScenarioError
from protocol.motors import mit as motor_mit
from protocol.motors.mit import ENTER, EXIT, ZERO, from_raw, pack_command, to_raw, unpack_command
from protocol.motors.motor_protocol import Action, Cause, Fault, Order, Reading
from protocol.scenario import Motor
from tests.contracts.motor_protocol_contract import MotorProtocolContract, orders_of
from tests.dbc import our_dbc

OURS = our_dbc("mit")
MOTOR = Motor(first_node_id=1)
RAW12 = st.integers(0, 0xFFF)
RAW16 = st.integers(0, 0xFFFF)


class TestContract(MotorProtocolContract):
    name = "mit"
    resolution = 18.0 / 4095 / 16.0


class TestContractWithShortReplies(MotorProtocolContract):
    """The reply of 6 bytes has neither temperature nor error."""

    name = "mit"
    resolution = 18.0 / 4095 / 16.0

    def test_what_drives_say_reaches_the_host(self) -> None:
        for length, named in ((5, False), (6, True)):
            motor = Motor(mit_reply_bytes=length)  # type: ignore[arg-type]
            host, drive = self.ends(motor)
            orders = orders_of(drive, host.command(np.zeros(6)))
            replies = [frame for order in orders for frame in drive.reply(order, Reading(torque=0.5, position=-1.0))]
            assert {len(reply.data) for reply in replies} == {length}
            heard = [status for reply in replies for status in host.decode(reply)]  # type: ignore[union-attr]
            assert [status.axis for status in heard] == [0, 1, 2, 3, 4, 5], named
            assert all(status.torque == pytest.approx(0.5, abs=3e-4) for status in heard)
            assert all(status.position == pytest.approx(-1.0, abs=2e-4) for status in heard)
            assert all(status.temperature_celsius is None for status in heard)


@given(RAW16, RAW12, RAW12, RAW12, RAW12)
def test_a_command_is_laid_out_as_the_dbc_says(position: int, velocity: int, kp: int, kd: int, torque: int) -> None:
    data = pack_command(position, velocity, kp, kd, torque)
    values = {"Position": position, "Velocity": velocity, "Kp": kp, "Kd": kd, "Torque": torque}
    assert data == OURS.encode_message("Command", values)
    assert unpack_command(data) == (position, velocity, kp, kd, torque)


@pytest.mark.parametrize(
    ("limit", "full"), [(12.5, 0xFFFF), (95.5, 0xFFFF), (50.0, 0xFFF), (18.0, 0xFFF), (5.0, 0xFFF)]
)
def test_every_raw_number_comes_back(limit: float, full: int) -> None:
    assert all(to_raw(from_raw(raw, -limit, limit, full), -limit, limit, full) == raw for raw in range(full + 1))


@given(st.floats(-18.0, 18.0))
def test_every_value_comes_back_within_half_a_step(value: float) -> None:
    assert abs(from_raw(to_raw(value, -18.0, 18.0, 0xFFF), -18.0, 18.0, 0xFFF) - value) <= 18.0 / 4095 * 1.0001


@given(st.floats(-12.5, 12.5), st.floats(-50.0, 50.0), st.floats(-1.0, 1.0), st.floats(-40.0, 200.0))
def test_a_reply_is_laid_out_as_the_dbc_says(
    position: float, velocity: float, torque: float, temperature: float
) -> None:
    reading = Reading(position, velocity, torque=torque, temperature_celsius=temperature, faults=Fault.OVER_TEMPERATURE)
    (reply,) = motor_mit.Drive(MOTOR).reply(Order(Action.TORQUE, 2), reading)
    values = OURS.decode_message("Reply", reply.data)
    assert reply.can_id == 0
    assert values["Drive_Id"] == 3
    assert from_raw(int(values["Position"]), -12.5, 12.5, 0xFFFF) == pytest.approx(position, abs=12.51 / 65535)
    assert from_raw(int(values["Velocity"]), -50.0, 50.0, 0xFFF) == pytest.approx(velocity, abs=50.01 / 4095)
    assert from_raw(int(values["Torque"]), -18.0, 18.0, 0xFFF) / 16.0 == pytest.approx(torque, abs=18.01 / 4095 / 16)
    assert values["Temperature"] == round(temperature)
    assert values["Error"] == motor_mit.OVER_TEMPERATURE
    assert OURS.encode_message("Reply", values) == reply.data


def test_the_special_frames_are_those_of_the_manual() -> None:
    drive = motor_mit.Drive(MOTOR)
    assert orders_of(drive, [CanFrame(1, b"\xff" * 7 + b"\xfc")]) == [Order(Action.ENABLE, 0)]
    leaving = orders_of(drive, [CanFrame(6, b"\xff" * 7 + b"\xfd")])
    assert [order.action for order in leaving] == [Action.DISABLE, Action.CLEAR]
    assert [order.action for order in orders_of(drive, [CanFrame(6, b"\xff" * 7 + b"\xfe")])] == [Action.NOTHING]


@pytest.mark.parametrize("data", [ENTER, EXIT, ZERO, pack_command(0x8000, 0x800, 0, 0, 0x800)])
def test_each_frame_to_a_drive_has_one_reply(data: bytes) -> None:
    drive = motor_mit.Drive(MOTOR)
    replies = [reply for order in orders_of(drive, [CanFrame(2, data)]) for reply in drive.reply(order, Reading())]
    assert len(replies) == 1


@pytest.mark.parametrize(
    ("frame", "cause"),
    [
        (CanFrame(1, b"\0" * 7), Cause.SHORT),
        (CanFrame(7, b"\0" * 8), Cause.FOREIGN),
        (CanFrame(0, b"\0" * 8), Cause.FOREIGN),
        (CanFrame(1, b"\0" * 8, extended=True), Cause.FOREIGN),
        (CanFrame(1, b"", remote=True), Cause.UNKNOWN),
        (CanFrame(1, pack_command(0x8000, 0x800, 100, 0, 0x800)), Cause.UNKNOWN),  # a position loop
    ],
)
def test_what_a_drive_does_not_take_has_a_cause(frame: CanFrame, cause: Cause) -> None:
    assert motor_mit.Drive(MOTOR).decode(frame) is cause


def test_a_full_scale_that_the_frames_cannot_carry_is_refused() -> None:
    with pytest.raises(ScenarioError, match="mit_torque_range"):
        motor_mit.Host(Motor(full_scale_nm=20.0))


class _Wire:
    """What the library takes for its socket: frames to a drive, its reply back."""

    def __init__(self, drive: motor_mit.Drive, reading: Reading) -> None:
        self.drive, self.reading = drive, reading
        self.heard: list[Order] = []
        self._replies: list[CanFrame] = []

    def send(self, packed: bytes) -> None:
        can_id, length = int.from_bytes(packed[:4], "little"), packed[4]
        orders = orders_of(self.drive, [CanFrame(can_id, packed[8 : 8 + length])])
        self.heard += orders
        self._replies += [reply for order in orders for reply in self.drive.reply(order, self.reading)]

    def recvfrom(self, _size: int) -> tuple[bytes, None]:
        reply = self._replies.pop(0)
        return reply.can_id.to_bytes(4, "little") + bytes((len(reply.data), 0, 0, 0)) + reply.data[:6], None


def test_a_motor_library_that_is_not_ours_drives_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """mini-cheetah-motor-driver-socketcan, its socket replaced: AK80-9, +-12.5 rad, +-25.64 rad/s, +-18 N m."""
    from motor_driver import canmotorlib

    motor = Motor(first_node_id=1, mit_velocity_range=25.64, mit_reply_bytes=6)
    wire = _Wire(motor_mit.Drive(motor), Reading(position=0.75, velocity=-3.0, torque=0.25))
    monkeypatch.setattr(canmotorlib.CanMotorController, "can_socket_declared", True)
    monkeypatch.setattr(canmotorlib.CanMotorController, "motor_socket", wire)
    monkeypatch.setattr(canmotorlib, "set_zero_sleep", 0.0)
    theirs = canmotorlib.CanMotorController(motor_id=2, motor_type="AK80_9_V2")
    assert theirs.enable_motor() is not None
    position, velocity, torque = theirs.send_rad_command(0.0, 0.0, 0.0, 0.0, 9.0)
    assert position == pytest.approx(0.75, abs=25.0 / 65535)
    assert velocity == pytest.approx(-3.0, abs=51.28 / 4095)
    assert torque == pytest.approx(0.25 * 16.0, abs=36.0 / 4095)
    assert theirs.disable_motor() is not None
    assert [order.action for order in wire.heard] == [
        *(Action.NOTHING, Action.ENABLE, Action.TORQUE, Action.TORQUE, Action.DISABLE, Action.CLEAR),
    ]
    assert all(order.axis == 1 for order in wire.heard)
    assert wire.heard[2].torque == pytest.approx(9.0 / 16.0, abs=36.0 / 4095 / 16.0)
