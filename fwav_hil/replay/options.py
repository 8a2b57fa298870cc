"""How a log is replayed: to a link, or into the controller or the emulator."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import click
import msgspec

from bridge.option_types import KEY_FILE
from bridge.options import Option
from bridge.shared_options import LAW, RealTime, WaitS, folder_option

TO, INTO = "--to", "--into"
SLOWEST, FASTEST = 0.1, 100.0


class Speed(click.ParamType[float | None]):
    """A factor, or None for `max`."""

    name = "speed"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | None:
        """The factor; fails with a message that names the valid values."""
        if value == "max":
            return None
        try:
            factor = float(value)
        except ValueError:
            factor = -1.0
        if not SLOWEST <= factor <= FASTEST:
            self.fail(f"{value} is not a speed: write a number from {SLOWEST:g} to {FASTEST:g}, or max", param, ctx)
        return factor


class ReplayOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How a log is replayed. speed: times log time; None: as fast as possible. realtime: with the settings of `real_time`."""

    speed: Annotated[float | None, Option(
        "--speed", "Times log time: 0.1 to 100, or max: as fast as possible.", "X|max", type=Speed(), only_with=TO
    )] = 1.0  # fmt: skip
    loop: Annotated[bool, Option("--loop", "Restart at the end, until Ctrl-C.", only_with=TO)] = False
    max_gap_s: Annotated[
        float | None, Option("--max-gap", "Shorten longer gaps to this.", "S", min=0.0, only_with=TO)
    ] = None
    rewrite_time: Annotated[bool, Option(
        "--rewrite-time", "Shift the times in the messages: those since 1970 begin now, those since boot at zero.",
        only_with=TO
    )] = False  # fmt: skip
    key: Annotated[bytes | None, Option(
        "--signing-key", "Sign every frame with this key: 64 hexadecimal digits, or 32 bytes.", "FILE", type=KEY_FILE,
        only_with=TO
    )] = None  # fmt: skip
    realtime: RealTime = False
    wait_s: WaitS = 30.0


class IntoOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How a log is replayed into a controller or an emulator, and where differences are saved. fast: without a link."""

    law: Annotated[str | None, replace(LAW, only_with=INTO)] = None
    scenario: Annotated[str | None, Option(
        "--scenario", "Scenario of the log, instead of the one in its folder (--into).", "SCENARIO",
        only_with=INTO
    )] = None  # fmt: skip
    fast: Annotated[bool, Option("--fast", "Replay within this process, without a link (--into).", only_with=INTO)] = (
        False
    )
    out: Annotated[
        Path | None,
        replace(
            folder_option("Folder for the report of a difference; by default a new one in runs/ (--into)."),
            only_with=INTO,
        ),
    ] = None
    plots: Annotated[bool, Option("--plots/--no-plots", "Draw a difference (PNG; --into).", only_with=INTO)] = True
