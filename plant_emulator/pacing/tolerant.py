"""The `tolerant` profile of lockstep: for other autopilots, which do not answer every tick, and for links that lose frames.

It is made for the observed behaviour of PX4's simulator link: on connecting a request for ground truth and one heartbeat,
then nothing for some dozens of ticks, then an answer to each tick at 250 Hz, and to one tick in two or four above that. Until
the first answer ticks are sent a period of wall time apart. From then on each answer is awaited for at most 10 ms of wall
time; then the tick is sent once more, and simulation time advances with the last command. Late answers act on arrival.
Results depend on the machine's timing; use the `exact` profile for reproducible results.
"""

from __future__ import annotations

from bridge.timing.rate import RateKeeper
from plant_emulator.pacing.lockstep import Lockstep
from plant_emulator.pacing.pacing import Parts
from protocol.errors import PeerLostError
from protocol.scenario import NANOSECONDS
from protocol.wire.streams import HEARTBEAT_TIMEOUT_NS

WAIT_NS = 10_000_000
"""The longest wait for the answer to a tick, in wall time, after the first answer."""


class Tolerant(Lockstep):
    """Simulation time waits for an answer, up to a timeout.

    The plant is held at its initial state until the first armed command: an autopilot needs sensors at rest before it arms.

    counters   those of `Lockstep` (resent: ticks sent once more), and
               unanswered     ticks without an answer in time     late_answers   answers to an earlier tick, which act now
               held           ticks with the plant held
    """

    def __init__(self, parts: Parts, *, delay_ns: int, keeper: RateKeeper | None, wait_s: float) -> None:
        super().__init__(parts, delay_ns=delay_ns, keeper=keeper)
        self._patience_ns = round(wait_s * NANOSECONDS)
        self._silence_ns = 0
        self._flies = False
        self.counters |= {"unanswered": 0, "late_answers": 0, "held": 0}

    def take_commands(self, t_ns: int) -> None:
        """Wait briefly for an answer to the tick. Raises PeerLostError after a long silence."""
        source = self.emulator.source
        source.expect(0, t_ns)
        replied = source.newest_ns >= 0
        wait_ns = WAIT_NS if replied else self.period_ns
        if self.await_answer(t_ns, wait_ns):
            return
        self.counters["unanswered"] += 1
        if source.newest_ns >= 0:
            self.counters["resent"] += 1
            self.endpoint.link.send(self.datagram)
        self._silence_ns += wait_ns
        if self._silence_ns > (HEARTBEAT_TIMEOUT_NS if replied else self._patience_ns):
            raise PeerLostError(
                f"the autopilot at {self.endpoint.link.peer} has sent no HIL_ACTUATOR_CONTROLS for "
                f"{self._silence_ns / NANOSECONDS:.3g} s of waiting, up to t = {t_ns * 1e-9:.3f} s: check that it still runs"
            )

    def command_came(self, t_ns: int) -> None:
        """Let an answer act now, even if it answers an earlier tick."""
        source = self.emulator.source
        self._silence_ns = 0
        self.counters["late_answers"] += source.newest_ns < t_ns
        self._flies = self._flies or source.armed
        if self._flies:
            self.emulator.act(t_ns, self.delay_ns)
            self.emulator.settle()

    def log_received(self, t_ns: int) -> None:
        """Log all frames received; another autopilot's sequence numbers follow no rule of ours."""
        source = self.emulator.source
        raws, source.raws = source.raws, []
        self.owe_log(t_ns // 1000, raws)

    def move(self, t_ns: int) -> None:
        """Advance the plant, or hold it."""
        end_ns = t_ns + self.period_ns
        if self._flies:
            self.emulator.check_staleness(end_ns, self.delay_ns)
            self.emulator.advance(end_ns)
        else:
            self.counters["held"] += 1
            self.emulator.hold(end_ns)
