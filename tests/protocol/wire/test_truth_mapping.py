"""The true state on the wire, as pymavlink reads it: units, frames, and the ends of the fields."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from protocol.wire import truth_mapping as truth_map
from protocol.wire.codec import FrameWriter, Layout

# A vehicle 1 m north, 2 m east, 3 m up, that heads east (yaw 90 degrees) and flies north at 4 m/s: to its left.
MOTION = np.array([1.0, 2.0, -3.0, 0.0, 0.0, math.pi / 2, 4.0, 0.0, 0.0, 0.0, 0.0, 0.5])
RATES = np.array([0.1, 0.2, 0.5])
FORCE = np.array([9.80665, 0.0, -2 * 9.80665])
PLACE = (47.1, 8.2, 488.5)


def parsed(message: Layout, payload: bytes) -> Any:
    (read,) = common.MAVLink(None).parse_buffer(FrameWriter(1, 191).seal(message, payload))
    return read


def test_the_state_is_in_the_units_of_the_message() -> None:
    read = parsed(truth_map.STATE, truth_map.encode_state(1_234_567_000, MOTION, RATES, PLACE, FORCE))
    assert read.get_type() == "HIL_STATE_QUATERNION"
    assert read.time_usec == 1_234_567
    assert read.attitude_quaternion == pytest.approx([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], abs=1e-7)
    assert (read.rollspeed, read.pitchspeed, read.yawspeed) == pytest.approx((0.1, 0.2, 0.5))
    assert (read.lat, read.lon, read.alt) == (471_000_000, 82_000_000, 488_500)
    assert (read.vx, read.vy, read.vz) == (400, 0, 0)
    assert read.ind_airspeed == read.true_airspeed == 400
    assert (read.xacc, read.yacc, read.zacc) == (1000, 0, -2000)  # mG


def test_odometry_has_metres_and_a_body_velocity() -> None:
    read = parsed(truth_map.ODOMETRY, truth_map.encode_odometry(1_234_567_000, MOTION, RATES))
    assert read.time_usec == 1_234_567
    assert (read.frame_id, read.child_frame_id) == (common.MAV_FRAME_LOCAL_NED, common.MAV_FRAME_BODY_FRD)
    assert (read.x, read.y, read.z) == (1.0, 2.0, -3.0)
    assert read.q == pytest.approx([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], abs=1e-7)
    assert (read.vx, read.vy, read.vz) == pytest.approx((0.0, -4.0, 0.0), abs=1e-6)
    assert (read.rollspeed, read.pitchspeed, read.yawspeed) == pytest.approx((0.1, 0.2, 0.5))
    assert set(read.pose_covariance) == set(read.velocity_covariance) == {0.0}


@pytest.mark.parametrize("far", [1e6, 1e300, -1e300, math.inf])
def test_a_plant_far_away_is_no_reason_to_stop(far: float) -> None:
    motion = np.array([far] * 3 + [0.0] * 3 + [far] * 3 + [0.0] * 3)
    place = (far, far, far)
    state = parsed(truth_map.STATE, truth_map.encode_state(0, motion, RATES, place, np.full(3, far)))
    assert abs(state.vx) == 32767
    assert state.true_airspeed == 65535
    assert math.isfinite(parsed(truth_map.ODOMETRY, truth_map.encode_odometry(0, motion, np.full(3, far))).x)


def test_a_drives_speed_is_in_turns_a_minute() -> None:
    read = parsed(truth_map.RPM, truth_map.encode_rpm(5, -2.0 * math.pi))
    assert (read.index, read.frequency) == (5, -60.0)
