"""The drives as seen from the bus: frames in, frames out, limits and watchdog, six nodes in one object. No I/O here.

Time. From the first SYNC on (`simulation_sync`) a node uses the bridge's simulation time: it advances when a SYNC arrives,
answers it, and its watchdog counts SYNC time. Without SYNC, as with any other controller, it uses its own clock.

When SYNC stops, the host counts as lost: the node uses its own clock again, and the watchdog acts. In real time this happens
after 2 s. In lockstep a silent host may be waiting, or stalled on a busy machine, so wall time changes nothing. Only after
30 s, longer than a host waits for any peer, is its run considered over: a host that returns later is not answered, so that
the run ends with an error rather than with drives that were disabled in the middle of it.

A drive outputs its safe value (`actuators.safe`) until it is enabled, and again once a fault is latched: no command for
`watchdog_s`, over-temperature, or an Estop. The torque jumps to that value and every filter is reset.

The first SYNC of a run (t = 0) starts the flight as the direct path does: with `initial.command` acting. A node started
in the middle of a run begins disabled, at its safe value (the gears' state is lost with the old process), and sends
HELLO before its first answers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from plant_emulator.drives.motor import DriveBank
from protocol.can_frame import CanFrame
from protocol.due import Due
from protocol.motors import simulation_sync
from protocol.motors.motor_protocol import CAUSES, DRIVES, Action, Cause, Drive, Fault, Order, Reading, make_drive
from protocol.scenario import NANOSECONDS, Scenario

HOST_GONE_NS = 2 * NANOSECONDS
RUN_OVER_NS = 30 * NANOSECONDS
"""In lockstep: wall time without a SYNC after which a run is over."""
OWN_STEP_NS = NANOSECONDS // 1000
"""On its own clock a node advances at least this often, if the caller polls it."""
LONGEST_STEP_NS = NANOSECONDS // 10
"""A process that was stalled catches up at most this much."""


class MotorNode:
    """Six drives of one protocol.

    counters   taken              frames with a command for one of the drives
               syncs, repeated_syncs, backward_syncs, waiting_syncs
                                  SYNC frames answered; repeated (same answer, nothing moves); from the past; received
                                  before all the commands that they name (not answered)
               watchdog_trips, over_temperatures, estops
                                  faults latched, drive by drive
               lost_hosts         times the SYNC was missing for too long
               refused_syncs      SYNC frames of a host in lockstep whose run is over
               and one for each cause of `motor_protocol.Cause`
    """

    def __init__(self, scenario: Scenario, protocol: str) -> None:
        motor = scenario.motor
        self.scenario = scenario
        self._drive: Drive = make_drive(protocol, motor)
        self._digest = scenario.drive_digest()
        self._safe = np.array(scenario.actuators.safe)
        self._scale = np.array(scenario.actuators.scale)
        self._initial = np.array(scenario.initial.command)
        self._watchdog_ns = round(motor.watchdog_s * NANOSECONDS)
        self.bank = DriveBank(scenario, self._safe)
        self._encoders = Due(motor.encoder_rate_hz)
        self._target = self._safe.copy()
        self._enabled = [False] * DRIVES
        self._faults = [Fault(0)] * DRIVES
        self._commanded_ns = [0] * DRIVES
        self._commanded = 0
        self._positions = self._angles(self.bank.state.u)
        self._velocities = np.zeros(DRIVES)
        self._readings: list[Reading] | None = None
        self._t_ns = 0
        self._sync_ns: int | None = None
        self._answers: list[CanFrame] = []
        self._heard_ns = 0
        self._fresh = True
        self._host_waits = False
        self._run_is_over = False
        names = ("taken", "syncs", "repeated_syncs", "backward_syncs", "waiting_syncs", "refused_syncs")
        faults = ("watchdog_trips", "over_temperatures", "estops", "lost_hosts")
        self.counters = dict.fromkeys((*names, *faults, *CAUSES), 0)

    @property
    def in_lockstep(self) -> bool:
        """Whether time is that of the SYNC."""
        return self._sync_ns is not None

    def elapse(self, now_ns: int) -> list[CanFrame]:
        """Advance to wall time now_ns (any epoch). Returns the cyclic messages due, if the node uses its own clock."""
        if self.in_lockstep:
            if now_ns - self._heard_ns < (RUN_OVER_NS if self._host_waits else HOST_GONE_NS):
                return []
            self.counters["lost_hosts"] += 1
            self._run_is_over = True
            self._use_own_time(now_ns)
        passed_ns = now_ns - self._heard_ns
        if passed_ns < OWN_STEP_NS:
            return []
        self._heard_ns = now_ns
        self._move(self._t_ns + passed_ns, min(passed_ns, LONGEST_STEP_NS))
        return self._cyclic()

    def receive(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
        """The drives' answers to a frame received at wall time now_ns."""
        if simulation_sync.is_simulation_only(frame):
            return self._simulation_frame(frame, now_ns)
        taken = self._drive.decode(frame)
        if isinstance(taken, Cause):
            self.counters[taken.value] += 1
            return []
        frames: list[CanFrame] = []
        for order in taken:
            self.counters["taken"] += 1
            self._obey(order)
            frames += self._drive.reply(order, self.readings()[order.axis])
        return frames

    def readings(self) -> list[Reading]:
        """The present readings of the six drives."""
        if self._readings is None:
            state = self.bank.state
            motor_side = self._angles(state.tau).tolist()
            self._readings = [
                Reading(position, velocity, before, target, torque, temperature, enabled, faults)
                for position, velocity, before, target, torque, temperature, enabled, faults in zip(
                    self._positions.tolist(),
                    self._velocities.tolist(),
                    motor_side,
                    (self._target / self._scale).tolist(),
                    (state.tau / self._scale).tolist(),
                    state.temperature.tolist(),
                    self._enabled,
                    self._faults,
                    strict=True,
                )
            ]
        return self._readings

    def _simulation_frame(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
        if simulation_sync.decode_hello(frame, drives=False) is not None:
            self._fresh = True
            return [simulation_sync.encode_hello(self._digest, drives=True)]
        sync = simulation_sync.decode_sync(frame)
        if sync is None:
            self.counters[Cause.FOREIGN.value] += 1
            return []
        begins = sync.t_ns == 0 and self._fresh
        if self._run_is_over and sync.lockstep and not begins:
            self.counters["refused_syncs"] += 1
            return []
        self._heard_ns = now_ns
        self._host_waits = sync.lockstep
        if not begins and sync.t_ns == self._sync_ns:
            self.counters["repeated_syncs"] += 1
            self._commanded = 0
            return self._answers
        if not begins and self._sync_ns is not None and sync.t_ns < self._sync_ns:
            self.counters["backward_syncs"] += 1
            return []
        if sync.commanded & ~self._commanded:
            self.counters["waiting_syncs"] += 1
            return []
        self.counters["syncs"] += 1
        return self._sync(sync.t_ns, begins=begins)

    def _sync(self, t_ns: int, *, begins: bool) -> list[CanFrame]:
        """Advance to the time of a new SYNC and over the period that it begins; answer it."""
        period_ns = self.scenario.period_ns
        joins = self._sync_ns is None and not begins
        if begins:
            self.bank.begin(self._initial)
            self._positions = self._angles(self.bank.state.u)
        if begins or self._sync_ns is None:
            self._restart_schedule()
        elif t_ns - self._sync_ns <= LONGEST_STEP_NS:
            period_ns = t_ns - self._sync_ns
        for axis in range(DRIVES):
            if self._commanded >> axis & 1 or self._sync_ns is None:
                self._commanded_ns[axis] = t_ns
        self._commanded = 0
        self._fresh = self._run_is_over = False
        self._sync_ns = t_ns
        self._move(t_ns, period_ns)
        tick = t_ns // self.scenario.period_ns
        self._answers = [
            simulation_sync.encode_answer(axis, tick, u, enabled=self._enabled[axis])
            for axis, u in enumerate(self.bank.state.mean_u.tolist())
        ]
        if joins:
            self._answers.insert(0, simulation_sync.encode_hello(self._digest, drives=True))
        return self._answers + self._cyclic()

    def _use_own_time(self, now_ns: int) -> None:
        self._sync_ns = None
        self._heard_ns = now_ns - OWN_STEP_NS
        # The host fell silent: let the watchdog see the last commands as expired.
        self._commanded_ns = [self._t_ns - self._watchdog_ns] * DRIVES
        self._restart_schedule()

    def _restart_schedule(self) -> None:
        self._drive.restart()
        self._encoders = Due(self.scenario.motor.encoder_rate_hz)

    def _obey(self, order: Order) -> None:
        axis = order.axis
        if order.action is Action.TORQUE:
            self._commanded |= 1 << axis
            self._commanded_ns[axis] = self._t_ns
            if self._enabled[axis]:
                self._target[axis] = order.torque * self._scale[axis]
            return  # readings show it from the next step on
        if order.action is Action.ENABLE and not self._faults[axis]:
            if not self._enabled[axis]:
                self._enabled[axis] = True
                self._commanded_ns[axis] = self._t_ns
        elif order.action is Action.DISABLE:
            self._let_go(axis)
        elif order.action is Action.CLEAR:
            self._faults[axis] = Fault(0)
        elif order.action is Action.ESTOP and Fault.ESTOP not in self._faults[axis]:
            self._latch(axis, Fault.ESTOP, "estops")
        self._readings = None

    def _move(self, t_ns: int, duration_ns: int) -> None:
        """Run the drives for duration_ns; t_ns is the watchdog's time."""
        self._t_ns = t_ns
        for axis in range(DRIVES):
            if self._enabled[axis] and t_ns - self._commanded_ns[axis] > self._watchdog_ns:
                self._latch(axis, Fault.WATCHDOG, "watchdog_trips")
        self.bank.step(self._target, duration_ns)
        hot = self.scenario.motor.over_temperature_celsius
        for axis, temperature in enumerate(self.bank.state.temperature.tolist()):
            if temperature > hot and self._enabled[axis]:
                self._latch(axis, Fault.OVER_TEMPERATURE, "over_temperatures")
        positions = self._angles(self.bank.state.u)
        resolution = self.scenario.motor.velocity_resolution
        velocities = (positions - self._positions) / (duration_ns / NANOSECONDS)
        self._velocities = np.round(velocities / resolution) * resolution if resolution else velocities
        self._positions = positions
        self._readings = None

    def _latch(self, axis: int, fault: Fault, counter: str) -> None:
        self.counters[counter] += 1
        self._faults[axis] |= fault
        self._let_go(axis)

    def _let_go(self, axis: int) -> None:
        self._enabled[axis] = False
        self._target[axis] = self._safe[axis]
        self.bank.jump(axis, float(self._safe[axis]))

    def _cyclic(self) -> list[CanFrame]:
        readings = self.readings()
        frames = self._drive.cyclic(self._t_ns, readings)
        if self._encoders.at(self._t_ns):
            frames += [
                simulation_sync.encode_encoders(axis, reading.motor_position, reading.position)
                for axis, reading in enumerate(readings)
            ]
        return frames

    def _angles(self, force: np.typing.NDArray[np.float64]) -> np.typing.NDArray[np.float64]:
        """Shaft angles (6,), in whole counts of the encoder, that represent a torque or force (6,)."""
        motor = self.scenario.motor
        count = 2.0 * math.pi / motor.encoder_counts
        return np.asarray(np.round(force / self._scale * motor.travel_rad / count) * count)


def is_of_drives(frame: CanFrame) -> bool:
    """Whether this frame can only come from drives of another process: an answer, a hello or an encoder frame."""
    return (
        simulation_sync.decode_answer(frame) is not None
        or simulation_sync.decode_hello(frame, drives=True) is not None
        or simulation_sync.decode_encoders(frame) is not None
    )


def warm_up(scenario: Scenario, protocol: str) -> Sequence[CanFrame]:
    """Compile every kernel of a node (or load it from the cache)."""
    node = MotorNode(scenario, protocol)
    node.bank.jump(0, 0.0)
    return node.receive(simulation_sync.encode_sync(0, 0), 0)
