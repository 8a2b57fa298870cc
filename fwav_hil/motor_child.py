"""The drives of a run as a process of their own: started with the others, started again when killed, ended last."""

from __future__ import annotations

import click

from fwav_hil.children import Child
from fwav_hil.jobs import Job
from plant_emulator.options import MotorOptions

MOST_RESTARTS = 3


class MotorKeeper:
    """Watches the process of the drives.

    restarts   times it was started again, since a signal had ended it
    """

    def __init__(self, job: Job[MotorOptions]) -> None:
        self._job = job
        self.restarts = 0
        self._asked = False
        self._ended: list[Child] = []
        self.child = self._start()

    def look(self, children: list[Child], emulator: Child) -> None:
        """Look after it: a new process joins `children`; one whose emulator has ended is asked to end."""
        code = self.child.process.poll()
        if emulator.process.poll() is not None:
            if not self._asked:  # a second time would end it on the spot
                self._asked = True
                self.child.ask_to_end()
        elif code is not None and code < 0 and self.restarts < MOST_RESTARTS:
            self.restarts += 1
            click.echo(f"{self.child.failure}: started again ({self.restarts} of {MOST_RESTARTS})", err=True)
            self._ended.append(self.child)  # its pipes are still listened to
            self.child = self._start()
            children.append(self.child)

    def end(self) -> None:
        """Leave no process behind."""
        for child in (*self._ended, self.child):
            child.end()

    @property
    def failed(self) -> bool:
        """Whether it has ended, and will not be started again."""
        code = self.child.process.poll()
        return (
            code is not None
            and code != 0
            and (code > 0 or self.restarts == MOST_RESTARTS)
            and self.child.failure is not None
        )

    def _start(self) -> Child:
        return Child("motor", self._job)
