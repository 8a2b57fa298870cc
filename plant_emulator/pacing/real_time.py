"""Real time: ticks on an absolute schedule of wall time."""

from __future__ import annotations

from bridge.latency.segments import LegTable
from bridge.timing.clock import unix_time_us
from bridge.timing.rate import RateKeeper
from bridge.timing.timesync import TimeSync
from plant_emulator.pacing.pacing import Pacing, Parts
from protocol.errors import DivergenceError, PeerLostError
from protocol.messages import VEHICLE
from protocol.wire import mapping
from protocol.wire.codec import Frame
from protocol.wire.streams import HEARTBEAT_TIMEOUT_NS

_LOG_PERIOD_NS = 10_000_000
"""How often the log of a real-time run is handed over: what a kill -9 may cost."""

_MOST_IN_A_PERIOD = 1000
"""Datagrams that one period's end takes in: a peer that floods the link must not stop the plant."""


class RealTime(Pacing):
    """Ticks on an absolute schedule of wall time; commands act the moment they arrive, so the link itself is the delay.

    Late ticks are counted and never caught up in a burst: where the machine misses whole periods, simulation time lags
    wall time by as many (`slipped`).

    sleeps_through   the plant moves at the end of a period only, so where the link stamps what it receives (`Link.received_ns`)
                     the period is slept through, and what came is taken at its end, each at the time of its stamp. Else each
                     command wakes the process, and came when it woke.
    added_delay_ns   of the link (`DelayedLink`): its stamps are so much older than what it hands on

    counters   late, slipped    of the schedule (`RateKeeper`)
               unanswered       ticks whose command had not come when the next one was due
               old_commands     commands older than one that came before, dropped
               repeated         commands that came again: they stand, and do not count as fresh
               unknown_echoes   commands that answer no tick that was sent, dropped

    legs   where to note when each tick and command was where, or None; time_sync: the other end's clock, asked for if so
    """

    def __init__(
        self,
        parts: Parts,
        *,
        ticks: int,
        spin_ns: int = 0,
        sleeps_through: bool = False,
        added_delay_ns: int = 0,
    ) -> None:
        super().__init__(parts)
        self._keeper = self.keeper = RateKeeper(self.clock, self.period_ns, spin_ns)
        self._sleeps_through = sleeps_through
        self._added_delay_ns = added_delay_ns
        self._ahead_until_ns = ticks * self.period_ns if self.emulator.safety.outlasts(self.period_ns) else 0
        """Ticks before this time may be sent together with the taking of a plain answer to the one before them."""
        self._log_every = max(1, _LOG_PERIOD_NS // self.period_ns)
        self._is_sent = False
        self._sent: dict[int, int] = {}
        self._newest_ns = -1
        self._begun = False
        self.time_sync = TimeSync(self.endpoint.seal, self.clock)
        self.legs: tuple[LegTable, LegTable] | None = None
        self._heard_ns = self._due_ns = self._woke_ns = self.clock.now_ns()
        self.counters = {"unanswered": 0, "old_commands": 0, "repeated": 0, "unknown_echoes": 0}

    def exchange(self, tick: int, t_ns: int) -> None:
        """Send the tick, then take commands until the next one is due."""
        self.stop.check()
        if tick == 0:
            self._keeper.start()
            self._heard_ns = self._due_ns = self._woke_ns = self.clock.now_ns()
        if not self._is_sent:
            frames = self.emulator.sense(t_ns)
            self._send(t_ns, b"".join(frames))
            self.owe_log(unix_time_us(), frames)
            self._note_tick(t_ns)
        self._is_sent = False
        if tick % self._log_every == 0:
            self.settle_log()
        begun_ns = self._sent[t_ns]
        if begun_ns >= self.time_sync.next_ns:
            self._say(self.time_sync.question())
        self._due_ns = self._keeper.deadline_ns
        if self._sleeps_through:
            self._keeper.sleep()
            self._woke_ns = self.clock.now_ns()
            self._keeper.tick()
            if self._take_what_came(t_ns, begun_ns):
                return
        else:
            while (wait_s := self._keeper.remaining_s()) is not None:
                received = self.endpoint.receive(wait_s)
                arrived_ns = self.clock.now_ns()
                for frame in received:
                    stamp_ns = self.endpoint.link.received_ns
                    self._take(frame, t_ns + self._since(begun_ns, arrived_ns), arrived_ns, stamp_ns)
            self._woke_ns = self.clock.now_ns()
            self._keeper.tick()
        if self._newest_ns < t_ns:
            self.counters["unanswered"] += 1
        self.emulator.check_staleness(t_ns + self.period_ns)
        if self.clock.now_ns() - self._heard_ns > HEARTBEAT_TIMEOUT_NS:
            raise PeerLostError(
                f"the controller at {self.endpoint.link.peer} fell silent at t = {t_ns * 1e-9:.3f} s, 3 s without a "
                "heartbeat or command: see whether it still runs"
            )
        self.emulator.advance(t_ns + self.period_ns)

    def _take_what_came(self, t_ns: int, begun_ns: int) -> bool:
        """Take what came in the period that has been slept through; whether that has sent the next tick too."""
        link = self.endpoint.link
        for _ in range(_MOST_IN_A_PERIOD):
            data = link.recv(0.0)
            if not data:
                break
            stamp_ns = link.received_ns
            came_ns = stamp_ns + self._added_delay_ns if stamp_ns else self.clock.now_ns()
            if self._go_on(t_ns, begun_ns, came_ns, data):
                return True  # should more have come, it waits for the next tick's turn, with its stamp
            for frame in self.endpoint.reader.read(data):
                self._take(frame, t_ns + self._since(begun_ns, came_ns), came_ns, stamp_ns)
        return False

    def _since(self, begun_ns: int, moment_ns: int) -> int:
        """How far into its period, begun at begun_ns, a moment of wall time lies."""
        return min(max(0, moment_ns - begun_ns), self.period_ns)

    def _send(self, t_ns: int, datagram: bytes) -> None:
        self._sent[t_ns] = self.clock.now_ns()
        self.endpoint.link.send(datagram)

    def _unix_us(self, moment_ns: int) -> int:
        """The time for the log of a moment that has just passed."""
        return unix_time_us() - (self.clock.now_ns() - moment_ns) // 1000

    def _go_on(self, t_ns: int, begun_ns: int, came_ns: int, data: bytes) -> bool:
        """Take a plain answer to the tick, move the plant, and send the next tick, which is plain too: all else waits."""
        end_ns = t_ns + self.period_ns
        if end_ns >= self._ahead_until_ns or not self._begun or self._newest_ns == t_ns:
            return False
        since_ns = self._since(begun_ns, came_ns)
        try:
            following = self.emulator.go_on(data, t_ns, end_ns, since_ns)
        except DivergenceError:
            self.owe_log(unix_time_us(), [data])
            raise
        if following is None:
            return False
        datagram, middle = following
        self._send(end_ns, datagram)
        self._is_sent = True
        self.emulator.settle(t_ns, t_ns + since_ns)
        now_us = unix_time_us()
        self.owe_log(now_us - (self._sent[end_ns] - came_ns) // 1000, (data,))
        self.owe_log(now_us, (datagram[:middle], datagram[middle:]))
        self._answered(t_ns, came_ns)
        self._note_tick(end_ns)
        self._note_answer(t_ns, self.endpoint.link.received_ns, came_ns, t_ns + since_ns)
        return True

    def _answered(self, t_ns: int, arrived_ns: int) -> None:
        """Take note of the newest command: that for the tick of t_ns."""
        self._newest_ns = t_ns
        self._heard_ns = self.clock.now_ns()  # not the stamp: the wall clock it was made of may have been set since
        sent_ns = self._sent.pop(t_ns)
        self.latencies_ns.append(arrived_ns - sent_ns)
        if len(self._sent) > 1:  # ticks that will not be answered any more
            self._sent = {later_ns: sent_ns for later_ns, sent_ns in self._sent.items() if later_ns > t_ns}

    def _take(self, frame: Frame, arrival_ns: int, wall_ns: int, stamp_ns: int) -> None:
        """Take a frame that came at simulation time arrival_ns, wall_ns of this machine, and was stamped then (0: not)."""
        self.owe_log(self._unix_us(wall_ns), [frame.raw])
        if self.emulator.take_request(frame):
            return
        if (frame.system, frame.component) != VEHICLE:
            return
        self._heard_ns = self.clock.now_ns()
        if frame.message_id == mapping.TIMESYNC.message_id:
            answer = self.time_sync.take(frame, stamp_ns or wall_ns)
            if answer:
                self._say(answer)
            return
        if frame.message_id != mapping.COMMAND.message_id:
            return
        if not self._begun:
            self._begun = True
            self.endpoint.reader.restart_sequences([(*VEHICLE, frame.sequence + 1)])
        command = self.emulator.decode(frame.payload)
        if command is None:
            return
        if command.t_ns < self._newest_ns:
            self.counters["old_commands"] += 1
            return
        if command.t_ns == self._newest_ns:
            self.counters["repeated"] += 1
            return
        if command.t_ns not in self._sent:
            self.counters["unknown_echoes"] += 1
            return
        self._answered(command.t_ns, wall_ns)
        self.emulator.act(arrival_ns, 0, command)
        self._note_answer(command.t_ns, stamp_ns, wall_ns, arrival_ns)

    def _note_tick(self, t_ns: int) -> None:
        """Note when the tick of t_ns, just sent, was where."""
        if self.legs:
            self.legs[0].add(t_ns, self._due_ns, self._woke_ns, self._sent[t_ns])

    def _note_answer(self, t_ns: int, stamp_ns: int, came_ns: int, arrival_ns: int) -> None:
        """Note when the command for the tick of t_ns was where; slept through, it is applied the moment it came."""
        if self.legs:
            applied_ns = came_ns if self._sleeps_through else self.clock.now_ns()
            self.legs[1].add(t_ns, stamp_ns, came_ns, applied_ns, arrival_ns)

    def _say(self, frame: bytes) -> None:
        self.endpoint.send([frame])
        self.owe_log(unix_time_us(), [frame])
