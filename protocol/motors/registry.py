"""The motor protocols by name; a command's help needs no more of them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

PROTOCOLS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "odrive": "protocol.motors.odrive",
        "mit": "protocol.motors.mit",
        "dronecan": "protocol.motors.dronecan_esc",
    }
)
"""Name -> module with `Host`, `Drive` and `traffic(motor, rate_hz)`. Imported at first use."""
