"""Equation (1) against its dense matrices as the paper prints them, and what a free rigid body must conserve."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from plant_emulator.plant.integrate import runge_kutta_step
from plant_emulator.plant.rigid_body import acceleration, body_parameters, body_rates
from protocol.messages import FloatArray
from protocol.scenario import ZERO6, Body, Disturbance

Matrix: TypeAlias = npt.NDArray[Any]
"""Real or complex."""

BODY = Body(mass=0.0056, inertia=(5.75e-7, 5.76e-7, 9.91e-7), gravity=9.81)
UNEVEN = Body(mass=0.3, inertia=(2e-4, 5e-4, 6e-4), gravity=3.7)
CALM = Disturbance(amplitude=ZERO6, frequency_rad_s=0.0)

modest = settings(deadline=None, max_examples=100)
attitudes = st.tuples(st.floats(-7.0, 7.0), st.floats(-1.3, 1.3), st.floats(-7.0, 7.0)).map(np.array)
rates = arrays(float, 3, elements=st.floats(-20.0, 20.0))
wrenches = arrays(float, 6, elements=st.floats(-30.0, 30.0))


def matrix_t(q_r: Matrix) -> Matrix:
    alpha, beta, _ = q_r
    sa, ca, sb, cb = np.sin(alpha), np.cos(alpha), np.sin(beta), np.cos(beta)
    return np.array([[1.0, 0.0, -sb], [0.0, ca, cb * sa], [0.0, -sa, cb * ca]])


def matrix_t_dot(q_r: FloatArray, q_r_dot: FloatArray) -> Matrix:
    """dT/dt along q_r' by a complex step, which is exact to rounding: no derivative is written out by hand."""
    step = 1e-30
    derivative: Matrix = matrix_t(q_r + 1j * step * q_r_dot).imag / step
    return derivative


def rotation_to_inertial(q_r: FloatArray) -> Matrix:
    """R^IB = (C^B2 C^21 C^1I)^-1."""
    (sa, sb, sg), (ca, cb, cg) = np.sin(q_r), np.cos(q_r)
    c_b2 = np.array([[1, 0, 0], [0, ca, sa], [0, -sa, ca]])
    c_21 = np.array([[cb, 0, -sb], [0, 1, 0], [sb, 0, cb]])
    c_1i = np.array([[cg, sg, 0], [-sg, cg, 0], [0, 0, 1]])
    inverse: Matrix = np.linalg.inv(c_b2 @ c_21 @ c_1i)
    return inverse


def cross_matrix(w: FloatArray) -> Matrix:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def dense_acceleration(body: Body, q_r: FloatArray, q_r_dot: FloatArray, u: FloatArray) -> Matrix:
    """q'' = M^-1 (F - C q' - G)."""
    zero = np.zeros((3, 3))
    inertia, t = np.diag(body.inertia), matrix_t(q_r)
    ell = cross_matrix(t @ q_r_dot) @ inertia @ t  # L q_r' = (T q_r') x Ip (T q_r')
    m = np.block([[body.mass * np.eye(3), zero], [zero, inertia @ t]])
    c = np.block([[zero, zero], [zero, inertia @ matrix_t_dot(q_r, q_r_dot) + ell]])
    g = np.array([0.0, 0.0, -body.mass * body.gravity, 0.0, 0.0, 0.0])
    f = np.block([[rotation_to_inertial(q_r), zero], [zero, np.eye(3)]]) @ u
    # The velocity does not matter: its columns of C are zero.
    q_ddot: Matrix = np.linalg.solve(m, f - c @ np.concatenate(([4.0, 5.0, 6.0], q_r_dot)) - g)
    return q_ddot


def inertias(body: Body) -> FloatArray:
    return np.array((body.mass,) * 3 + body.inertia)


@pytest.mark.parametrize("body", [BODY, UNEVEN])
@modest
@given(q_r=attitudes, q_r_dot=rates, specific=wrenches)
def test_the_acceleration_solves_equation_1(
    body: Body, q_r: FloatArray, q_r_dot: FloatArray, specific: FloatArray
) -> None:
    expected = dense_acceleration(body, q_r, q_r_dot, specific * inertias(body))
    (alpha, beta, gamma), (alpha_dot, beta_dot, gamma_dot) = q_r.tolist(), q_r_dot.tolist()
    parameters = body_parameters(body, CALM)
    came = acceleration(alpha, beta, gamma, alpha_dot, beta_dot, gamma_dot, tuple(specific), parameters)
    scale = 1.0 + np.abs(specific).max() + np.square(q_r_dot).max()
    assert came == pytest.approx(expected, rel=1e-12, abs=1e-12 * scale)


def test_a_wrench_and_a_disturbance_become_specific_by_mass_and_inertia() -> None:
    amplitude = (0.1, 0.2, 0.3, 1e-4, 2e-4, 3e-4)
    parameters = body_parameters(UNEVEN, Disturbance(amplitude=amplitude, frequency_rad_s=2.0))
    assert parameters.specific * inertias(UNEVEN) == pytest.approx(np.ones(6), rel=1e-15)
    assert parameters.disturbance == pytest.approx(np.array(amplitude) / inertias(UNEVEN), rel=1e-15)
    assert parameters.disturbance_frequency == 2.0


@modest
@given(q_r=attitudes, q_r_dot=rates)
def test_body_rates_are_t_times_the_angle_rates(q_r: FloatArray, q_r_dot: FloatArray) -> None:
    motion = np.concatenate((np.full(3, 7.0), q_r, np.full(3, 8.0), q_r_dot))
    assert body_rates(motion) == pytest.approx(matrix_t(q_r) @ q_r_dot, rel=1e-13, abs=1e-13)


def fly(body: Body, motion: FloatArray, duration_s: float, step_s: float = 2.5e-4) -> FloatArray:
    """Where `motion` gets to without any wrench."""
    motion = motion.copy()
    parameters = body_parameters(body, CALM)
    for k in range(round(duration_s / step_s)):
        runge_kutta_step(motion, np.zeros(6), k * step_s, step_s, parameters)
    return motion


def energy_and_momentum(body: Body, motion: FloatArray) -> FloatArray:
    w = matrix_t(motion[3:6]) @ motion[9:]
    spin = np.array(body.inertia) * w
    return np.concatenate(([0.5 * w @ spin], rotation_to_inertial(motion[3:6]) @ spin))


@pytest.mark.parametrize("body", [BODY, UNEVEN])
@pytest.mark.parametrize("q_r_dot", [(0.3, 0.4, 9.0), (8.0, 0.2, 0.5), (-2.0, 1.0, -6.0)])
def test_a_free_body_keeps_its_energy_and_its_angular_momentum(body: Body, q_r_dot: tuple[float, ...]) -> None:
    start = np.array([0.0] * 3 + [0.1, -0.1, 0.2] + [0.0] * 3 + list(q_r_dot))
    end = fly(body, start, 0.5)
    assert np.abs(end[3:6] - start[3:6]).max() > 0.5, "the body has to turn for the test to say something"
    before, after = energy_and_momentum(body, start), energy_and_momentum(body, end)
    assert after[0] == pytest.approx(before[0], rel=1e-10)
    assert after[1:] == pytest.approx(before[1:], rel=0.0, abs=1e-10 * float(np.linalg.norm(before[1:])))


@modest
@given(velocity=rates, q_r_dot=arrays(float, 3, elements=st.floats(-3.0, 3.0)))
def test_without_force_the_flight_is_ballistic(velocity: FloatArray, q_r_dot: FloatArray) -> None:
    start = np.concatenate(([1.0, 2.0, 3.0, 0.1, 0.2, 0.3], velocity, q_r_dot))
    end = fly(BODY, start, 0.1)
    fall = np.array([0.0, 0.0, 9.81])
    assert end[:3] == pytest.approx(start[:3] + velocity * 0.1 + 0.5 * fall * 0.1**2, rel=1e-12, abs=1e-12)
    assert end[6:9] == pytest.approx(velocity + fall * 0.1, rel=1e-12, abs=1e-12)
