"""`fwav-hil budget`, and the commands that ask it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bridge.command_line import run_command
from fwav_hil.cli import cli

SERIAL = "serial:///dev/ttyUSB0:921600"
REFUSAL = "1000 Hz does not fit"


def test_what_fits_is_shown_with_its_share_and_delay(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(cli, "fwav-hil", ["budget", "--link", SERIAL, "--rate", "500"]) == 0
    out = capsys.readouterr().out
    for words in ("ATT_POS_MOCAP", "1.367 ms", "1.009 ms", "500 Hz fits", "69 %"):
        assert words in out


def test_what_does_not_fit_ends_with_2_after_the_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(cli, "fwav-hil", ["budget", "--link", SERIAL, "--rate", "1000", "--json", "-"]) == 2
    captured = capsys.readouterr()
    told = json.loads(captured.out)
    assert told["budget"]["fits"] is False
    assert told["scenario_delay_s"] == pytest.approx(0.006)
    assert captured.err.splitlines()[-1].startswith(f"fwav-hil: {REFUSAL}")


@pytest.mark.parametrize(
    ("arguments", "refused"),
    [
        (["emulator", "--clock", "realtime"], True),
        (["controller", "--clock", "realtime"], True),
        (["emulator", "--speed", "1"], True),
        (["emulator", "--speed", "0.5"], False),
        (["emulator"], False),
    ],
)
def test_an_end_that_keeps_wall_time_refuses_the_rate(
    arguments: list[str], refused: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Otherwise it goes on to the device, which is not there."""
    missing = f"serial://{tmp_path}/no_such_device:921600"
    code = run_command(cli, "fwav-hil", [*arguments, "--link", missing, "--rate", "1000"])
    assert code == (2 if refused else 3)
    assert (REFUSAL in capsys.readouterr().err) == refused


@pytest.mark.parametrize(
    "arguments", [["run", "--realtime"], ["emulator", "--realtime"], ["controller", "--trigger", "clock"]]
)
def test_real_time_options_without_real_time_are_refused(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(cli, "fwav-hil", arguments) == 2
    assert "add --clock realtime" in capsys.readouterr().err
