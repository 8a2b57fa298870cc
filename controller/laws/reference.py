"""The reference: commands c(t) and the reference model (12), (31), solved in closed form as a pure function of time.

    q_d'' = -A_d q_d' - B_d q_d - C_d c(t),   c(t) = amplitude sin(frequency t + phase)   (32), (33)

per axis. It can be evaluated at any time, so a lost sample does no harm. By its sign the model lags by 180 degrees, and the
paper's numbers shrink the command: q_d swings +-12.55 cm for 100 cm and +-.313 rad for 2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from protocol.compiled import compiled
from protocol.messages import FloatArray
from protocol.scenario import Reference


class ReferenceParameters(NamedTuple):
    """The solution, as the kernel takes it; arrays (6,).

    sine, cosine         the steady swing: sine sin(frequency t) + cosine cos(frequency t)
    half_damping         A_d / 2
    discriminant         A_d^2 / 4 - B_d: above, at or below zero the model is over-, critically or underdamped
    offset, offset_rate  the transient and its rate at t = 0
    A_d, B_d, drive_sine, drive_cosine   for q_d'': the model itself, with -C_d c(t) split like the swing
    """

    frequency: FloatArray
    sine: FloatArray
    cosine: FloatArray
    half_damping: FloatArray
    discriminant: FloatArray
    offset: FloatArray
    offset_rate: FloatArray
    A_d: FloatArray
    B_d: FloatArray
    drive_sine: FloatArray
    drive_cosine: FloatArray


def reference_parameters(reference: Reference) -> ReferenceParameters:
    """Solve the model of a scenario, from q_d(0) = `initial`, q_d'(0) = 0."""
    damping, stiffness = np.array(reference.A_d), np.array(reference.B_d)
    frequency, phase = np.array(reference.frequency_rad_s), np.array(reference.phase_rad)
    drive = -np.array(reference.C_d) * np.array(reference.amplitude)
    drive_sine, drive_cosine = drive * np.cos(phase), drive * np.sin(phase)
    # Steady state of q'' + A q' + B q = s sin wt + c cos wt.
    inertia, friction = stiffness - frequency**2, damping * frequency
    gain = 1.0 / (inertia**2 + friction**2)
    sine = gain * (inertia * drive_sine + friction * drive_cosine)
    cosine = gain * (inertia * drive_cosine - friction * drive_sine)
    return ReferenceParameters(
        frequency=frequency,
        sine=sine,
        cosine=cosine,
        half_damping=0.5 * damping,
        discriminant=0.25 * damping**2 - stiffness,
        offset=np.array(reference.initial) - cosine,
        offset_rate=-frequency * sine,
        A_d=damping,
        B_d=stiffness,
        drive_sine=drive_sine,
        drive_cosine=drive_cosine,
    )


@compiled
def _free_motion(t: float, half_damping: float, discriminant: float) -> tuple[float, float]:
    """The two free motions at t of x'' + 2 half_damping x' + (half_damping^2 - discriminant) x = 0: even and odd."""
    if discriminant > 0.0:
        root = math.sqrt(discriminant)
        slow = math.exp(-(half_damping - root) * t)
        fast = math.exp(-(half_damping + root) * t)
        even, odd = 0.5 * (slow + fast), 0.5 * (slow - fast) / root
    elif discriminant < 0.0:
        root = math.sqrt(-discriminant)
        decay = math.exp(-half_damping * t)
        even, odd = decay * math.cos(root * t), decay * math.sin(root * t) / root
    else:
        even = math.exp(-half_damping * t)
        odd = even * t
    return even, odd


@compiled
def evaluate_reference(
    t: float, reference: ReferenceParameters, q: FloatArray, q_dot: FloatArray, q_ddot: FloatArray
) -> None:
    """Fill q_d, q_d' and q_d'' (6,) at time t (s)."""
    swing = lead = even = odd = 0.0
    for i in range(6):
        # Axes often share a frequency and a model: then their sines and exponentials are computed once.
        frequency = reference.frequency[i]
        if i == 0 or frequency != reference.frequency[i - 1]:
            swing, lead = math.sin(frequency * t), math.cos(frequency * t)
        half_damping, discriminant = reference.half_damping[i], reference.discriminant[i]
        if i == 0 or half_damping != reference.half_damping[i - 1] or discriminant != reference.discriminant[i - 1]:
            even, odd = _free_motion(t, half_damping, discriminant)
        x, v = reference.offset[i], reference.offset_rate[i]
        pull = v + half_damping * x
        q[i] = x * even + pull * odd + reference.sine[i] * swing + reference.cosine[i] * lead
        q_dot[i] = (
            v * even
            + (discriminant * x - half_damping * pull) * odd
            + frequency * (reference.sine[i] * lead - reference.cosine[i] * swing)
        )
        q_ddot[i] = (
            reference.drive_sine[i] * swing
            + reference.drive_cosine[i] * lead
            - reference.A_d[i] * q_dot[i]
            - reference.B_d[i] * q[i]
        )


@compiled
def _trajectory(t_ns: int, period_ns: int, reference: ReferenceParameters, result: FloatArray) -> None:
    for k in range(result.shape[0]):
        evaluate_reference((t_ns + k * period_ns) * 1e-9, reference, result[k, 0], result[k, 1], result[k, 2])


def reference_trajectory(reference: Reference, count: int, period_ns: int) -> FloatArray:
    """(count, 3, 6): q_d, q_d', q_d'' at t_k = k periods."""
    result = np.empty((count, 3, 6))
    _trajectory(0, period_ns, reference_parameters(reference), result)
    return result
