"""What every way of keeping time between the emulator and its peer does: one tick across the link, and its books."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import NamedTuple

from bridge.endpoint import Endpoint
from bridge.process import StopFlag
from bridge.timing.clock import Clock
from bridge.timing.rate import RateKeeper
from plant_emulator.emulator import Emulator
from protocol.logs.tlog import TlogWriter


class Parts(NamedTuple):
    """What a pacing brings together, whichever it is; period_ns: from tick to tick."""

    emulator: Emulator
    endpoint: Endpoint
    log: TlogWriter | None
    clock: Clock
    stop: StopFlag
    period_ns: int


class Pacing(abc.ABC):
    """Carries ticks across the link.

    counters        of the pacing, by name
    keeper          of its schedule, where it has one
    latencies_ns    for each command, wall time from the sending of its sample to the command's arrival
    """

    def __init__(self, parts: Parts) -> None:
        self.emulator, self.endpoint, self.log, self.clock, self.stop, self.period_ns = parts
        self.keeper: RateKeeper | None = None
        self.latencies_ns: list[int] = []
        self.counters: dict[str, int] = {}
        self._owed: list[tuple[int, Sequence[bytes]]] = []

    @abc.abstractmethod
    def exchange(self, tick: int, t_ns: int) -> None:
        """Send the tick at simulation time t_ns, hand what comes of it to the emulator, and move that to the next tick.

        Raises PeerLostError where the controller fell silent, Interrupted where the user asked to stop, DivergenceError
        where the plant cannot go on; the tick's row is then recorded.
        """

    def all_counters(self) -> dict[str, int]:
        """Everything counted, by name, that of the schedule too."""
        return {**self.counters, **(self.keeper.counters if self.keeper else {})}

    def owe_log(self, t_us: int, frames: Sequence[bytes]) -> None:
        """Have frames logged under one time, at the next `settle_log`."""
        self._owed.append((t_us, frames))

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
