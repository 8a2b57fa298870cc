"""The check of the linear figures on the whole plant: hysteresis, limits, rotation, noise, as in `simulate`.

**When is a flight lost?** If it diverges; but limits turn many divergences into a saturated oscillation that never
ends. So a flight is lost where it diverges, or where in the second half of its time

- more than 20 % of the commands are at a limit, and
- on some axis the RMS error is over a quarter of the reference's own RMS swing, and over ten times the sensor's noise.

Both must hold: a limit reached occasionally is not a loss, nor is a constant error (a PD without gravity feed-forward), nor
the small limit cycle of a worn gear, which stays within the limits.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from controller.laws.law import Law, make_law
from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.score import desired_positions, tracking_error
from fwav_hil.simulate import Simulation, simulate
from protocol.messages import AXES, FloatArray
from protocol.scenario import NANOSECONDS, ZERO6, Backlash, Delay, Initial, Noise, Play, Scenario, Vector6

LOST_SATURATED = 0.2
LOST_ERROR = 0.25
_NOISES = 10.0
_LONGEST_S = 1.0
_SHORTEST_S = 10.0


class Flight(msgspec.Struct, frozen=True, kw_only=True):
    """The judgement of one flight.

    saturated   share of the commands of the second half with an axis at a limit
    error       by axis: RMS error of the second half over the reference's RMS swing there; None where it does not move
    lost        why the flight is lost, or None
    """

    delay_s: float
    saturated: float
    error: dict[str, float | None]
    lost: str | None


def fly(scenario: Scenario, delay_s: float, law: Law | None = None) -> Flight:
    """Simulate the scenario with this total delay (s, at most 1) in place of its own, and judge it; `law`: reused if given.

    It lasts as long as the scenario, but at least 10 s (a start-up alone is not enough) and at most 20 s.
    """
    duration_s = min(max(scenario.duration_s, _SHORTEST_S), 2.0 * _SHORTEST_S)
    delayed = msgspec.structs.replace(scenario, delay=Delay(samples=0, seconds=delay_s), duration_s=duration_s)
    return judge_flight(delayed, simulate(delayed, law))


def judge_flight(scenario: Scenario, result: Simulation) -> Flight:
    """Judge a flight by the definition at the top of this module."""
    half = len(result.t_ns) // 2
    error = _rms(tracking_error(scenario, result.q)[half:])
    desired = desired_positions(scenario, len(result.q))[half:]
    swing = _rms(desired - desired.mean(axis=0)) if len(desired) else np.zeros(6)
    saturated = saturated_share(scenario, result.command[half:])
    noise = np.repeat((scenario.noise.position, scenario.noise.attitude), 3)
    off = error > np.maximum(LOST_ERROR * swing, _NOISES * noise)
    lost = result.divergence
    if lost is None and saturated > LOST_SATURATED and off.any():
        where = ", ".join(name for name, is_off in zip(AXIS_NAMES.values(), off, strict=True) if is_off)
        lost = f"{100.0 * saturated:.0f} % of the commands are at a limit and the error of {where} does not settle"
    return Flight(
        delay_s=scenario.delay_ns / NANOSECONDS,
        saturated=saturated,
        error={
            axis: float(e / s) if s > 0.0 and np.isfinite(e) else None
            for axis, e, s in zip(AXES, error, swing, strict=True)
        },
        lost=lost,
    )


def saturated_share(scenario: Scenario, command: FloatArray) -> float:
    """Share of the commands (n, 6) with an axis at a limit, to the rounding of the wire (float32)."""
    if not len(command):
        return 0.0
    near = 1e-6 * np.array(scenario.actuators.scale)
    at_limit = (command <= np.array(scenario.actuators.lower) + near) | (
        command >= np.array(scenario.actuators.upper) - near
    )
    return float(at_limit.any(axis=1).mean())


def without_hysteresis(scenario: Scenario) -> Scenario:
    """Gears with u = h tau (to one part in 10^9, since kappa must stay below h)."""
    gears = scenario.hysteresis
    if isinstance(gears, Backlash):
        x, y, z, roll, pitch, yaw = ((1.0 - 1e-9) * np.array(gears.h)).tolist()
        straight: Backlash | Play = msgspec.structs.replace(gears, kappa=(x, y, z, roll, pitch, yaw))
    else:
        straight = msgspec.structs.replace(gears, B=ZERO6)
    return msgspec.structs.replace(scenario, hysteresis=straight)


def with_far_limits(scenario: Scenario, factor: float = 100.0) -> Scenario:
    """Actuator limits, and the wire's scales, multiplied by that factor."""
    actuators = scenario.actuators

    def far(values: Vector6) -> Vector6:
        x, y, z, roll, pitch, yaw = (factor * np.array(values)).tolist()
        return (x, y, z, roll, pitch, yaw)

    return msgspec.structs.replace(
        scenario,
        actuators=msgspec.structs.replace(
            actuators, lower=far(actuators.lower), upper=far(actuators.upper), scale=far(actuators.scale)
        ),
    )


def without_noise(scenario: Scenario) -> Scenario:
    """The scenario without sensor noise."""
    return msgspec.structs.replace(scenario, noise=Noise())


def about_rest(scenario: Scenario) -> Scenario:
    """The vehicle held at the origin, released 1 mm and .01 rad off: motions too small to couple the axes by rotation."""
    return msgspec.structs.replace(
        scenario,
        reference=msgspec.structs.replace(scenario.reference, amplitude=ZERO6, initial=ZERO6),
        initial=Initial(position=(1e-3,) * 3, attitude=(1e-2,) * 3, command=scenario.initial.command),
    )


VARIANTS: tuple[tuple[str, Callable[[Scenario], Scenario]], ...] = (
    ("no noise", without_noise),
    ("gears without hysteresis", without_hysteresis),
    ("limits 100 times as far", with_far_limits),
    ("small motions about rest", about_rest),
    ("small motions, no noise, no hysteresis", lambda s: without_noise(without_hysteresis(about_rest(s)))),
)
"""Parts removed from the plant to find the cause of the difference to the linear figure; the last is the linear loop."""


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0))) if len(values) else np.full(6, np.nan)


class FlownDelay(msgspec.Struct, frozen=True, kw_only=True):
    """The bisection on delay: the flight at the scenario's own delay, the longest delay not lost, the shortest lost (s).

    max_delay_s is 0 where the flight is lost without delay; lost_delay_s is None where none up to a second is lost.
    """

    at_own_delay: Flight
    max_delay_s: float
    lost_delay_s: float | None
    why_lost: str | None
    flights: int


def flown_delay(
    scenario: Scenario, first_guess_s: float | None, progress: Callable[[], None] = lambda: None
) -> FlownDelay:
    """Bisect on the total delay to a tenth of a sample, and at least 2 %; `progress` is called after each flight."""
    flights = 0
    law = make_law(scenario.law, scenario)  # no delay changes it

    def lost(delay_s: float) -> str | None:
        nonlocal flights
        flights += 1
        outcome = fly(scenario, delay_s, law).lost
        progress()
        return outcome

    own = fly(scenario, scenario.delay_ns / NANOSECONDS, law)
    progress()
    if why := lost(0.0):
        return FlownDelay(at_own_delay=own, max_delay_s=0.0, lost_delay_s=0.0, why_lost=why, flights=flights + 1)
    period = scenario.period_ns / NANOSECONDS
    low, high = 0.0, min(_LONGEST_S, max(first_guess_s or 0.0, period))
    while not (why := lost(high)):
        if high >= _LONGEST_S:
            return FlownDelay(at_own_delay=own, max_delay_s=high, lost_delay_s=None, why_lost=None, flights=flights + 1)
        low, high = high, min(_LONGEST_S, 1.5 * high)
    while high - low > min(0.1 * period, 0.02 * high):
        middle = 0.5 * (low + high)
        if found := lost(middle):
            high, why = middle, found
        else:
            low = middle
    return FlownDelay(at_own_delay=own, max_delay_s=low, lost_delay_s=high, why_lost=why, flights=flights + 1)


class Oscillation(msgspec.Struct, frozen=True, kw_only=True):
    """The free motion of one axis in closed loop: amplitudes of q (m, rad) and tau (N, N m), frequency (rad/s).

    All None: the flight diverged. Amplitudes 0 and no frequency: it comes to rest.
    """

    motion: float | None
    amplitude: float | None
    frequency_rad_s: float | None


_AT_REST = 0.01
"""An oscillation below this share of the axis's initial offset counts as rest."""


def at_rest(scenario: Scenario, offset: FloatArray, duration_s: float = 20.0) -> dict[str, Oscillation]:
    """Hold the vehicle at the origin, without noise and disturbance, released at `offset` (6,): the motion in the last half.

    Amplitudes are those of a sine of the same power; the frequency is that of the spectrum's peak (to about 0.3 rad/s).
    """
    quiet = msgspec.structs.replace(
        about_rest(scenario),
        duration_s=duration_s,
        noise=Noise(),
        disturbance=msgspec.structs.replace(scenario.disturbance, amplitude=ZERO6),
        initial=Initial(
            position=(float(offset[0]), float(offset[1]), float(offset[2])),
            attitude=(float(offset[3]), float(offset[4]), float(offset[5])),
            command=scenario.initial.command,
        ),
    )
    result = simulate(quiet)
    half = len(result.t_ns) // 2
    found = {}
    for i, axis in enumerate(AXES):
        motion, tau = (_without_drift(values[half:, i]) for values in (result.q, result.tau))
        size = float(np.sqrt(2.0) * motion.std())
        if result.divergence or not np.isfinite(size):
            found[axis] = Oscillation(motion=None, amplitude=None, frequency_rad_s=None)
        elif size < _AT_REST * abs(offset[i]):
            found[axis] = Oscillation(motion=0.0, amplitude=0.0, frequency_rad_s=None)
        else:
            spectrum = np.abs(np.fft.rfft(motion * np.hanning(len(motion))))
            frequency = float(2.0 * np.pi * spectrum.argmax() / len(motion) * scenario.rate_hz)
            found[axis] = Oscillation(motion=size, amplitude=float(np.sqrt(2.0) * tau.std()), frequency_rad_s=frequency)
    return found


def _without_drift(values: FloatArray) -> FloatArray:
    """The remainder after subtracting a cubic fit: the slow approach to rest is not an oscillation."""
    if len(values) < 8:
        return values - values.mean() if len(values) else values
    t = np.linspace(-1.0, 1.0, len(values))
    return np.asarray(values - np.polynomial.Polynomial.fit(t, values, 3)(t))
