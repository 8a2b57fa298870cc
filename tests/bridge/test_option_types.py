"""Types of options: what no number is, is refused before anything reckons with it."""

from __future__ import annotations

from pathlib import Path

import click
import pytest

from bridge.command_line import run_command
from bridge.option_types import KEY_FILE, MICROSECONDS, DurationNs, FiniteRange, check_speed
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
        (("--speed", "0.001"), "is a tick every 4 s, longer than the ends' timeouts: choose --speed 0.004 or more"),
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


class TestDuration:
    @pytest.mark.parametrize(
        ("text", "expected_ns"),
        [("5ms", 5_000_000), ("250us", 250_000), ("0.1s", 100_000_000), (".5ms", 500_000), ("7ns", 7), ("0s", 0),
         ("1.5us", 1500), (" 1s ", 1_000_000_000), ("1.s", 1_000_000_000)],
    )  # fmt: skip
    def test_a_number_and_its_unit(self, text: str, expected_ns: int) -> None:
        assert DurationNs().convert(text, None, None) == expected_ns

    @pytest.mark.parametrize("text", ["", "5", "ms", "-5ms", "5 ms", "5min", "nans", "1e-3s", "5msx", "five ms", "٥ms"])
    def test_anything_else_names_the_remedy(self, text: str) -> None:
        with pytest.raises(click.BadParameter, match="5ms, 250us"):
            DurationNs().convert(text, None, None)

    @pytest.mark.parametrize("text", ["1.001s", "1001ms", "9" * 400 + "s"])
    def test_more_than_a_second_is_refused(self, text: str) -> None:
        with pytest.raises(click.BadParameter, match="longer than a second"):
            DurationNs().convert(text, None, None)


class TestMicroseconds:
    @pytest.mark.parametrize(("text", "expected_s"), [("0", 0.0), ("1", 1e-6), ("500", 500e-6)])
    def test_they_become_seconds(self, text: str, expected_s: float) -> None:
        assert MICROSECONDS.convert(text, None, None) == expected_s

    @pytest.mark.parametrize("text", ["-1", "0.5", "1e3", "nan"])
    def test_anything_else_is_refused(self, text: str) -> None:
        with pytest.raises(click.BadParameter):
            MICROSECONDS.convert(text, None, None)


class TestKeyFile:
    def test_it_becomes_the_key(self, tmp_path: Path) -> None:
        (tmp_path / "key").write_text("0123456789abcdef" * 4)
        assert KEY_FILE.convert(tmp_path / "key", None, None) == bytes.fromhex("0123456789abcdef" * 4)

    @pytest.mark.parametrize("command", ["run", "emulator", "controller"])
    def test_one_without_a_key_is_said_before_anything_starts(
        self, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "key").write_text("secret")
        arguments = [command, "flapper", "--signing-key", str(tmp_path / "key"), "--out", str(tmp_path / "run")]
        assert run_command(cli, "fwav-hil", arguments) == 2
        said = capsys.readouterr().err
        assert str(tmp_path / "key") in said
        assert said.count("\n") == 1
        assert not (tmp_path / "run").exists()
