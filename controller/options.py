"""How a controller process runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from bridge.options import Option
from bridge.shared_options import DEFAULT_CONTROLLER_LINK, EndOptions, Station, folder_option

Trigger: TypeAlias = Literal["sample", "clock"]


class ControllerOptions(EndOptions, frozen=True, kw_only=True):
    """How the process runs.

    link: a URI, or `-`: read from standard input once everything is ready. core: the processor core to run on with `realtime`.
    """

    link: Annotated[str, Option(
        "--link", "Where the emulator is: udpout://, udpin://, tcpout://, tcpin://, serial:///dev/x:baud.", "URI"
    )] = DEFAULT_CONTROLLER_LINK  # fmt: skip
    trigger: Annotated[Trigger, Option(
        "--trigger",
        "With --clock realtime: step on each sample as it arrives (sample), or on the controller's own clock with "
        "the newest sample (clock)."
    )] = "sample"  # fmt: skip
    arm: Annotated[bool, Option(
        "--arm/--no-arm",
        "Arm once the emulator has reported the same scenario, or wait for MAV_CMD_COMPONENT_ARM_DISARM."
    )] = True  # fmt: skip
    station: Station = None
    out: Annotated[Path | None, folder_option("Folder for the counters.")] = None
    core: int | None = None
