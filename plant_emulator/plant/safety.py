"""The safety envelope: what a command must pass before it reaches a motor. It starts at "no output".

It sits apart from control and trusts nothing: commands are clamped to the actuators' limits, a disarmed command turns the
motors to zero, and a command that has grown stale turns each channel to its safe value.
"""

from __future__ import annotations

import numpy as np

from protocol.compiled import compiled
from protocol.messages import ActuatorCommand, FloatArray
from protocol.scenario import NANOSECONDS, Actuators

_TOLERANCE = 1e-6
"""Part of a channel's range that float32 may add to a limit without the clamp being counted."""


@compiled
def clamp(tau: FloatArray, lower: FloatArray, upper: FloatArray, allowed: FloatArray) -> float:
    """Fill allowed (6,) with tau (6,) clamped to the limits; returns the largest excess as a fraction of its range."""
    excess = 0.0
    for i in range(6):
        allowed[i] = min(max(tau[i], lower[i]), upper[i])
        excess = max(excess, abs(allowed[i] - tau[i]) / (upper[i] - lower[i]))
    return excess


class SafetyEnvelope:
    """Limits, arming and staleness.

    lower, upper   (6,) the limits
    counters   clamped   commands that were beyond a limit
               disarmed  commands that came without arming
               stale     times the output went to its safe value because no command came within staleness_s
    """

    def __init__(self, actuators: Actuators) -> None:
        self.lower = np.array(actuators.lower)
        self.upper = np.array(actuators.upper)
        self._safe = np.array(actuators.safe)
        self._staleness_ns = round(actuators.staleness_s * NANOSECONDS)
        self._last_ns: int | None = 0  # from t = 0 on a first command is awaited, like any other
        self.counters = {"clamped": 0, "disarmed": 0, "stale": 0}

    def accept(self, t_ns: int, command: ActuatorCommand) -> FloatArray:
        """What the motors get of a command that came at simulation time t_ns: tau (6,)."""
        if not command.armed:
            self._last_ns = t_ns
            self.counters["disarmed"] += 1
            return np.zeros(6)
        allowed = np.empty(6)
        self.accepted(t_ns, clamp(command.tau, self.lower, self.upper, allowed))
        return allowed

    def accepted(self, t_ns: int, excess: float) -> None:
        """Take note of an armed command of that time and excess over the limits, clamped by `clamp`."""
        self._last_ns = t_ns
        if excess > _TOLERANCE:
            self.counters["clamped"] += 1

    def outlasts(self, period_ns: int) -> bool:
        """Whether no command grows stale within a period after it came."""
        return self._staleness_ns >= period_ns

    def stale_output(self, t_ns: int) -> tuple[int, FloatArray] | None:
        """(time it begins to act, safe tau) once per outage, where the last command is too old at t_ns; else None."""
        if self._last_ns is None or t_ns - self._last_ns <= self._staleness_ns:
            return None
        expired_ns = self._last_ns + self._staleness_ns
        self._last_ns = None
        self.counters["stale"] += 1
        return expired_ns, self._safe.copy()
