"""The closed loop in one process, without a link: the same law, plant, sampling, noise, delays and wire mapping.

A lockstep run of the two processes gives the same numbers to the bit, since every kernel is shared and the order of a
tick is the same: measure (rounded as on the wire), law, safety envelope, queue the command, record, advance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from controller.laws.law import Law, control_step, make_law
from plant_emulator.plant.integrate import GOES_ON, TOO_MANY_PENDING, Plant, divergence_sentence, record_and_advance
from plant_emulator.plant.safety import SafetyEnvelope
from plant_emulator.plant.sensors import PositionSensor, add_noise
from plant_emulator.tick import act
from protocol.compiled import Packed, compiled
from protocol.errors import UsageError
from protocol.messages import FloatArray
from protocol.scenario import Scenario
from protocol.wire.mapping import pose_from_wire, pose_to_wire


@compiled
def _loop(
    packed_law: Packed,
    packed_law_state: Packed,
    packed_plant: Packed,
    parameters: Packed,
    packed_envelope: Packed,
    delays_ns: np.typing.NDArray[np.int64],
    normal: FloatArray,
    position_noise: float,
    attitude_noise: float,
    rows: FloatArray,
) -> tuple[int, int]:
    """Run len(rows) ticks; row k is that of the ground truth at t_k. Returns (rows made, outcome).

    The command of tick k acts delays_ns[k] later, but never before that of the previous tick; with a negative delay it
    never acts.
    """
    law, law_state, plant = packed_law[0], packed_law_state[0], packed_plant[0]
    body, envelope, period_ns = parameters[0], packed_envelope[0], law.period_ns
    measured, seen, wire = np.empty(6), np.empty(6), np.empty(7)
    acts_ns = 0
    for k in range(rows.shape[0]):
        t_ns = k * period_ns
        add_noise(plant.motion, normal[k], position_noise, attitude_noise, measured)
        pose_to_wire(measured, wire)
        pose_from_wire(wire, seen)
        control_step(law, law, law, period_ns, law_state, t_ns, seen, plant.motion[6:])
        if delays_ns[k] >= 0:
            acts_ns = max(acts_ns, t_ns + delays_ns[k])
            if not act(envelope, plant, t_ns, acts_ns, law_state.tau, True):
                return k, TOO_MANY_PENDING
        outcome = record_and_advance(plant, body, t_ns, t_ns + period_ns, law_state.tau, rows[k])
        if outcome != GOES_ON:
            return k + 1, outcome
    return rows.shape[0], GOES_ON


class Simulation(NamedTuple):
    """The results of a simulation.

    t_ns (n,), and (n, 6) each: q, q_dot true motion at t_k; command, the tau of the law (body frame); tau, what acts at the
    motors at t_k; u, after the gears. divergence: why the run ended early, or None.
    """

    t_ns: np.typing.NDArray[np.int64]
    q: FloatArray
    q_dot: FloatArray
    command: FloatArray
    tau: FloatArray
    u: FloatArray
    law_counts: dict[str, int]
    divergence: str | None


def simulate(
    scenario: Scenario, law: Law | None = None, delays_ns: np.typing.NDArray[np.int64] | None = None
) -> Simulation:
    """Run a scenario; `law` replaces the scenario's own. A divergence ends the run early and is named in the result.

    delays_ns (ticks,): the delay of each tick's command in place of the scenario's; one below 0 never acts. Raises UsageError
    where their number is another.
    """
    if delays_ns is None:
        delays_ns = np.full(scenario.ticks, scenario.delay_ns)
    if delays_ns.shape != (scenario.ticks,):
        raise UsageError(f"delays of shape {delays_ns.shape} for {scenario.ticks} ticks: give one per tick")
    law = law or make_law(scenario.law, scenario)
    plant = Plant(scenario)
    state = law.start()
    rows = np.empty((scenario.ticks, 31))
    normal = PositionSensor(scenario.seed).draw(scenario.ticks)
    count, outcome = _loop(
        law.packed,
        state.packed,
        plant.state.packed,
        plant.parameters,
        SafetyEnvelope(scenario.actuators).packed,
        np.ascontiguousarray(delays_ns, dtype=np.int64),
        normal,
        scenario.noise.position,
        scenario.noise.attitude,
        rows,
    )
    rows = rows[:count]
    t_ns = np.arange(count, dtype=np.int64) * scenario.period_ns
    return Simulation(
        t_ns=t_ns,
        q=rows[:, 1:7],
        q_dot=rows[:, 7:13],
        command=rows[:, 13:19],
        tau=rows[:, 19:25],
        u=rows[:, 25:],
        law_counts=law.counts(state),
        divergence=None if outcome == GOES_ON else divergence_sentence(outcome, count * scenario.period_ns),
    )
