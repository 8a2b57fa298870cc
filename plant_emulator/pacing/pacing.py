"""What every way of keeping time between the emulator and its peer does: carry one tick across the link, keep its books."""

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
    """What a pacing brings together, whichever it is; period_ns: from tick to tick, ticks: how many there are."""

    emulator: Emulator
    endpoint: Endpoint
    log: TlogWriter | None
    clock: Clock
    stop: StopFlag
    period_ns: int
    ticks: int


class Pacing(abc.ABC):
    """Carries ticks across the link.

    counters        of the pacing, by name
    keeper          of its schedule, where it has one
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
        """When the tick sent last was handed to the link, on the clock."""
        self.datagram = b""
        """That tick, as it was sent."""
        self._is_sent = False

    def exchange(self, t_ns: int) -> None:
        """Send the tick at simulation time t_ns, let what comes of it act, and move the plant on to the next tick.

        Raises PeerLostError where the controller fell silent, Interrupted where the user asked to stop, DivergenceError
        where the plant cannot go on; the tick's row is then recorded.
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
    """Whether a tick leaves as soon as the plant has reached it, before the books of the one before it are kept."""

    def begin(self, t_ns: int) -> None:  # noqa: B027  (most have nothing to wait for)
        """Wait until the tick at t_ns is to be sent."""

    @abc.abstractmethod
    def take_commands(self, t_ns: int) -> None:
        """Receive what comes upon the tick at t_ns, and let its commands act."""

    @abc.abstractmethod
    def stamp_us(self, t_ns: int) -> int:
        """The time (us) under which what belongs to the tick at t_ns, now sent, is logged."""

    @abc.abstractmethod
    def command_came(self, t_ns: int) -> None:
        """React to the newest command, read during the tick at t_ns: let it act."""

    def send(self, t_ns: int) -> None:
        """Measure the plant at t_ns and send the tick."""
        self.datagram = self.emulator.sense(t_ns)
        self.sent_ns = self.clock.now_ns()
        self.endpoint.link.send(self.datagram)

    def owe_tick(self, t_ns: int) -> None:
        """Have the tick at t_ns, now sent, logged: after what came upon the tick before it."""
        self.owe_log(self.stamp_us(t_ns), self.emulator.frames())

    def process(self, data: bytes, t_ns: int) -> None:
        """Take all that came during the tick at t_ns, in its order: commands act, the rest is heard."""
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
        """Note the row of the tick at t_ns and move the plant on."""
        self.emulator.advance(t_ns + self.period_ns)

    def all_counters(self) -> dict[str, int]:
        """Everything counted, by name, that of the schedule too."""
        return {**self.counters, **(self.keeper.counters if self.keeper else {})}

    def owe_log(self, t_us: int, frames: Sequence[bytes]) -> None:
        """Have frames logged under one time, when the books are next settled."""
        self._owed.append((t_us, frames))

    def settle_books(self, _t_ns: int) -> None:
        """See to what can wait until the tick is on its way."""
        self.settle_log()

    def settle_log(self) -> None:
        """Write what is owed to the log: done while the other end is at work, and at the end of the run."""
        if self.log:
            write = self.log.write
            for t_us, frames in self._owed:
                for frame in frames:
                    write(t_us, frame)
            self.log.hand_over()
        self._owed.clear()

    def flush(self) -> None:
        """Hand what is logged so far to the system."""
        self.settle_log()
        if self.log:
            self.log.flush()
