"""The child processes of a run, seen from their parent: start them, read their reports, end them, leave none running."""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import msgspec

from fwav_hil.jobs import Job
from protocol.errors import Interrupted

_GRACE_S = 5.0


class Child:
    """A process that does a job (`fwav_hil/jobs.py`) and reports one JSON object a line on its standard output.

    name   which process, one of `jobs.PROCESSES`: used in messages, and by the process itself on standard error
    """

    def __init__(self, name: str, job: Job[Any], module: str = "fwav_hil.jobs") -> None:
        self.name = name
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self.error = ""
        self._asked = False
        self._partial = b""
        self.tell(job.encode())

    @property
    def failure(self) -> str | None:
        """Why it ended, in one sentence; None where it ended without error, was asked to end, or still runs."""
        code = self.process.poll()
        if not code or (self._asked and code in (-signal.SIGTERM, Interrupted.exit_code)):
            return None
        lines = [line for line in self.error.splitlines() if line.strip()]
        if lines and code > 0:  # a process that was killed wrote no error message
            return lines[-1].removeprefix(f"{self.name}: ")
        how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return f"the {self.name.replace('_', ' ')} process {how}"

    def tell(self, line: str) -> None:
        """Send it a line."""
        if self.process.stdin and not self.process.stdin.closed:
            try:
                self.process.stdin.write(line.encode() + b"\n")
                self.process.stdin.flush()
            except BrokenPipeError:
                pass  # it has ended; its exit code says why

    def ask_to_end(self) -> None:
        """Close its standard input, and send SIGTERM if it still runs."""
        if self.process.poll() is None:
            self._asked = True
            if self.process.stdin:
                self.process.stdin.close()
            self.process.terminate()

    def events_in(self, data: bytes) -> Iterator[dict[str, Any]]:
        """The reports completed by `data`, the next bytes of its standard output."""
        *lines, self._partial = (self._partial + data).split(b"\n")
        for line in lines:
            try:
                yield msgspec.json.decode(line, type=dict[str, Any])
            except ValueError:  # not JSON, not an object, not UTF-8
                self.error += line.decode(errors="replace") + "\n"  # printed by a library

    def end(self) -> None:
        """Wait briefly for it to end by itself, then terminate it, then kill it."""
        for signal_it in (None, self.process.terminate, self.process.kill):
            if signal_it:
                signal_it()
            try:
                self.process.wait(_GRACE_S)
                break
            except subprocess.TimeoutExpired:
                continue
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            if pipe:
                try:
                    pipe.close()
                except BrokenPipeError:
                    continue


def listen(children: list[Child]) -> Iterator[tuple[Child | None, dict[str, Any]]]:
    """The reports of all children as they arrive, until every child has closed its output.

    At least ten times a second something is yielded: (None, {}) where nothing arrived, so that the caller can do other work.
    Children added to the list meanwhile are read too.
    """
    with selectors.DefaultSelector() as selector:
        heard = 0
        while True:
            for child in children[heard:]:
                selector.register(child.process.stdout, selectors.EVENT_READ, (child, True))  # type: ignore[arg-type]
                selector.register(child.process.stderr, selectors.EVENT_READ, (child, False))  # type: ignore[arg-type]
            heard = len(children)
            if not selector.get_map():
                return
            ready = selector.select(0.1)
            if not ready:
                yield None, {}
            for key, _ in ready:
                child, is_report = key.data
                data = os.read(key.fd, 65536)
                if not data:
                    selector.unregister(key.fileobj)
                elif is_report:
                    for event in child.events_in(data):
                        yield child, event
                else:
                    child.error += data.decode(errors="replace")
