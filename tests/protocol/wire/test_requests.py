"""COMMAND_LONG as pymavlink writes it, COMMAND_ACK as pymavlink reads it."""

from __future__ import annotations

import math
import random

import pytest
from pymavlink.dialects.v20 import common

from protocol.wire import requests
from protocol.wire.codec import FrameReader, FrameWriter
from protocol.wire.mapping import COMMAND_ACK
from protocol.wire.requests import Request, Result


def decoded(command: int, *parameters: float, target: tuple[int, int] = (1, 1)) -> Request:
    seven = [*parameters, *[math.nan] * 7][:7]
    message = common.MAVLink_command_long_message(*target, command, 0, *seven)
    (frame,) = FrameReader(is_datagram=True).read(message.pack(common.MAVLink(None)))
    return requests.decode_request(frame.payload)


@pytest.mark.parametrize(
    ("param1", "arm"), [(1.0, True), (0.0, False), (math.nan, None), (math.inf, None), (0.5, None)]
)
@pytest.mark.parametrize("unused", [0.0, math.nan, math.inf])
def test_nan_is_legal_in_the_unused_parameters_of_arming(param1: float, arm: bool | None, unused: float) -> None:
    # MAVSDK arms with param2 = NaN.
    request = decoded(400, param1, *[unused] * 6)
    assert request[:3] == (400, 1, 1)
    assert requests.wanted_arming(request) is arm


@pytest.mark.parametrize("result", list(Result))
def test_the_answer_names_the_command_the_outcome_and_the_asker(result: Result) -> None:
    payload = requests.encode_acknowledgement(511, result, (255, 190))
    (message,) = common.MAVLink(None).parse_buffer(FrameWriter(1, 1).seal(COMMAND_ACK, payload))
    assert (message.get_type(), message.command, message.result) == ("COMMAND_ACK", 511, result)
    assert (message.target_system, message.target_component) == (255, 190)


@pytest.mark.parametrize(
    ("target", "is_for"), [((0, 0), True), ((1, 0), True), ((1, 191), True), ((1, 1), False), ((2, 191), False)]
)
def test_whom_a_request_is_for(target: tuple[int, int], is_for: bool) -> None:
    assert decoded(511, target=target).is_for((1, 191)) is is_for


@pytest.mark.parametrize(
    ("param1", "number"), [(115.0, 115), (0.0, 0), (-1.0, None), (1.5, None), (math.nan, None), (math.inf, None)]
)
def test_the_message_that_is_wanted(param1: float, number: int | None) -> None:
    assert requests.wanted_message(decoded(512, param1)) == number


@pytest.mark.parametrize(
    ("param2", "interval"),
    [(5000.0, 5000.0), (0.0, 0.0), (-1.0, -1.0), (-2.0, None), (math.nan, None), (math.inf, None)],
)
def test_the_interval_that_is_wanted(param2: float, interval: float | None) -> None:
    assert requests.wanted_interval_us(decoded(511, 115.0, param2)) == interval


@pytest.mark.parametrize(("param1", "bus"), [(1.0, 1), (0.0, 0), (2.0, 2), (math.nan, None)])
def test_the_bus_that_is_wanted(param1: float, bus: int | None) -> None:
    assert requests.wanted_bus(decoded(32000, param1)) == bus


def test_any_bytes_are_some_request() -> None:
    payload = random.Random(1).randbytes(255)
    for length in range(256):
        request = requests.decode_request(payload[:length])
        requests.wanted_arming(request)
        requests.wanted_bus(request)
        requests.wanted_message(request)
        requests.wanted_interval_us(request)
