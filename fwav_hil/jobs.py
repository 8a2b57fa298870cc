"""The job of a child process as one structure, and that process: `python -m fwav_hil.jobs NAME`.

It reads its job from the first line of its standard input, reports one JSON object a line on its standard output, and ends
with its parent.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import click
import msgspec

from bridge.command_line import run_command
from bridge.process import StopFlag, end_with_parent, sit_on_core
from bridge.reporting import report_json
from protocol.errors import Interrupted
from protocol.scenario import Scenario

PROCESSES: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "plant_emulator": ("plant_emulator.options:EmulatorOptions", "plant_emulator.process:run_emulator"),
        "controller": ("controller.options:ControllerOptions", "controller.process:run_controller"),
        "motor": ("plant_emulator.options:MotorOptions", "plant_emulator.drives.motor_process:run_motor"),
    }
)
"""Name -> type of its options, and the function that takes (scenario, options, report, stop)."""

Options = TypeVar("Options")


class Job(msgspec.Struct, Generic[Options], frozen=True):
    """What one process has to do, and its core affinity, if any."""

    scenario: Scenario
    options: Options
    core: int | None = None

    def encode(self) -> str:
        """One line of JSON."""
        return msgspec.json.encode(self, enc_hook=str).decode()  # str: for a Path


def decode_job(line: str, options: type[Options]) -> Job[Options]:
    """The job in a line. Raises Interrupted where the line is empty, since the parent has ended."""
    if not line.strip():
        raise Interrupted("interrupted before a job arrived on standard input")
    return msgspec.json.decode(line, type=Job[options], dec_hook=lambda kind, text: kind(text))  # type: ignore[valid-type]


def do_job(name: str) -> None:
    """Run the process of this name until it ends. Raises the errors of `protocol.errors`."""
    end_with_parent()
    options, run = (_named(place) for place in PROCESSES[name])
    job = decode_job(sys.stdin.readline(), options)
    if job.core is not None:
        sit_on_core(job.core)
    stop = StopFlag()
    stop.install()
    run(job.scenario, job.options, report_json(sys.stdout), stop)


def _named(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


if __name__ == "__main__":
    NAME = sys.argv[1]
    sys.exit(run_command(click.Command(NAME, callback=lambda: do_job(NAME)), NAME, []))
