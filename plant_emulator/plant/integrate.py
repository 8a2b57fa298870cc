"""The plant over time: commands act when they arrive, gears move at once, the body is integrated by Runge-Kutta 4.

Every kernel works in place on a `PlantState`; `Plant` is their interface for Python. A command that arrives within a
step of the integrator splits that step in two, so the time at which it acts is exact.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from plant_emulator.plant.backlash import ELSEWHERE, gear_parameters, gear_step
from plant_emulator.plant.rigid_body import BodyParameters, Specific, acceleration, body_parameters
from protocol.compiled import Packed, compiled, pack, views
from protocol.errors import DivergenceError
from protocol.messages import FloatArray
from protocol.rotations import PITCH_LIMIT_RAD
from protocol.scenario import NANOSECONDS, Scenario

PENDING = 4096
"""Most commands that can be pending (delayed, not yet acting) at once: 2 s at 2 kHz."""

GOES_ON = 0
NOT_FINITE = 1
PITCH_LIMIT = 2
TOO_MANY_PENDING = 3


class ActuatorParameters(NamedTuple):
    """From commands to the wrench on the body: u = gear(tau), then wrench = allocation u.

    model, h, p, chi   the gears: model code, slope (6,), kappa or half width (6,), chi (6,); see `backlash`
    allocation (6, 6)  generalised body force (row) that one unit of each actuator's u (column) makes; identity: six forces
    """

    model: int
    h: FloatArray
    p: FloatArray
    chi: FloatArray
    allocation: FloatArray


class PlantState(NamedTuple):
    """The plant's state, changed in place by the kernels.

    motion        (12,)       q and q' (m, rad, m/s, rad/s)
    tau           (6,)        motor command in action (N, N m)
    u             (6,)        output of the actuators, after the gears
    wrench        (6,)        generalised body force of u: allocation u
    d             (6,)        hysteresis state u - h tau
    pending_ns    (PENDING,)  when each pending command begins to act
    pending_tau   (PENDING, 6)
    queue         (2,)        index of the first pending command, and their number
    packed                    all of the above as one structure (the arrays share its memory), for calls from Python
    """

    motion: FloatArray
    tau: FloatArray
    u: FloatArray
    wrench: FloatArray
    d: FloatArray
    pending_ns: npt.NDArray[np.int64]
    pending_tau: FloatArray
    queue: npt.NDArray[np.int64]
    packed: Packed


def initial_state(scenario: Scenario) -> PlantState:
    """The plant at t = 0: the scenario's motion, its initial command in action, d = 0."""
    tau = np.array(scenario.initial.command)
    u = np.array(scenario.hysteresis.h) * tau
    packed = pack(
        {
            "motion": scenario.initial_motion,
            "tau": tau,
            "u": u,
            "wrench": u,
            "d": np.zeros(6),
            "pending_ns": np.zeros(PENDING, dtype=np.int64),
            "pending_tau": np.zeros((PENDING, 6)),
            "queue": np.zeros(2, dtype=np.int64),
        }
    )
    return PlantState(**views(packed), packed=packed)


@compiled
def push_command(state: PlantState, t_ns: int, tau: FloatArray) -> bool:
    """Let tau act from t_ns on; times must not decrease. False where too many commands are pending."""
    first, count = state.queue[0], state.queue[1]
    if count == PENDING:
        return False
    at = (first + count) % PENDING
    state.pending_ns[at] = t_ns
    state.pending_tau[at] = tau
    state.queue[1] = count + 1
    return True


@compiled
def allocate(allocation: FloatArray, u: FloatArray, wrench: FloatArray) -> None:
    """Fill wrench (6,) with allocation (6, 6) times u (6,)."""
    for i in range(6):
        total = 0.0
        for j in range(6):
            total += allocation[i, j] * u[j]
        wrench[i] = total


@compiled
def apply_due_commands(state: PlantState, gears: ActuatorParameters, t_ns: int) -> None:
    """Apply every command that is due, one after the other, so that the gears see each reversal."""
    if state.queue[1] == 0 or state.pending_ns[state.queue[0]] > t_ns:
        return
    while state.queue[1] > 0 and state.pending_ns[state.queue[0]] <= t_ns:
        at = state.queue[0]
        for i in range(6):
            tau = state.pending_tau[at, i]
            state.u[i], state.d[i] = gear_step(
                gears.model, state.tau[i], tau, state.u[i], state.d[i], gears.h[i], gears.p[i], gears.chi[i]
            )
            state.tau[i] = tau
        state.queue[0] = (at + 1) % PENDING
        state.queue[1] -= 1
    allocate(gears.allocation, state.u, state.wrench)


@compiled
def specific_wrench(t: float, wrench: FloatArray, body: BodyParameters) -> Specific:
    """The wrench on the body at time t (s), actuators plus disturbance, divided by its inertia."""
    s, d = body.specific, body.disturbance
    swing = 0.0
    if body.disturbance_frequency != 0.0:
        swing = math.sin(body.disturbance_frequency * t)
    return (
        s[0] * wrench[0] + swing * d[0],
        s[1] * wrench[1] + swing * d[1],
        s[2] * wrench[2] + swing * d[2],
        s[3] * wrench[3] + swing * d[3],
        s[4] * wrench[4] + swing * d[4],
        s[5] * wrench[5] + swing * d[5],
    )


@compiled
def specific_force(t: float, wrench: FloatArray, body: BodyParameters, force: FloatArray) -> None:
    """Fill force (3,), m/s^2, with what an accelerometer reads at time t (s): a - g in the body frame."""
    swing = math.sin(body.disturbance_frequency * t) if body.disturbance_frequency != 0.0 else 0.0
    for i in range(3):
        force[i] = wrench[i] / body.mass + swing * body.disturbance[i]


@compiled
def runge_kutta_step(motion: FloatArray, wrench: FloatArray, t: float, step: float, body: BodyParameters) -> None:
    """One classical Runge-Kutta step of fourth order on motion (12,), in place; the wrench (6,) is constant over it.

    Written in scalars so that the compiler keeps all of it in registers. Accelerations do not depend on
    position and velocity, so the stages of the translation reduce to one sum each.
    """
    half, sixth = 0.5 * step, step / 6.0
    a, b, c = motion[3], motion[4], motion[5]
    va, vb, vc = motion[9], motion[10], motion[11]
    start = specific_wrench(t, wrench, body)
    middle = end = start
    if body.disturbance_frequency != 0.0:
        middle, end = specific_wrench(t + half, wrench, body), specific_wrench(t + step, wrench, body)

    x1, y1, z1, a1, b1, c1 = acceleration(a, b, c, va, vb, vc, start, body)
    va2, vb2, vc2 = va + half * a1, vb + half * b1, vc + half * c1
    x2, y2, z2, a2, b2, c2 = acceleration(a + half * va, b + half * vb, c + half * vc, va2, vb2, vc2, middle, body)
    va3, vb3, vc3 = va + half * a2, vb + half * b2, vc + half * c2
    x3, y3, z3, a3, b3, c3 = acceleration(a + half * va2, b + half * vb2, c + half * vc2, va3, vb3, vc3, middle, body)
    va4, vb4, vc4 = va + step * a3, vb + step * b3, vc + step * c3
    x4, y4, z4, a4, b4, c4 = acceleration(a + step * va3, b + step * vb3, c + step * vc3, va4, vb4, vc4, end, body)

    motion[0] += step * (motion[6] + sixth * (x1 + x2 + x3))
    motion[1] += step * (motion[7] + sixth * (y1 + y2 + y3))
    motion[2] += step * (motion[8] + sixth * (z1 + z2 + z3))
    motion[3] += sixth * (va + 2.0 * (va2 + va3) + va4)
    motion[4] += sixth * (vb + 2.0 * (vb2 + vb3) + vb4)
    motion[5] += sixth * (vc + 2.0 * (vc2 + vc3) + vc4)
    motion[6] += sixth * (x1 + 2.0 * (x2 + x3) + x4)
    motion[7] += sixth * (y1 + 2.0 * (y2 + y3) + y4)
    motion[8] += sixth * (z1 + 2.0 * (z2 + z3) + z4)
    motion[9] += sixth * (a1 + 2.0 * (a2 + a3) + a4)
    motion[10] += sixth * (b1 + 2.0 * (b2 + b3) + b4)
    motion[11] += sixth * (c1 + 2.0 * (c2 + c3) + c4)


@compiled
def advance(
    state: PlantState, body: BodyParameters, gears: ActuatorParameters, t_ns: int, end_ns: int, substep_ns: int
) -> int:
    """Integrate from t_ns to end_ns, a whole number of substeps later. Returns GOES_ON, NOT_FINITE or PITCH_LIMIT."""
    substep_end = t_ns + substep_ns
    while t_ns < end_ns:
        apply_due_commands(state, gears, t_ns)
        until = substep_end
        if state.queue[1] > 0 and state.pending_ns[state.queue[0]] < until:
            until = state.pending_ns[state.queue[0]]
        runge_kutta_step(state.motion, state.wrench, t_ns * 1e-9, (until - t_ns) * 1e-9, body)
        t_ns = until
        if t_ns == substep_end:
            substep_end += substep_ns
        total = 0.0
        for i in range(12):
            total += state.motion[i]
        if not math.isfinite(total):
            return NOT_FINITE
        if abs(state.motion[4]) > PITCH_LIMIT_RAD:
            return PITCH_LIMIT
    return GOES_ON


@compiled
def fill_row(state: PlantState, command: FloatArray, row: FloatArray) -> None:
    """Fill a row (31,) of the ground truth, except its first number: q, q', newest command, tau, u."""
    for i in range(12):
        row[1 + i] = state.motion[i]
    for i in range(6):
        row[13 + i] = command[i]
        row[19 + i] = state.tau[i]
        row[25 + i] = state.u[i]


@compiled
def record_and_advance(
    state: PlantState, parameters: Any, t_ns: int, end_ns: int, command: FloatArray, row: FloatArray
) -> int:
    """Apply the commands due at t_ns, fill the row (31,) of that time, then `advance`; returns its outcome."""
    apply_due_commands(state, parameters, t_ns)
    fill_row(state, command, row)
    return advance(state, parameters, parameters, t_ns, end_ns, parameters.substep_ns)


class Plant:
    """The plant for callers in Python: `command` sets the motors' target and its time, `advance` moves time on.

    State: see `PlantState`. Time starts at 0 ns. Nothing here reads a clock or draws a random number.

    gears_elsewhere   commands are forces after the gears, which are modelled outside this plant
    """

    def __init__(self, scenario: Scenario, *, gears_elsewhere: bool = False) -> None:
        self.state = initial_state(scenario)
        self.body = body_parameters(scenario.body, scenario.disturbance)
        self.gears = ActuatorParameters(*gear_parameters(scenario.hysteresis), np.eye(6))
        if gears_elsewhere:
            self.gears = self.gears._replace(model=ELSEWHERE)
            self.state.tau[:] = self.state.u
        self.substep_ns = scenario.substep_ns
        self.parameters = pack({**self.body._asdict(), **self.gears._asdict(), "substep_ns": self.substep_ns})
        self.t_ns = 0

    def command(self, t_ns: int, tau: FloatArray) -> None:
        """Let tau (6,) act from t_ns on; times must not decrease. Raises DivergenceError where too many are pending."""
        if not push_command(self.state.packed[0], t_ns, tau):
            self.refuse_more()

    def refuse_more(self) -> None:
        """Raise DivergenceError: too many commands are pending."""
        raise DivergenceError(divergence_sentence(TOO_MANY_PENDING, self.t_ns))

    def apply_due_commands(self) -> None:
        """Apply the commands that are due, without advancing time."""
        apply_due_commands(self.state.packed[0], self.parameters[0], self.t_ns)

    def advance(self, end_ns: int) -> None:
        """Integrate up to end_ns. Raises DivergenceError; the state is then the last one computed."""
        parameters = self.parameters[0]
        self.arrive(end_ns, advance(self.state.packed[0], parameters, parameters, self.t_ns, end_ns, self.substep_ns))

    def specific_force(self) -> FloatArray:
        """The reading (3,) of an accelerometer now, m/s^2: a - g in the body frame."""
        force = np.empty(3)
        specific_force(self.t_ns * 1e-9, self.state.wrench, self.parameters[0], force)
        return force

    def arrive(self, end_ns: int, outcome: int) -> None:
        """Record that a kernel has advanced the state to end_ns. Raises DivergenceError for an outcome other than GOES_ON."""
        if outcome != GOES_ON:
            raise DivergenceError(divergence_sentence(outcome, end_ns))
        self.t_ns = end_ns


def divergence_sentence(outcome: int, t_ns: int) -> str:
    """The error message of a run that diverged before t_ns, or cannot continue at t_ns."""
    if outcome == TOO_MANY_PENDING:
        return f"more than {PENDING} delayed commands are pending: lower the rate or the delay"
    reason = {
        NOT_FINITE: "the state is no longer finite",
        PITCH_LIMIT: f"the pitch angle exceeded {PITCH_LIMIT_RAD} rad, where the equations of motion become singular",
    }[outcome]
    return (
        f"the flight diverged at t = {t_ns / NANOSECONDS:.3f} s: {reason}; "
        "try a higher rate, less delay or lower gains (K, N) in the scenario"
    )
