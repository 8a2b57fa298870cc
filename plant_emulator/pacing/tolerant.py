"""The `tolerant` profile of lockstep: for a foreign autopilot, which answers in its own time, and for links that lose things.

What it expects is what PX4's simulator link was seen to do: on connecting a request for ground truth and one heartbeat, then
nothing for some dozens of ticks, then an answer to each tick at 250 Hz, and to one tick in two or four above that. So ticks go
out freely, a period of wall time apart, until the first answer. From then on each is waited for, at most 10 ms of wall time;
then the tick is sent once more, and simulation time steps on with the command that stands. Late answers act when they come.
Results depend on the machine's timing: for a result that is the same each time, the `exact` profile is there.
"""

from __future__ import annotations

from bridge.timing.rate import RateKeeper
from plant_emulator.pacing.lockstep import Lockstep
from plant_emulator.pacing.pacing import Parts
from protocol.errors import PeerLostError
from protocol.messages import VEHICLE, ActuatorCommand
from protocol.scenario import NANOSECONDS
from protocol.wire.codec import Frame
from protocol.wire.streams import HEARTBEAT_TIMEOUT_NS

WAIT_NS = 10_000_000
"""The longest wait for the answer to a tick, in wall time, once there was one."""
HELLO_PERIOD_S = 0.1


class Tolerant(Lockstep):
    """Simulation time waits for an answer, but not for ever.

    The plant is held where it starts until the first armed command: an autopilot needs its sensors at rest before it arms.

    counters   those of `Lockstep`, where resent counts ticks sent once more, and
               unanswered     ticks without an answer in time     late_answers   answers to an earlier tick, which act now
               held           ticks with the plant held
    """

    def __init__(self, parts: Parts, *, ticks: int, delay_ns: int, keeper: RateKeeper | None, wait_s: float) -> None:
        super().__init__(parts, ticks=ticks, delay_ns=delay_ns, keeper=keeper)
        self._patience_ns = round(wait_s * NANOSECONDS)
        self._silence_ns = 0
        self._newest_ns = -1
        self._flies = False
        self.counters |= {"unanswered": 0, "late_answers": 0, "held": 0}

    def exchange(self, tick: int, t_ns: int) -> None:
        """One tick out, its answer back if there is one."""
        self.begin_tick(tick, t_ns)
        replied = self._newest_ns >= 0
        wait_ns = WAIT_NS if replied else self.period_ns
        received: list[Frame] = []
        if self.await_answer(tick, t_ns, wait_ns, received):
            self._silence_ns = 0
            return
        self.owe_log(t_ns // 1000, [frame.raw for frame in received])
        self.counters["unanswered"] += 1
        if self._newest_ns >= 0:
            self.counters["resent"] += 1
            self.endpoint.link.send(self._datagram)
        self._silence_ns += wait_ns
        if self._silence_ns > (HEARTBEAT_TIMEOUT_NS if replied else self._patience_ns):
            raise PeerLostError(
                f"the autopilot at {self.endpoint.link.peer} has sent no HIL_ACTUATOR_CONTROLS for "
                f"{self._silence_ns / NANOSECONDS:.3g} s of waiting, up to t = {t_ns * 1e-9:.3f} s: see whether it still runs"
            )
        self._step(t_ns)

    def apply(self, t_ns: int, command: ActuatorCommand) -> None:
        """Let the answer to the tick act, and move on."""
        self._take(t_ns, command)
        self._step(t_ns)

    def go_on(self, data: bytes, t_ns: int) -> bool:
        """As in `Lockstep`; what is plain is armed."""
        gone = super().go_on(data, t_ns)
        if gone:
            self._newest_ns = t_ns
            self._flies = True
        return gone

    def accept(self, tick: int, t_us: int, frames: list[Frame]) -> None:
        """Log the frames of an answer; a foreign autopilot numbers its frames as it likes."""
        if self._newest_ns < 0:
            self.endpoint.reader.restart_sequences([(*VEHICLE, frames[-1].sequence + 1)])
        self.owe_log(t_us, [frame.raw for frame in frames])

    def take_stray(self, t_ns: int, command: ActuatorCommand | None, received: list[Frame]) -> None:
        """An answer to an earlier tick acts now, if it is newer than the last one."""
        if command is None or not self._newest_ns < command.t_ns < t_ns:
            super().take_stray(t_ns, command, received)
            return
        self.counters["late_answers"] += 1
        self.accept(1, t_ns // 1000, received)
        received.clear()
        self._silence_ns = 0
        self._take(t_ns, command)

    def _take(self, t_ns: int, command: ActuatorCommand) -> None:
        self._newest_ns = command.t_ns
        self._flies = self._flies or command.armed
        if self._flies:
            self.emulator.act(t_ns, self._delay_ns, command)

    def _step(self, t_ns: int) -> None:
        if self._flies:
            self.emulator.check_staleness(t_ns + self.period_ns, self._delay_ns)
            self.emulator.advance(t_ns + self.period_ns)
        else:
            self.counters["held"] += 1
            self.emulator.hold(t_ns + self.period_ns)
