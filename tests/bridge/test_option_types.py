"""Types of options: what no number is, is refused before anything reckons with it."""

from __future__ import annotations

from pathlib import Path

import click
import pytest

from bridge.command_line import run_command
from bridge.option_types import FiniteRange, check_speed
from fwav_hil.cli import cli

NO_NUMBERS = ("nan", "inf", "-inf")


@pytest.mark.parametrize(("text", "number"), [("0.5", 0.5), ("2e3", 2000.0)])
def test_a_number_in_its_range_is_taken(text: str, number: float) -> None:
    assert FiniteRange(min=0.1).convert(text, None, None) == number


@pytest.mark.parametrize("text", [*NO_NUMBERS, "0.05", "much"])
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(click.BadParameter):
        FiniteRange(min=0.1).convert(text, None, None)


@pytest.mark.parametrize("text", ["nan", "inf"])
@pytest.mark.parametrize(
    "arguments",
    [
        ("doctor", "--seconds"),
        ("doctor", "--rate"),
        ("margin", "--gain-ratio"),
        ("margin", "--n-filter"),
        ("design", "--out", "never.toml", "--delay-s"),
        ("run", "--speed"),
        ("controller", "--wait"),
        ("emulator", "--wait", "0.1", "--link", "udpin://127.0.0.1:0", "--speed"),
    ],
)
def test_every_command_says_so_in_one_line(
    arguments: tuple[str, ...], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(cli, "fwav-hil", [*arguments, text]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert arguments[-1] in said
    assert not Path("never.toml").exists()


@pytest.mark.parametrize("command", ["run", "emulator"])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--clock", "realtime", "--speed", "2"), "leave one of them out"),
        (("--speed", "0.001"), "is a tick every 4 s, for which no end waits: choose --speed 0.004 or more"),
    ],
)
def test_a_speed_that_cannot_be_kept_is_refused(
    command: str, arguments: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run_command(cli, "fwav-hil", [command, "flapper", *arguments, "--out", str(tmp_path / "run")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_speed_in_its_range_is_taken() -> None:
    for clock, speed in (("lockstep", None), ("lockstep", 0.004), ("realtime", None)):
        check_speed(clock, speed, 250.0)
