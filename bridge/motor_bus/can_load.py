"""Load of a CAN bus and waiting time of its frames, calculated before a run; a run that does not fit is refused.

Load is bits on the wire at worst stuffing, over the bit rate. The wait is the worst response time of each frame by the
fixed-priority analysis of Davis, Burns, Bril, Lukkien (Real-Time Systems 35, 2007, sufficient test, eq. 13): a frame
waits for the longest frame that may just have begun, then for every frame of a lower identifier that becomes ready meanwhile,

    w = max(B, C) + sum over higher priority k of ceil((w + one bit) / T_k) C_k,        response = w + C

with periods T and durations C. Frames that exist in simulation only (`simulation_sync`) are not counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from protocol.errors import UsageError
from protocol.motors.motor_protocol import Traffic, traffic
from protocol.scenario import NANOSECONDS, Motor

BITRATES: Final = (125_000, 250_000, 500_000, 1_000_000)
RATES_HZ: Final = (1000, 800, 625, 500, 400, 250, 200, 125, 100, 50, 25, 20, 10)
"""Control rates that error messages propose: their periods are whole microseconds."""


class _Message(NamedTuple):
    priority: tuple[int, int, int]
    duration_s: float
    period_s: float
    command: bool


def load(kinds: Sequence[Traffic], bitrate: int) -> float:
    """Fraction of the bus capacity that the traffic takes at worst stuffing; above 1 it does not fit."""
    return sum(kind.bits * kind.rate_hz * kind.number for kind in kinds) / bitrate


def worst_response_s(kinds: Sequence[Traffic], bitrate: int) -> float:
    """Worst time (s) from handing over the torques until the last drive has its command; inf where it is unbounded."""
    messages = sorted(
        _Message(_priority(kind, i), kind.bits / bitrate, 1.0 / kind.rate_hz, kind.command)
        for kind in kinds
        for i in range(kind.number)
    )
    return max(_response_s(at, messages, 1.0 / bitrate) for at, message in enumerate(messages) if message.command)


def _priority(kind: Traffic, index: int) -> tuple[int, int, int]:
    """Sort key as in arbitration: 11 bits first, a standard frame before an extended one with the same, then 18 bits."""
    can_id = kind.can_id + index * kind.step
    return (can_id >> 18, 1, can_id & 0x3FFFF) if kind.extended else (can_id, 0, 0)


def _response_s(at: int, messages: list[_Message], bit_s: float) -> float:
    own = messages[at]
    higher = messages[:at]
    if own.duration_s / own.period_s + sum(one.duration_s / one.period_s for one in higher) >= 1.0:
        return math.inf
    begin = max([own.duration_s, *(one.duration_s for one in messages[at + 1 :])])
    wait = begin
    while True:
        longer = begin + sum(math.ceil((wait + bit_s) / one.period_s) * one.duration_s for one in higher)
        if longer <= wait:
            return wait + own.duration_s
        wait = longer


class BusPlan(NamedTuple):
    """Load and response time that a protocol causes on the bus at a control rate."""

    protocol: str
    rate_hz: float
    bitrate: int
    loads: dict[int, float]
    """load (fraction of capacity) at worst stuffing, by bit rate"""
    response_s: float
    """worst time until the last drive has its command, at `bitrate`"""

    def as_dict(self) -> dict[str, Any]:
        """The plan for a summary."""
        return {
            "protocol": self.protocol,
            "bitrate": self.bitrate,
            "load_percent": {str(bitrate): 100.0 * share for bitrate, share in self.loads.items()},
            "command_response_us": 1e6 * self.response_s,
        }


def plan_bus(protocol: str, motor: Motor, rate_hz: float) -> BusPlan:
    """Calculate the bus load for torques at rate_hz. Raises UsageError where it does not fit, naming what does."""
    kinds = traffic(protocol, motor, rate_hz)
    loads = {bitrate: load(kinds, bitrate) for bitrate in sorted({*BITRATES, motor.bitrate})}
    share = loads[motor.bitrate]
    if share > 1.0:
        raise UsageError(
            f"six {protocol} drives at {rate_hz:g} Hz need {100.0 * share:.0f} % of a CAN bus of "
            f"{motor.bitrate / 1000:g} kbit/s at worst stuffing, which does not fit: "
            + _what_fits(protocol, motor, rate_hz, loads)
        )
    return BusPlan(protocol, rate_hz, motor.bitrate, loads, worst_response_s(kinds, motor.bitrate))


def _what_fits(protocol: str, motor: Motor, rate_hz: float, loads: dict[int, float]) -> str:
    faster = [bitrate for bitrate, share in loads.items() if bitrate > motor.bitrate and share <= 1.0]
    remedies = [f"motor.bitrate {faster[0]} fits ({100.0 * loads[faster[0]]:.0f} %)"] if faster else []
    for rate in RATES_HZ:
        share = load(traffic(protocol, motor, rate), motor.bitrate)
        if rate < rate_hz and share <= 1.0:
            remedies.append(f"{rate} Hz fits ({100.0 * share:.0f} %)")
            break
    return " and ".join(remedies) or "lower the rates of the scenario's [motor] table"


def response_ns(plan: BusPlan) -> int:
    """The worst response in whole ns, for the delay of a run."""
    return math.ceil(plan.response_s * NANOSECONDS)
