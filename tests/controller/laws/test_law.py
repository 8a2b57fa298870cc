"""The stepping function: what it does with its matrices at the start, at the limits and where samples are missing."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.laws.law import (
    Law,
    LawState,
    begin_sample,
    coast,
    law_advance,
    law_output,
    limit_on_the_wire,
    make_law,
)
from controller.laws.reference import evaluate_reference, reference_trajectory
from controller.laws.registry import LAWS
from fwav_hil.simulate import simulate
from protocol.compiled import Packed, compiled
from protocol.messages import FloatArray
from protocol.scenario import ZERO6, Noise, Scenario, find_scenario, load_scenario, replace_gains
from tests.contracts.law_contract import WIDE, rotation_to_body

MS = 1_000_000
PERIOD_NS = 4 * MS
FLAPPER = load_scenario(find_scenario("flapper"))

modest = settings(deadline=None, max_examples=25)
BLIND_LAWS = sorted(name for name, entry in LAWS.items() if "filters" in entry.gains and not entry.needs_velocity)
two_kinds = pytest.mark.parametrize("name", ["ude", "uncompensated"])
"""The laws share their stepping; what differs is whether the estimate and what was applied come back into it."""


def replaced(scenario: Scenario, *, control: dict[str, Any] | None = None, **changes: Any) -> Scenario:
    if control:
        changes["control"] = msgspec.structs.replace(scenario.control, **control)
    copy: Scenario = msgspec.structs.replace(scenario, **changes)
    return copy


def path(count: int, seed: int) -> FloatArray:
    """Measured poses (count, 6) that wander about the reference."""
    rng = np.random.default_rng(seed)
    wander = np.cumsum(rng.normal(size=(count, 6)), axis=0) * ([0.002] * 3 + [0.01] * 3)
    result: FloatArray = reference_trajectory(FLAPPER.reference, count, PERIOD_NS)[:, 0] + wander
    return result


def inputs(scenario: Scenario, t_ns: int, q: FloatArray) -> FloatArray:
    """r (6, 5) of the module's equations, of an output-feedback law: its rates are left out."""
    q_d, _, q_d_ddot = reference_at(scenario, t_ns)
    error = q - q_d
    error[3:] = np.arctan2(np.sin(error[3:]), np.cos(error[3:]))
    zero = np.zeros(6)
    return np.array((q, error, q_d_ddot, zero, zero)).T


def reference_at(scenario: Scenario, t_ns: int) -> FloatArray:
    assert t_ns % MS == 0
    row: FloatArray = reference_trajectory(scenario.reference, t_ns // MS + 1, MS)[-1]
    return row


def advanced(law: Law, x: FloatArray, r: FloatArray, applied: FloatArray) -> FloatArray:
    """x_(k+1) = A x_k + B r_k + B_tau tau_applied, every axis."""
    m = law.realisation
    result: FloatArray = np.einsum("aij,aj->ai", m.A, x) + np.einsum("aij,aj->ai", m.B, r) + m.B_tau * applied[:, None]
    return result


def commanded(law: Law, x: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(tau, uhat) of the module's equations, inertial frame, before the limits."""
    m = law.realisation
    tau = np.einsum("ai,ai->a", m.C, x) + np.einsum("ai,ai->a", m.D, r) + m.bias
    uhat = np.einsum("ai,ai->a", m.C_u, x) + np.einsum("ai,ai->a", m.D_u, r)
    return tau, uhat


def fly_until(law: Law, q: FloatArray, count: int) -> LawState:
    state = law.start()
    for k in range(count):
        law.step(state, k * PERIOD_NS, q[k])
    return state


@two_kinds
@modest
@given(seed=st.integers(0, 1000), count=st.integers(1, 20), rotate=st.booleans(), order=st.sampled_from([2, 3, 6]))
def test_one_step_is_matrices_then_rotation_then_limits_then_wire_and_back(
    name: str, seed: int, count: int, rotate: bool, order: int
) -> None:
    """With the limits of `flapper`, which some of these paths run into; the applied value is the limited one."""
    scenario = replace_gains(replaced(FLAPPER, control={"rotate_force": rotate}), "filters", order=order)
    law, q = make_law(name, scenario), path(count + 1, seed)
    state = fly_until(law, q, count)
    x, t_ns = state.x.copy(), count * PERIOD_NS
    came = law.step(state, t_ns, q[count])

    r = inputs(scenario, t_ns, q[count])
    tau, uhat = commanded(law, x, r)
    turn = rotation_to_body(*q[count, 3:]) if rotate else np.eye(3)
    body = np.clip(np.concatenate((turn @ tau[:3], tau[3:])), scenario.actuators.lower, scenario.actuators.upper)
    scale = np.array(scenario.actuators.scale)
    assert came == pytest.approx(body, rel=0.0, abs=1e-7 * scale.max())
    assert np.abs(came - body) / scale == pytest.approx(np.zeros(6), abs=7e-8), "float32 of a fraction, no more"
    applied = np.concatenate((turn.T @ came[:3], came[3:]))
    assert state.applied == pytest.approx(applied, rel=1e-12, abs=1e-16)
    assert state.uhat == pytest.approx(uhat, rel=1e-9, abs=1e-9 * np.abs(uhat).max())
    expected = advanced(law, x, r, applied)
    assert state.x == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("name", BLIND_LAWS)
def test_the_start_is_the_observer_at_rest_with_the_scenarios_estimate(name: str) -> None:
    law, q = make_law(name, FLAPPER), path(1, 3)
    state = law.start()
    law.step(state, 0, q[0])
    uhat0 = np.array(FLAPPER.control.uhat0)
    assert state.uhat == pytest.approx(uhat0, rel=0.0, abs=1e-12 / 0.05**2)
    assert law.counts(state) == {"steps": 1, "missed_samples": 0, "restarts": 0, "saturated": state.counts[3]}


def with_memory(T: tuple[float, ...]) -> Scenario:
    return replace_gains(replaced(FLAPPER, actuators=WIDE), "filters", T=T)


@two_kinds
@modest
@given(seed=st.integers(0, 1000), before=st.integers(1, 10), periods=st.integers(2, 12), early_ns=st.integers(-1, 1))
def test_missing_samples_are_stepped_with_a_straight_line_and_the_command_held(
    name: str, seed: int, before: int, periods: int, early_ns: int
) -> None:
    """The state after a gap is that of stepping each omitted period, however late the sample within its own."""
    scenario = with_memory((0.05,) * 6)
    law, q = make_law(name, scenario), path(before + periods + 1, seed)
    state = fly_until(law, q, before)
    x, applied, last, last_ns = state.x.copy(), state.applied.copy(), before - 1, (before - 1) * PERIOD_NS
    t_ns = last_ns + periods * PERIOD_NS + early_ns * MS
    came = law.step(state, t_ns, q[last + periods])

    for missing in range(1, periods):
        between = q[last] + (q[last + periods] - q[last]) * missing / periods
        x = advanced(law, x, inputs(scenario, last_ns + missing * PERIOD_NS, between), applied)
    r = inputs(scenario, t_ns, q[last + periods])
    tau, uhat = commanded(law, x, r)
    tau[:3] = rotation_to_body(*q[last + periods, 3:]) @ tau[:3]
    assert came == pytest.approx(tau, rel=1e-6, abs=1e-7 * np.array(WIDE.scale).min())
    assert state.uhat == pytest.approx(uhat, rel=1e-8, abs=1e-8 * np.abs(uhat).max())
    expected = advanced(law, x, r, state.applied)
    assert state.x == pytest.approx(expected, rel=1e-8, abs=1e-9 * np.abs(expected).max())
    assert law.counts(state) == {"steps": before + 1, "missed_samples": periods - 1, "restarts": 0, "saturated": 0}


@pytest.mark.parametrize("name", BLIND_LAWS)
@pytest.mark.parametrize("periods", [13, 40])
def test_after_a_gap_as_long_as_its_memory_an_axis_starts_again_from_its_last_estimate(name: str, periods: int) -> None:
    """x and gamma remember longer than the others: they are stepped through the gap of 52 ms, and not of 160 ms."""
    scenario = with_memory((0.1, 0.05, 0.05, 0.052, 0.05, 0.1))
    law, q = make_law(name, scenario), path(periods + 11, 4)
    state = fly_until(law, q, 10)
    x, applied, uhat = state.x.copy(), state.applied.copy(), state.uhat.copy()
    t_ns, now = (9 + periods) * PERIOD_NS, q[9 + periods]
    law.step(state, t_ns, now)

    for missing in range(1, periods):
        between = q[9] + (now - q[9]) * missing / periods
        x = advanced(law, x, inputs(scenario, (9 + missing) * PERIOD_NS, between), applied)
    r = inputs(scenario, t_ns, now)
    forgotten = np.array([False, True, True, True, True, False]) if periods == 13 else np.full(6, True)
    m = law.realisation
    afresh = np.einsum("aij,aj->ai", m.start_r, r) + m.start_u * uhat[:, None]
    x[forgotten] = afresh[forgotten]
    expected = advanced(law, x, r, state.applied)
    assert state.x == pytest.approx(expected, rel=1e-8, abs=1e-9 * np.abs(expected).max())
    assert state.uhat[forgotten] == pytest.approx(uhat[forgotten], rel=1e-10, abs=1e-9), "the last estimate stands"
    assert law.counts(state) == {"steps": 11, "missed_samples": periods - 1, "restarts": 1, "saturated": 0}


def test_a_sample_later_than_half_a_period_counts_as_the_next_one() -> None:
    law, q = make_law("ude", FLAPPER), path(4, 1)
    for late_ns, missed in ((PERIOD_NS // 2 - 1, 0), (PERIOD_NS // 2, 1)):
        state = fly_until(law, q, 2)
        law.step(state, 2 * PERIOD_NS + late_ns, q[2])
        assert law.counts(state)["missed_samples"] == missed


def test_an_angle_may_turn_on_past_a_half_turn() -> None:
    """Yaw measured within +-pi leaps by a whole turn there; the observer must see it go on."""
    scenario = replaced(FLAPPER, actuators=WIDE, reference=msgspec.structs.replace(FLAPPER.reference, amplitude=ZERO6))
    law = make_law("ude", scenario)
    turning = [np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0 + 0.05 * k]) for k in range(100)]
    state = law.start()
    for k, q in enumerate(turning):
        law.step(state, k * PERIOD_NS, np.append(q[:5], np.arctan2(np.sin(q[5]), np.cos(q[5]))))
    assert state.q[5] == pytest.approx(turning[-1][5], rel=1e-12)


@two_kinds
@modest
@given(seed=st.integers(0, 1000), one=st.floats(-2.0, 2.0), other=st.floats(-2.0, 2.0))
def test_away_from_the_limits_a_law_is_linear(name: str, seed: int, one: float, other: float) -> None:
    """Two disturbances of the path together give the sum of what each gives: with the rotation off, and no limits."""
    law = make_law(name, replaced(FLAPPER, actuators=WIDE, control={"rotate_force": False}))
    rng = np.random.default_rng(seed)
    base = path(15, seed)
    first, second = 1e-3 * rng.normal(size=(2, *base.shape))

    def response(q: FloatArray) -> FloatArray:
        state = law.start()
        return np.array([law.step(state, k * PERIOD_NS, row) for k, row in enumerate(q)])

    rest = response(base)
    together = response(base + one * first + other * second) - rest
    apart = one * (response(base + first) - rest) + other * (response(base + second) - rest)
    assert np.abs(together - apart) / np.array(WIDE.scale) == pytest.approx(np.zeros_like(rest), abs=2e-5)
    assert np.abs(response(base + first) - rest).max() > 0.0


def without_anti_windup(scenario: Scenario) -> Law:
    """The same law whose observer believes that its command is carried out: B_tau sees C x + D r, not the limited value."""
    law = make_law("ude", scenario)
    m = law.realisation
    believed = m._replace(
        A=m.A + np.einsum("ai,aj->aij", m.B_tau, m.C),
        B=m.B + np.einsum("ai,aj->aij", m.B_tau, m.D),
        B_tau=np.zeros_like(m.B_tau),
    )
    return Law("ude without anti-windup", scenario, believed)


def step_of_10_cm(sideways: float) -> Scenario:
    """From rest, level and 10 cm off a reference that stands still, with little force to spare sideways."""
    lower, upper = list(FLAPPER.actuators.lower), list(FLAPPER.actuators.upper)
    lower[:2], upper[:2] = [-sideways] * 2, [sideways] * 2
    actuators = msgspec.structs.replace(FLAPPER.actuators, lower=tuple(lower), upper=tuple(upper))
    still = msgspec.structs.replace(FLAPPER.reference, amplitude=ZERO6, initial=ZERO6)
    level = msgspec.structs.replace(FLAPPER.initial, attitude=(0.0, 0.0, 0.0))
    return replaced(FLAPPER, actuators=actuators, reference=still, initial=level, noise=Noise(), duration_s=5.0)


@pytest.mark.parametrize("sideways", [0.003, 0.005])
def test_the_observer_of_the_applied_value_is_the_anti_windup(sideways: float) -> None:
    """With it the law is at rest a few seconds after its limits held it; without, it still swings by more than the step."""
    scenario = step_of_10_cm(sideways)
    run, wound_up = simulate(scenario), simulate(scenario, without_anti_windup(scenario))
    assert run.law_counts["saturated"] > 50, "the limits have to matter"

    def rmse(q: FloatArray) -> float:
        return float(np.sqrt(np.mean(np.square(q[:, :2]))))

    assert rmse(wound_up.q) > 3.0 * rmse(run.q)
    assert np.abs(run.q[-250:, :3]).max() < 0.005
    assert np.abs(wound_up.q[-250:, :3]).max() > 0.1


def test_without_limits_in_reach_the_two_observers_are_one() -> None:
    """The variant above differs by the limits alone."""
    scenario = replaced(FLAPPER, actuators=WIDE, duration_s=1.0)
    run, other = simulate(scenario), simulate(scenario, without_anti_windup(scenario))
    assert run.law_counts["saturated"] == 0
    assert other.q == pytest.approx(run.q, rel=0.0, abs=1e-6)


@compiled
def _step_in_parts(
    law: Packed, state: Packed, t_ns: int, measured: FloatArray, velocity: FloatArray, share: float
) -> None:
    """The parts of `control_step` one by one; of what the wire carries, only `share` acts."""
    data, s = law[0], state[0]
    periods = begin_sample(data, data.period_ns, s, t_ns, measured)
    if periods < 1:
        return
    gap_s = periods * data.period_ns * 1e-9 if periods > 1 else 0.0
    if gap_s < data.memory_s.max():
        for missing in range(1, periods):
            then_s = (s.t_ns[0] + missing * data.period_ns) * 1e-9
            evaluate_reference(then_s, data, s.desired[0], s.desired[1], s.desired[2])
            coast(data, s, missing / periods, velocity)
    evaluate_reference(t_ns * 1e-9, data, s.desired[0], s.desired[1], s.desired[2])
    law_output(data, s, gap_s, velocity)
    limit_on_the_wire(data, s, measured)
    for axis in range(6):
        s.applied[axis] *= share
    law_advance(data, data.period_ns, s, t_ns, periods)


class TestParts:
    """The output of a law apart from its advance: other sinks put their own limits between the two."""

    @pytest.mark.parametrize("name", BLIND_LAWS)
    def test_one_by_one_they_give_the_bits_of_a_step(self, name: str) -> None:
        law, q = make_law(name, FLAPPER), path(200, 7)
        whole, parts, velocity = law.start(), law.start(), np.zeros(6)
        t_ns = 0
        for periods, measured in zip(np.random.default_rng(4).choice([0, 1, 1, 1, 1, 2, 5, 400], 200), q, strict=True):
            t_ns += int(periods) * PERIOD_NS
            law.step(whole, t_ns, measured)
            _step_in_parts(law.packed, parts.packed, t_ns, measured, velocity, 1.0)
            assert parts.packed.tobytes() == whole.packed.tobytes()
        assert law.counts(whole)["missed_samples"] > 0
        assert law.counts(whole)["steps"] < 200

    @pytest.mark.parametrize("share", [0.0, 0.25, 0.9])
    @pytest.mark.parametrize("name", ["ude", "dob"])
    def test_with_another_limit_between_them_a_law_advances_with_what_really_acted(
        self, name: str, share: float
    ) -> None:
        law, q = make_law(name, FLAPPER), path(21, 8)
        state = fly_until(law, q, 20)
        beside, x, t_ns = law.start(), state.x.copy(), 20 * PERIOD_NS
        beside.packed[:] = state.packed
        _step_in_parts(law.packed, state.packed, t_ns, q[20], np.zeros(6), share)
        law.step(beside, t_ns, q[20])
        assert state.tau.tobytes() == beside.tau.tobytes(), "what it asks for is the same"
        assert state.applied.tolist() == (share * beside.applied).tolist()
        expected = advanced(law, x, inputs(FLAPPER, t_ns, q[20]), share * beside.applied)
        assert state.x == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())
        assert np.abs(state.x - beside.x).max() > 1e-6 * np.abs(expected).max(), "and that is another state"
