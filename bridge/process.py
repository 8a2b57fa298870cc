"""What all processes of the project share: stop on request, end with the parent, take a folder, set core affinity."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from pathlib import Path

from bridge.links.link import Link, open_link
from bridge.timing.clock import MonotonicClock
from protocol.errors import Interrupted, PeerMissingError, RunFolderError

_CONNECT_SLICE_S = 0.2


class StopFlag:
    """Set by SIGINT and SIGTERM; checked where a loop can end without leaving files half-written.

    peer_restarts   number of SIGURG received: the parent has restarted a process that this one may be waiting for. A
                    process that has not installed its handler yet ignores that signal.
    """

    def __init__(self) -> None:
        self.requested = False
        self.peer_restarts = 0

    def install(self) -> None:
        """Install the signal handlers; a second stop signal has its default effect."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        signal.signal(signal.SIGURG, self._on_restart)

    def _on_signal(self, number: int, _frame: object) -> None:
        self.requested = True
        signal.signal(number, signal.SIG_DFL)

    def _on_restart(self, _number: int, _frame: object) -> None:
        self.peer_restarts += 1

    def check(self) -> None:
        """Raise Interrupted where a stop was requested."""
        if self.requested:
            raise Interrupted("interrupted")


def open_patiently(uri: str, wait_s: float, stop: StopFlag) -> Link:
    """`open_link`, waiting up to wait_s for a server to appear; a stop request ends the wait.

    Raises what `open_link` raises, and Interrupted.
    """
    clock = MonotonicClock()
    give_up_ns = clock.now_ns() + round(wait_s * 1e9)
    while True:
        stop.check()
        try:
            return open_link(uri, connect_timeout_s=min(wait_s, _CONNECT_SLICE_S))
        except PeerMissingError:
            if clock.now_ns() >= give_up_ns:
                raise


def take_folder(folder: Path, *names: str) -> None:
    """Make the folder, before a process begins, to which it writes files of these names at its end.

    Raises RunFolderError where it cannot be made or holds one of the files: nothing is overwritten.
    """
    from bridge.summary import make_folder  # imported here: code that needs only signals need not load numpy

    for name in names:
        if (folder / name).exists():
            raise RunFolderError(
                f"{folder / name} exists already and is not overwritten: choose another folder with --out, or remove it"
            )
    make_folder(folder)


def end_with_parent() -> None:
    """Have the system send SIGTERM to this process when its parent ends for any reason (Linux only)."""
    if sys.platform == "linux":
        set_parent_death_signal = 1
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGTERM)


def sit_on_core(core: int) -> None:
    """Set the core affinity of this process to one core; no effect where the system refuses or has no such call."""
    if hasattr(os, "sched_setaffinity"):
        try:
            os.sched_setaffinity(0, {core})
        except (OSError, ValueError, OverflowError):
            return
