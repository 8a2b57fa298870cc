"""Arming: who may ask for it, and when it is obeyed."""

from __future__ import annotations

import math

import pytest

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from controller.session import HilSession
from protocol.errors import ScenarioMismatchError
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader, FrameWriter, Layout
from protocol.wire.requests import ARM_DISARM

DIGEST = b"12345678"


def frame(system: int, component: int, message: Layout, payload: bytes) -> Frame:
    (read,) = FrameReader(is_datagram=True).read(FrameWriter(system, component).seal(message, payload))
    return read


def request(param1: float, *, target: tuple[int, int] = (1, 1), command: int = ARM_DISARM) -> Frame:
    payload = mapping.COMMAND_LONG.pack_fields(
        command=command, param1=param1, param2=math.nan, target_system=target[0], target_component=target[1]
    )
    return frame(255, 190, mapping.COMMAND_LONG, payload)


def session(*, arm: bool = False, agreed: bool = True) -> HilSession:
    near, _ = memory_pair()
    made = HilSession(Endpoint(near, 1, 1), DIGEST, (1, 191), arm=arm)
    if agreed:
        made.hear(frame(1, 191, mapping.VERSION, mapping.encode_version(DIGEST)))
    return made


def test_it_starts_disarmed_and_arms_by_itself_only_when_told_to() -> None:
    assert not session(arm=True, agreed=False).armed
    assert session(arm=True).armed
    assert not session(arm=False).armed


def test_a_station_arms_and_disarms_it() -> None:
    made = session()
    made.hear(request(1.0))
    assert made.armed
    made.hear(request(0.0))
    assert not made.armed


@pytest.mark.parametrize("param1", [math.nan, 0.5, -1.0])
def test_what_asks_for_neither_changes_nothing(param1: float) -> None:
    made = session(arm=True)
    made.hear(request(param1))
    assert made.armed


def test_requests_to_others_and_other_commands_change_nothing() -> None:
    made = session()
    for one in (request(1.0, target=(2, 1)), request(1.0, target=(1, 2)), request(1.0, command=511)):
        made.hear(one)
    assert not made.armed


def test_it_does_not_arm_before_the_emulator_has_shown_the_same_scenario() -> None:
    made = session(agreed=False)
    made.hear(request(1.0))
    assert not made.armed


def test_another_scenario_is_refused() -> None:
    with pytest.raises(ScenarioMismatchError):
        session().hear(frame(1, 191, mapping.VERSION, mapping.encode_version(b"87654321")))
