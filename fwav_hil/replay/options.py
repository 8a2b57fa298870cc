"""How a log is replayed: to a link, or into an end of the loop."""

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
        """The factor, or fail with the sentence that names the remedy."""
        if value == "max":
            return None
        try:
            factor = float(value)
        except ValueError:
            factor = -1.0
        if not SLOWEST <= factor <= FASTEST:
            self.fail(f"{value} is no speed: write a number from {SLOWEST:g} to {FASTEST:g}, or max", param, ctx)
        return factor


class ReplayOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How a log is replayed. speed: of log time; None is as fast as it goes. realtime: with what `real_time` asks for."""

    speed: Annotated[float | None, Option(
        "--speed", "Of log time: 0.1 to 100, or max, as fast as it goes.", "X|max", type=Speed(), only_with=TO
    )] = 1.0  # fmt: skip
    loop: Annotated[bool, Option("--loop", "Begin again at the end, until Ctrl-C.", only_with=TO)] = False
    max_gap_s: Annotated[
        float | None, Option("--max-gap", "Shorten longer silences to this.", "S", min=0.0, only_with=TO)
    ] = None
    rewrite_time: Annotated[bool, Option(
        "--rewrite-time", "Move the messages' own times: those since 1970 begin now, those since boot at zero.",
        only_with=TO
    )] = False  # fmt: skip
    key: Annotated[bytes | None, Option(
        "--signing-key", "Sign every frame with this key: 64 hexadecimal digits, or 32 bytes.", "FILE", type=KEY_FILE,
        only_with=TO
    )] = None  # fmt: skip
    realtime: RealTime = False
    wait_s: WaitS = 30.0


class IntoOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What is replayed into a controller or an emulator, and where a difference goes. fast: without a link."""

    law: Annotated[str | None, replace(LAW, only_with=INTO)] = None
    scenario: Annotated[str | None, Option(
        "--scenario", "Scenario of the log, instead of the one in the log's folder (--into).", "SCENARIO",
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
