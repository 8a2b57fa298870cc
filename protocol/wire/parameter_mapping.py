"""Payloads of the MAVLink parameter protocol. Source: the MAVLink guide on it, with bytewise encoding of integers.

PARAM_VALUE and PARAM_SET have a value field of four bytes: a float32, or the bytes of an integer.
"""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple

from pymavlink.dialects.v20 import common

from protocol.wire.codec import layout

READ = layout("PARAM_REQUEST_READ")
LIST = layout("PARAM_REQUEST_LIST")
SET = layout("PARAM_SET")
VALUE = layout("PARAM_VALUE")
ERROR = layout("PARAM_ERROR")

LONGEST_NAME = 16
_VALUE_BYTES = 4
_BY_NAME = -1


class Kind(enum.IntEnum):
    """MAV_PARAM_TYPE of the parameter types used here."""

    INT32 = common.MAV_PARAM_TYPE_INT32
    REAL32 = common.MAV_PARAM_TYPE_REAL32


class Refusal(enum.IntEnum):
    """MAV_PARAM_ERROR: why a parameter was not sent or not set."""

    UNKNOWN = common.MAV_PARAM_ERROR_DOES_NOT_EXIST
    OUT_OF_RANGE = common.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
    READ_ONLY = common.MAV_PARAM_ERROR_READ_ONLY
    ARMED = common.MAV_PARAM_ERROR_PERMISSION_DENIED


_NUMBERS = {Kind.INT32: struct.Struct("<i"), Kind.REAL32: struct.Struct("<f")}


class Wanted(NamedTuple):
    """A parameter that a peer requests or sets, by name or by index (`number`; the name is then empty); None: no value."""

    target: tuple[int, int]
    name: str
    number: int = _BY_NAME
    value: float | None = None
    kind: int = 0


def encode_value(name: str, kind: Kind, value: float, index: int, count: int) -> bytes:
    """PARAM_VALUE payload of one of `count` parameters."""
    payload = VALUE.pack_fields(param_id=name.encode(), param_type=int(kind), param_index=index, param_count=count)
    number = value if kind is Kind.REAL32 else int(value)
    return _NUMBERS[kind].pack(number) + payload[_VALUE_BYTES:]


def decode_value(payload: bytes) -> tuple[str, float | None]:
    """(name, value) of a PARAM_VALUE; the value is None where its type is not in `Kind`."""
    values = VALUE.unpack_fields(payload)
    return _name(values["param_id"]), _number(payload, values["param_type"])


def encode_error(target: tuple[int, int], name: str, index: int, refusal: Refusal) -> bytes:
    """PARAM_ERROR payload, addressed to the peer that sent the request."""
    return ERROR.pack_fields(
        target_system=target[0], target_component=target[1], param_id=name.encode(), param_index=index, error=refusal
    )


def decode_list(payload: bytes) -> Wanted:
    """The target of a PARAM_REQUEST_LIST."""
    return Wanted(_target(LIST.unpack_fields(payload)), "")


def decode_read(payload: bytes) -> Wanted:
    """The parameter that a PARAM_REQUEST_READ requests."""
    values = READ.unpack_fields(payload)
    index = int(values["param_index"])
    return Wanted(_target(values), _name(values["param_id"]) if index == _BY_NAME else "", index)


def decode_set(payload: bytes) -> Wanted:
    """The parameter and value of a PARAM_SET; value None where its type is not in `Kind`."""
    values = SET.unpack_fields(payload)
    kind = int(values["param_type"])
    return Wanted(_target(values), _name(values["param_id"]), value=_number(payload, kind), kind=kind)


def _target(values: dict[str, int]) -> tuple[int, int]:
    return int(values["target_system"]), int(values["target_component"])


def _name(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode("ascii", errors="replace")


def _number(payload: bytes, kind: int) -> float | None:
    if kind not in _NUMBERS:
        return None
    (value,) = _NUMBERS[Kind(kind)].unpack(payload[:_VALUE_BYTES].ljust(_VALUE_BYTES, b"\0"))
    return float(value)
