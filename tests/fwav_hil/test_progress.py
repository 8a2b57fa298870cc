"""How far a run is: a line now and then where there is no terminal, a bar where there is one."""

from __future__ import annotations

import io
import itertools
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.timing.clock import VirtualClock
from fwav_hil import progress
from fwav_hil.progress import Progress

SECOND_NS = 1_000_000_000
PATIENCE_S = 60.0


class Stream(io.StringIO):
    """Standard error that is a terminal, or is none."""

    def __init__(self, *, is_terminal: bool) -> None:
        super().__init__()
        self._is_terminal = is_terminal

    def isatty(self) -> bool:
        return self._is_terminal


def lines_of(steps_ns: list[int], speed: float = 1.0) -> list[tuple[int, str]]:
    """Updates at these distances of wall time: at which wall time a line came, and the line."""
    clock = VirtualClock(SECOND_NS)
    lines = []
    with pytest.MonkeyPatch.context() as patch:
        stream = Stream(is_terminal=False)
        patch.setattr("sys.stderr", stream)
        patch.setattr(progress, "MonotonicClock", lambda: clock)
        with Progress(10.0) as shown:
            for step_ns in steps_ns:
                clock.advance_ns(step_ns)
                shown.update(speed * clock.now_ns() / SECOND_NS, (0.0015, 0.1))
                if text := stream.getvalue():
                    lines.append((clock.now_ns(), text))
                    stream.seek(0)
                    stream.truncate()
        assert stream.getvalue() == ""
    return lines


def test_ten_updates_a_second_are_a_line_every_two_seconds() -> None:
    times_s = [t_ns / SECOND_NS for t_ns, _ in lines_of([SECOND_NS // 10] * 100)]
    assert len(times_s) in (4, 5)
    assert min(after - before for before, after in itertools.pairwise(times_s)) >= 2.0


@given(st.lists(st.integers(0, 5 * SECOND_NS), max_size=40))
def test_however_updates_come_lines_are_two_seconds_apart(steps_ns: list[int]) -> None:
    begun_ns = SECOND_NS + sum(steps_ns[:1])
    lines = lines_of(steps_ns)
    times_ns = [begun_ns, *(t_ns for t_ns, _ in lines)]
    assert all(after - before >= 2 * SECOND_NS for before, after in itertools.pairwise(times_ns))
    assert all(text.count("\n") == 1 and text.endswith("\n") for _, text in lines)


def test_a_line_says_where_the_run_is_how_fast_it_goes_and_how_well() -> None:
    """Four seconds of wall time after the first update, at t = 3 s: now t = 15 s, three times real time."""
    ((_, line),) = lines_of([0, 4 * SECOND_NS], speed=3.0)
    assert line.split() == [
        "t",
        "=",
        "15.00",
        "of",
        "10",
        "s,",
        "3.0",
        "x",
        "real",
        "time,",
        "error",
        "1.5",
        "mm,",
        "5.73",
        "deg",
    ]


def test_updates_at_one_moment_do_no_harm() -> None:
    assert lines_of([0, 0, 0]) == []


def test_on_a_terminal_it_is_a_bar_that_ends_with_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream = VirtualClock(SECOND_NS), Stream(is_terminal=True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr(progress, "MonotonicClock", lambda: clock)
    threads = set(threading.enumerate())
    with Progress(10.0) as shown:
        for _ in range(2):
            clock.advance_ns(SECOND_NS)
            shown.update(clock.now_ns() / SECOND_NS, (0.0015, 0.1))
    for thread in set(threading.enumerate()) - threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
    text = stream.getvalue()
    assert "flying" in text
    assert "t =  3.00 of 10 s" in text
    assert "error 1.5 mm" in text
