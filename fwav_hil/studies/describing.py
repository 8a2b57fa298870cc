"""The describing function of the gears, and the limit cycles predicted with it (harmonic balance).

tau = A sin(phi) is passed through the gear's own step function (`plant_emulator.plant.backlash`) until the output is
periodic; the first harmonic of the output divided by that of the input is N(A): complex, and the same at every frequency,
since the gear is rate independent. A constant part of tau has no effect. A gear of slope h has N = h; the hysteresis has
|N| < h and a phase lag.

In the linear loop N(A) replaces h. A limit cycle is where 1 + N(A) L(j omega) = 0: where a pole of the loop with
that gain is on the unit circle. It is stable where oscillations grow at smaller amplitudes and decay at larger ones.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from fwav_hil.studies.loop_model import Channel
from plant_emulator.plant.backlash import BACKLASH, PLAY, gear_parameters, gear_step
from protocol.compiled import compiled
from protocol.messages import FloatArray
from protocol.scenario import Backlash, Play

_STEPS = 2048
_PERIODS = 50


class Gear(NamedTuple):
    """One gear: model code, h, p (kappa or half width), chi, as `gear_step` takes them."""

    model: int
    h: float
    p: float
    chi: float

    @property
    def amplitude(self) -> float:
        """Approximate amplitude of tau at which the hysteresis is most visible: 1/chi, or the half width."""
        return self.p if self.model == PLAY else 1.0 / self.chi

    @property
    def reversal_slope(self) -> float:
        """du/dtau just after a reversal at the end of a long stroke: 2 kappa - h, or 0 for the play operator."""
        return 0.0 if self.model == PLAY else 2.0 * self.p - self.h

    def alike(self, other: Gear) -> bool:
        """Whether both have the same N(A)/h, except for the scale of A."""
        mine, theirs = (0.0 if gear.model == PLAY else gear.p / gear.h for gear in (self, other))
        return self.model == other.model and math.isclose(mine, theirs, rel_tol=1e-9)


def gears(model: Backlash | Play) -> tuple[Gear, ...]:
    """The six gears of a scenario."""
    code, h, p, chi = gear_parameters(model)
    return tuple(Gear(code, *map(float, values)) for values in zip(h, p, chi, strict=True))


@compiled
def _first_harmonic(
    model: int, h: float, p: float, chi: float, amplitude: float, u: float, d: float, steps: int
) -> tuple[float, float, float, float]:
    """(in phase, in quadrature, u, d) over one period of tau = amplitude sin(phi) from phi = -pi/2 on.

    The moves between samples are exact; u over a move is taken at its ends, by the trapezoidal rule.
    """
    sine = cosine = 0.0
    tau = -amplitude
    for k in range(1, steps + 1):
        phi = 2.0 * math.pi * k / steps - 0.5 * math.pi
        following = amplitude * math.sin(phi)
        u, d = gear_step(model, tau, following, u, d, h, p, chi)
        tau = following
        sine += u * math.sin(phi)
        cosine += u * math.cos(phi)
    return 2.0 * sine / steps, 2.0 * cosine / steps, u, d


def describing_function(gear: Gear, amplitude: float) -> complex:
    """N(A) for tau of that amplitude (N, N m); the imaginary part is negative: a lag."""
    model, h, p, chi = gear
    # In the periodic motion d at the lower end is such that the next half stroke changes its sign.
    d = (h - p) / chi * math.tanh(chi * amplitude) if model == BACKLASH else h * p
    u = -h * amplitude + d
    for _ in range(_PERIODS):
        sine, cosine, u, after = _first_harmonic(model, h, p, chi, amplitude, u, d, _STEPS)
        settled = abs(after - d) <= 1e-9 * max(abs(d), h * amplitude)
        d = after
        if settled:
            break
    return complex(sine, cosine) / amplitude


class LimitCycle(NamedTuple):
    """A predicted oscillation: amplitude of tau (N, N m), frequency (rad/s), amplitude of q (m, rad); attracting or not.

    One that does not attract is a boundary: oscillations below that amplitude decay, those above it grow.
    """

    amplitude: float
    frequency_rad_s: float
    motion: float
    attracting: bool


def growth(channel: Channel, gear: Gear, delay_s: float, amplitude: float) -> tuple[float, float]:
    """(modulus, frequency in rad/s) of the outermost oscillating pole of the loop with N(A) in place of h."""
    gain = channel.ratio * describing_function(gear, amplitude) / gear.h
    poles = channel.poles(complex(gain), delay_s)
    outermost = poles[np.argmax(np.abs(poles))]
    return float(abs(outermost)), float(np.angle(outermost)) / channel.period


def amplitudes(gear: Gear, count: int) -> FloatArray:
    """A logarithmic grid from far below (a play's output is zero there) to far above the width of the hysteresis."""
    least = 1.01 if gear.model == PLAY else 0.02
    return np.geomspace(least, 500.0, count) * (gear.amplitude or 1.0)


def limit_cycles(channel: Channel, gear: Gear, b: float, delay_s: float) -> list[LimitCycle]:
    """Every limit cycle that harmonic balance predicts for this channel, by amplitude. `b` turns tau into b tau."""
    grid = np.log(amplitudes(gear, 70))
    excess = [growth(channel, gear, delay_s, math.exp(a))[0] - 1.0 for a in grid]
    found = []
    for i in range(len(grid) - 1):
        if excess[i] * excess[i + 1] >= 0.0:
            continue
        amplitude = math.exp(
            brentq(lambda a: growth(channel, gear, delay_s, math.exp(a))[0] - 1.0, grid[i], grid[i + 1], xtol=1e-6)
        )
        _, frequency = growth(channel, gear, delay_s, amplitude)
        # The plant alone: q = N/h ratio b tau / -(omega^2), except for the hold.
        size = abs(describing_function(gear, amplitude)) / gear.h * channel.ratio * b
        found.append(LimitCycle(amplitude, frequency, size * amplitude / frequency**2, excess[i] > 0.0))
    return found
