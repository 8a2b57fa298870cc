"""The drives' physics: equal to the direct path without lag; lag, rates, limits and heat as their equations say."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from plant_emulator.drives.motor import DriveBank
from plant_emulator.plant.backlash import GearHysteresis
from protocol.scenario import Scenario
from tests.loop import scenario_of

MILLISECOND = 1_000_000


def with_motor(name: str = "flapper", **motor: Any) -> Scenario:
    scenario = scenario_of(name)
    return scenario_of(name, motor=msgspec.to_builtins(scenario.motor) | motor)


def strokes(scenario: Scenario, count: int) -> np.typing.NDArray[np.float64]:
    """Torques within the limits, (count, 6)."""
    low, high = scenario.actuators.lower, scenario.actuators.upper
    return np.random.default_rng(1).uniform(low, high, (count, 6))


@pytest.mark.parametrize("name", ["flapper", "paper"])
@pytest.mark.parametrize("duration_ns", [4 * MILLISECOND, 1_234_567])
def test_without_lag_the_force_is_that_of_the_direct_path_to_the_bit(name: str, duration_ns: int) -> None:
    scenario = with_motor(name, lag_s=0.0)
    tau0 = np.array(scenario.initial.command)
    bank, gears = DriveBank(scenario, tau0), GearHysteresis(scenario.hysteresis, tau0)
    for tau in strokes(scenario, 200):
        assert np.array_equal(bank.step(tau, duration_ns), gears.step(tau))
    assert np.array_equal(bank.state.d, gears.d)


def test_lag_is_first_order() -> None:
    scenario = with_motor(lag_s=0.01)
    bank = DriveBank(scenario, np.zeros(6))
    target = 0.5 * np.array(scenario.actuators.upper)
    for k in range(1, 6):
        bank.step(target, 5 * MILLISECOND)
        assert bank.state.tau == pytest.approx(target * (1.0 - np.exp(-0.5 * k)), rel=1e-12)


def test_the_mean_force_of_a_step_keeps_the_impulse() -> None:
    """With a gear of slope 1 and no width, the sum of the means times the period is the integral of the lagged torque."""
    wide = {"model": "play", "h": [1.0] * 6, "B": [0.0] * 6}
    scenario = scenario_of("flapper", hysteresis=wide, motor=msgspec.to_builtins(with_motor(lag_s=0.002).motor))
    bank = DriveBank(scenario, np.zeros(6))
    target = 0.5 * np.array(scenario.actuators.upper)
    impulse = sum(bank.step(target, 4 * MILLISECOND) * 0.004 for _ in range(10))
    exact = target * (0.04 - 0.002 * (1.0 - np.exp(-20.0)))
    assert impulse == pytest.approx(exact, abs=1e-4 * float(np.max(np.abs(target))))  # sub-steps of 1/8000 s


def test_the_rate_limit_is_in_full_scales_per_second() -> None:
    scenario = with_motor(lag_s=0.0, rate_limit=[1.0, 2.0, 0.0, 1.0, 1.0, 1.0])
    bank = DriveBank(scenario, np.zeros(6))
    scale = np.array(scenario.actuators.scale)
    target = np.array([0.5, 0.5, 0.1, -0.5, 0.5, 0.5]) * scale
    bank.step(target, 100 * MILLISECOND)
    assert bank.state.tau / scale == pytest.approx([0.1, 0.2, 0.1, -0.1, 0.1, 0.1])
    for _ in range(9):
        bank.step(target, 100 * MILLISECOND)
    assert bank.state.tau == pytest.approx(target)


def test_limits_are_the_narrower_of_actuators_and_drive() -> None:
    scenario = with_motor(lag_s=0.0, torque_limit=[0.5, 1.0, 1.0, 1.0, 1.0, 0.25])
    bank = DriveBank(scenario, np.zeros(6))
    bank.step(np.full(6, 1.0), MILLISECOND)
    assert bank.state.tau == pytest.approx([0.02, 0.04, 0.02, 3e-4, 3e-4, 0.75e-4])
    bank.step(np.full(6, -1.0), MILLISECOND)
    assert bank.state.tau == pytest.approx([-0.02, -0.04, -0.12, -3e-4, -3e-4, -0.75e-4])


def test_heat_goes_with_the_square_of_torque() -> None:
    scenario = with_motor(lag_s=0.0, temperature_rise=80.0, thermal_time_constant_s=2.0)
    bank = DriveBank(scenario, np.zeros(6))
    scale = np.array(scenario.actuators.scale)
    torque = np.array([1.0, 0.5, -1.0, 0.0, -0.5, 1.0]) * scale
    assert bank.state.temperature == pytest.approx(np.full(6, 15.0))
    for _ in range(20):
        bank.step(torque, 100 * MILLISECOND)
    rise = 80.0 * np.array([1.0, 0.25, 1.0, 0.0, 0.25, 1.0]) * (1.0 - np.exp(-1.0))
    assert bank.state.temperature == pytest.approx(15.0 + rise, abs=0.01)


def test_a_jump_resets_the_filters_and_the_gear_sees_it() -> None:
    scenario = with_motor(lag_s=0.01, rate_limit=[1.0] * 6)
    bank = DriveBank(scenario, np.zeros(6))
    target = 0.5 * np.array(scenario.actuators.upper)
    bank.step(target, 20 * MILLISECOND)
    gears = GearHysteresis(scenario.hysteresis, np.zeros(6))
    gears.tau, gears.u, gears.d = bank.state.tau.copy(), bank.state.u.copy(), bank.state.d.copy()
    for axis in range(6):
        bank.jump(axis, 0.0)
    assert np.array_equal(bank.state.u, gears.step(np.zeros(6)))
    assert not bank.state.tau.any()
    assert not bank.state.ramp.any()
