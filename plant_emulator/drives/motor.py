"""Six drives and their gears: torque limits, rate limit, current lag, hysteresis, heat. Compiled; no bus, no clock.

input   target (6,)   commanded torque (N, N m), the scenario's `actuators.safe` for a drive that is not enabled
output  u (6,)        generalised force after the gears, its mean over the step
state   ramp, tau, u, d, temperature (6,) each

    ramp   moves to the target, held at the limits, at most rate_limit * scale in a second
    tau    lag_s tau' = ramp - tau                                 torque loop, a first-order lag, exact over each sub-step
    u, d   gear hysteresis (2), (3), the functions of the direct path (`backlash.gear_step`)
    temp   thermal_time_constant_s temp' = ambient + temperature_rise (tau / scale)^2 - temp       copper loss

A step consists of sub-steps of at most the torque loop's period. With lag_s and rate_limit 0 the torque acts at once,
and u equals that of the direct path to the bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from plant_emulator.plant.backlash import gear_parameters, gear_step
from protocol.compiled import Packed, compiled, pack, views
from protocol.messages import FloatArray
from protocol.scenario import NANOSECONDS, Scenario


class DriveState(NamedTuple):
    """The drives' state, (6,) each, changed in place; `packed` holds the same memory."""

    ramp: FloatArray
    tau: FloatArray
    u: FloatArray
    d: FloatArray
    temperature: FloatArray
    mean_u: FloatArray
    packed: Packed


@compiled
def _step(state: Packed, parameters: Packed, target: FloatArray, steps: int, step_s: float) -> None:
    """Advance all six by `steps` sub-steps of step_s."""
    s, p = state[0], parameters[0]
    keep = math.exp(-step_s / p.lag_s) if p.lag_s > 0.0 else 0.0
    heat = -math.expm1(-step_s / p.thermal_time_constant_s)
    for i in range(6):
        goal = min(max(target[i], p.lower[i]), p.upper[i])
        first = 0.0
        above = 0.0
        for k in range(steps):
            ramp = goal
            if p.rate_limit[i] > 0.0:
                most = p.rate_limit[i] * p.scale[i] * step_s
                ramp = s.ramp[i] + min(max(goal - s.ramp[i], -most), most)
            s.ramp[i] = ramp
            tau = ramp + keep * (s.tau[i] - ramp) if keep > 0.0 else ramp
            s.u[i], s.d[i] = gear_step(p.model, s.tau[i], tau, s.u[i], s.d[i], p.h[i], p.p[i], p.chi[i])
            s.tau[i] = tau
            ratio = tau / p.scale[i]
            s.temperature[i] += heat * (p.ambient + p.temperature_rise * ratio * ratio - s.temperature[i])
            if k == 0:
                first = s.u[i]
            above += s.u[i] - first
        s.mean_u[i] = first + above / steps


@compiled
def _jump(state: Packed, parameters: Packed, axis: int, tau: float) -> None:
    """Set the torque of one drive, and its filters, at once; the gear sees the move."""
    s, p = state[0], parameters[0]
    s.u[axis], s.d[axis] = gear_step(p.model, s.tau[axis], tau, s.u[axis], s.d[axis], p.h[axis], p.p[axis], p.chi[axis])
    s.tau[axis] = tau
    s.ramp[axis] = tau
    s.mean_u[axis] = s.u[axis]


class DriveBank:
    """The six drives for callers in Python. They start with `tau0` (6,) acting, d = 0 and the motors at ambient temperature."""

    def __init__(self, scenario: Scenario, tau0: FloatArray) -> None:
        motor, actuators = scenario.motor, scenario.actuators
        model, h, p, chi = gear_parameters(scenario.hysteresis)
        scale = np.array(actuators.scale)
        limit = np.array(motor.torque_limit) * scale
        self.ambient = scenario.world.temperature_celsius
        self._parameters = pack(
            {
                "lower": np.maximum(actuators.lower, -limit),
                "upper": np.minimum(actuators.upper, limit),
                "scale": scale,
                "rate_limit": np.array(motor.rate_limit),
                "lag_s": motor.lag_s,
                "thermal_time_constant_s": motor.thermal_time_constant_s,
                "temperature_rise": motor.temperature_rise,
                "ambient": self.ambient,
                "model": model,
                "h": h,
                "p": p,
                "chi": chi,
            }
        )
        self._h = h
        self._loop_hz = motor.loop_hz
        zeros = np.zeros(6)
        fields = ("ramp", "tau", "u", "d", "temperature", "mean_u")
        packed = pack(dict.fromkeys(fields, zeros))
        self.state = DriveState(**views(packed), packed=packed)
        self.begin(tau0)

    def begin(self, tau0: FloatArray) -> None:
        """Reset to the start, with tau0 (6,) acting."""
        state = self.state
        state.ramp[:] = state.tau[:] = tau0
        state.u[:] = state.mean_u[:] = self._h * tau0
        state.d[:] = 0.0
        state.temperature[:] = self.ambient

    def step(self, target: FloatArray, duration_ns: int) -> FloatArray:
        """Advance by duration_ns towards target (6,); returns the mean u (6,) over it."""
        steps = max(1, math.ceil(duration_ns / NANOSECONDS * self._loop_hz - 1e-9))
        _step(self.state.packed, self._parameters, target, steps, duration_ns / NANOSECONDS / steps)
        return self.state.mean_u.copy()

    def jump(self, axis: int, tau: float) -> None:
        """Let the torque of one drive be tau at once, filters reset."""
        _jump(self.state.packed, self._parameters, axis, tau)
