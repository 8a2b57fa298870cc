"""Lockstep: simulation time stands still until the tick is answered. The `exact` profile, for our own controller."""

from __future__ import annotations

from bridge.timing.rate import RateKeeper
from plant_emulator.pacing.pacing import Pacing, Parts
from protocol.errors import PeerLostError
from protocol.messages import VEHICLE
from protocol.wire.codec import lone_frame
from protocol.wire.mapping import COMMAND

RESEND_AFTER_S = (0.010, 0.020, 0.040, 0.080, 0.160, 0.320, 0.640, 0.730)
"""Timeouts of the exact profile: after each the tick is sent again; after the last, 2 s in all, the run ends."""


class Lockstep(Pacing):
    """Without an answer the same bytes are sent again after 10, 20, 40 ms ...; after 2 s the run ends with an error.

    It never steps without an answer, so stalls of the machine do not change the result. Every time stamp in the log is
    simulation time. With a `keeper` (`--speed`) a tick waits for its time.

    counters   resent   ticks sent again              foreign  frames that belong to no answer, such as late copies
               late, slipped    of the schedule, with `--speed` (`RateKeeper`)
    """

    def __init__(self, parts: Parts, *, delay_ns: int, keeper: RateKeeper | None) -> None:
        super().__init__(parts)
        self.delay_ns = delay_ns
        self.keeper = keeper
        self.sends_ahead = keeper is None
        self._strays = 0
        self.counters = {"resent": 0, "foreign": 0}
        if self.emulator.motors:  # sending the tick again keeps the controller waiting while the drives are awaited
            self.emulator.motors.on_long_wait.append(lambda: self.endpoint.link.send(self.datagram))

    def begin(self, t_ns: int) -> None:
        """Wait for the tick's time, with `--speed`."""
        if self.keeper:
            if t_ns == 0:
                self.keeper.start()
            self.keeper.sleep()
            self.keeper.tick()

    def stamp_us(self, t_ns: int) -> int:
        """Simulation time."""
        return t_ns // 1000

    def take_commands(self, t_ns: int) -> None:
        """Wait for the one answer to the tick. Raises PeerLostError."""
        self.emulator.source.expect(t_ns, t_ns)
        for attempt, wait_s in enumerate(RESEND_AFTER_S):
            if attempt:
                self.counters["resent"] += 1
                self.stop.check()
                self.endpoint.link.send(self.datagram)
            if self.await_answer(t_ns, round(wait_s * 1e9)):
                return
        raise PeerLostError(
            f"the controller at {self.endpoint.link.peer} did not answer the tick at t = {t_ns * 1e-9:.3f} s within 2 s: "
            "check that it still runs"
        )

    def await_answer(self, t_ns: int, wait_ns: int) -> bool:
        """Whether the answer to the tick arrived in time, and acts now."""
        source, clock = self.emulator.source, self.clock
        deadline_ns = clock.now_ns() + wait_ns
        timeout_s = wait_ns * 1e-9
        while True:
            data = self.endpoint.link.recv(timeout_s)
            came_ns = clock.now_ns()
            if data:
                self.process(data, t_ns)
                if source.newest_ns == t_ns:
                    self.latencies_ns.append(came_ns - self.sent_ns)
                    return True
                if source.strays > self._strays:
                    self._strays = source.strays
                    self.forget_received()
            remaining_ns = deadline_ns - came_ns
            if (timeout_s == 0.0 and not data) or remaining_ns < -wait_ns:
                return False
            timeout_s = max(0.0, remaining_ns * 1e-9)  # at 0 receive once more: the machine may have stalled

    def command_came(self, t_ns: int) -> None:
        """Let the answer act after the delay, in simulation time."""
        self.emulator.act(t_ns, self.delay_ns)

    def forget_received(self) -> None:
        """Count a late copy of an earlier answer: neither it nor what came with it belongs to this tick."""
        raws = self.emulator.source.raws
        self.counters["foreign"] += len(raws)
        raws.clear()

    def log_received(self, t_ns: int) -> None:
        """Log the frames of an answer, each once. Sequence numbers restart at t = 0: so the first answer's are known."""
        source = self.emulator.source
        raws, source.raws = source.raws, []
        if len(raws) > 1 or t_ns == 0:
            received = len(raws)
            if t_ns == 0:
                raws = _without_strays(raws)
            raws = list(dict.fromkeys(raws))  # after a damaged answer and its copy some frames are there twice
            self.counters["foreign"] += received - len(raws)
        self.owe_log(t_ns // 1000, raws)


def _without_strays(raws: list[bytes]) -> list[bytes]:
    """The frames received up to the first answer, without those that the controller sent before it.

    The command's sequence number tells how many frames of its sender belong to the answer.
    """
    frames = [lone_frame(raw) for raw in raws]
    theirs = [number for number, frame in enumerate(frames) if (frame.system, frame.component) == VEHICLE]
    last = max(number for number in theirs if frames[number].message_id == COMMAND.message_id)
    before = [number for number in theirs if number <= last]
    strays = set(before[: -(frames[last].sequence + 1)])
    return [raw for number, raw in enumerate(raws) if number not in strays]
