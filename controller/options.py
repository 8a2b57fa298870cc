"""How a controller process runs."""

from __future__ import annotations

from pathlib import Path

import msgspec


class ControllerOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How the process runs.

    link: a URI, or `-` to read it from standard input once everything is ready. legs: real time: note when each sample
    and command was where. trigger: in real time, `sample` or `clock`. realtime, core: ask for what `bridge.timing.realtime`
    lists. spin_s: in lockstep see `Link.spin_s` (None: 0); in real time how long to poll before a sample or deadline is due
    (None: as measured with `realtime`, else 0). station: URI of a ground station's link. key: of
    signatures on the loop's link.
    """

    link: str
    clock: str = "lockstep"
    arm: bool = True
    out: Path | None = None
    wait_s: float = 30.0
    spin_s: float | None = None
    legs: bool = False
    trigger: str = "sample"
    realtime: bool = False
    core: int | None = None
    station: str | None = None
    key: bytes | None = None
