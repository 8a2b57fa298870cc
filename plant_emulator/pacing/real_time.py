"""Real time: ticks on an absolute schedule of wall time."""

from __future__ import annotations

from bridge.latency.segments import LegTable
from bridge.timing.clock import unix_time_us
from bridge.timing.rate import RateKeeper
from bridge.timing.timesync import TimeSync
from plant_emulator.pacing.pacing import Pacing, Parts
from protocol.errors import PeerLostError
from protocol.messages import VEHICLE
from protocol.wire import mapping
from protocol.wire.codec import Frame
from protocol.wire.streams import HEARTBEAT_TIMEOUT_NS

_LOG_PERIOD_NS = 10_000_000
"""How often the log of a real-time run is handed over: the most that a kill -9 loses."""
_MOST_IN_A_PERIOD = 1000
"""Datagrams read at most at the end of a period: a peer that floods the link must not stop the plant."""


class RealTime(Pacing):
    """Ticks on an absolute schedule; commands act at the moment they arrive, so the link itself is the delay.

    Late ticks are counted and never caught up in a burst: where the machine misses whole periods, simulation time lags
    wall time by that number of periods (`slipped`).

    sleeps_through   the plant moves at the end of a period only; where the link stamps received data (`Link.received_ns`),
                     the process sleeps until then and applies each command at the time of its stamp. Otherwise each
                     command wakes the process and acts at that time.
    added_delay_ns   of the link (`DelayedLink`): its stamps are older than the delivery by this

    counters   late, slipped    of the schedule (`RateKeeper`)
               unanswered       ticks whose command had not arrived when the next one was due

    legs   tables for the time stamps of ticks and commands, or None; time_sync: offset of the other end's clock
    """

    def __init__(
        self, parts: Parts, *, spin_ns: int = 0, sleeps_through: bool = False, added_delay_ns: int = 0
    ) -> None:
        super().__init__(parts)
        self._keeper = self.keeper = RateKeeper(self.clock, self.period_ns, spin_ns)
        self._sleeps_through = sleeps_through
        self._added_delay_ns = added_delay_ns
        self._log_every_ns = max(1, _LOG_PERIOD_NS // self.period_ns) * self.period_ns
        self._sent: dict[int, int] = {}
        self.time_sync = TimeSync(self.endpoint.seal, self.clock)
        self.legs: tuple[LegTable, LegTable] | None = None
        self._stamp_ns = self._came_ns = 0
        self._heard_ns = self._due_ns = self._woke_ns = self.clock.now_ns()
        self.counters = {"unanswered": 0}

    def begin(self, t_ns: int) -> None:
        """Start the schedule with the first tick; each other tick is sent when the period before it ends."""
        if t_ns == 0:
            self._keeper.start()
            self._heard_ns = self._due_ns = self._woke_ns = self.clock.now_ns()

    def stamp_us(self, t_ns: int) -> int:
        """Unix time, now; the time of sending is recorded too."""
        self._sent[t_ns] = self.sent_ns
        if self.legs:
            self.legs[0].add(t_ns, self._due_ns, self._woke_ns, self.sent_ns)
        return unix_time_us()

    def settle_books(self, t_ns: int) -> None:
        """Hand over the log at intervals, and send a TIMESYNC request when due."""
        if t_ns % self._log_every_ns == 0:
            self.settle_log()
        if self.sent_ns >= self.time_sync.next_ns:
            self._say(self.time_sync.question())

    def take_commands(self, t_ns: int) -> None:
        """Receive until the next tick is due; each command acts at the time it arrived. Raises PeerLostError."""
        keeper, link, source = self._keeper, self.endpoint.link, self.emulator.source
        source.expect(0, t_ns)
        self._due_ns = keeper.deadline_ns
        if self._sleeps_through:
            keeper.sleep()
            self._woke_ns = self.clock.now_ns()
            keeper.tick()
            for _ in range(_MOST_IN_A_PERIOD):
                data = link.recv(0.0)
                if not data:
                    break
                stamp_ns = link.received_ns
                self._process_at(data, t_ns, stamp_ns + self._added_delay_ns if stamp_ns else self.clock.now_ns())
        else:
            while (wait_s := keeper.remaining_s()) is not None:
                data = link.recv(wait_s)
                if data:
                    self._process_at(data, t_ns, self.clock.now_ns())
            self._woke_ns = self.clock.now_ns()
            keeper.tick()
        if source.newest_ns < t_ns:
            self.counters["unanswered"] += 1
            if self.clock.now_ns() - self._heard_ns > HEARTBEAT_TIMEOUT_NS:
                raise PeerLostError(
                    f"the controller at {link.peer} fell silent at t = {t_ns * 1e-9:.3f} s, 3 s without a "
                    "heartbeat or command: check that it still runs"
                )
        self.emulator.check_staleness(t_ns + self.period_ns)

    def _process_at(self, data: bytes, t_ns: int, came_ns: int) -> None:
        """Process bytes that arrived at came_ns, on the clock, during the period of the tick at t_ns."""
        self._came_ns, self._stamp_ns = came_ns, self.endpoint.link.received_ns
        self.process(data, t_ns)
        self._log_what_came()

    def _log_what_came(self) -> None:
        """Log the frames read, with their time of arrival."""
        source = self.emulator.source
        if source.raws:
            raws, source.raws = source.raws, []
            self.owe_log(unix_time_us() - (self.clock.now_ns() - self._came_ns) // 1000, raws)

    def command_came(self, t_ns: int) -> None:
        """Let a command act at its time of arrival, within the period of the tick at t_ns."""
        now_ns = self._heard_ns = (
            self.clock.now_ns()
        )  # not the stamp: it comes from the wall clock, which may have been set since
        came_ns, answered_ns = self._came_ns, self.emulator.source.newest_ns
        since_ns = min(max(0, came_ns - self.sent_ns), self.period_ns)
        self.emulator.act(t_ns + since_ns, 0)
        self.emulator.settle()
        self.latencies_ns.append(came_ns - self._sent.pop(answered_ns, came_ns))
        for lost_ns in [sent_ns for sent_ns in self._sent if sent_ns < answered_ns]:
            del self._sent[lost_ns]  # it will not be answered anymore
        if self.legs:
            applied_ns = came_ns if self._sleeps_through else now_ns
            self.legs[1].add(answered_ns, self._stamp_ns, came_ns, applied_ns, t_ns + since_ns)

    def hear(self, frames: list[Frame]) -> None:
        """React to frames that are no commands; a question is logged before its answer."""
        self._log_what_came()
        rest = []
        for frame in frames:
            if (frame.system, frame.component) == VEHICLE:
                self._heard_ns = self.clock.now_ns()
                if frame.message_id == mapping.TIMESYNC.message_id:
                    answer = self.time_sync.handle(frame, self._stamp_ns or self._came_ns)
                    if answer:
                        self._say(answer)
                    continue
            rest.append(frame)
        super().hear(rest)

    def _say(self, frame: bytes) -> None:
        self.endpoint.send([frame])
        self.owe_log(unix_time_us(), [frame])
