"""The discrete matrices against the continuous systems they stand for, between samples as the two holds say."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import butter, lsim

from controller.laws.discretise import Estimator, butterworth, estimator, exponential, realise
from controller.laws.filters import Filters, StateFeedbackFilters
from controller.laws.state_space import ERROR, POSITION, REFERENCE_ACCELERATION, VELOCITY, Realisation
from protocol.errors import ScenarioError
from protocol.messages import FloatArray
from protocol.scenario import Scenario, find_scenario, load_scenario, replace_gains

ROOT_2 = math.sqrt(2.0)

few = settings(deadline=None, max_examples=15)
modest = settings(deadline=None, max_examples=40)
filter_times = st.floats(0.01, 0.5)
plain = st.integers(-1000, 1000).map(lambda thousandths: 1e-3 * thousandths)
"""Numbers whose squares do not vanish: scipy's error estimate divides zero by zero for those."""
periods = st.sampled_from([0.0005, 0.001, 0.004, 0.01])


@pytest.fixture(scope="module")
def flapper() -> Scenario:
    return load_scenario(find_scenario("flapper"))


def run(part: Estimator, m: FloatArray, tau: FloatArray, uhat0: float) -> FloatArray:
    """uhat_k for the samples m_k and the commands tau_k that act from sample k to k + 1."""
    w = part.start_m * m[0] + part.start_u * uhat0
    uhat = []
    for m_k, tau_k in zip(m.tolist(), tau.tolist(), strict=True):
        uhat.append(part.C @ w + part.D * m_k)
        w = part.A @ w + part.B * m_k + part.B_tau * tau_k
    return np.array(uhat)


@few
@given(
    T=filter_times, b=st.floats(0.5, 5.0), period=periods, uhat0=plain,
    q=arrays(float, 7, elements=plain), tau=arrays(float, 7, elements=plain),
)  # fmt: skip
def test_the_papers_estimator_is_exact_between_the_holds(
    T: float, b: float, period: float, uhat0: float, q: FloatArray, tau: FloatArray
) -> None:
    """xi' as in the design, q linear from sample to sample, tau held."""

    def slope(t: float, xi: FloatArray, k: int) -> list[float]:
        q_t = q[k] + (q[k + 1] - q[k]) * (t / period - k)
        return [(-ROOT_2 * xi[0] + xi[1] - ROOT_2 * q_t) / T, (-xi[0] - q_t - T**2 * b * tau[k]) / T]

    xi = np.array([T**2 * uhat0 - q[0], ROOT_2 * T**2 * uhat0])
    expected = [(xi[0] + q[0]) / T**2]
    for k in range(len(q) - 1):
        span = (k * period, (k + 1) * period)
        xi = solve_ivp(slope, span, xi, "DOP853", args=(k,), rtol=1e-12, atol=1e-14).y[:, -1]
        expected.append((xi[0] + q[k + 1]) / T**2)
    part = estimator(2, T, b, period, derivatives=2)
    assert run(part, q, tau, uhat0) == pytest.approx(np.array(expected), rel=1e-10, abs=1e-10 / T**2)


@pytest.mark.parametrize(("order", "derivatives"), [(2, 2), (3, 2), (4, 2), (1, 1), (2, 1), (3, 1)], ids=str)
@few
@given(T=filter_times, b=st.floats(0.5, 5.0), period=periods, seed=st.integers(0, 99))
def test_every_order_is_its_transfer_function(
    order: int, derivatives: int, T: float, b: float, period: float, seed: int
) -> None:
    """s^j G_f m - b G_f tau, G_f with the Butterworth poles on the circle of radius 1/T, by scipy's own simulation."""
    rng = np.random.default_rng(seed)
    m, tau = rng.normal(size=(2, 40))
    m[0] = 0.0  # the transfer function starts at rest at zero, and so does the estimator then
    angles = np.pi * (2.0 * np.arange(1, order + 1) + order - 1.0) / (2.0 * order)
    denominator = np.real(np.poly(np.exp(1j * angles) / T))
    gain = denominator[-1]  # so that G_f is one at rest
    t = period * np.arange(len(m))
    _, from_m, _ = lsim(([gain] + [0.0] * derivatives, denominator), m, t, interp=True)
    _, from_tau, _ = lsim(([gain], denominator), tau, t, interp=False)
    expected = from_m - b * from_tau
    came = run(estimator(order, T, b, period, derivatives=derivatives), m, tau, uhat0=0.0)
    assert came == pytest.approx(expected, rel=1e-8, abs=1e-8 * np.abs(expected).max())


@modest
@given(
    st.integers(1, 6), st.integers(1, 2), filter_times, periods, st.floats(-10.0, 10.0), st.floats(-3.0, 3.0),
)  # fmt: skip
def test_at_rest_the_estimate_stays_what_it_was(
    order: int, derivatives: int, T: float, period: float, uhat0: float, m: float
) -> None:
    """Where the estimate is balanced by the command, b tau = -uhat, nothing may move: a hovering start is no event."""
    b, count = 3.0, 200
    part = estimator(max(order, derivatives), T, b, period, derivatives=derivatives)
    uhat = run(part, np.full(count, m), np.full(count, -uhat0 / b), uhat0)
    assert uhat == pytest.approx(np.full(count, uhat0), rel=1e-9, abs=1e-9 / T**derivatives)


def test_output_feedback_needs_a_filter_of_second_order(flapper: Scenario) -> None:
    """As the paper says below (21); with the velocity at hand the first order will do."""
    first = replace_gains(flapper, "filters", order=1)
    with pytest.raises(
        ScenarioError, match=r"gains\.filters: .* filter of order 2 or more, but order is 1: set order = 2"
    ):
        first.read_gains("filters", Filters)
    filters = first.read_gains("filters", StateFeedbackFilters)
    law = realise(
        first, filters, error_gain=ONES, rate_gain=ONES, feed_forward=True, compensate=True, state_feedback=True
    )
    assert law.A.shape == (6, 2, 2)


ONES = np.ones(6)


def gains_only(
    scenario: Scenario, error_gain: float = 0.0, rate_gain: float = 0.0, *, feed_forward: bool, compensate: bool
) -> Realisation:
    return realise(
        scenario,
        scenario.read_gains("filters", Filters),
        error_gain=error_gain * ONES,
        rate_gain=rate_gain * ONES,
        feed_forward=feed_forward,
        compensate=compensate,
    )


def commands(law: Realisation, axis: int, r: FloatArray, applied: FloatArray) -> FloatArray:
    """b tau of one axis for the inputs r (n, 5), and the values applied (n,), from the start with uhat0."""
    x = law.start_r[axis] @ r[0] + law.start_u[axis] * law.uhat0[axis]
    tau = []
    for r_k, applied_k in zip(r, applied, strict=True):
        tau.append(law.C[axis] @ x + law.D[axis] @ r_k + law.bias[axis])
        x = law.A[axis] @ x + law.B[axis] @ r_k + law.B_tau[axis] * applied_k
    return np.array(tau)


def derivative(scenario: Scenario, axis: int, error: FloatArray) -> FloatArray:
    """v_k = D q_e as the laws have it: the command of a law with nothing but a rate gain of b is -v."""
    bare = msgspec.structs.replace(scenario, control=msgspec.structs.replace(scenario.control, uhat0=(0.0,) * 6))
    law = gains_only(bare, rate_gain=1.0, feed_forward=False, compensate=False)
    r = np.zeros((len(error), 5))
    r[:, ERROR] = error
    return -scenario.control.b[axis] * commands(law, axis, r, np.zeros(len(error)))


@modest
@given(arrays(float, 12, elements=st.floats(-2.0, 2.0)), st.integers(0, 5))
def test_the_derivative_is_the_design_formula(error: FloatArray, axis: int) -> None:
    scenario = load_scenario(find_scenario("flapper"))
    period = 0.004
    a = math.exp(-scenario.read_gains("filters", Filters).N[axis] * period)
    v = [0.0]
    for before, now in zip(error[:-1].tolist(), error[1:].tolist(), strict=True):
        v.append(a * v[-1] + (1.0 - a) * (now - before) / period)
    assert derivative(scenario, axis, error) == pytest.approx(np.array(v), rel=1e-11, abs=1e-10)


@pytest.mark.parametrize("axis", [0, 3])
def test_the_derivative_is_that_of_a_filter_for_straight_lines_between_samples(flapper: Scenario, axis: int) -> None:
    """N s/(s + N), exactly: on a ramp it is slope (1 - e^(-N t)), with the newest sample in it and none before."""
    n, t = flapper.read_gains("filters", Filters).N[axis], 0.004 * np.arange(50)
    ramp = np.linspace(5.0, 5.0 + 3.0 * t[-1], len(t))
    assert derivative(flapper, axis, ramp) == pytest.approx(3.0 * (1.0 - np.exp(-n * t)), rel=1e-10, abs=1e-9)
    any_shape = np.sin(40.0 * t) + 0.1 * np.random.default_rng(1).normal(size=50)
    _, expected, _ = lsim(([n, 0.0], [1.0, n]), any_shape - any_shape[0], t, interp=True)
    assert derivative(flapper, axis, any_shape) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_step_of_the_error_is_felt_at_once_and_forgotten(flapper: Scenario) -> None:
    error = np.zeros(60)
    error[20:] = 1.0
    v = derivative(flapper, 0, error)
    decay = math.exp(-flapper.read_gains("filters", Filters).N[0] * 0.004)
    assert v[:20].tolist() == [0.0] * 20
    assert v[20:] == pytest.approx((1.0 - decay) / 0.004 * decay ** np.arange(40), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("compensate", [False, True])
@pytest.mark.parametrize("feed_forward", [False, True])
def test_each_gain_does_what_the_common_form_says(flapper: Scenario, feed_forward: bool, compensate: bool) -> None:
    """b tau = f q_d'' - k_1 D q_e - k_0 q_e - c uhat - (1 - c) uhat0, per axis, with D and uhat tested above."""
    k_0, k_1, period, filters = 7.0, 3.0, 0.004, flapper.read_gains("filters", Filters)
    law = gains_only(flapper, k_0, k_1, feed_forward=feed_forward, compensate=compensate)
    rng = np.random.default_rng(4)
    for axis in range(6):
        r, applied = rng.normal(size=(20, 5)), rng.normal(size=20)
        b, uhat0 = flapper.control.b[axis], flapper.control.uhat0[axis]
        part = estimator(2, filters.T[axis], b, period, derivatives=2)
        uhat = run(part, r[:, POSITION], applied, uhat0) if compensate else np.full(20, uhat0)
        feed = r[:, REFERENCE_ACCELERATION] if feed_forward else 0.0
        expected = feed - k_1 * derivative(flapper, axis, r[:, ERROR]) - k_0 * r[:, ERROR] - uhat
        came = b * commands(law, axis, r, applied)
        assert came == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_state_feedback_takes_the_rate_of_the_error_as_it_comes(flapper: Scenario) -> None:
    k_0, k_1, period, filters = 7.0, 3.0, 0.004, flapper.read_gains("filters", StateFeedbackFilters)
    law = realise(
        flapper, filters, error_gain=k_0 * ONES, rate_gain=k_1 * ONES, feed_forward=True, compensate=True,
        state_feedback=True,
    )  # fmt: skip
    rng = np.random.default_rng(5)
    for axis in range(6):
        r, applied = rng.normal(size=(20, 5)), rng.normal(size=20)
        b = flapper.control.b[axis]
        part = estimator(2, filters.T[axis], b, period, derivatives=1)
        uhat = run(part, r[:, VELOCITY], applied, flapper.control.uhat0[axis])
        expected = r[:, REFERENCE_ACCELERATION] - k_1 * r[:, 4] - k_0 * r[:, ERROR] - uhat
        came = b * commands(law, axis, r, applied)
        assert came == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("order", range(1, 9))
def test_the_butterworth_polynomial_is_scipys_to_the_bit(order: int) -> None:
    assert butterworth(order).tolist() == butter(order, 1.0, analog=True)[1].tolist()


@given(matrix=arrays(np.float64, st.integers(1, 7).map(lambda n: (n, n)), elements=st.floats(-4.0, 4.0)))
def test_the_exponential_is_scipys(matrix: FloatArray) -> None:
    """Both round: what is compared is the whole matrix."""
    theirs = expm(matrix)
    # Squaring leaves an error in proportion to the largest powers on the way.
    assert exponential(matrix) == pytest.approx(theirs, rel=0.0, abs=1e-12 * np.exp(np.linalg.norm(matrix, 2)))


def test_the_exponential_of_no_matrix_at_all_is_one() -> None:
    assert exponential(np.zeros((3, 3))).tolist() == np.eye(3).tolist()


def test_the_exponential_of_a_turn_turns() -> None:
    turn = exponential(np.array([[0.0, -1.0], [1.0, 0.0]]) * math.pi / 6.0)
    assert turn == pytest.approx(np.array([[math.sqrt(3.0), -1.0], [1.0, math.sqrt(3.0)]]) / 2.0, abs=1e-15)
