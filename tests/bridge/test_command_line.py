"""What all commands share: how an error ends one, and how its status reaches a user."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from rich.console import Console

from bridge.command_line import begin_process, run_command
from bridge.summary import show_json
from protocol import errors
from protocol.errors import FwavHilError

ERRORS = sorted(
    (kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, FwavHilError)),
    key=lambda kind: kind.__name__,
)
STOP_SIGNALS = [signal.SIGINT, signal.SIGTERM]


def command_that(act: Callable[[], Any]) -> click.Command:
    return click.Command("act", callback=act)


def command_raising(error: BaseException) -> click.Command:
    def act() -> None:
        raise error

    return command_that(act)


class TestEndOfACommand:
    @pytest.mark.parametrize("kind", ERRORS)
    def test_an_error_is_one_line_and_its_exit_code(
        self, kind: type[FwavHilError], capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert run_command(command_raising(kind("what is wrong: the remedy")), "prog", []) == kind.exit_code
        assert capsys.readouterr() == ("", "prog: what is wrong: the remedy\n")

    def test_the_exit_code_may_be_the_errors_own(self, capsys: pytest.CaptureFixture[str]) -> None:
        error = FwavHilError("a child failed")
        error.exit_code = 17
        assert run_command(command_raising(error), "prog", []) == 17
        assert capsys.readouterr().err == "prog: a child failed\n"

    @pytest.mark.parametrize("error", [KeyboardInterrupt(), click.Abort()])
    def test_an_interrupt_is_130(self, error: BaseException, capsys: pytest.CaptureFixture[str]) -> None:
        assert run_command(command_raising(error), "prog", []) == 130
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.strip() == "prog: interrupted"

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [(["--wrong"], "No such option"), (["surplus"], "unexpected extra argument"), (["--number", "x"], "--number")],
    )
    def test_a_wrong_argument_is_2_and_says_which(
        self, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        command = click.Command("act", params=[click.Option(["--number"], type=int)], callback=lambda number: None)
        assert run_command(command, "prog", arguments) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert words in captured.err.splitlines()[-1]
        assert "Traceback" not in captured.err

    @pytest.mark.parametrize(("result", "code"), [(None, 0), (0, 0), (3, 3), ("text", 0)])
    def test_a_command_that_ends_well(self, result: object, code: int, capsys: pytest.CaptureFixture[str]) -> None:
        assert run_command(command_that(lambda: result), "prog", []) == code
        assert capsys.readouterr() == ("", "")

    def test_help_is_0(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert run_command(click.Command("act", help="What it does."), "prog", ["--help"]) == 0
        captured = capsys.readouterr()
        assert "What it does." in captured.out
        assert captured.err == ""

    def test_a_mistake_of_ours_is_not_hidden(self) -> None:
        with pytest.raises(ZeroDivisionError):
            run_command(command_raising(ZeroDivisionError()), "prog", [])

    @pytest.mark.parametrize("code", [0, 7])
    def test_who_ends_the_process_ends_it(self, code: int) -> None:
        with pytest.raises(SystemExit) as caught:
            run_command(command_raising(SystemExit(code)), "prog", [])
        assert caught.value.code == code


WORDS = "x" * 200_000
"""More than a pipe or a buffer holds."""


@pytest.mark.parametrize(
    "say",
    [
        lambda: click.echo(WORDS),
        lambda: click.echo("short"),
        lambda: Console(highlight=False).print("short"),
        lambda: print("short", flush=True),  # noqa: T201
        lambda: show_json(Path("-"), {"words": WORDS}),
        lambda: show_json(Path("-"), {"words": "short"}),
    ],
    ids=["click", "click short", "rich", "print", "json", "json short"],
)
def test_a_reader_that_left_is_no_error(
    say: Callable[[], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As with `fwav-hil ... | head`: no message, 0, and what is still buffered can be flushed at the end."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stdout, monkeypatch.context() as patch:
        patch.setattr("sys.stdout", stdout)
        assert run_command(command_that(say), "prog", []) == 0
        stdout.write("to nobody")
        stdout.flush()
    assert capsys.readouterr().err == ""


@pytest.fixture(autouse=True)
def signals_come_back() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class TestBeginProcess:
    def test_it_listens_to_signals(self) -> None:
        _, stop = begin_process()
        assert not stop.requested
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested

    def test_for_a_person_it_reports_in_words_beside_the_results(self, capsys: pytest.CaptureFixture[str]) -> None:
        report, _ = begin_process()
        report({"event": "waiting", "link": "udpin://127.0.0.1:14560"})
        report({"event": "started", "peer": "127.0.0.1:5"})
        report({"event": "progress", "t_ns": 10**9, "q": [0.0] * 6})  # on a terminal only
        report({"event": "ended", "counters": {"sent": 3, "late": 0, "bad_crc": 2}})
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.splitlines() == [
            "waiting on udpin://127.0.0.1:14560",
            "started with 127.0.0.1:5",
            "ended; sent 3, bad_crc 2",
        ]
