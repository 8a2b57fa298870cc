"""ODrive: our bytes against our DBC, and our drives against the DBC that is published for firmware 0.6.10."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.can_frame import CanFrame
from protocol.motors import odrive as motor_odrive
from protocol.motors.motor_protocol import Action, Cause, Fault, Order, Reading
from protocol.scenario import Motor
from tests.contracts.motor_protocol_contract import MotorProtocolContract, orders_of
from tests.dbc import our_dbc, published_odrive_dbc

OURS, THEIRS = our_dbc("odrive"), published_odrive_dbc()
MOTOR = Motor(first_node_id=3)
READING = Reading(
    position=0.5, velocity=-2.0, target=0.25, torque=0.125, temperature_celsius=55.5, enabled=True, faults=Fault(0)
)


class TestContract(MotorProtocolContract):
    name = "odrive"
    resolution = 1e-7


@given(st.lists(st.floats(-1.0, 1.0, width=32), min_size=6, max_size=6))
def test_torque_bytes_are_cantools(torques: list[float]) -> None:
    for axis, frame in enumerate(motor_odrive.Host(MOTOR).command(np.array(torques))):
        assert frame.can_id == (3 + axis) << 5 | 0x0E
        assert frame.data == OURS.encode_message("Set_Input_Torque", {"Input_Torque": 16.0 * torques[axis]})


def test_every_reading_is_laid_out_as_our_dbc_says() -> None:
    drive = motor_odrive.Drive(MOTOR)
    frames = {frame.can_id & 0x1F: frame for frame in drive.cyclic(0, [READING] * 6)}
    amperes = 16.0 / MOTOR.torque_constant
    expected = {
        "Heartbeat": {"Axis_Error": 0, "Axis_State": 8, "Procedure_Result": 0, "Trajectory_Done_Flag": 0},
        "Get_Encoder_Estimates": {"Pos_Estimate": 0.5 / math.tau, "Vel_Estimate": -2.0 / math.tau},
        "Get_Iq": {"Iq_Setpoint": 0.25 * amperes, "Iq_Measured": 0.125 * amperes},
        "Get_Temperature": {"FET_Temperature": 55.5, "Motor_Temperature": 55.5},
        "Get_Bus_Voltage_Current": {"Bus_Voltage": 24.0, "Bus_Current": 0.125 * amperes},
    }
    assert len(frames) == len(expected)
    for name, values in expected.items():
        message = OURS.get_message_by_name(name)
        assert frames[message.frame_id].data == message.encode(values), name


def test_our_dbc_is_the_published_one_where_it_speaks() -> None:
    """Identifiers, places and sizes of every signal; they leave the length of a torque frame at 8, and floats unmarked."""
    for message in OURS.messages:
        theirs = THEIRS.get_message_by_name(f"Axis0_{message.name}")
        assert theirs.frame_id == message.frame_id
        assert message.length <= theirs.length
        places = {signal.name: (signal.start, signal.length, signal.byte_order) for signal in theirs.signals}
        assert {s.name: (s.start, s.length, s.byte_order) for s in message.signals} == places


def test_a_drive_obeys_frames_made_from_the_published_dbc() -> None:
    drive = motor_odrive.Drive(Motor(first_node_id=1))

    def say(name: str, **values: object) -> list[Order]:
        message = THEIRS.get_message_by_name(name)
        return orders_of(drive, [CanFrame(message.frame_id, message.encode(values, strict=False))])

    assert say("Axis1_Set_Controller_Mode", Control_Mode=1, Input_Mode=1) == [Order(Action.NOTHING, 0)]
    assert say("Axis1_Set_Axis_State", Axis_Requested_State="CLOSED_LOOP_CONTROL") == [Order(Action.ENABLE, 0)]
    assert say("Axis6_Set_Axis_State", Axis_Requested_State="IDLE") == [Order(Action.DISABLE, 5)]
    assert say("Axis3_Set_Input_Torque", Input_Torque=-8.0) == [Order(Action.TORQUE, 2, -0.5)]
    assert say("Axis3_Clear_Errors", Identify=0) == [Order(Action.CLEAR, 2)]
    assert say("Axis4_Estop") == [Order(Action.ESTOP, 3)]


@pytest.mark.parametrize(
    ("fault", "name"),
    [
        (Fault.WATCHDOG, "WATCHDOG_TIMER_EXPIRED"),
        (Fault.OVER_TEMPERATURE, "MOTOR_OVER_TEMP"),
        (Fault.ESTOP, "ESTOP_REQUESTED"),
    ],
)
def test_errors_have_the_names_that_the_published_dbc_gives_them(fault: Fault, name: str) -> None:
    drive = motor_odrive.Drive(Motor(first_node_id=1))
    (frame,) = drive.reply(Order(Action.ASK, 0, detail=0x03), READING._replace(faults=fault))
    assert THEIRS.decode_message(frame.can_id, frame.data) == {"Active_Errors": name, "Disarm_Reason": name}
    heartbeat = drive.cyclic(0, [READING._replace(faults=fault, enabled=False)] * 6)[0]
    seen = THEIRS.decode_message(heartbeat.can_id, heartbeat.data)
    assert (seen["Axis_Error"], seen["Axis_State"]) == (name, "IDLE")


def test_readings_are_asked_for_by_remote_frames() -> None:
    drive = motor_odrive.Drive(MOTOR)
    for message in (0x01, 0x03, 0x09, 0x14, 0x15, 0x17):
        (order,) = orders_of(drive, [CanFrame(4 << 5 | message, remote=True)])
        (reply,) = drive.reply(order, READING)
        assert reply.can_id == 4 << 5 | message
        assert len(reply.data) == 8
    assert drive.decode(CanFrame(4 << 5 | 0x0E, remote=True)) is Cause.UNKNOWN
    assert drive.reply(Order(Action.TORQUE, 1, 0.5), READING) == ()  # commands have no reply


def test_cyclic_messages_keep_their_periods() -> None:
    drive = motor_odrive.Drive(MOTOR)
    counts: dict[int, int] = {}
    for tick in range(1000):
        for frame in drive.cyclic(tick * 1_000_000, [READING] * 6):
            counts[frame.can_id & 0x1F] = counts.get(frame.can_id & 0x1F, 0) + 1
    assert counts == {0x01: 60, 0x09: 600, 0x14: 120, 0x15: 120, 0x17: 120}


@pytest.mark.parametrize(
    ("frame", "cause"),
    [
        (CanFrame(3 << 5 | 0x0E, b"\0" * 3), Cause.SHORT),
        (CanFrame(3 << 5 | 0x0E, b"\x00\x00\xc0\x7f"), Cause.MALFORMED),  # NaN
        (CanFrame(3 << 5 | 0x0E, b"\x00\x00\x80\x7f"), Cause.MALFORMED),  # infinity
        (CanFrame(3 << 5 | 0x0C, b"\0" * 8), Cause.UNKNOWN),  # Set_Input_Pos: no position loop here
        (CanFrame(3 << 5 | 0x07, b"\x03\0\0\0"), Cause.UNKNOWN),  # a calibration
        (CanFrame(2 << 5 | 0x0E, b"\0" * 4), Cause.FOREIGN),
        (CanFrame(9 << 5 | 0x0E, b"\0" * 4), Cause.FOREIGN),
        (CanFrame(3 << 5 | 0x0E, b"\0" * 4, extended=True), Cause.FOREIGN),
    ],
)
def test_what_a_drive_does_not_take_has_a_cause(frame: CanFrame, cause: Cause) -> None:
    assert motor_odrive.Drive(MOTOR).decode(frame) is cause
