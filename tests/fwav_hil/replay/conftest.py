"""A recorded run for the tests of replays, and commands run within this process."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bridge.command_line import run_command
from bridge.links.memory import memory_pair
from fwav_hil.cli import cli
from tests.loop import fly_both, scenario_of

Command = Callable[..., int]


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lockstep run of the flapper, 0.4 s."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    ends = fly_both(scenario_of("flapper", duration_s=0.4), *memory_pair(), folder)
    assert isinstance(ends.emulator, dict), ends.emulator
    assert isinstance(ends.controller, dict), ends.controller
    return folder


@pytest.fixture
def fwav_hil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Command]:
    """Runs `fwav-hil` with arguments, in a folder of its own; returns the exit code. Nothing about compiling is said."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("fwav_hil.logs.choice.kernels_are_warm", lambda *_packages: True)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield lambda *arguments: run_command(cli, "fwav-hil", [str(argument) for argument in arguments])
    for number, handler in handlers.items():
        signal.signal(number, handler)
