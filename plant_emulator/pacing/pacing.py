"""What all ways of keeping time have in common: exchange one tick over the link, log it and count."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import NamedTuple

from bridge.endpoint import Endpoint
from bridge.process import StopFlag
from bridge.timing.clock import Clock
from bridge.timing.rate import RateKeeper
from plant_emulator.command_source import Found
from plant_emulator.tick import Emulator
from protocol.logs.tlog import TlogWriter
from protocol.wire.codec import Frame

_COMMAND = Found.COMMAND


class Parts(NamedTuple):
    """What every pacing needs; period_ns: from tick to tick, ticks: how many there are."""

    emulator: Emulator
    endpoint: Endpoint
    log: TlogWriter | None
    clock: Clock
    stop: StopFlag
    period_ns: int
    ticks: int


class Pacing(abc.ABC):
    """Exchanges ticks over the link.

    counters        of the pacing, by name
    keeper          of its schedule, if it has one
    latencies_ns    for each command, wall time from the sending of its sample to the command's arrival
    """

    def __init__(self, parts: Parts) -> None:
        self.emulator, self.endpoint, self.log, self.clock, self.stop, self.period_ns, ticks = parts
        self.end_ns = ticks * self.period_ns
        self.keeper: RateKeeper | None = None
        self.latencies_ns: list[int] = []
        self.counters: dict[str, int] = {}
        self._owed: list[tuple[int, Sequence[bytes]]] = []
        self.sent_ns = 0
        """When the last tick was handed to the link, on the clock."""
        self.datagram = b""
        """The last tick, as it was sent."""
        self._is_sent = False

    def exchange(self, t_ns: int) -> None:
        """Send the tick at simulation time t_ns, let the answer act, and advance the plant to the next tick.

        Raises PeerLostError where the controller fell silent, Interrupted where the user asked to stop, DivergenceError
        where the plant diverged; the tick's row is then recorded.
        """
        if self.stop.requested:
            self.stop.check()
        if not self._is_sent:
            self.begin(t_ns)
            self.send(t_ns)
            self.owe_tick(t_ns)
        self._is_sent = False
        self.settle_books(t_ns)
        self.take_commands(t_ns)
        try:
            self.move(t_ns)
            following_ns = t_ns + self.period_ns
            self._is_sent = self.sends_ahead and following_ns < self.end_ns
            if self._is_sent:
                self.send(following_ns)
        finally:
            self.log_received(t_ns)  # like all books, kept while the next tick is on its way
        if self._is_sent:
            self.owe_tick(following_ns)
        self.emulator.record(t_ns)

    sends_ahead = True
    """Whether a tick is sent as soon as the plant has reached it, before the previous one is recorded."""

    def begin(self, t_ns: int) -> None:  # noqa: B027  (most have nothing to wait for)
        """Wait until the tick at t_ns is due."""

    @abc.abstractmethod
    def take_commands(self, t_ns: int) -> None:
        """Receive the answers to the tick at t_ns, and let their commands act."""

    @abc.abstractmethod
    def stamp_us(self, t_ns: int) -> int:
        """The log's time stamp (us) of the tick at t_ns, which has just been sent."""

    @abc.abstractmethod
    def command_came(self, t_ns: int) -> None:
        """Let the newest command, read during the tick at t_ns, act."""

    def send(self, t_ns: int) -> None:
        """Measure the plant at t_ns and send the tick."""
        self.datagram = self.emulator.sense(t_ns)
        self.sent_ns = self.clock.now_ns()
        self.endpoint.link.send(self.datagram)

    def owe_tick(self, t_ns: int) -> None:
        """Have the tick at t_ns, now sent, logged: after what came upon the tick before it."""
        self.owe_log(self.stamp_us(t_ns), self.emulator.frames())

    def process(self, data: bytes, t_ns: int) -> None:
        """Process the bytes received during the tick at t_ns, in order: commands act, other frames are handled."""
        source = self.emulator.source
        source.feed(data)
        while True:
            found = source.read()
            if source.others:
                others, source.others = source.others, []
                self.hear(others)
            if found is _COMMAND:
                self.command_came(t_ns)
            if source.is_read:
                return

    def log_received(self, t_ns: int) -> None:  # noqa: B027  (real time logs what comes as it comes)
        """Log the frames that came upon the tick at t_ns."""

    def hear(self, frames: list[Frame]) -> None:
        """React to frames that are no commands."""
        self.emulator.hear(frames)

    def move(self, t_ns: int) -> None:
        """Fill the row of the tick at t_ns and advance the plant."""
        self.emulator.advance(t_ns + self.period_ns)

    def all_counters(self) -> dict[str, int]:
        """All counters, by name, with those of the schedule."""
        return {**self.counters, **(self.keeper.counters if self.keeper else {})}

    def owe_log(self, t_us: int, frames: Sequence[bytes]) -> None:
        """Queue frames for the log, with one time stamp; `settle_books` writes them."""
        self._owed.append((t_us, frames))

    def settle_books(self, _t_ns: int) -> None:
        """Do what can wait until the tick has been sent."""
        self.settle_log()

    def settle_log(self) -> None:
        """Write the queued frames to the log: done while the other end computes, and at the end of the run."""
        if self.log:
            write = self.log.write
            for t_us, frames in self._owed:
                for frame in frames:
                    write(t_us, frame)
            self.log.hand_over()
        self._owed.clear()

    def flush(self) -> None:
        """Flush the log to the operating system."""
        self.settle_log()
        if self.log:
            self.log.flush()
