"""What the two ends say to each other: exactly these fields, and nothing can change them on the way."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from protocol.messages import AXES, AXIS_UNITS, ActuatorCommand, PositionSample

MESSAGES = [
    (PositionSample(1, np.zeros(6)), ("t_ns", "q")),
    (ActuatorCommand(1, np.zeros(6), True), ("t_ns", "tau", "armed")),
]


@pytest.mark.parametrize(("message", "fields"), MESSAGES)
def test_a_message_has_these_fields_and_no_velocity(message: msgspec.Struct, fields: tuple[str, ...]) -> None:
    assert message.__struct_fields__ == fields


@pytest.mark.parametrize(("message", "fields"), MESSAGES)
def test_a_message_cannot_be_changed(message: Any, fields: tuple[str, ...]) -> None:
    for field in fields:
        with pytest.raises(AttributeError):
            setattr(message, field, 2)


@pytest.mark.parametrize(("message", "fields"), MESSAGES)
def test_nothing_can_be_smuggled_into_a_message(message: Any, fields: tuple[str, ...]) -> None:
    assert "velocity" not in fields
    with pytest.raises(AttributeError):
        message.velocity = np.zeros(6)
    with pytest.raises(TypeError):
        type(message)(*[1] * len(fields), velocity=np.zeros(6))


def test_axes_are_three_positions_in_metres_then_three_angles_in_radians() -> None:
    assert AXES == ("x", "y", "z", "alpha", "beta", "gamma")
    assert AXIS_UNITS == ("m",) * 3 + ("rad",) * 3
