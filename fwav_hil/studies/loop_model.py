"""The linear loop of each channel, from the law's own discrete matrices: stability, margins, the largest delay.

Per channel the plant is the double integrator q'' = g tau, g = slope of the gear / inertia. The command of sample k acts on
[t_k + delay, t_(k+1) + delay), as in the emulator: hold and delay, fractional or not, are in the matrices exactly. The
applied command equals the commanded one: no limit acts here. Stable means that every eigenvalue of the closed
loop lies within the unit circle; frequency responses only give estimates of the boundaries, eigenvalues decide.

Left out: the coupling of the axes (rotation, gyration), limits, noise; the hysteresis is only a gain, which may be
complex (a describing function). tau is multiplied by b here, so a plant's gain is the ratio g/b.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.laws.registry import make_realisation
from controller.laws.state_space import ERROR, ERROR_RATE, POSITION, VELOCITY, Realisation
from protocol.messages import AXES, FloatArray
from protocol.scenario import NANOSECONDS, Scenario

ComplexArray = npt.NDArray[np.complex128]

_LOWEST_RAD_S = 1e-3
_MOST_STEPS, _ROUNDING = 100, 1e-13
_ENOUGH_SAMPLES = 600
"""A loop that is stable with more periods of delay than this is reported to have no limit."""


class Channel:
    """One axis of a law with its plant.

    axis      name                          period     s
    ratio     g/b of the scenario           A (n, n), B (n, 2), B_tau (n,), C (n,), D (2,): the law; inputs q, q'
    """

    def __init__(
        self,
        axis: str,
        ratio: float,
        period: float,
        A: FloatArray,
        B: FloatArray,
        B_tau: FloatArray,
        C: FloatArray,
        D: FloatArray,
    ) -> None:
        self.axis, self.ratio, self.period = axis, ratio, period
        self.A, self.B, self.B_tau, self.C, self.D = A, B, B_tau, C, D

    def twin_of(self, other: Channel) -> bool:
        """Whether both are the same loop, except for rounding."""
        return bool(np.isclose(self.ratio, other.ratio, rtol=1e-9)) and all(
            np.allclose(mine, theirs, rtol=1e-9, atol=0.0)
            for mine, theirs in zip(
                (self.A, self.B, self.B_tau, self.C, self.D),
                (other.A, other.B, other.B_tau, other.C, other.D),
                strict=True,
            )
        )

    def closed_loop(self, gain: complex, delay_s: float) -> npt.NDArray[Any]:
        """The matrix of one period: states of the law, q, q', and the delayed commands."""
        n, period = len(self.C), self.period
        whole, fraction = split_delay(delay_s, period)
        old, new = _held(period, fraction)
        size = n + 2 + whole + 1
        matrix = np.zeros((size, size), dtype=complex if np.iscomplexobj(gain) else float)
        command = np.zeros(size)  # the newest command as a row over the states
        command[:n], command[n : n + 2] = self.C, self.D
        on_the_way = np.eye(size)[n + 2 :]
        matrix[:n, :n], matrix[:n, n : n + 2] = self.A, self.B
        matrix[:n] += np.outer(self.B_tau, command)
        matrix[n, n : n + 2] = 1.0, period
        matrix[n + 1, n + 1] = 1.0
        begins = command if whole == 0 else on_the_way[whole - 1]
        matrix[n : n + 2] += gain * (np.outer(new, begins) + np.outer(old, on_the_way[whole]))
        matrix[n + 2] = command
        for i in range(whole):
            matrix[n + 3 + i] = on_the_way[i]
        return matrix

    def poles(self, gain: complex, delay_s: float) -> ComplexArray:
        """Eigenvalues of the closed loop. For a complex gain those of positive frequency only, where it holds."""
        values = np.linalg.eigvals(self.closed_loop(gain, delay_s)).astype(complex)
        if not np.iscomplexobj(gain):
            return values
        angles = np.angle(values)
        kept: ComplexArray = values[(angles > 1e-9) & (angles < np.pi - 1e-9)]
        return kept

    def stable(self, gain: complex, delay_s: float) -> bool:
        """Whether every pole lies within the unit circle."""
        poles = self.poles(gain, delay_s)
        return bool(np.abs(poles).max(initial=0.0) < 1.0)

    @cached_property
    def frequencies(self) -> FloatArray:
        """Grid (rad/s) up to the Nyquist frequency, dense at both ends."""
        top = np.pi / self.period
        return np.unique(np.concatenate((np.geomspace(_LOWEST_RAD_S, top, 1200), np.linspace(0.0, top, 801)[1:])))

    @cached_property
    def _law_on_grid(self) -> ComplexArray:
        return self._law_response(self.frequencies)

    def _law_response(self, frequency: FloatArray) -> ComplexArray:
        """From q and q' to b tau with the law's own command fed back, (len(frequency), 2)."""
        z = np.exp(1j * frequency * self.period)[:, None, None]
        fed_back = self.A + np.outer(self.B_tau, self.C)
        inputs = self.B + np.outer(self.B_tau, self.D)
        inner = np.linalg.solve(z * np.eye(len(self.C)) - fed_back, np.broadcast_to(inputs, (len(z), *inputs.shape)))
        return np.asarray(self.C @ inner + self.D, dtype=complex)

    def loop(self, delay_s: float, frequency: FloatArray | None = None) -> ComplexArray:
        """L(j omega) for gain 1, broken at the plant's input: 1 + gain L = 0 at a pole. On the grid by default."""
        law = self._law_on_grid if frequency is None else self._law_response(frequency)
        omega = self.frequencies if frequency is None else frequency
        whole, fraction = split_delay(delay_s, self.period)
        old, new = _held(self.period, fraction)
        z = np.exp(1j * omega * self.period)
        turn: ComplexArray = np.expm1(1j * omega * self.period)  # z - 1 without cancellation
        moved = new[:, None] + old[:, None] / z
        velocity = moved[1] / turn
        position = (moved[0] + self.period * velocity) / turn
        loop: ComplexArray = -(law[:, 0] * position + law[:, 1] * velocity) * z ** (-float(whole))
        return loop

    def _loop_at(self, delay_s: float, omega: float) -> complex:
        return complex(self.loop(delay_s, np.array([omega]))[0])


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    """The zero of a function between two points of opposite sign: regula falsi (Illinois), to rounding.

    As `scipy.optimize.brentq` finds it (a test holds that), without the half second that importing it adds to `run`.
    """
    at_low, at_high = function(low), function(high)
    found, moved = low, 0
    for _ in range(_MOST_STEPS):
        before, found = found, (low * at_high - high * at_low) / (at_high - at_low)
        at = function(found)
        if at == 0.0 or abs(found - before) <= _ROUNDING * abs(found):
            break
        if (at > 0.0) == (at_high > 0.0):
            high, at_high = found, at
            at_low *= 0.5 if moved == 1 else 1.0
            moved = 1
        else:
            low, at_low = found, at
            at_high *= 0.5 if moved == -1 else 1.0
            moved = -1
    return float(found)


def split_delay(delay_s: float, period: float) -> tuple[int, float]:
    """Whole periods of a delay, and the rest as a fraction of one."""
    samples = delay_s / period
    whole = int(np.floor(samples + 1e-9))
    return whole, max(0.0, samples - whole)


def _held(period: float, fraction: float) -> tuple[FloatArray, FloatArray]:
    """The contribution to (q, q') of an old command, acting for `fraction` of the period, and of the new one after it."""
    rest = 1.0 - fraction
    return (
        np.array((0.5 * period**2 * (1.0 - rest**2), period * fraction)),
        np.array((0.5 * period**2 * rest**2, period * rest)),
    )


def channels(scenario: Scenario) -> dict[str, Channel]:
    """The linear loop of each axis, for the slope h of the gears. Raises UsageError for an unknown law."""
    return channels_of(scenario, make_realisation(scenario.law, scenario))


def channels_of(scenario: Scenario, law: Realisation) -> dict[str, Channel]:
    """The same for a law that has been realised already."""
    ratios = gain_ratios(scenario)
    loops = {}
    for i, axis in enumerate(AXES):
        b = scenario.control.b[i]
        loops[axis] = Channel(
            axis,
            float(ratios[i]),
            scenario.period_ns / NANOSECONDS,
            A=law.A[i],
            B=np.stack(
                (law.B[i, :, POSITION] + law.B[i, :, ERROR], law.B[i, :, VELOCITY] + law.B[i, :, ERROR_RATE]), 1
            ),
            B_tau=law.B_tau[i] / b,
            C=law.C[i] * b,
            D=np.array((law.D[i, POSITION] + law.D[i, ERROR], law.D[i, VELOCITY] + law.D[i, ERROR_RATE])) * b,
        )
    return loops


def gain_ratios(scenario: Scenario) -> FloatArray:
    """g/b (6,): slope h of the gears over inertia, over the law's b."""
    inertia = np.array((scenario.body.mass,) * 3 + scenario.body.inertia)
    return np.asarray(np.array(scenario.hysteresis.h) / inertia / np.array(scenario.control.b))


def stable_gains(channel: Channel, delay_s: float, turn: complex = 1.0) -> list[tuple[float, float]]:
    """Every interval of real gains r > 0 for which the loop with gain r `turn` is stable; ends may be 0 and infinity."""
    complex_turn = bool(np.imag(turn))
    borders = sorted(_border_gains(channel, delay_s, turn, nyquist=not complex_turn))
    ends = [0.0, *borders, np.inf]
    intervals: list[tuple[float, float]] = []
    for low, high in itertools.pairwise(ends):
        if low == 0.0:
            middle = 0.5 * high if np.isfinite(high) else 1.0
        else:
            middle = float(np.sqrt(low * high)) if np.isfinite(high) else 2.0 * low
        if not channel.stable(middle * turn if complex_turn else middle, delay_s):
            continue
        if intervals and intervals[-1][1] == low:
            low = intervals.pop()[0]  # noqa: PLW2901 - a border that was touched, not crossed
        intervals.append((low, high))
    return intervals


def _border_gains(channel: Channel, delay_s: float, turn: complex, *, nyquist: bool) -> Iterator[float]:
    """Gains r at which r `turn` L(j omega) = -1 for some frequency: where the loop is real and negative."""
    omega, loop = channel.frequencies, turn * channel.loop(delay_s)
    change = np.nonzero((np.sign(loop.imag[:-1]) * np.sign(loop.imag[1:]) < 0) & (loop.real[:-1] + loop.real[1:] < 0))[
        0
    ]
    for i in change:
        if i == len(omega) - 2 and nyquist:
            continue  # there the imaginary part is zero by rounding; that boundary is handled below
        crossing = _root(lambda w: (turn * channel._loop_at(delay_s, w)).imag, omega[i], omega[i + 1])
        real = (turn * channel._loop_at(delay_s, crossing)).real
        if real < 0.0:
            yield -1.0 / real
    if nyquist and loop[-1].real < 0.0:
        yield -1.0 / float(loop[-1].real)


def range_around(intervals: list[tuple[float, float]], gain: float) -> tuple[float, float] | None:
    """The interval that contains the gain; else the nearest one; None where there are no intervals."""

    def distance(interval: tuple[float, float]) -> float:
        low, high = interval
        return float(max(np.log(max(low, 1e-300) / gain), np.log(gain / high), 0.0))

    return min(intervals, key=distance, default=None)


def crossovers(channel: Channel, gain: complex, delay_s: float) -> list[tuple[float, float]]:
    """(omega, phase margin) at each frequency (rad/s) where |gain L| = 1; margins in rad, wrapped to +-pi."""
    omega, size = channel.frequencies, np.log(np.abs(gain * channel.loop(delay_s)))
    found = []
    for i in np.nonzero(np.sign(size[:-1]) * np.sign(size[1:]) < 0)[0]:
        crossing = _root(lambda w: float(np.log(abs(gain * channel._loop_at(delay_s, w)))), omega[i], omega[i + 1])
        found.append((crossing, float(np.angle(-gain * channel._loop_at(delay_s, crossing)))))
    return found


def largest_delay(channel: Channel, gain: complex) -> float | None:
    """The largest total delay (s) up to which the loop stays stable; 0 where it is unstable without delay; None: no limit.

    A Newton iteration on the phase margin estimates it; eigenvalues 0.02 periods to both sides and at smaller delays
    confirm it; if they do not, a bisection on the eigenvalues finds it to a hundredth of a period.
    """
    if not channel.stable(gain, 0.0):
        return 0.0
    period = channel.period
    proposed = _proposed_delay(channel, gain)
    if proposed is not None:
        near = 0.02 * period
        along = [proposed * k / 6.0 for k in range(1, 6)]
        if (
            all(channel.stable(gain, delay) for delay in along)
            and channel.stable(gain, max(0.0, proposed - near))
            and not channel.stable(gain, proposed + near)
        ):
            return proposed
    low, step = 0.0, 0.5 * period
    while channel.stable(gain, low + step):
        low += step
        if low > _ENOUGH_SAMPLES * period:
            return None
        step = max(0.5 * period, 0.02 * low)
    high = low + step
    while high - low > 0.01 * period:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if channel.stable(gain, middle) else (low, middle)
    return 0.5 * (low + high)


def _proposed_delay(channel: Channel, gain: complex) -> float | None:
    """The delay at which the smallest phase margin vanishes, if the iteration converges."""
    delay = 0.0
    for _ in range(25):
        margins = crossovers(channel, gain, delay)
        if not margins:
            return None
        # Without delay the margin is counted downwards only; later it may have either sign.
        steps = [(margin % (2.0 * np.pi) if delay == 0.0 else margin) / omega for omega, margin in margins]
        step = min(steps, key=abs)
        delay += step
        if not 0.0 <= delay < _ENOUGH_SAMPLES * channel.period:
            return None
        if abs(step) < 1e-6 * channel.period:
            return delay
    return None
