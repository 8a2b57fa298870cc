"""What every process of the project does alike: stop when asked, end with its parent, tell its status, sit on a core."""

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
    """Set by SIGINT and SIGTERM; looked at where a loop may end with nothing half-written.

    peer_restarts   times SIGURG came: the parent has started a process again that this one may be waiting for. The system
                    ignores that signal in a process that has not got so far yet.
    """

    def __init__(self) -> None:
        self.requested = False
        self.peer_restarts = 0

    def install(self) -> None:
        """Take over these signals in this process; a second one to stop acts as it would by default."""
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
    """`open_link`, waiting up to wait_s for a server to appear; a stop is heard while waiting.

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
    """Make the folder that a process writes files of these names to at its end, before it begins.

    Raises RunFolderError where it cannot be made, or holds one of them: what is there stays.
    """
    from bridge.summary import make_folder  # here: who only wants signals need not wait for numpy

    for name in names:
        if (folder / name).exists():
            raise RunFolderError(
                f"{folder / name} is there already, and stays: choose another folder with --out, or remove it"
            )
    make_folder(folder)


def end_with_parent() -> None:
    """Have the system send SIGTERM to this process when its parent ends, however that ends (Linux only)."""
    if sys.platform == "linux":
        set_parent_death_signal = 1
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGTERM)


def sit_on_core(core: int) -> None:
    """Let this process run on one core only; left as it is where the system has no such call or refuses."""
    if hasattr(os, "sched_setaffinity"):
        try:
            os.sched_setaffinity(0, {core})
        except (OSError, ValueError, OverflowError):
            return
