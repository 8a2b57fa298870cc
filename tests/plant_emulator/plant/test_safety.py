"""The safety envelope: whatever comes, what leaves it is within the limits, and an outage ends in the safe output."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from plant_emulator.plant.safety import SafetyEnvelope
from protocol.messages import FloatArray
from protocol.scenario import Actuators
from protocol.wire.mapping import command_from_wire, command_to_wire

ACTUATORS = Actuators(
    lower=(-0.04, -0.04, -0.12, -3e-4, -3e-4, -3e-4),
    upper=(0.04, 0.04, 0.02, 3e-4, 3e-4, 3e-4),
    scale=(0.04, 0.05, 0.12, 3e-4, 7e-4, 1.0),
    safe=(0.0, 0.0, -0.03, 0.0, 1e-4, 0.0),
    staleness_s=0.05,
)
LOWER, UPPER = np.array(ACTUATORS.lower), np.array(ACTUATORS.upper)
STALENESS_NS = 50_000_000
INSIDE = np.array([0.01, -0.02, -0.05, 1e-4, -1e-4, 0.0])

modest = settings(deadline=None, max_examples=100)
wild = arrays(float, 6, elements=st.floats(allow_nan=False))


@pytest.fixture
def envelope() -> SafetyEnvelope:
    return SafetyEnvelope(ACTUATORS)


def passed(envelope: SafetyEnvelope, t_ns: int, tau: FloatArray, *, armed: bool = True) -> FloatArray:
    return envelope.pass_command(t_ns, tau, armed=armed)


@modest
@given(wild)
def test_whatever_comes_the_motors_get_what_is_within_the_limits(tau: FloatArray) -> None:
    envelope = SafetyEnvelope(ACTUATORS)
    allowed = passed(envelope, 0, tau)
    assert allowed.tolist() == np.clip(tau, LOWER, UPPER).tolist()
    beyond = bool(np.any((tau < LOWER - 2e-6 * (UPPER - LOWER)) | (tau > UPPER + 2e-6 * (UPPER - LOWER))))
    if beyond or allowed.tolist() == tau.tolist():
        assert envelope.counters["clamped"] == beyond


def test_a_command_within_the_limits_passes_unchanged_and_uncounted(envelope: SafetyEnvelope) -> None:
    assert passed(envelope, 0, INSIDE).tobytes() == INSIDE.tobytes()
    assert envelope.counters == {"clamped": 0, "disarmed": 0, "stale": 0}


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_each_limit_of_each_axis_is_kept_and_counted(envelope: SafetyEnvelope, axis: int, side: float) -> None:
    limit = (UPPER if side > 0.0 else LOWER)[axis]
    tau = INSIDE.copy()
    tau[axis] = limit + side * 1e-5 * (UPPER - LOWER)[axis]
    allowed = passed(envelope, 0, tau)
    assert allowed[axis] == limit
    assert np.delete(allowed, axis).tolist() == np.delete(tau, axis).tolist()
    assert envelope.counters["clamped"] == 1


@modest
@given(st.floats(1e-6, 10.0), st.floats(0.0, 1.0), st.floats(1.0, 100.0))
def test_what_float32_adds_to_a_limit_is_cut_off_but_not_counted(high: float, part: float, factor: float) -> None:
    """The controller clamps before the wire rounds to float32, so an honest command can come a hair beyond its limit."""
    low, scale = -part * high, factor * high
    actuators = Actuators(lower=(low,) * 6, upper=(high,) * 6, scale=(scale,) * 6)
    envelope = SafetyEnvelope(actuators)
    tau = np.array([command_from_wire(command_to_wire(limit, scale), scale) for limit in (low, high) for _ in range(3)])
    allowed = passed(envelope, 0, tau)
    assert low <= allowed.min() <= allowed.max() <= high
    assert envelope.counters["clamped"] == 0


def test_disarmed_the_motors_get_zeros(envelope: SafetyEnvelope) -> None:
    beyond = np.full(6, 9.0)
    assert passed(envelope, 0, beyond, armed=False).tolist() == [0.0] * 6
    assert envelope.counters == {"clamped": 0, "disarmed": 1, "stale": 0}


def test_a_first_command_that_does_not_come_is_stale_as_any_other(envelope: SafetyEnvelope) -> None:
    assert envelope.stale_output(STALENESS_NS) is None
    stale = envelope.stale_output(STALENESS_NS + 1)
    assert stale is not None
    assert stale[0] == STALENESS_NS
    assert envelope.counters["stale"] == 1


def test_a_command_is_stale_just_after_its_time_and_once_an_outage(envelope: SafetyEnvelope) -> None:
    start_ns = 7_000_000
    for outage in (1, 2):
        passed(envelope, start_ns, INSIDE)
        assert envelope.stale_output(start_ns + STALENESS_NS) is None
        stale = envelope.stale_output(start_ns + STALENESS_NS + 3_000_001)
        assert stale is not None
        expired_ns, output = stale
        assert expired_ns == start_ns + STALENESS_NS, (
            "it acts from when the command expired, not from when that was seen"
        )
        assert output.tolist() == list(ACTUATORS.safe)
        assert envelope.stale_output(start_ns + 2 * STALENESS_NS) is None
        assert envelope.counters["stale"] == outage
        start_ns += 3 * STALENESS_NS


def test_one_nanosecond_too_old_is_stale(envelope: SafetyEnvelope) -> None:
    passed(envelope, 0, INSIDE)
    assert envelope.stale_output(STALENESS_NS) is None
    assert envelope.stale_output(STALENESS_NS + 1) is not None


@pytest.mark.parametrize("came_ns", [0, 1, 2])
def test_whenever_a_command_came_it_grows_stale(envelope: SafetyEnvelope, came_ns: int) -> None:
    passed(envelope, came_ns, INSIDE)
    stale = envelope.stale_output(came_ns + STALENESS_NS + 1)
    assert stale is not None
    assert stale[0] == came_ns + STALENESS_NS


def test_every_command_even_a_disarmed_one_starts_the_time_anew(envelope: SafetyEnvelope) -> None:
    passed(envelope, 0, INSIDE)
    passed(envelope, STALENESS_NS, INSIDE, armed=False)
    assert envelope.stale_output(2 * STALENESS_NS) is None
    assert envelope.stale_output(2 * STALENESS_NS + 1) is not None


def test_the_envelope_keeps_no_hold_on_what_it_gives_and_takes(envelope: SafetyEnvelope) -> None:
    tau = INSIDE.copy()
    allowed = passed(envelope, 0, tau)
    tau[:] = 1.0
    assert allowed.tolist() == INSIDE.tolist()
    for _ in range(2):
        stale = envelope.stale_output(STALENESS_NS + 1)
        assert stale is not None
        assert stale[1].tolist() == list(ACTUATORS.safe)
        stale[1][:] = 9.0
        passed(envelope, 0, tau)


def test_two_envelopes_count_apart() -> None:
    one, other = SafetyEnvelope(ACTUATORS), SafetyEnvelope(msgspec.structs.replace(ACTUATORS, staleness_s=1.0))
    passed(one, 0, np.full(6, 9.0))
    assert other.counters["clamped"] == 0
    assert other.stale_output(STALENESS_NS + 1) is None
