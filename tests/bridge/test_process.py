"""What every process does alike: stop when asked, end with its parent, tell its status, sit on a core."""

from __future__ import annotations

import contextlib
import ctypes
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import bridge
from bridge.command_line import run_command
from bridge.process import StopFlag, end_with_parent, sit_on_core
from bridge.reporting import report_json
from fwav_hil.cli import cli
from protocol.errors import Interrupted

ROOT = Path(str(bridge.__file__)).resolve().parent.parent
PATIENCE_S = 60.0
STOP_SIGNALS = [signal.SIGINT, signal.SIGTERM]
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="NOT TESTED: prctl and affinity are Linux's")


def python(code: str) -> subprocess.Popen[str]:
    """A Python process of its own that runs `code`."""
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.fixture
def stop() -> Iterator[StopFlag]:
    """A flag that has taken its signals over; the handlers from before come back afterwards."""
    before = {number: signal.getsignal(number) for number in (*STOP_SIGNALS, signal.SIGURG)}
    flag = StopFlag()
    flag.install()
    yield flag
    for number, handler in before.items():
        signal.signal(number, handler)


class TestStopFlag:
    def test_nobody_asked(self, stop: StopFlag) -> None:
        assert not stop.requested
        stop.check()

    @pytest.mark.parametrize("number", STOP_SIGNALS)
    def test_a_signal_sets_it_and_the_next_look_ends_the_loop(self, stop: StopFlag, number: signal.Signals) -> None:
        signal.raise_signal(number)
        assert stop.requested
        for _ in range(2):
            with pytest.raises(Interrupted, match="interrupted"):
                stop.check()

    @pytest.mark.parametrize("number", STOP_SIGNALS)
    def test_only_the_signal_that_came_acts_by_default_next_time(self, stop: StopFlag, number: signal.Signals) -> None:
        signal.raise_signal(number)
        (other,) = (one for one in STOP_SIGNALS if one is not number)
        assert signal.getsignal(number) is signal.SIG_DFL
        signal.raise_signal(other)  # would end this process, had it no handler
        assert stop.requested

    @pytest.mark.parametrize("number", STOP_SIGNALS)
    def test_a_second_signal_ends_a_process_that_does_not_look(self, number: signal.Signals) -> None:
        code = f"""
import signal
from bridge.process import StopFlag
flag = StopFlag()
flag.install()
signal.raise_signal({number.value})
print(flag.requested, flush=True)
signal.raise_signal({number.value})
print("alive")
"""
        with python(code) as process:
            assert process.communicate(timeout=PATIENCE_S)[0] == "True\n"
        assert process.returncode == -number

    def test_a_peer_that_was_started_again_is_counted_and_stops_nothing(self, stop: StopFlag) -> None:
        for count in (1, 2):
            signal.raise_signal(signal.SIGURG)
            assert stop.peer_restarts == count
            stop.check()

    def test_that_signal_does_no_harm_before_anyone_listens(self) -> None:
        before = signal.signal(signal.SIGURG, signal.SIG_DFL)
        try:
            signal.raise_signal(signal.SIGURG)
        finally:
            signal.signal(signal.SIGURG, before)


class TestEndWithParent:
    @on_linux
    def test_a_child_is_told_when_its_parent_was_killed(self) -> None:
        """Both hold the pipe, so its end is the end of both. Nobody asks the child but the system."""
        child = """
import os, signal
from bridge.process import StopFlag, end_with_parent
stop = StopFlag()
stop.install()
end_with_parent()
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
print(os.getpid(), flush=True)
signal.sigtimedwait({signal.SIGTERM}, 300) or os._exit(1)
signal.raise_signal(signal.SIGTERM)
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
print("asked to stop" if stop.requested else "not asked", flush=True)
"""
        parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
        with python(parent) as process:
            assert process.stdout is not None
            child_pid = int(process.stdout.readline())
            try:
                process.kill()
                said, _ = process.communicate(timeout=PATIENCE_S)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child_pid, signal.SIGKILL)
                pytest.fail("the child outlived its parent")
        assert process.returncode == -signal.SIGKILL
        assert said == "asked to stop\n"

    def test_elsewhere_it_does_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object) -> None:
            raise AssertionError("called")

        monkeypatch.setattr(sys, "platform", "darwin")
        monkeypatch.setattr(ctypes, "CDLL", refuse)
        end_with_parent()


@pytest.fixture
def cores() -> Iterator[set[int]]:
    """The cores of this process, given back afterwards."""
    before = os.sched_getaffinity(0)
    yield before
    os.sched_setaffinity(0, before)


class TestSitOnCore:
    @on_linux
    def test_it_sits_there(self, cores: set[int]) -> None:
        sit_on_core(max(cores))
        assert os.sched_getaffinity(0) == {max(cores)}

    @on_linux
    @pytest.mark.parametrize("core", [-1, 1_000_000, 10**12, 10**30])
    def test_nonsense_leaves_the_process_where_it_is(self, cores: set[int], core: int) -> None:
        sit_on_core(core)
        assert os.sched_getaffinity(0) == cores

    def test_a_system_without_the_call_is_left_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delattr(os, "sched_setaffinity", raising=False)
        sit_on_core(0)


class TestReportJson:
    def test_one_object_a_line(self) -> None:
        stream = io.StringIO()
        report = report_json(stream)
        events: list[dict[str, Any]] = [
            {"event": "waiting", "link": "udpin://127.0.0.1:1"},
            {"event": "odd", "text": 'two\nlines, "quotes", µ', "numbers": [1, 2.5, None], "bad": float("nan")},
        ]
        for event in events:
            report(event)
        lines = stream.getvalue().splitlines()
        assert [json.loads(line) for line in lines] == [events[0], {**events[1], "bad": None}]

    def test_a_parent_gets_each_line_at_once(self) -> None:
        reading, writing = os.pipe()
        with os.fdopen(reading) as parent, os.fdopen(writing, "w") as child:
            report_json(child)({"event": "started"})
            os.set_blocking(reading, False)  # a line still in a buffer is an error then, not a wait
            assert json.loads(parent.readline()) == {"event": "started"}


@pytest.mark.parametrize(
    ("command", "file"),
    [
        (["controller", "--link", "udpout://127.0.0.1:9", "--wait", "0.1"], "controller.json"),
        (
            ["controller", "--clock", "realtime", "--legs", "--link", "udpout://127.0.0.1:9", "--wait", "0.1"],
            "legs_controller.npz",
        ),
        (["motor", "--can", "virtual:taken"], "motor.json"),
    ],
)
def test_what_another_process_left_in_the_folder_stays(
    command: list[str], file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The figures of a run alone on this machine: its other half may be on another."""
    (tmp_path / file).write_text("before")
    assert run_command(cli, "fwav-hil", [*command, "--out", str(tmp_path)]) == 6
    assert f"{file} exists already and is not overwritten" in capsys.readouterr().err
    assert (tmp_path / file).read_text() == "before"


def test_a_folder_that_cannot_be_made_is_said_before_anything_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    for command in ("controller", "motor"):
        assert run_command(cli, "fwav-hil", [command, "--out", str(tmp_path / "file" / "run")]) == 6
        assert "cannot create the folder" in capsys.readouterr().err
