"""The drives of a run as a process of their own: started with the others, restarted when killed, ended last."""

from __future__ import annotations

import signal

import click

from fwav_hil.children import Child
from fwav_hil.jobs import Job
from plant_emulator.options import MotorOptions

MOST_RESTARTS = 3


class MotorKeeper:
    """Watches the process of the drives.

    restarts   times it was restarted after a signal had ended it
    """

    def __init__(self, job: Job[MotorOptions]) -> None:
        self._job = job
        self.restarts = 0
        self._asked = False
        self._ended: list[Child] = []
        self.child = self._start()

    def look(self, children: list[Child], emulator: Child) -> None:
        """Restart it if it was killed (added to `children`, the emulator is notified); end it once the emulator has ended."""
        code = self.child.process.poll()
        if emulator.process.poll() is not None:
            self.ask_to_end()
        elif code is not None and code < 0 and self.restarts < MOST_RESTARTS:
            self.restarts += 1
            click.echo(f"{self.child.failure}: restarted ({self.restarts} of {MOST_RESTARTS})", err=True)
            self._ended.append(self.child)  # its pipes are still read
            self.child = self._start()
            children.append(self.child)
            emulator.process.send_signal(signal.SIGURG)  # see `StopFlag`

    def ask_to_end(self) -> None:
        """Ask it to end with the run; only once, since a second request would end it immediately."""
        if not self._asked and self.child.process.poll() is None:
            self._asked = True
            self.child.ask_to_end()

    def end(self) -> None:
        """Leave no process behind."""
        for child in (*self._ended, self.child):
            child.end()

    @property
    def failure(self) -> str | None:
        """Why it ended before the run and is not restarted, in one sentence; None where it still runs."""
        code = self.child.process.poll()
        if code is not None and code > 0:
            return self.child.failure
        if code is None or self._asked or (code < 0 and self.restarts < MOST_RESTARTS):
            return None
        how = f"was ended by signal {-code} after {MOST_RESTARTS} restarts" if code else "ended"
        return f"the process of the drives {how}, which ended the run: find out what ends it, then run again"

    def _start(self) -> Child:
        return Child("motor", self._job)
