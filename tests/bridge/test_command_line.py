"""What all commands share: how an error ends one, how its status reaches a user, which scenario it gets."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from rich.console import Console

from bridge import command_line
from bridge.command_line import DurationNs, begin_process, chosen_scenario, options, run_command
from bridge.summary import show_json
from protocol import errors
from protocol.errors import FwavHilError, ScenarioError
from protocol.scenario import find_scenario, load_scenario

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


class TestOptions:
    def test_they_are_listed_in_the_order_given(self, capsys: pytest.CaptureFixture[str]) -> None:
        @click.command()
        @options(click.option("--first"), click.option("--second"))
        def command(**_: object) -> None: ...

        run_command(command, "prog", ["--help"])
        shown = capsys.readouterr().out
        assert 0 < shown.index("--first") < shown.index("--second")

    def test_those_between_processes_are_not_shown(self, capsys: pytest.CaptureFixture[str]) -> None:
        @click.command()
        @command_line.process_options
        def command(**given: object) -> None:
            click.echo(json.dumps(given))

        assert run_command(command, "prog", ["--help"]) == 0
        shown = capsys.readouterr().out
        assert not [name for name in ("--status", "--core", "--with-parent") if name in shown]
        assert run_command(command, "prog", ["--status", "jsonl", "--core", "1", "--with-parent"]) == 0
        assert json.loads(capsys.readouterr().out) == {"status": "jsonl", "core": 1, "with_parent": True}


class TestChosenScenario:
    def test_by_name_and_by_path_it_is_the_same(self) -> None:
        path = find_scenario("flapper")
        assert chosen_scenario("flapper") == chosen_scenario(str(path)) == load_scenario(path)

    def test_what_the_command_line_says_replaces_and_none_does_not(self) -> None:
        plain = chosen_scenario("flapper")
        chosen = chosen_scenario("flapper", rate_hz=500.0, seed=7, law=None, duration_s=None)
        assert (chosen.rate_hz, chosen.seed) == (500.0, 7)
        assert (chosen.law, chosen.duration_s, chosen.body) == (plain.law, plain.duration_s, plain.body)

    def test_an_unknown_name_is_refused_with_those_there_are(self) -> None:
        with pytest.raises(ScenarioError, match="there is no scenario flaper: give a file, or one of flapper, paper"):
            chosen_scenario("flaper")

    @pytest.mark.parametrize(
        ("overrides", "place"),
        [
            ({"rate_hz": -1.0}, "the command line, rate_hz: "),
            ({"rate_hz": float("nan")}, "the command line, rate_hz: "),
            ({"rate_hz": 333.0}, "the command line: rate_hz 333 "),
            ({"duration_s": 0.0}, "the command line, duration_s: "),
            ({"duration_s": 1e-6}, "the command line: duration_s 1e-06 "),
            ({"seed": -1}, "the command line, seed: "),
        ],
    )
    def test_what_makes_no_sense_is_blamed_on_the_command_line(self, overrides: dict[str, Any], place: str) -> None:
        with pytest.raises(ScenarioError) as caught:
            chosen_scenario("flapper", **overrides)
        assert str(caught.value).startswith(place)

    def test_a_mistake_in_a_file_is_blamed_on_the_file(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.toml"
        path.write_text(find_scenario("flapper").read_text(encoding="utf-8").replace("mass =", "mas ="))
        with pytest.raises(ScenarioError) as caught:
            chosen_scenario(str(path))
        assert str(caught.value) == f"{path}: unknown key 'body.mas': did you mean 'mass'?"


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[object]]:
    """What `begin_process` would do to this process beyond its signals, which are given back afterwards."""
    done: list[object] = []
    monkeypatch.setattr(command_line, "end_with_parent", lambda: done.append("with parent"))
    monkeypatch.setattr(command_line, "sit_on_core", done.append)
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield done
    for number, handler in before.items():
        signal.signal(number, handler)


class TestBeginProcess:
    def test_alone_it_only_listens_to_signals(self, calls: list[object]) -> None:
        _, stop = begin_process("text", None, with_parent=False)
        assert calls == []
        assert not stop.requested
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested

    def test_core_0_is_a_core(self, calls: list[object]) -> None:
        begin_process("text", 0, with_parent=True)
        assert calls == ["with parent", 0]

    def test_for_a_parent_it_reports_in_json(self, calls: list[object], capsys: pytest.CaptureFixture[str]) -> None:
        report, _ = begin_process("jsonl", None, with_parent=False)
        report({"event": "waiting", "link": "mem://x"})
        captured = capsys.readouterr()
        assert json.loads(captured.out) == {"event": "waiting", "link": "mem://x"}
        assert captured.err == ""

    def test_for_a_person_it_reports_in_words_beside_the_results(
        self, calls: list[object], capsys: pytest.CaptureFixture[str]
    ) -> None:
        report, _ = begin_process("text", None, with_parent=False)
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
        with pytest.raises(click.BadParameter, match="more than a second"):
            DurationNs().convert(text, None, None)
