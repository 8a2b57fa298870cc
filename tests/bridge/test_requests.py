"""Requests of one component: which are obeyed, what is then due when, and what is answered."""

from __future__ import annotations

import functools
import math

import pytest

from bridge.requests import Handler, Requests
from protocol.due import NEVER
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader, FrameWriter, layout
from protocol.wire.requests import Request, Result
from protocol.wire.schedule import Saying, Schedule

ME = (1, 191)
STATE, ODOMETRY = 115, 331
MS = 1_000_000


def command(number: int, *parameters: float, target: tuple[int, int] = ME) -> Frame:
    fields = {f"param{i + 1}": value for i, value in enumerate([*parameters, *[math.nan] * 7][:7])}
    payload = mapping.COMMAND_LONG.pack_fields(
        command=number, target_system=target[0], target_component=target[1], **fields
    )
    (read,) = FrameReader(is_datagram=True).read(FrameWriter(255, 190).seal(mapping.COMMAND_LONG, payload))
    return read


class One:
    """A component that offers two messages; what it says is told as text."""

    def __init__(self, odometry_hz: float | None = 10.0, commands: dict[int, Handler] | None = None) -> None:
        names = ("HIL_STATE_QUATERNION", "ODOMETRY")
        encoders = {name: functools.partial(made, layout(name).message_id) for name in names}
        self.schedule = Schedule(encoders, {"ODOMETRY": odometry_hz})
        self.requests = Requests(ME, self.schedule, names, commands)


def new() -> One:
    return One()


def made(number: int, t_ns: int) -> list[Saying]:
    return [(layout("DEBUG"), f"{number}@{t_ns // MS}".encode())]


def said(one: One, t_ns: int) -> list[str]:
    return [payload.decode() for message, payload in one.schedule.due(t_ns) if message.name == "DEBUG"]


def result(one: One, frame: Frame) -> Result:
    assert one.requests.handle(frame)
    ((message, payload),) = one.schedule.answers()
    values = message.unpack_fields(payload)
    assert message.name == "COMMAND_ACK"
    assert (values["target_system"], values["target_component"]) == (255, 190)
    return Result(values["result"])


def test_a_default_rate_holds_until_it_is_changed() -> None:
    one = new()
    assert [line for t in range(0, 300, 50) for line in said(one, t * MS)] == ["331@0", "331@100", "331@200"]


@pytest.mark.parametrize(
    ("interval_us", "times"), [(5000.0, [8, 12, 16, 20]), (10_000.0, [8, 12, 20]), (1.0, [8, 12, 16, 20])]
)
def test_an_interval_is_kept_as_far_as_the_ticks_go(interval_us: float, times: list[int]) -> None:
    one = One(odometry_hz=None)
    assert said(one, 0) == []
    assert one.schedule.next_ns == NEVER
    assert result(one, command(511, STATE, interval_us)) is Result.ACCEPTED
    assert one.schedule.next_ns == 0  # at the next occasion
    assert [line for t in (8, 12, 16, 20) for line in said(one, t * MS)] == [f"115@{t}" for t in times]
    assert one.schedule.next_ns > 20 * MS


def test_minus_one_ends_a_stream_and_zero_brings_the_default_back() -> None:
    one = new()
    assert result(one, command(511, ODOMETRY, -1.0)) is Result.ACCEPTED
    assert said(one, 0) == []
    assert result(one, command(511, ODOMETRY, 0.0)) is Result.ACCEPTED
    assert said(one, 0) == ["331@0"]
    assert result(one, command(511, STATE, 0.0)) is Result.ACCEPTED  # by default: not at all
    assert said(one, 200 * MS) == ["331@200"]


def test_once_is_once() -> None:
    one = new()
    assert result(one, command(512, STATE)) is Result.ACCEPTED
    one.requests.handle(command(512, STATE))
    assert said(one, 4 * MS) == ["115@4", "331@4"]
    assert said(one, 8 * MS) == []


@pytest.mark.parametrize(
    "parameters", [(math.nan, 1000.0), (30.0, 1000.0), (STATE, math.nan), (STATE, -7.0), (-1.0, 0.0)]
)
def test_what_is_not_offered_or_no_number_is_denied_and_changes_nothing(parameters: tuple[float, float]) -> None:
    one = new()
    assert result(one, command(511, *parameters)) is Result.DENIED
    assert said(one, 0) == ["331@0"]
    assert one.requests.counters == {"requests": 1, "requests_refused": 1}


def test_other_commands_go_to_their_handlers_or_are_unknown() -> None:
    seen: list[Request] = []

    def handler(request: Request) -> Result:
        seen.append(request)
        return Result.NOT_NOW

    one = One(commands={400: handler})
    assert result(one, command(400, 1.0)) is Result.NOT_NOW
    assert seen[0].parameters[0] == 1.0
    assert result(one, command(176, 1.0)) is Result.UNSUPPORTED


@pytest.mark.parametrize("target", [(2, 191), (1, 1)])
def test_requests_to_others_are_left_alone(target: tuple[int, int]) -> None:
    one = new()
    assert not one.requests.handle(command(511, STATE, 5000.0, target=target))
    assert one.schedule.answers() == []
    assert one.requests.counters == {"requests": 0, "requests_refused": 0}


@pytest.mark.parametrize("target", [(0, 0), (1, 0), (0, 191)])
def test_zero_means_everybody(target: tuple[int, int]) -> None:
    assert new().requests.handle(command(511, STATE, 5000.0, target=target))


def test_answers_come_first() -> None:
    one = new()
    one.requests.handle(command(512, STATE))
    assert [message.name for message, _ in one.schedule.due(0)] == ["COMMAND_ACK", "DEBUG", "DEBUG"]
