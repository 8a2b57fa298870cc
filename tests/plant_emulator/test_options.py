"""Options of drives on a bus: where there is no bus they are refused, not ignored."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.command_line import run_command
from fwav_hil.cli import cli

GIVEN = [
    ("--can", "virtual:a"),
    ("--protocol", "mit"),
    ("--lag", "0.01"),
    ("--feedback", "bus"),
    ("--can-log", "bus.blf"),
    ("--tap", "udpin://127.0.0.1:0"),
]


@pytest.mark.parametrize("command", ["run", "emulator"])
@pytest.mark.parametrize("option", GIVEN, ids=lambda option: option[0])
@pytest.mark.parametrize("direct", [(), ("--motor", "direct")])
def test_without_a_bus_they_are_refused(
    command: str, option: tuple[str, str], direct: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run_command(cli, "fwav-hil", [command, "flapper", *option, *direct, "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"{option[0]} has no effect without --motor can: add it" in said
    assert not (tmp_path / "run").exists()


def test_with_one_they_are_taken_wherever_motor_stands(capsys: pytest.CaptureFixture[str]) -> None:
    """The URI of the bus is looked at, and is none: so far it came."""
    given = [word for option in GIVEN[1:] for word in option]
    assert run_command(cli, "fwav-hil", ["run", "flapper", "--can", "none", *given, "--motor", "can"]) == 2
    assert "'none' is not a CAN bus URI" in capsys.readouterr().err
