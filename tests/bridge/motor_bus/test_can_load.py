"""Bus load and waits: against figures worked out by hand and published ones."""

from __future__ import annotations

import math

import pytest

from bridge.motor_bus.can_load import BITRATES, load, plan_bus, response_ns, worst_response_s
from protocol.errors import UsageError
from protocol.motors.motor_protocol import Traffic
from protocol.motors.registry import PROTOCOLS
from protocol.scenario import Motor


def test_load_by_hand() -> None:
    """Six frames of 4 bytes at 1 kHz: 95 bits each at worst, 57 % of 1 Mbit/s."""
    kinds = [Traffic("torque", 0x2AE, 4, 1000.0)]
    assert load(kinds, 1_000_000) == pytest.approx(0.57)
    assert load(kinds, 500_000) == pytest.approx(1.14)


def test_the_published_example_of_three_messages() -> None:
    """Davis et al. 2007, section 3.2: three messages of 125 bits at 125 kbit/s, periods 2.5, 3.5 and 3.5 ms. Their exact
    worst response times are 2, 3 and 3.5 ms; the sufficient test may be above, never below, and here finds 2, 3 and no bound
    within the period for the last (its utilisation is 97 %)."""
    kinds = [
        Traffic("A", 1, 7, 400.0, 1, command=True),
        Traffic("B", 2, 7, 1e3 / 3.5, 1, command=True),
        Traffic("C", 3, 7, 1e3 / 3.5, 1, command=True),
    ]
    assert {kind.bits for kind in kinds} == {125}
    responses = [worst_response_s([one._replace(command=one is kind) for one in kinds], 125_000) for kind in kinds]
    assert responses[0] == pytest.approx(2e-3)
    assert responses[1] == pytest.approx(3e-3)
    assert responses[2] >= 3.5e-3


def test_a_frame_of_the_highest_priority_waits_for_one_other() -> None:
    kinds = [Traffic("command", 1, 4, 100.0, 1, command=True), Traffic("status", 0x400, 8, 100.0, 5)]
    assert worst_response_s(kinds, 1_000_000) == pytest.approx((135 + 95) * 1e-6)


def test_an_extended_identifier_yields_to_a_standard_one_that_begins_alike() -> None:
    standard = Traffic("standard", 0x100, 8, 100.0, 1)
    extended = Traffic("command", 0x100 << 18, 8, 100.0, 1, extended=True, command=True)
    assert worst_response_s([standard, extended], 1_000_000) == pytest.approx((160 + 135 + 160) * 1e-6)
    higher = extended._replace(can_id=0x0FF << 18)
    assert worst_response_s([standard, higher], 1_000_000) == pytest.approx((160 + 160) * 1e-6)


def test_an_overloaded_bus_has_no_bound() -> None:
    kinds = [Traffic("other", 1, 8, 8000.0, 1), Traffic("command", 2, 8, 100.0, 1, command=True)]
    assert worst_response_s(kinds, 1_000_000) == math.inf


@pytest.mark.parametrize("protocol", sorted(PROTOCOLS))
def test_a_slower_bus_is_fuller_and_slower(protocol: str) -> None:
    plan = plan_bus(protocol, Motor(), 250.0)
    shares = [plan.loads[bitrate] for bitrate in BITRATES]
    assert shares == sorted(shares, reverse=True)
    assert 0.0 < shares[-1] < 0.5
    assert response_ns(plan) >= 1e9 * plan.response_s > 0
    assert plan.as_dict()["load_percent"]["1000000"] == pytest.approx(100.0 * shares[-1])


def test_command_and_reply_at_1_khz_do_not_fit_and_what_does_is_said() -> None:
    with pytest.raises(UsageError, match=r"six mit drives at 1000 Hz need 162 % .* 500 Hz fits \(81 %\)"):
        plan_bus("mit", Motor(), 1000.0)
    assert plan_bus("mit", Motor(), 500.0).loads[1_000_000] <= 1.0


def test_a_faster_bus_is_proposed_where_it_helps() -> None:
    with pytest.raises(UsageError, match=r"of 250 kbit/s .*motor.bitrate 500000 fits \(56 %\) and 125 Hz fits"):
        plan_bus("odrive", Motor(bitrate=250_000), 250.0)


def test_where_the_cyclic_messages_alone_are_too_many_they_are_to_blame() -> None:
    with pytest.raises(UsageError, match=r"lower the rates of the scenario's \[motor\] table"):
        plan_bus("odrive", Motor(encoder_rate_hz=2000.0), 10.0)
