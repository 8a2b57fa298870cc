"""The emulator's end of the motor bus: sends torques as CAN frames and receives the force u at the gear output.

Each command is sent as the protocol's frames, followed by a SYNC with the time; six ANSWER frames return u.

In lockstep simulation time stands still until all six drives have answered: the same bytes are sent again after 10, 20,
40 ms ..., and after 8 s of wall time the run ends. Drives that were restarted meanwhile answer the tick in progress,
disabled and at the safe output, and are enabled with the next one. So the plant sees an outage of one tick, however long
the wait was, and the result depends only on the tick at which the drives were lost.

In real time the wait for an answer is short, and the last u is held. After `actuators.staleness_s` without answers an
outage is counted: the plant gets the safe output until the drives answer and are enabled again. After 10 s without answers
the run is disarmed and ends.

With feedback "bus" u comes from the protocol's own status frames, if they carry the output shaft position, as it was when
they were sent: as from an encoder at the gear output. In real time no SYNC is then sent at all, as on hardware.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from bridge.motor_bus.can_bus import CanBus
from bridge.motor_bus.can_load import BusPlan, response_ns
from bridge.process import StopFlag
from bridge.reporting import Report
from bridge.timing.clock import Clock
from protocol.can_frame import CanFrame
from protocol.due import Due
from protocol.errors import (
    FwavHilError,
    LinkInUseError,
    PeerLostError,
    PeerMissingError,
    ScenarioMismatchError,
    UsageError,
)
from protocol.messages import FloatArray
from protocol.motors import simulation_sync
from protocol.motors.can_stuffing import exact_bits
from protocol.motors.motor_protocol import CAUSES, DRIVES, Cause, Status, make_host
from protocol.motors.simulation_sync import ALL_AXES, TICKS
from protocol.scenario import NANOSECONDS, Scenario

ENABLE_AGAIN_NS = NANOSECONDS // 10
"""Simulation time between two attempts to enable drives that are not enabled."""
GIVE_UP_NS = 10 * NANOSECONDS
"""In real time: an outage this long ends the run."""
HELLO_S = 0.1
SHORT_WAIT_S = 0.002

RESEND_AFTER_S = (0.010, 0.020, 0.040, 0.080, 0.160, 0.320, *(0.640,) * 11, 0.330)
"""Waits in lockstep: after each the frames are sent again; after the last, 8 s in all, the run ends."""
LONG_WAIT_S = 0.5

Watch = Callable[[int, CanFrame], None]
"""Called with the time (ns) of each frame on the bus, and the frame: a recorder, the tap."""


class CanMotors:
    """Six drives behind a bus, for the emulator.

    counters   motor_resent        commands sent again because not all drives had answered
               motor_outages       outages of the drives; in lockstep, restarts of the drives during a run
               motor_outage_ticks  ticks without answers: none in lockstep
               motor_recoveries    times all were enabled again         motor_safe_ticks     ticks with a drive not enabled
               motor_enables       attempts to enable the drives
               motor_late_answers  answers to an earlier tick, and duplicates
               motor_faults        status frames that report a latched fault
               bus_bits            bits of all frames, with stuffing, except those that exist in simulation only
               and those of the bus and of `motor_protocol.Cause`
    """

    def __init__(
        self,
        scenario: Scenario,
        bus: CanBus,
        plan: BusPlan,
        *,
        lockstep: bool,
        feedback: str,
        clock: Clock,
        stop: StopFlag,
        report: Report,
        waits_s: tuple[float, ...] = RESEND_AFTER_S,
    ) -> None:
        self._scenario = scenario
        self._bus = bus
        self._plan = plan
        self._lockstep = lockstep
        self._from_bus = feedback == "bus"
        if self._from_bus and plan.protocol == "dronecan":
            raise UsageError("--feedback bus: DroneCAN's esc.Status carries no position; use --protocol odrive or mit")
        self._syncs = lockstep or not self._from_bus
        self._clock = clock
        self._stop = stop
        self._report = report
        self._waits_s = waits_s
        self._digest = scenario.drive_digest()
        self._host = make_host(plan.protocol, scenario.motor)
        self.watches: list[Watch] = []
        self.poll: list[Callable[[], None]] = []
        self.on_long_wait: list[Callable[[], None]] = []
        """Called during a long wait for answers, so that other peers that wait for us can be informed."""
        self.tap_counters: dict[str, int] = {}
        self._now_ns = 0
        self.delay_ns = response_ns(plan) if scenario.motor.bus_delay else 0
        self._scale = np.array(scenario.actuators.scale)
        h = np.array(scenario.hysteresis.h)
        self._safe_u = h * np.array(scenario.actuators.safe)
        self._u: FloatArray = h * np.array(scenario.initial.command)
        self._bus_u = self._u.copy()
        self._heard = 0
        self._answered = self._answered_enabled = 0
        self._answers: FloatArray = np.zeros(DRIVES)
        self._hello_ns: int | None = None
        self._all_enabled = False
        self._enabled = 0
        self._enable_ns: int | None = None
        self._answered_ns = 0
        self._out_ns: int | None = None
        self._recovering = False
        self._begun = False
        self._tau = np.array(scenario.initial.command)
        self.velocities: FloatArray = np.zeros(DRIVES)
        """(6,) speeds that the drives reported last, rad/s."""
        self._coming: deque[tuple[int, FloatArray]] = deque()
        names = ("resent", "outages", "outage_ticks", "recoveries", "safe_ticks", "enables", "late_answers", "faults")
        self._counters = {
            **dict.fromkeys((f"motor_{name}" for name in names), 0),
            "bus_bits": 0,
            **dict.fromkeys(CAUSES, 0),
        }

    @property
    def counters(self) -> dict[str, int]:
        """All counters, by name."""
        return {**self._counters, **self._bus.counters, **self.tap_counters}

    def inject(self, frames: list[CanFrame]) -> None:
        """Send the frames of a station on the tap on the bus."""
        for frame in frames:
            self._bus.send(frame)
            self._note(self._now_ns, frame)

    def summary(self, duration_s: float) -> dict[str, Any]:
        """The bus in a run's summary: planned loads, and loads measured over the simulated (or real) duration_s."""
        bits = self._counters["bus_bits"] / duration_s if duration_s else 0.0
        measured = {str(bitrate): 100.0 * bits / bitrate for bitrate in self._plan.loads}
        return {"uri": self._bus.uri.text, **self._plan.as_dict(), "measured_load_percent": measured}

    def meet(self, wait_s: float) -> None:
        """Wait for the drives. Raises PeerMissingError, ScenarioMismatchError, LinkInUseError."""
        give_up_ns = self._clock.now_ns() + round(wait_s * NANOSECONDS)
        due = Due(1.0 / HELLO_S)
        seen = 0
        while (now_ns := self._clock.now_ns()) < give_up_ns:
            self._stop.check()
            if due.at(now_ns):
                hello = (
                    [simulation_sync.encode_hello(self._digest, drives=False)] if self._syncs else self._host.disable()
                )
                for frame in hello:
                    self._bus.send(frame)
            received = self._bus.recv(HELLO_S)
            if received is None:
                continue
            if simulation_sync.decode_sync(received) or simulation_sync.decode_hello(received, drives=False):
                raise LinkInUseError(
                    f"another emulator commands the drives on {self._bus.uri.text}: choose another bus with --can"
                )
            if self._is_hello(received) and self._syncs:
                return
            taken = self._host.decode(received)
            if not self._syncs and not isinstance(taken, Cause):
                seen |= sum(1 << status.axis for status in taken)
                if seen == ALL_AXES:
                    return
        raise PeerMissingError(
            f"no drives on the CAN bus {self._bus.uri.text} answered within {wait_s:g} s, so the run was not armed: start "
            f"them with {self._command}"
        )

    def drive(self, t_ns: int, tau: FloatArray, acts_ns: int) -> FloatArray:
        """Command tau (6,) at time t_ns; returns the force u (6,) at the gear output, which acts from acts_ns on.

        Raises PeerLostError where the drives do not come back, ScenarioMismatchError where drives with another scenario
        took their place, CanBusLostError where the bus is lost, Interrupted.
        """
        self._coming.append((acts_ns, tau.copy()))
        self._now_ns = t_ns
        self._answered = self._answered_enabled = 0
        if self._ask(t_ns, self._frames(t_ns, tau)):
            self._arrived(t_ns)
        elif self._lockstep:
            trouble = f" (the interface is lost: {self._bus.trouble})" if self._bus.trouble else ""
            raise PeerLostError(
                f"the drives on {self._bus.uri.text} did not answer the tick at t = {t_ns * 1e-9:.3f} s for "
                f"{sum(self._waits_s):.0f} s{trouble}: check whether they still run, or restart them with {self._command}"
            )
        else:
            self._missed(t_ns)
        return self._u.copy()

    def _ask(self, t_ns: int, frames: list[CanFrame]) -> bool:
        """Send the frames of a tick, repeatedly in lockstep; whether all six have answered."""
        waits = deque(self._waits())
        restarts = self._stop.peer_restarts
        first = True
        while waits:
            if not first:
                self._counters["motor_resent"] += 1
                self._stop.check()
            for frame in frames:
                self._bus.send(frame)
                if first:
                    self._note(t_ns, frame)
            for poll in self.poll:
                poll()
            wait_s = waits.popleft()
            if wait_s >= LONG_WAIT_S:
                for tell in self.on_long_wait:
                    tell()
            if self._collect(t_ns, wait_s):
                return True
            first = False
            if self._stop.peer_restarts != restarts:  # a process that was just started gets the full timeout
                restarts = self._stop.peer_restarts
                waits = deque(self._waits())
        return False

    @property
    def _command(self) -> str:
        """The command line that starts the drives."""
        return f"`fwav-hil motor SCENARIO --can {self._bus.uri.text} --protocol {self._plan.protocol}`"

    def tau_at(self, t_ns: int) -> FloatArray:
        """The commanded torques (6,) that act at t_ns; times must not decrease."""
        while self._coming and self._coming[0][0] <= t_ns:
            self._tau = self._coming.popleft()[1]
        return self._tau

    def close(self) -> None:
        """Disable the drives."""
        try:
            for frame in self._host.disable():
                self._bus.send(frame)
        except FwavHilError:
            return  # the bus itself may have failed

    def _frames(self, t_ns: int, tau: FloatArray) -> list[CanFrame]:
        frames = self._host.cyclic(t_ns)
        if not self._all_enabled and (self._enable_ns is None or t_ns - self._enable_ns >= ENABLE_AGAIN_NS):
            self._enable_ns = t_ns
            self._counters["motor_enables"] += 1
            frames += self._host.enable([axis for axis in range(DRIVES) if not self._enabled >> axis & 1])
        frames += self._host.command(tau / self._scale)
        if self._syncs:
            frames.append(simulation_sync.encode_sync(t_ns, lockstep=self._lockstep))
        return frames

    def _waits(self) -> tuple[float, ...]:
        return self._waits_s if self._lockstep else (min(SHORT_WAIT_S, 0.25e-9 * self._scenario.period_ns),)

    def _collect(self, t_ns: int, wait_s: float) -> bool:
        """Handle frames until all six have answered the SYNC of t_ns or the wait ends; whether all have answered."""
        tick = t_ns // self._scenario.period_ns % TICKS
        deadline_ns = self._clock.now_ns() + round(wait_s * NANOSECONDS)
        while True:
            remaining_ns = deadline_ns - self._clock.now_ns()
            frame = self._bus.recv(max(0.0, remaining_ns * 1e-9) if self._syncs else 0.0)
            if frame is None:
                if not self._syncs:
                    return self._heard_all()
                return False
            answer = simulation_sync.decode_answer(frame)
            if answer is None:
                if self._begun or not self._syncs:  # frames sent before the first SYNC are not part of this run
                    self._note(t_ns, frame)
                self._take(t_ns, frame)
            elif answer.tick != tick:
                self._counters["motor_late_answers"] += 1
            else:
                if self._answered >> answer.axis & 1:
                    self._counters["motor_late_answers"] += 1
                    continue
                self._begun = True
                self._note(t_ns, frame)
                self._answers[answer.axis] = answer.u
                self._answered |= 1 << answer.axis
                self._answered_enabled |= answer.enabled << answer.axis
                if self._answered == ALL_AXES:
                    self._u = (self._bus_u if self._from_bus else self._answers).copy()
                    self._enabled = self._answered_enabled
                    return True
            if remaining_ns < -NANOSECONDS:
                return False

    def _take(self, t_ns: int, frame: CanFrame) -> None:
        """Handle a frame that is not an ANSWER."""
        if self._begun and self._is_hello(frame):  # restarted drives: earlier answers to this tick are void
            self._hello_ns = t_ns
            self._answered = self._answered_enabled = 0
        if simulation_sync.is_simulation_only(frame):
            return
        taken = self._host.decode(frame)
        if isinstance(taken, Cause):
            self._counters[taken.value] += 1
            return
        for status in taken:
            self._learn(status)

    def _is_hello(self, frame: CanFrame) -> bool:
        """Whether the frame is a HELLO of drives. Raises ScenarioMismatchError where it has another digest."""
        theirs = simulation_sync.decode_hello(frame, drives=True)
        if theirs is not None and theirs != self._digest:
            raise ScenarioMismatchError(
                f"the drives run another scenario (digest {theirs.hex()}, here {self._digest.hex()}): start both with the "
                "same scenario file, --protocol and --lag"
            )
        return theirs is not None

    def _learn(self, status: Status) -> None:
        bit = 1 << status.axis
        self._heard |= bit
        self._counters["motor_faults"] += bool(status.faulty)
        if not self._syncs:
            if status.enabled is not None:
                self._enabled = self._enabled | bit if status.enabled else self._enabled & ~bit
            elif status.faulty is not None:
                self._enabled = self._enabled & ~bit if status.faulty else self._enabled | bit
        if status.velocity is not None:
            self.velocities[status.axis] = status.velocity
        if status.position is not None:
            travel = self._scenario.motor.travel_rad
            self._bus_u[status.axis] = status.position / travel * self._scale[status.axis]

    def _heard_all(self) -> bool:
        """Without SYNC: whether every drive has sent a status since this was last true."""
        self._u = self._bus_u.copy()
        if self._heard != ALL_AXES:
            return False
        self._heard = 0
        return True

    def _arrived(self, t_ns: int) -> None:
        """Update state and counters after all six have answered."""
        self._answered_ns = t_ns
        self._all_enabled = self._enabled == ALL_AXES
        joined = self._lockstep and self._hello_ns == t_ns and not self._enabled
        self._counters["motor_outages"] += joined
        if joined or self._out_ns is not None:
            self._out_ns = None
            self._recovering = True
            self._enable_ns = None
            self._report({"event": "motors_back", "t_ns": t_ns})
        if not self._all_enabled:
            self._counters["motor_safe_ticks"] += 1
        elif self._recovering:
            self._recovering = False
            self._counters["motor_recoveries"] += 1

    def _missed(self, t_ns: int) -> None:
        """In real time: handle a tick without answers in time."""
        now_ns = self._clock.now_ns()
        if self._out_ns is None:
            limit_ns = round(self._scenario.actuators.staleness_s * NANOSECONDS)
            if t_ns - self._answered_ns <= (limit_ns if self._syncs else 2 * NANOSECONDS):
                return  # the last u is held
            self._out_ns = now_ns
            self._all_enabled = False
            self._enabled = 0
            self._counters["motor_outages"] += 1
            self._report({"event": "motors_lost", "t_ns": t_ns})
        self._counters["motor_outage_ticks"] += 1
        self._u = self._safe_u.copy()
        if now_ns - self._out_ns > GIVE_UP_NS:
            raise PeerLostError(
                f"the drives on {self._bus.uri.text} stopped answering and did not come back within "
                f"{GIVE_UP_NS // NANOSECONDS} s (t = {t_ns * 1e-9:.3f} s): the run is disarmed; check whether they still run"
            )

    def _note(self, t_ns: int, frame: CanFrame) -> None:
        if not simulation_sync.is_simulation_only(frame):
            self._counters["bus_bits"] += exact_bits(frame)
        for watch in self.watches:
            watch(t_ns, frame)
