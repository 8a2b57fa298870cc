"""The one stepping function of every control law, and its state.

Between its inputs and tau each law is linear: per axis a discrete state space, computed once from its equations and its
sampling period by the law's own file (`ude`, `pd`, `dob`):

    tau_k    = C x_k + D r_k + bias          r = [q, q_e, q_d'', q', q_e']   (the last two for state feedback only)
    x_(k+1)  = A x_k + B r_k + B_tau tau_applied_k
    uhat_k   = C_u x_k + D_u r_k             the estimate of u_d, for the log and for restarting after a gap

Then the force is rotated into the body, limited and rounded to float32 as on the wire; the applied value is rotated back
and fed to the observer (anti-windup). The HIL process, the in-process simulation and the margin study all use this
object. For x_0 at the start and after missing samples see `_start_axis` and `control_step`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from controller.laws.reference import ReferenceParameters, evaluate_reference, reference_parameters
from controller.laws.registry import law_entry, make_realisation, velocity_sentence
from controller.laws.state_space import INPUTS, Realisation
from protocol.compiled import Packed, compiled, pack, views
from protocol.errors import UsageError
from protocol.messages import FloatArray
from protocol.rotations import rotate_to_body, rotate_to_inertial, unwrap_angle, wrap_angle
from protocol.scenario import Actuators, Scenario
from protocol.wire.mapping import command_from_wire, command_to_wire


class Output(NamedTuple):
    """From the linear law to the wire: limits and scale (6,), body frame; whether the force is rotated into the body."""

    lower: FloatArray
    upper: FloatArray
    scale: FloatArray
    rotate_force: bool


class LawState(NamedTuple):
    """The state of a law, changed in place.

    x         (6, n)  states of the realisation
    q         (6,)    last measured position and attitude, angles unwrapped
    applied   (6,)    tau applied last, inertial frame
    uhat      (6,)    last estimate
    tau       (6,)    last command, body frame, exactly as sent on the wire
    desired   (3, 6)  q_d, q_d', q_d'' at the last sample
    t_ns      (1,)    the law's own time: that of the first sample plus whole periods
    fresh     (1,)    not zero: the next sample starts the law
    counts    (4,)    STEPS, MISSED, RESTARTS, SATURATED
    r         (6, INPUTS)  inputs of the last step
    scratch   (3, 6)
    packed    all of the above as one structure (the arrays above share its memory), for calls from Python
    """

    x: FloatArray
    q: FloatArray
    applied: FloatArray
    uhat: FloatArray
    tau: FloatArray
    desired: FloatArray
    t_ns: npt.NDArray[np.int64]
    fresh: npt.NDArray[np.int64]
    counts: npt.NDArray[np.int64]
    r: FloatArray
    scratch: FloatArray
    packed: Packed


STEPS, MISSED, RESTARTS, SATURATED = range(4)
COUNTS = ("steps", "missed_samples", "restarts", "saturated")


@compiled
def _inputs(q: FloatArray, velocity: FloatArray, desired: FloatArray, r: FloatArray) -> None:
    """Fill r (6, INPUTS); the error of an angle is wrapped to +-pi."""
    for axis in range(6):
        error = q[axis] - desired[0, axis]
        if axis >= 3:
            error = wrap_angle(error)
        r[axis, 0] = q[axis]
        r[axis, 1] = error
        r[axis, 2] = desired[2, axis]
        r[axis, 3] = velocity[axis]
        r[axis, 4] = velocity[axis] - desired[1, axis]


@compiled
def _start_axis(axis: int, law: Realisation, state: LawState, uhat: float) -> None:
    """x_0: the observer at rest at q_0 with the estimate uhat, the differentiator at rest."""
    for i in range(state.x.shape[1]):
        x = law.start_u[axis, i] * uhat
        for j in range(INPUTS):
            x += law.start_r[axis, i, j] * state.r[axis, j]
        state.x[axis, i] = x


@compiled
def _step_states(law: Realisation, state: LawState) -> None:
    """x_(k+1) from x_k and the inputs r, in place."""
    order = state.x.shape[1]
    following = state.scratch[2]
    for axis in range(6):
        for i in range(order):
            x = law.B_tau[axis, i] * state.applied[axis]
            for j in range(order):
                x += law.A[axis, i, j] * state.x[axis, j]
            for j in range(INPUTS):
                x += law.B[axis, i, j] * state.r[axis, j]
            following[i] = x
        for i in range(order):
            state.x[axis, i] = following[i]


@compiled
def begin_sample(law: Realisation, period_ns: int, state: LawState, t_ns: int, measured: FloatArray) -> int:
    """Accept the sample `measured` (6,) of time t_ns, its angles unwrapped; returns the periods since the last one.

    0: the sample arrives more than half a period early, so nothing changes and the last command remains. Periods are
    counted from the first sample, which begins the law's own time.
    """
    first = state.fresh[0] != 0
    periods = 1
    if not first:
        periods = (t_ns - state.t_ns[0] + period_ns // 2) // period_ns
        if periods < 1:
            return 0
        state.counts[1] += periods - 1
    for i in range(3):
        state.scratch[0, i] = measured[i]
        state.scratch[0, 3 + i] = measured[3 + i] if first else unwrap_angle(measured[3 + i], state.q[3 + i])
    return int(periods)


@compiled
def coast(law: Realisation, state: LawState, part: float, velocity: FloatArray) -> None:
    """Step through a period without a sample: q is interpolated between the last sample and this one, at fraction `part`.

    tau is held. state.desired holds the reference at the end of that period.
    """
    between = state.scratch[1]
    for axis in range(6):
        between[axis] = state.q[axis] + (state.scratch[0, axis] - state.q[axis]) * part
    _inputs(between, velocity, state.desired, state.r)
    _step_states(law, state)


@compiled
def law_output(law: Realisation, state: LawState, gap_s: float, velocity: FloatArray) -> None:
    """Compute the law's command for the sample begun, inertial frame, in state.tau; its estimate in state.uhat.

    state.desired (3, 6) holds the reference at the time of the sample. An axis restarts from its last estimate where the gap
    reaches its memory_s; at the first sample every axis starts from uhat0.
    """
    first = state.fresh[0] != 0
    restarted = False
    r = state.r
    _inputs(state.scratch[0], velocity, state.desired, r)
    for axis in range(6):
        if first:
            _start_axis(axis, law, state, law.uhat0[axis])
        elif gap_s >= law.memory_s[axis]:
            _start_axis(axis, law, state, state.uhat[axis])
            restarted = True
        uhat = 0.0
        tau = law.bias[axis]
        for i in range(state.x.shape[1]):
            uhat += law.C_u[axis, i] * state.x[axis, i]
            tau += law.C[axis, i] * state.x[axis, i]
        for j in range(INPUTS):
            uhat += law.D_u[axis, j] * r[axis, j]
            tau += law.D[axis, j] * r[axis, j]
        state.uhat[axis] = uhat
        state.tau[axis] = tau
    if restarted:
        state.counts[2] += 1


@compiled
def law_advance(law: Realisation, period_ns: int, state: LawState, t_ns: int, periods: int) -> None:
    """Advance to the next period; state.applied (6,) holds the command that really acts until then, inertial frame."""
    _step_states(law, state)
    for axis in range(6):
        state.q[axis] = state.scratch[0, axis]
    state.t_ns[0] = t_ns if state.fresh[0] != 0 else state.t_ns[0] + periods * period_ns
    state.fresh[0] = 0
    state.counts[0] += 1


@compiled
def limit_on_the_wire(output: Output, state: LawState, measured: FloatArray) -> None:
    """Rotate state.tau into the body frame, limit and round it as HIL_ACTUATOR_CONTROLS does; state.applied is the result."""
    tau = state.tau
    alpha, beta, gamma = measured[3], measured[4], measured[5]
    if output.rotate_force:
        tau[0], tau[1], tau[2] = rotate_to_body(alpha, beta, gamma, tau[0], tau[1], tau[2])
    saturated = False
    for axis in range(6):
        allowed = min(max(tau[axis], output.lower[axis]), output.upper[axis])
        saturated = saturated or allowed != tau[axis]
        tau[axis] = command_from_wire(command_to_wire(allowed, output.scale[axis]), output.scale[axis])
        state.applied[axis] = tau[axis]
    if saturated:
        state.counts[3] += 1
    if output.rotate_force:
        state.applied[0], state.applied[1], state.applied[2] = rotate_to_inertial(
            alpha, beta, gamma, tau[0], tau[1], tau[2]
        )


@compiled
def control_step(
    law: Realisation,
    output: Output,
    reference: ReferenceParameters,
    period_ns: int,
    state: LawState,
    t_ns: int,
    measured: FloatArray,
    velocity: FloatArray,
) -> None:
    """One step of the law on the sample `measured` (6,) of time t_ns; the command is then in state.tau (6,), body frame.

    The reference is passed in as data. The output is separate from the advance with what really acts, so that another sink
    can apply its own limits in between. Periods without a sample are stepped first, all at once (q linear, tau held), unless
    the gap is as long as the longest memory_s. `velocity` (6,) is read by state-feedback laws only.
    """
    periods = begin_sample(law, period_ns, state, t_ns, measured)
    if periods < 1:
        return
    gap_s = periods * period_ns * 1e-9 if periods > 1 else 0.0
    if gap_s < law.memory_s.max():
        for missing in range(1, periods):
            then_s = (state.t_ns[0] + missing * period_ns) * 1e-9
            evaluate_reference(then_s, reference, state.desired[0], state.desired[1], state.desired[2])
            coast(law, state, missing / periods, velocity)
    evaluate_reference(t_ns * 1e-9, reference, state.desired[0], state.desired[1], state.desired[2])
    law_output(law, state, gap_s, velocity)
    limit_on_the_wire(output, state, measured)
    law_advance(law, period_ns, state, t_ns, periods)


@compiled
def packed_control_step(law: Packed, state: Packed, t_ns: int, measured: FloatArray, velocity: FloatArray) -> None:
    """`control_step` on packed structures: `Law.packed` and `LawState.packed`."""
    data = law[0]
    control_step(data, data, data, data.period_ns, state[0], t_ns, measured, velocity)


class Law:
    """A control law ready to run: data plus one step function.

    name            as in the registry (`controller.laws.registry`)
    needs_velocity  state feedback: available in the in-process simulation only
    realisation, output, reference, period_ns: what `control_step` takes; packed: all four as one structure
    """

    def __init__(
        self, name: str, scenario: Scenario, realisation: Realisation, *, needs_velocity: bool = False
    ) -> None:
        self.name = name
        self.needs_velocity = needs_velocity
        self.realisation = realisation
        self.output = output_of(scenario.actuators, rotate_force=scenario.control.rotate_force)
        self.reference = reference_parameters(scenario.reference)
        self.period_ns = scenario.period_ns
        self.packed = pack(
            {
                **realisation._asdict(),
                **self.output._asdict(),
                **self.reference._asdict(),
                "period_ns": self.period_ns,
            }
        )

    def start(self) -> LawState:
        """The state before the first sample."""
        order = self.realisation.A.shape[1]
        packed = pack(
            {
                "x": np.zeros((6, order)),
                "q": np.zeros(6),
                "applied": np.zeros(6),
                "uhat": np.zeros(6),
                "tau": np.zeros(6),
                "desired": np.zeros((3, 6)),
                "t_ns": np.zeros(1, dtype=np.int64),
                "fresh": np.ones(1, dtype=np.int64),
                "counts": np.zeros(len(COUNTS), dtype=np.int64),
                "r": np.zeros((6, INPUTS)),
                "scratch": np.zeros((3, max(6, order))),
            }
        )
        return LawState(**views(packed), packed=packed)

    def step(self, state: LawState, t_ns: int, q: FloatArray, q_dot: FloatArray | None = None) -> FloatArray:
        """tau (6,) in the body frame for the sample q (6,) of time t_ns; a copy, to keep.

        Raises UsageError where the law needs the velocity q_dot (6,) and it is not given.
        """
        if q_dot is None:
            if self.needs_velocity:
                raise UsageError(velocity_sentence(self.name))
            q_dot = _NO_VELOCITY
        packed_control_step(self.packed, state.packed, t_ns, q, q_dot)
        return state.tau.copy()

    def adopt(self, other: Law) -> None:
        """Adopt another law's gains, in place: all users of this law use them from now on; call `restart` afterwards.

        Raises UsageError, with nothing changed, where the other law has another form, or its gains are so extreme that its
        matrices are not finite.
        """
        if other.packed.dtype != self.packed.dtype or not all(np.isfinite(part).all() for part in other.realisation):
            raise UsageError(f"the law '{other.name}' with these gains cannot replace the running law '{self.name}'")
        self.realisation, self.output = other.realisation, other.output
        self.packed[...] = other.packed

    @staticmethod
    def restart(state: LawState) -> None:
        """Let the next sample start the law as its first sample did; counters are kept."""
        state.fresh[0] = 1

    @staticmethod
    def counts(state: LawState) -> dict[str, int]:
        """The law's counters, by name."""
        return dict(zip(COUNTS, state.counts.tolist(), strict=True))


def make_law(name: str, scenario: Scenario) -> Law:
    """The law called `name` for the scenario's gains and rate.

    Raises UsageError for an unknown name, ScenarioError where the law cannot use the scenario's filter.
    """
    return Law(name, scenario, make_realisation(name, scenario), needs_velocity=law_entry(name).needs_velocity)


_NO_VELOCITY = np.zeros(6)


def output_of(actuators: Actuators, *, rotate_force: bool) -> Output:
    """Limits and scales of a scenario as the kernel takes them."""
    return Output(np.array(actuators.lower), np.array(actuators.upper), np.array(actuators.scale), rotate_force)
