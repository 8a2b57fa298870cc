"""Lockstep: simulation time stands still until the answer to the tick is there."""

from __future__ import annotations

from bridge.timing.rate import RateKeeper
from plant_emulator.pacing.pacing import Pacing, Parts
from protocol.errors import DivergenceError, PeerLostError
from protocol.messages import VEHICLE, ActuatorCommand
from protocol.wire import mapping
from protocol.wire.codec import Frame

RESEND_AFTER_S = (0.010, 0.020, 0.040, 0.080, 0.160, 0.320, 0.640, 0.730)
"""Waits of the exact profile: after each the tick is sent again; after the last, 2 s in all, the run ends."""


class Lockstep(Pacing):
    """Simulation time stands still until the answer to the tick is there: the `exact` profile.

    No answer: the same bytes again after 10, 20, 40 ms ..., and after 2 s a named error. It never steps on without an
    answer, so stalls of the machine change nothing in the result. Every stamp in the log is simulation time.

    counters   resent   ticks sent again              foreign  frames that belong to no answer: strays, late copies
               late, slipped    of the schedule, where `--speed` gives one (`RateKeeper`)
    """

    def __init__(
        self,
        parts: Parts,
        *,
        ticks: int,
        delay_ns: int,
        keeper: RateKeeper | None,
    ) -> None:
        super().__init__(parts)
        self._delay_ns = delay_ns
        self._keeper = self.keeper = keeper
        self._ahead_until_ns = 0 if keeper else ticks * self.period_ns
        """Ticks before this time may leave the moment the answer to the one before them is there."""
        self._sent_ns = self._answered_ns = 0
        self._datagram = b""
        self._is_sent = False
        self.counters = {"resent": 0, "foreign": 0}

    def exchange(self, tick: int, t_ns: int) -> None:
        """One tick out, its one answer back."""
        self.begin_tick(tick, t_ns)
        received: list[Frame] = []
        for attempt, wait_s in enumerate(RESEND_AFTER_S):
            if attempt:
                self.counters["resent"] += 1
                self.stop.check()
                self.endpoint.link.send(self._datagram)
            if self.await_answer(tick, t_ns, round(wait_s * 1e9), received):
                return
        raise PeerLostError(
            f"the controller at {self.endpoint.link.peer} gave no answer to the tick at t = {t_ns * 1e-9:.3f} s for 2 s: "
            "see whether it still runs"
        )

    def begin_tick(self, tick: int, t_ns: int) -> None:
        """Send the tick, unless it has left with the answer to the one before it."""
        self.stop.check()
        if not self._is_sent:
            self._pace(tick)
            frames = self.emulator.sense(t_ns)
            self._send(b"".join(frames))
            self.owe_log(t_ns // 1000, frames)
        self._is_sent = False
        self.settle_log()

    def _pace(self, tick: int) -> None:
        """Wait for the tick's time, where there is a speed to keep."""
        if self._keeper:
            if tick == 0:
                self._keeper.start()
            self._keeper.sleep()
            self._keeper.tick()

    def _send(self, datagram: bytes) -> None:
        self._sent_ns = self.clock.now_ns()
        self.endpoint.link.send(datagram)
        self._datagram = datagram

    def await_answer(self, tick: int, t_ns: int, wait_ns: int, received: list[Frame]) -> bool:
        """Whether the answer to the tick came in time; the plant has then moved on. `received` gathers its frames."""
        deadline_ns = self.clock.now_ns() + wait_ns
        timeout_s = wait_ns * 1e-9
        while True:
            data = self.endpoint.link.recv(timeout_s)
            if data and not received and self.go_on(data, t_ns):
                return True
            self._answered_ns = self.clock.now_ns()
            frames = self.endpoint.reader.read(data) if data else []
            for frame in frames:
                received.append(frame)
                if frame.message_id != mapping.COMMAND.message_id or (frame.system, frame.component) != VEHICLE:
                    self.emulator.take_request(frame)
                    continue
                command = self.emulator.decode(frame.payload)
                if command is not None and command.t_ns == t_ns:
                    self.latencies_ns.append(self._answered_ns - self._sent_ns)
                    self.accept(tick, t_ns // 1000, received)
                    self.apply(t_ns, command)
                    return True
                self.take_stray(t_ns, command, received)
            remaining_ns = deadline_ns - self.clock.now_ns()
            if (timeout_s == 0.0 and not data) or remaining_ns < -wait_ns:
                return False
            timeout_s = max(0.0, remaining_ns * 1e-9)  # at 0 one last look: the machine may have stalled

    def go_on(self, data: bytes, t_ns: int) -> bool:
        """Take a plain answer and send the next tick, which is plain too, at once: all else waits until it is on its way."""
        end_ns = t_ns + self.period_ns
        if end_ns >= self._ahead_until_ns:
            return False
        answered_ns = self.clock.now_ns()
        try:
            following = self.emulator.go_on(data, t_ns, end_ns, self._delay_ns)
        except DivergenceError:
            self.owe_log(t_ns // 1000, [data])
            raise
        if following is None:
            return False
        datagram, middle = following
        self.latencies_ns.append(answered_ns - self._sent_ns)
        self._send(datagram)
        self._is_sent = True
        self.emulator.settle(t_ns, t_ns)
        self.owe_log(t_ns // 1000, [data])
        self.owe_log(end_ns // 1000, (datagram[:middle], datagram[middle:]))
        return True

    def apply(self, t_ns: int, command: ActuatorCommand) -> None:
        """Let the answer to the tick act, and move on."""
        self.emulator.act(t_ns, self._delay_ns, command)
        self.emulator.advance(t_ns + self.period_ns)

    def take_stray(self, _t_ns: int, _command: ActuatorCommand | None, received: list[Frame]) -> None:
        """Count a late copy of an earlier answer: neither it nor what came with it belongs to this tick."""
        self.counters["foreign"] += len(received)
        received.clear()

    def accept(self, tick: int, t_us: int, frames: list[Frame]) -> None:
        """Log the frames of an answer. Numbers restart at t = 0, so the first answer's own tells how many belong to it."""
        if tick == 0:
            theirs = [frame for frame in frames if (frame.system, frame.component) == VEHICLE]
            strays = {id(frame) for frame in theirs[: -(frames[-1].sequence + 1)]}
            self.counters["foreign"] += len(strays)
            frames = [frame for frame in frames if id(frame) not in strays]
            self.endpoint.reader.restart_sequences([(*VEHICLE, frames[-1].sequence + 1)])
        once = list(dict.fromkeys(frame.raw for frame in frames))  # of a damaged answer and its copy some came twice
        self.counters["foreign"] += len(frames) - len(once)
        self.owe_log(t_us, once)
