"""DBC files for the tests: ours beside the protocols, and the one that is published for ODrive 0.6.10."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import cantools

import protocol.motors


def our_dbc(name: str) -> Any:
    """The database of protocol/motors/NAME.dbc."""
    return cantools.database.load_file(Path(protocol.motors.__file__).with_name(f"{name}.dbc"))


def published_odrive_dbc() -> Any:
    """The DBC in the odrive-can package (MIT licence), which is ODrive's for 0.6.10; nodes 0 to 7."""
    spec = importlib.util.find_spec("odrive_can")
    assert spec is not None
    assert spec.origin is not None
    return cantools.database.load_file(Path(spec.origin).parent / "dbc" / "odrive-cansimple-0.6.10.dbc")
