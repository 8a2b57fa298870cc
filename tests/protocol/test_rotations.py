"""Rotations against the paper's three matrices and against scipy, which use neither our formulas nor each other's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from protocol.messages import FloatArray
from protocol.rotations import (
    euler_from_quaternion,
    quaternion_from_euler,
    rotate_to_body,
    rotate_to_inertial,
    unwrap_angle,
    wrap_angle,
)

PI = math.pi
ROUNDING = 1e-14

half_turn = st.floats(-PI, PI)
any_angle = st.floats(-1e3, 1e3)
pitch = st.floats(-1.5, 1.5)
attitudes = st.tuples(any_angle, any_angle, any_angle)
vectors = st.tuples(*[st.floats(-100.0, 100.0)] * 3)


def paper_matrix(alpha: float, beta: float, gamma: float) -> FloatArray:
    """R^BI = C^B2 C^21 C^1I as printed in section II of the paper."""
    c_b2 = np.array(
        [[1, 0, 0], [0, math.cos(alpha), math.sin(alpha)], [0, -math.sin(alpha), math.cos(alpha)]], dtype=float
    )
    c_21 = np.array([[math.cos(beta), 0, -math.sin(beta)], [0, 1, 0], [math.sin(beta), 0, math.cos(beta)]], dtype=float)
    c_1i = np.array(
        [[math.cos(gamma), math.sin(gamma), 0], [-math.sin(gamma), math.cos(gamma), 0], [0, 0, 1]], dtype=float
    )
    product: FloatArray = c_b2 @ c_21 @ c_1i
    return product


def columns(rotate: object, attitude: tuple[float, float, float]) -> FloatArray:
    """The matrix of a rotation function, by what it does to the unit vectors."""
    assert callable(rotate)
    return np.array([rotate(*attitude, *unit) for unit in np.eye(3)]).T


class TestRotations:
    @settings(max_examples=100)
    @given(attitudes)
    def test_to_body_is_the_product_of_the_papers_matrices(self, attitude: tuple[float, float, float]) -> None:
        assert columns(rotate_to_body, attitude) == pytest.approx(paper_matrix(*attitude), abs=ROUNDING)

    @settings(max_examples=100)
    @given(attitudes)
    def test_to_inertial_is_scipys_rotation_z_y_x(self, attitude: tuple[float, float, float]) -> None:
        expected = Rotation.from_euler("ZYX", attitude[::-1]).as_matrix()
        # scipy goes by half angles: at 1000 rad an angle is only good to 1e-13.
        assert columns(rotate_to_inertial, attitude) == pytest.approx(expected, abs=1e-12)

    @settings(max_examples=60)
    @given(attitudes)
    def test_both_are_rotations_and_no_mirrors(self, attitude: tuple[float, float, float]) -> None:
        for rotate in (rotate_to_body, rotate_to_inertial):
            matrix = columns(rotate, attitude)
            assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=ROUNDING)
            assert np.linalg.det(matrix) == pytest.approx(1.0, abs=ROUNDING)

    @settings(max_examples=100)
    @given(attitudes, vectors)
    def test_one_undoes_the_other(
        self, attitude: tuple[float, float, float], vector: tuple[float, float, float]
    ) -> None:
        assert rotate_to_body(*attitude, *rotate_to_inertial(*attitude, *vector)) == pytest.approx(vector, abs=1e-12)
        assert rotate_to_inertial(*attitude, *rotate_to_body(*attitude, *vector)) == pytest.approx(vector, abs=1e-12)

    def test_the_signs_are_those_of_aviation(self) -> None:
        # Inertial: north, east, down; body: forward, right, down. Yawed by 90 degrees, forward is east; pitched up,
        # forward is up; rolled to the right, right is down.
        quarter = PI / 2
        assert rotate_to_inertial(0.0, 0.0, quarter, 1.0, 0.0, 0.0) == pytest.approx((0.0, 1.0, 0.0), abs=ROUNDING)
        assert rotate_to_inertial(0.0, quarter, 0.0, 1.0, 0.0, 0.0) == pytest.approx((0.0, 0.0, -1.0), abs=ROUNDING)
        assert rotate_to_inertial(quarter, 0.0, 0.0, 0.0, 1.0, 0.0) == pytest.approx((0.0, 0.0, 1.0), abs=ROUNDING)


class TestQuaternions:
    @settings(max_examples=150)
    @given(half_turn, pitch, half_turn)
    def test_euler_angles_come_back(self, alpha: float, beta: float, gamma: float) -> None:
        back = euler_from_quaternion(*quaternion_from_euler(alpha, beta, gamma))
        # Just below pi and just above -pi are one attitude.
        for sent, came in zip((alpha, beta, gamma), back, strict=True):
            assert abs(math.remainder(came - sent, 2 * PI)) <= 1e-13 / math.cos(1.5) ** 2
            assert abs(came) <= PI

    @settings(max_examples=100)
    @given(attitudes)
    def test_a_quaternion_is_scipys_with_the_scalar_first(self, attitude: tuple[float, float, float]) -> None:
        ours = np.array(quaternion_from_euler(*attitude))
        theirs = Rotation.from_euler("ZYX", attitude[::-1]).as_quat()[[3, 0, 1, 2]]
        assert ours @ ours == pytest.approx(1.0, abs=ROUNDING)
        # A quaternion and its negative are one rotation.
        assert abs(ours @ theirs) == pytest.approx(1.0, abs=1e-12)

    @settings(max_examples=100)
    @given(half_turn, pitch, half_turn, vectors)
    def test_a_quaternion_turns_body_vectors_into_inertial_ones(
        self, alpha: float, beta: float, gamma: float, vector: tuple[float, float, float]
    ) -> None:
        w, x, y, z = quaternion_from_euler(alpha, beta, gamma)
        expected = Rotation.from_quat([x, y, z, w]).apply(vector)
        assert rotate_to_inertial(alpha, beta, gamma, *vector) == pytest.approx(expected, abs=1e-12)

    @settings(max_examples=60)
    @given(half_turn, pitch, half_turn, st.floats(1e-3, 1e3) | st.floats(-1e3, -1e-3))
    def test_length_and_sign_of_a_quaternion_do_not_matter(
        self, alpha: float, beta: float, gamma: float, length: float
    ) -> None:
        quaternion = quaternion_from_euler(alpha, beta, gamma)
        plain = euler_from_quaternion(*quaternion)
        scaled = euler_from_quaternion(*(length * part for part in quaternion))
        for one, other in zip(plain, scaled, strict=True):
            assert abs(math.remainder(one - other, 2 * PI)) <= 1e-12

    @pytest.mark.parametrize("sign", [-1.0, 1.0])
    @pytest.mark.parametrize("off", [0.0, 1e-9, -1e-9])
    def test_straight_up_and_down_stays_a_number(self, sign: float, off: float) -> None:
        # The sine may be rounded to just above one.
        angles = euler_from_quaternion(*quaternion_from_euler(0.3, sign * (PI / 2 + off), 0.1))
        assert all(map(math.isfinite, angles))
        assert angles[1] == pytest.approx(sign * PI / 2, abs=1e-7)


class TestWrapping:
    @given(half_turn)
    @settings(max_examples=60)
    def test_an_angle_within_half_a_turn_keeps_its_bits(self, angle: float) -> None:
        assert wrap_angle(angle).hex() == angle.hex()

    @given(st.floats(-1e6, 1e6))
    @settings(max_examples=150)
    def test_a_wrapped_angle_is_within_half_a_turn_and_whole_turns_away(self, angle: float) -> None:
        wrapped = wrap_angle(angle)
        rounding = abs(angle) * 2.0**-51
        assert abs(wrapped) <= PI + rounding
        turns = (angle - wrapped) / (2 * PI)
        assert abs(turns - round(turns)) <= rounding + 1e-15

    @pytest.mark.parametrize(
        ("angle", "expected"),
        [(1.5 * PI, -0.5 * PI), (-1.5 * PI, 0.5 * PI), (2 * PI, 0.0), (-5 * PI, PI), (7.0, 7 - 2 * PI)],
    )
    def test_known_angles_wrap_to_known_ones(self, angle: float, expected: float) -> None:
        assert abs(math.remainder(wrap_angle(angle) - expected, 2 * PI)) <= 1e-14
        assert abs(wrap_angle(angle)) <= PI + 1e-14

    @given(half_turn, any_angle)
    @settings(max_examples=150)
    def test_an_unwrapped_angle_is_within_half_a_turn_of_the_last(self, angle: float, last: float) -> None:
        unwrapped = unwrap_angle(angle, last)
        assert abs(unwrapped - last) <= PI + 1e-12
        assert abs(math.remainder(unwrapped - angle, 2 * PI)) <= 1e-12

    @given(half_turn, st.floats(-2 * PI, 2 * PI))
    @settings(max_examples=100)
    def test_where_no_turn_is_needed_the_bits_stay(self, angle: float, last: float) -> None:
        assume(abs(angle - last) <= PI)
        assert unwrap_angle(angle, last).hex() == angle.hex()

    @given(st.floats(-10.0, 10.0), st.lists(st.floats(-3.0, 3.0), max_size=40))
    @settings(max_examples=60)
    def test_a_measured_path_is_followed_through_any_number_of_turns(self, start: float, steps: list[float]) -> None:
        """The sensor wraps each angle; unwrapping one after the other restores the path that was flown."""
        true = followed = start
        for step in steps:
            true += step
            followed = unwrap_angle(math.remainder(true, 2 * PI), followed)
            assert followed == pytest.approx(true, abs=1e-11)

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_what_is_no_angle_does_not_become_one(self, bad: float) -> None:
        assert not math.isfinite(wrap_angle(bad))
        assert not math.isfinite(unwrap_angle(bad, 0.0))
