"""The reference model's closed form against its differential equation, and the paper's numbers."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from controller.laws.reference import evaluate_reference, reference_parameters, reference_trajectory
from protocol.messages import FloatArray
from protocol.scenario import ZERO6, Reference, find_scenario, load_scenario

few = settings(deadline=None, max_examples=25)
T_END = 1.5

Axis = tuple[float, float, float, float, float, float, float]
"""A_d, B_d, C_d, amplitude, frequency, phase, initial."""


@st.composite
def axes(draw: st.DrawFn) -> Axis:
    """Over-, critically and underdamped, and a hair beside critical, where the closed form could cancel."""
    natural = draw(st.floats(0.5, 30.0))
    near = st.floats(-1e-6, 1e-6).map(lambda hair: 1.0 + hair)
    ratio = draw(st.one_of(st.floats(0.05, 0.95), st.just(1.0), near, st.floats(1.05, 4.0)))
    # Not so small that their squares vanish, for which scipy's error estimate divides zero by zero.
    swing = st.integers(-3000, 3000).map(lambda thousandths: 1e-3 * thousandths)
    return (
        2.0 * ratio * natural,
        natural**2,
        draw(swing),
        draw(swing),
        draw(st.floats(0.0, 10.0)),
        draw(swing),
        draw(swing),
    )


def reference_of(six: list[Axis]) -> Reference:
    damping, stiffness, gain, amplitude, frequency, phase, initial = zip(*six, strict=True)
    return Reference(
        A_d=damping,
        B_d=stiffness,
        C_d=gain,
        amplitude=amplitude,
        frequency_rad_s=frequency,
        phase_rad=phase,
        initial=initial,
    )


def evaluate(reference: Reference, t: float) -> FloatArray:
    """(3, 6): q_d, q_d', q_d''."""
    q, q_dot, q_ddot = np.full(6, np.nan), np.full(6, np.nan), np.full(6, np.nan)
    evaluate_reference(t, reference_parameters(reference), q, q_dot, q_ddot)
    return np.array((q, q_dot, q_ddot))


def solve_model(six: list[Axis], t: FloatArray) -> FloatArray:
    """(len(t), 3, 6) by DOP853 from the definition (12) with c(t) as in (32)."""
    damping, stiffness, gain, amplitude, frequency, phase, initial = np.array(six).T

    def acceleration(now: float, q: FloatArray, q_dot: FloatArray) -> FloatArray:
        result: FloatArray = -damping * q_dot - stiffness * q - gain * amplitude * np.sin(frequency * now + phase)
        return result

    def slope(now: float, state: FloatArray) -> FloatArray:
        return np.concatenate((state[6:], acceleration(now, state[:6], state[6:])))

    start = np.concatenate((initial, np.zeros(6)))
    y = solve_ivp(slope, (0.0, t[-1]), start, "DOP853", t_eval=t, rtol=1e-12, atol=1e-15).y.T
    return np.array([(s[:6], s[6:], acceleration(now, s[:6], s[6:])) for now, s in zip(t, y, strict=True)])


@few
@given(st.lists(axes(), min_size=6, max_size=6))
@example([(40.0, 400.0, 2.0, 1.0, 3.0, 0.5, 1.0)] * 6)
@example([(108.0, 324.0, -0.003, 0.007, 3.25, 0.001, -0.089)] * 6)
def test_the_closed_form_solves_the_model(six: list[Axis]) -> None:
    t = np.linspace(0.0, T_END, 7)
    expected = solve_model(six, t)
    came = np.array([evaluate(reference_of(six), now) for now in t.tolist()])
    scale = np.abs(expected).max(axis=(0, 2))[None, :, None] + 1e-3
    # Not closer: a fast, overdamped model costs the solver the last digits (seen: 1.5e-8).
    assert (came / scale) == pytest.approx(expected / scale, rel=0.0, abs=1e-7)


@few
@given(st.lists(axes(), min_size=6, max_size=6), st.floats(0.0, T_END))
def test_the_derivatives_are_those_of_what_they_derive(six: list[Axis], t: float) -> None:
    """The integral of each over a short time, by a quadrature that is exact to rounding, is what its primitive changed."""
    reference, length = reference_of(six), 0.05
    nodes, weights = np.polynomial.legendre.leggauss(24)
    came = np.array([evaluate(reference, t + 0.5 * length * (1.0 + node)) for node in nodes.tolist()])
    integral = 0.5 * length * np.tensordot(weights, came, axes=1)
    change = evaluate(reference, t + length) - evaluate(reference, t)
    scale = np.abs(came).max(axis=(0, 2)) + 1e-3
    assert integral[1] == pytest.approx(change[0], rel=0.0, abs=1e-8 * scale[:2].max())
    assert integral[2] == pytest.approx(change[1], rel=0.0, abs=1e-8 * scale[1:].max())


@few
@given(st.lists(axes(), min_size=6, max_size=6))
def test_it_starts_at_its_initial_value_at_rest(six: list[Axis]) -> None:
    came = evaluate(reference_of(six), 0.0)
    scale = 1.0 + np.abs(np.array(six)).max()
    assert came[0] == pytest.approx([axis[6] for axis in six], rel=0.0, abs=1e-14 * scale)
    assert came[1] == pytest.approx([0.0] * 6, rel=0.0, abs=1e-13 * scale)


BASE: Axis = (20.0, 300.0, 2.0, 1.0, 3.0, 0.5, 1.0)
ONE_OTHER_NUMBER = [(*BASE[:i], 1.5 * BASE[i], *BASE[i + 1 :]) for i in range(len(BASE))]


@few
@given(st.lists(st.sampled_from([BASE, *ONE_OTHER_NUMBER]), min_size=6, max_size=6), st.permutations(range(6)))
@example([BASE, ONE_OTHER_NUMBER[0], BASE, ONE_OTHER_NUMBER[1], BASE, ONE_OTHER_NUMBER[4]], range(6))
def test_an_axis_does_not_depend_on_its_neighbours(kinds: list[Axis], order: Sequence[int]) -> None:
    """Neighbours with the same model share what they can: never more than that."""
    together = evaluate(reference_of([kinds[kind] for kind in order]), 0.7)
    alone = [evaluate(reference_of([kind] * 6), 0.7) for kind in kinds]
    for axis, kind in enumerate(order):
        assert together[:, axis].tobytes() == alone[kind][:, 0].tobytes()


def test_any_time_can_be_asked_for_at_any_time() -> None:
    """Random access: a sample that was lost loses nothing."""
    reference = load_scenario(find_scenario("flapper")).reference
    count, period_ns = 500, 4_000_000
    trajectory = reference_trajectory(reference, count, period_ns)
    assert trajectory.shape == (count, 3, 6)
    for k in np.random.default_rng(1).permutation(count)[:100].tolist():
        assert evaluate(reference, k * period_ns * 1e-9).tobytes() == trajectory[k].tobytes()


def test_a_phase_moves_the_steady_swing_in_time() -> None:
    reference = load_scenario(find_scenario("paper")).reference
    phase = (0.3, -1.0, 2.0, 0.3, -1.0, 2.0)
    shifted = msgspec.structs.replace(reference, phase_rad=phase)
    t = 40.0  # the slowest pole, -1.6, has forgotten the start to 1e-28
    for axis in range(6):
        earlier = evaluate(reference, t + phase[axis] / reference.frequency_rad_s[axis])
        assert evaluate(shifted, t)[:, axis] == pytest.approx(earlier[:, axis], rel=1e-11, abs=1e-13)


def test_the_papers_command_is_shrunk_and_turned_round() -> None:
    """q_d swings +-12.55 cm for 100 cm and +-.313 rad for 2 rad, and more than a quarter period late by the model's sign."""
    reference = load_scenario(find_scenario("paper")).reference
    late = reference_trajectory(reference, 10_000, 1_000_000)[5_000:, 0]
    swing = np.abs(late).max(axis=0)
    assert swing[:3] == pytest.approx(np.full(3, 0.1255), abs=5e-5)
    assert swing[3:] == pytest.approx(np.full(3, 0.313), abs=5e-4)
    t = np.arange(5_000, 10_000) * 1e-3
    command = np.sin(np.outer(t, reference.frequency_rad_s))
    assert np.all(np.sum(command * late, axis=0) < 0.0)


@pytest.mark.parametrize(("axis", "slow", "fast"), [(0, -2.53, -197.0), (3, -1.605, -498.4)])
def test_the_papers_model_has_its_poles(axis: int, slow: float, fast: float) -> None:
    """Found from the free motion alone: four equidistant values of two exponentials give both (Prony)."""
    reference = load_scenario(find_scenario("paper")).reference
    free = msgspec.structs.replace(reference, amplitude=ZERO6, initial=(1.0,) * 6)
    step_ns = 4_000_000
    x = reference_trajectory(free, 4, step_ns)[:, 0, axis]
    total, product = np.linalg.solve([[x[1], -x[0]], [x[2], -x[1]]], x[2:])
    poles = np.sort(np.log(np.roots([1.0, -total, product])) / (step_ns * 1e-9))
    assert poles == pytest.approx([fast, slow], rel=3e-3)
