"""The live peer of a replay: a child process that is watched while it runs, and always ended."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from bridge.process import StopFlag
from fwav_hil.children import Child
from fwav_hil.jobs import Job
from protocol.errors import PeerLostError


class WatchingStop(StopFlag):
    """A stop flag that also checks whether the peer still runs."""

    def __init__(self, stop: StopFlag, child: Child) -> None:
        super().__init__()
        self._stop = stop
        self._child = child

    def check(self) -> None:
        """Raise Interrupted where a stop was requested, PeerLostError where the process has failed."""
        self._stop.check()
        if self._child.process.poll():
            if self._child.process.stderr:
                self._child.error += self._child.process.stderr.read().decode(errors="replace")
            raise PeerLostError(self._child.failure or f"the {self._child.name} process ended")


@contextmanager
def other_end(name: str, job: Job[Any], stop: StopFlag) -> Iterator[tuple[Child, WatchingStop]]:
    """Start a process of the project for as long as the block lasts."""
    child = Child(name, job)
    try:
        yield child, WatchingStop(stop, child)
    finally:
        child.ask_to_end()
        child.end()
