"""The safety envelope: the checks between a received command and the motors. Its output starts at zero.

It is independent of control: commands are clamped to the actuators' limits, a disarmed command sets the
motors to zero, and a stale command sets each channel to its safe value.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from protocol.compiled import compiled, pack
from protocol.messages import FloatArray
from protocol.scenario import NANOSECONDS, Actuators

_TOLERANCE = 1e-6
"""Part of a channel's range by which float32 rounding may exceed a limit without being counted as clamped."""

CAUSES = ("clamped", "disarmed", "stale")
CLAMPED, DISARMED, STALE = range(len(CAUSES))
_OUTAGE = -1  # instead of the last command's time: the safe output is active


@compiled
def clamp(tau: FloatArray, lower: FloatArray, upper: FloatArray, allowed: FloatArray) -> float:
    """Fill allowed (6,) with tau (6,) clamped to the limits; returns the largest excess as a fraction of its range."""
    excess = 0.0
    for i in range(6):
        allowed[i] = min(max(tau[i], lower[i]), upper[i])
        excess = max(excess, abs(allowed[i] - tau[i]) / (upper[i] - lower[i]))
    return excess


@compiled
def pass_command(envelope: Any, t_ns: int, tau: FloatArray, armed: bool) -> None:
    """Fill envelope.allowed (6,) with the motors' part of a command received at simulation time t_ns."""
    envelope.last_ns = t_ns
    if not armed:
        envelope.counters[DISARMED] += 1
        envelope.allowed[:] = 0.0
    elif clamp(tau, envelope.lower, envelope.upper, envelope.allowed) > _TOLERANCE:
        envelope.counters[CLAMPED] += 1


@compiled
def expired_ns(envelope: Any, t_ns: int) -> int:
    """When the last command became stale, once per outage; -1 where it is not stale at t_ns, or this was reported before."""
    if envelope.last_ns == _OUTAGE or t_ns - envelope.last_ns <= envelope.staleness_ns:
        return -1
    since_ns = envelope.last_ns + envelope.staleness_ns
    envelope.last_ns = _OUTAGE
    envelope.counters[STALE] += 1
    return int(since_ns)


class SafetyEnvelope:
    """Limits, arming and staleness.

    packed     the envelope as the kernels take it
    counters   clamped   commands that exceeded a limit
               disarmed  commands that were sent disarmed
               stale     times the output switched to its safe value because no command arrived within staleness_s
    """

    def __init__(self, actuators: Actuators) -> None:
        self._safe = np.array(actuators.safe)
        self.packed = pack(
            {
                "lower": np.array(actuators.lower),
                "upper": np.array(actuators.upper),
                "allowed": np.zeros(6),
                "staleness_ns": round(actuators.staleness_s * NANOSECONDS),
                "last_ns": 0,  # the first command is due within staleness_s of t = 0, like any other
                "counters": np.zeros(len(CAUSES), dtype=np.int64),
            }
        )
        self.allowed: FloatArray = self.packed["allowed"][0]

    @property
    def counters(self) -> dict[str, int]:
        """The counters so far."""
        return dict(zip(CAUSES, self.packed["counters"][0].tolist(), strict=True))

    def pass_command(self, t_ns: int, tau: FloatArray, *, armed: bool) -> FloatArray:
        """The motors' part of a command tau (6,) received at simulation time t_ns."""
        pass_command(self.packed[0], t_ns, tau, armed)
        return self.allowed.copy()

    def stale_output(self, t_ns: int) -> tuple[int, FloatArray] | None:
        """(time it begins to act, safe tau) once per outage, where the last command is stale at t_ns; else None."""
        since_ns = expired_ns(self.packed[0], t_ns)
        return None if since_ns < 0 else (since_ns, self._safe.copy())
