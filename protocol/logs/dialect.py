"""The messages that logs are read with: pymavlink's `all` dialect, the widest there is.

Two dialects, matrixpilot and paparazzi, use numbers of `all` for messages of their own; those are counted as unknown.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

from pymavlink.dialects.v20 import all as widest

from protocol.wire.codec import Layout

BINARY = frozenset(
    {("PARAM_EXT_VALUE", "param_value"), ("PARAM_EXT_SET", "param_value"), ("PARAM_EXT_ACK", "param_value")}
)
"""Fields that are characters by their definition and hold bytes: here, a value of the kind that param_type says."""


@functools.cache
def layouts() -> Mapping[int, Layout]:
    """Every message by its id."""
    return {number: Layout(message) for number, message in widest.mavlink_map.items()}


@functools.cache
def layouts_by_name() -> Mapping[str, Layout]:
    """Every message by its name."""
    return {message.name: message for message in layouts().values()}


def unit(message: str, field: str) -> str:
    """The unit of a field as the dialect writes it ("m/s"); empty where it has none, or is no message of the dialect."""
    known = layouts_by_name().get(message)
    units = widest.mavlink_map[known.message_id].fieldunits_by_name if known else {}
    return str(units.get(field, ""))
