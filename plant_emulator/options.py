"""How an emulator process runs."""

from __future__ import annotations

from pathlib import Path

import msgspec


class MotorLink(msgspec.Struct, frozen=True, kw_only=True):
    """How the emulator reaches its drives.

    can: URI of the bus. feedback: "sync" (every bit of u) or "bus" (the protocol's own status). log: where the bus is
    recorded, by suffix; None: motor_bus.blf in the run folder, if there is one. tap: MAVLink link of the CAN tap.
    """

    can: str
    feedback: str = "sync"
    log: Path | None = None
    tap: str | None = None


class EmulatorOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How the process runs.

    speed: lockstep paced to that multiple of real time (None: as fast as it goes). delay_ns: real time: what comes is taken
    so much later. legs: real time: note when each tick and command was where. realtime: ask for what `bridge.timing.realtime`
    lists, with `core` as the core to have. spin_s: in lockstep see `Link.spin_s` (None: 0); in real time how long to poll
    before each deadline (None: as measured with `realtime`, else 0).
    on_log_error: what a disk that refuses means for the run: "stop", or "continue" with what can be recorded.
    motors: where the drives are, if not in the plant itself. station: URI of a ground station's link. truth_hz: say the true
    state on the link at this rate, as if its peer had asked for it. key: of signatures on
    the loop's link. profile: of lockstep, "exact" or "tolerant".
    """

    link: str
    clock: str = "lockstep"
    speed: float | None = None
    out: Path | None = None
    wait_s: float = 30.0
    spin_s: float | None = None
    delay_ns: int = 0
    legs: bool = False
    on_log_error: str = "stop"
    realtime: bool = False
    core: int | None = None
    motors: MotorLink | None = None
    station: str | None = None
    key: bytes | None = None
    truth_hz: float | None = None
    profile: str = "exact"
