"""Requests to a component (COMMAND_LONG) and their acknowledgement (COMMAND_ACK). Source: the MAVLink command protocol.

NaN is allowed in parameters that a command does not use; in a used parameter it makes the request invalid.
"""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

from pymavlink.dialects.v20 import common

from protocol.wire.mapping import COMMAND_ACK, COMMAND_LONG

ARM_DISARM = common.MAV_CMD_COMPONENT_ARM_DISARM
SET_MESSAGE_INTERVAL = common.MAV_CMD_SET_MESSAGE_INTERVAL
REQUEST_MESSAGE = common.MAV_CMD_REQUEST_MESSAGE
REQUEST_CAPABILITIES = common.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
CAN_FORWARD = common.MAV_CMD_CAN_FORWARD


class Result(enum.IntEnum):
    """MAV_RESULT: accepted; not now; never with these parameters; unknown command."""

    ACCEPTED = common.MAV_RESULT_ACCEPTED
    NOT_NOW = common.MAV_RESULT_TEMPORARILY_REJECTED
    DENIED = common.MAV_RESULT_DENIED
    UNSUPPORTED = common.MAV_RESULT_UNSUPPORTED


class Request(NamedTuple):
    """A COMMAND_LONG: the number of the command, its target (0: all), its seven parameters."""

    command: int
    target_system: int
    target_component: int
    parameters: tuple[float, ...]

    def is_for(self, who: tuple[int, int]) -> bool:
        """Whether (system, component) `who` is addressed, alone or with all others."""
        return self.target_system in (0, who[0]) and self.target_component in (0, who[1])


def decode_request(payload: bytes) -> Request:
    """The request in a COMMAND_LONG."""
    values = COMMAND_LONG.unpack_fields(payload)
    parameters = tuple(float(values[f"param{number}"]) for number in range(1, 8))
    return Request(int(values["command"]), int(values["target_system"]), int(values["target_component"]), parameters)


def encode_acknowledgement(command: int, result: Result, asker: tuple[int, int] = (0, 0)) -> bytes:
    """COMMAND_ACK payload, for the (system, component) that sent the request."""
    return COMMAND_ACK.pack_fields(
        command=command, result=int(result), target_system=asker[0], target_component=asker[1]
    )


def wanted_arming(request: Request) -> bool | None:
    """Whether MAV_CMD_COMPONENT_ARM_DISARM requests to arm (1) or to disarm (0); None for any other value."""
    return {1.0: True, 0.0: False}.get(request.parameters[0])


def wanted_bus(request: Request) -> int | None:
    """The bus (counted from 1; 0 stops) that MAV_CMD_CAN_FORWARD requests; None where it is not finite."""
    bus = request.parameters[0]
    return int(bus) if math.isfinite(bus) else None


def wanted_message(request: Request) -> int | None:
    """The message id in command 511 or 512; None where it is not valid."""
    number = request.parameters[0]
    return int(number) if math.isfinite(number) and number == int(number) and number >= 0 else None


def wanted_interval_us(request: Request) -> float | None:
    """The interval of MAV_CMD_SET_MESSAGE_INTERVAL: positive, -1: stop, 0: default; None for any other value."""
    interval_us = request.parameters[1]
    return interval_us if math.isfinite(interval_us) and (interval_us >= 0.0 or interval_us == -1.0) else None
