"""The processes of a run, seen from their parent, with tiny modules in their place: heard, explained and never left."""

from __future__ import annotations

import json
import os
import signal
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import pytest

from fwav_hil import children
from fwav_hil.children import Child, listen
from fwav_hil.jobs import Job
from plant_emulator.options import MotorOptions
from tests.loop import scenario_of

Start: TypeAlias = Callable[..., Child]
JOB = Job(scenario_of("flapper"), MotorOptions(can="virtual:tiny"))
FOREVER_S = 300
PATIENCE_S = 60.0
REPORT = """
import json, os, signal, sys, time
def report(**event): print(json.dumps(event), flush=True)
job = json.loads(sys.stdin.readline())
"""
WAIT_FOR_EVER = f"report(event='ready')\ntime.sleep({FOREVER_S})"


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Starts `code` as a module, `tiny_one` unless named; every process is gone afterwards."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setattr(children, "_GRACE_S", PATIENCE_S)
    begun: list[Child] = []

    def begin(code: str, module: str = "tiny_one") -> Child:
        (tmp_path / f"{module}.py").write_text(REPORT + textwrap.dedent(code))
        child = Child(module, JOB, module)
        begun.append(child)
        return child

    yield begin
    for child in begun:
        child.process.kill()
        child.end()


def hear(*heard: Child) -> list[tuple[Child, dict[str, Any]]]:
    """All that they report until they have ended."""
    reports = [(child, event) for child, event in listen(list(heard)) if child]
    for child in heard:
        child.process.wait(PATIENCE_S)
    return reports


def hear_first(child: Child) -> dict[str, Any]:
    return next(event for one, event in listen([child]) if one)


def assert_gone(child: Child) -> None:
    with pytest.raises(ProcessLookupError):
        os.kill(child.process.pid, 0)
    for pipe in (child.process.stdin, child.process.stdout, child.process.stderr):
        assert pipe is not None
        assert pipe.closed


class TestListening:
    def test_reports_come_as_they_were_made(self, start: Start) -> None:
        child = start("for k in range(3): report(event='progress', t_ns=k, q=[0.5, None])")
        expected = [{"event": "progress", "t_ns": k, "q": [0.5, None]} for k in range(3)]
        assert hear(child) == [(child, event) for event in expected]
        assert child.failure is None

    def test_two_are_heard_at_once_and_told_apart(self, start: Start) -> None:
        """Each waits for a line, which it gets when the other has spoken."""
        code = "report(event='hello', of=__file__)\nreport(event='told', line=sys.stdin.readline())"
        one, other = start(code, module="tiny_one"), start(code, module="tiny_other")
        events: list[tuple[str, str]] = []
        for child, event in listen([one, other]):
            if child:
                events.append((child.name, event["event"]))
                if event["event"] == "hello":
                    assert Path(event["of"]).stem == child.name
                    (one if child is other else other).tell("go on")
                else:
                    assert event["line"] == "go on\n"
        assert sorted(events) == sorted(
            (name, kind) for name in ("tiny_one", "tiny_other") for kind in ("hello", "told")
        )

    def test_it_gets_its_order_first(self, start: Start) -> None:
        child = start("report(event=sys.argv[1:], told=job)")
        assert hear(child) == [(child, {"event": ["tiny_one"], "told": json.loads(JOB.encode())})]

    def test_silence_gives_the_listener_time_to_look_around(self, start: Start) -> None:
        child = start("sys.stdin.readline()\nreport(event='woken')")
        heard = []
        for who, event in listen([child]):
            heard.append((who, event))
            if len(heard) == 2:
                child.tell("wake up")
        assert heard[:2] == [(None, {})] * 2
        assert (child, {"event": "woken"}) in heard

    def test_a_report_may_come_in_pieces(self, start: Start) -> None:
        child = start("")
        hear(child)
        data = '{"event":"a","text":"µ"}\n{"event":"b"}\n'.encode()
        for first in range(len(data) + 1):
            for second in range(first, len(data) + 1, 7):
                pieces = (data[:first], data[first:second], data[second:])
                events = [event for piece in pieces for event in child.events_in(piece)]
                assert events == [{"event": "a", "text": "µ"}, {"event": "b"}]
        assert child.error == ""

    def test_what_is_no_report_is_kept_for_the_explanation(self, start: Start) -> None:
        child = start("""
            sys.stdout.buffer.write(b'a library says\\n42\\n["list"]\\n{"bad": "\\xff"}\\nnull\\n')
            report(event="ended")
            sys.exit(9)
            """)
        assert hear(child) == [(child, {"event": "ended"})]
        assert child.error.splitlines() == ["a library says", "42", '["list"]', '{"bad": "\ufffd"}', "null"]
        assert child.failure == "null"

    def test_output_that_fills_a_pipe_does_not_hold_it(self, start: Start) -> None:
        child = start("""
            sys.stderr.write("x" * 500_000 + "\\n")
            sys.stderr.flush()
            report(event="x" * 500_000)
            """)
        ((_, event),) = hear(child)
        assert len(event["event"]) == 500_000
        assert len(child.error) == 500_001


class TestFailure:
    def test_none_while_it_runs(self, start: Start) -> None:
        child = start(WAIT_FOR_EVER)
        hear_first(child)
        assert child.failure is None

    def test_none_where_it_ended_well_whatever_it_said(self, start: Start) -> None:
        child = start("sys.stderr.write('a warning\\n')")
        assert hear(child) == []
        assert child.error == "a warning\n"
        assert child.failure is None

    def test_the_last_line_on_standard_error_is_the_sentence(self, start: Start) -> None:
        child = start("""
            sys.stderr.write("a warning\\ntiny_one: the port is taken: choose another\\n\\n")
            sys.exit(3)
            """)
        hear(child)
        assert child.process.returncode == 3
        assert child.failure == "the port is taken: choose another"

    def test_a_traceback_ends_in_the_error(self, start: Start) -> None:
        child = start("raise ValueError('what nobody expected')")
        hear(child)
        assert child.failure == "ValueError: what nobody expected"

    def test_without_a_word_its_exit_code_must_do(self, start: Start) -> None:
        child = start("sys.exit(7)")
        hear(child)
        assert child.failure == "the tiny one process ended with exit code 7"

    @pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGTERM])
    def test_one_that_was_killed_is_named_with_its_signal(self, start: Start, number: signal.Signals) -> None:
        """Whatever it had said before: that was not why."""
        child = start(f"""
            import resource
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            sys.stderr.write("a warning\\n")
            sys.stderr.flush()
            os.kill(os.getpid(), {number.value})
            time.sleep({FOREVER_S})
            """)
        hear(child)
        assert child.failure == f"the tiny one process was ended by signal {number.value}"

    def test_telling_one_that_has_ended_does_no_harm(self, start: Start) -> None:
        child = start("sys.exit(4)")
        hear(child)
        for _ in range(3):
            child.tell("are you there?")
        child.end()
        assert child.failure == "the tiny one process ended with exit code 4"


class TestEnd:
    def test_one_that_ends_by_itself_is_let(self, start: Start) -> None:
        child = start("time.sleep(0.2)\nsys.exit(5)")
        child.end()
        assert child.process.returncode == 5
        assert_gone(child)

    def test_one_that_goes_on_is_asked(self, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
        child = start(f"signal.signal(signal.SIGTERM, lambda *_: sys.exit(6))\n{WAIT_FOR_EVER}")
        hear_first(child)
        self.be_patient_after(child, "terminate", monkeypatch)
        child.end()
        assert child.process.returncode == 6
        assert_gone(child)

    def test_one_that_does_not_listen_is_made_to(self, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
        child = start(f"signal.signal(signal.SIGTERM, signal.SIG_IGN)\n{WAIT_FOR_EVER}")
        hear_first(child)
        self.be_patient_after(child, "kill", monkeypatch)
        child.end()
        assert child.process.returncode == -signal.SIGKILL
        assert_gone(child)

    def test_even_one_that_is_stopped(self, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
        child = start(WAIT_FOR_EVER)
        hear_first(child)
        os.kill(child.process.pid, signal.SIGSTOP)
        self.be_patient_after(child, "kill", monkeypatch)
        child.end()
        assert_gone(child)

    def test_it_may_be_said_twice(self, start: Start) -> None:
        child = start("")
        child.end()
        child.end()
        assert_gone(child)

    @staticmethod
    def be_patient_after(child: Child, step: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """Short waits up to the step that must do it, and a long one then: a slow minute changes nothing."""
        act = getattr(child.process, step)

        def act_and_wait() -> None:
            monkeypatch.setattr(children, "_GRACE_S", PATIENCE_S)
            act()

        monkeypatch.setattr(children, "_GRACE_S", 0.1)
        monkeypatch.setattr(child.process, step, act_and_wait)


def test_a_child_in_the_way_of_its_own_end_is_no_reason_to_wait_for_ever(start: Start) -> None:
    """The pipes of a child that was killed are empty and at their end: listening ends too."""
    child = start(WAIT_FOR_EVER)
    begun = time.monotonic()
    for who, _ in listen([child]):
        if who:
            child.process.kill()
    assert time.monotonic() - begun < FOREVER_S / 2
    child.process.wait(PATIENCE_S)
    assert child.failure == "the tiny one process was ended by signal 9"
