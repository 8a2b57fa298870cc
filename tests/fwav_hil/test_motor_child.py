"""Looking after the process of the drives: started again where a signal ended it, else named as why the run ended."""

from __future__ import annotations

import signal
from typing import Any, cast
from unittest.mock import Mock

import pytest

from fwav_hil import motor_child
from fwav_hil.children import Child
from fwav_hil.motor_child import MOST_RESTARTS, MotorKeeper


class Process:
    """Stands in for a child and its process."""

    def __init__(self, *_: object, **__: object) -> None:
        self.code: int | None = None
        self.sentence: str | None = None
        self.signals: list[int] = []
        self.asked = 0

    @property
    def process(self) -> Process:
        return self

    @property
    def failure(self) -> str | None:
        return self.sentence or f"the motor process was ended by signal {-(self.code or 0)}"

    def poll(self) -> int | None:
        return self.code

    def send_signal(self, number: int) -> None:
        self.signals.append(number)

    def ask_to_end(self) -> None:
        self.asked += 1

    def end(self) -> None:
        pass


@pytest.fixture
def emulator() -> Process:
    return Process()


@pytest.fixture
def keeper(monkeypatch: pytest.MonkeyPatch) -> MotorKeeper:
    monkeypatch.setattr(motor_child, "Child", Process)
    return MotorKeeper(Mock())


def drives_of(keeper: MotorKeeper) -> Process:
    return cast("Process", keeper.child)


def look(keeper: MotorKeeper, emulator: Process, children: list[Any] | None = None) -> None:
    keeper.look(cast("list[Child]", [] if children is None else children), cast("Any", emulator))


def test_one_that_a_signal_ended_is_started_again_and_the_emulator_is_told(
    keeper: MotorKeeper, emulator: Process, capsys: pytest.CaptureFixture[str]
) -> None:
    look(keeper, emulator)
    assert emulator.signals == []
    first = drives_of(keeper)
    first.code = -signal.SIGKILL
    children: list[Any] = [first]
    look(keeper, emulator, children)
    assert children == [first, drives_of(keeper)]
    assert emulator.signals == [signal.SIGURG]
    assert keeper.failure is None
    assert "was ended by signal 9: restarted (1 of 3)" in capsys.readouterr().err


def test_a_few_times_only(keeper: MotorKeeper, emulator: Process) -> None:
    for _ in range(MOST_RESTARTS):
        drives_of(keeper).code = -signal.SIGSEGV
        assert keeper.failure is None
        look(keeper, emulator)
    last = drives_of(keeper)
    last.code = -signal.SIGSEGV
    look(keeper, emulator)
    assert drives_of(keeper) is last
    assert len(emulator.signals) == MOST_RESTARTS
    assert keeper.failure == (
        "the process of the drives was ended by signal 11 after 3 restarts, which ended the run: "
        "find out what ends it, then run again"
    )


def test_one_that_failed_says_why_itself(keeper: MotorKeeper, emulator: Process) -> None:
    drives_of(keeper).code = 3
    drives_of(keeper).sentence = "cannot open the CAN bus"
    look(keeper, emulator)
    keeper.ask_to_end()
    assert keeper.failure == "cannot open the CAN bus"
    assert emulator.signals == []
    assert drives_of(keeper).asked == 0


def test_one_that_somebody_else_ended_is_named(keeper: MotorKeeper, emulator: Process) -> None:
    drives_of(keeper).code = 0
    look(keeper, emulator)
    assert (
        keeper.failure == "the process of the drives ended, which ended the run: find out what ends it, then run again"
    )


def test_one_whose_run_is_over_is_asked_to_end_once_and_is_no_failure(keeper: MotorKeeper, emulator: Process) -> None:
    emulator.code = 0
    for _ in range(3):
        look(keeper, emulator)
    assert drives_of(keeper).asked == 1
    for code in (0, -signal.SIGTERM, -signal.SIGKILL):
        drives_of(keeper).code = code
        look(keeper, emulator)
        assert keeper.failure is None
    assert keeper.restarts == 0
