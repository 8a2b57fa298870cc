"""How an emulator process runs, and a process of drives on a CAN bus."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import click
import msgspec

from bridge.option_types import FILE
from bridge.options import Option
from bridge.shared_options import (
    DEFAULT_EMULATOR_LINK,
    DelayNs,
    EndOptions,
    OnLogError,
    ScenarioChoice,
    Station,
    folder_option,
)
from protocol.motors.registry import PROTOCOLS
from protocol.scenario import Scenario, with_overrides

_WITH_A_BUS = "--motor can"
CanUri = Annotated[str, Option(
    "--can", "The CAN bus: udp_multicast:group[:port], virtual:name, socketcan:can0, slcan:/dev/x.", "URI",
    only_with=_WITH_A_BUS
)]  # fmt: skip
DEFAULT_CAN = "udp_multicast:239.74.163.2"


class MotorScenarioChoice(ScenarioChoice, frozen=True, kw_only=True):
    """A scenario, with the command line's changes to its drives too."""

    protocol: Annotated[str | None, Option(
        "--protocol", "Motor protocol of the drives, instead of the scenario's.", type=click.Choice(list(PROTOCOLS)),
        only_with=_WITH_A_BUS
    )] = None  # fmt: skip
    lag_s: Annotated[float | None, Option(
        "--lag", "Lag of the drives' torque loop, instead of the scenario's.", "S", min=0.0, only_with=_WITH_A_BUS
    )] = None  # fmt: skip

    def load(self) -> Scenario:
        """The scenario with the changes. Raises ScenarioError."""
        scenario = super().load()
        changes = {key: value for key in ("protocol", "lag_s") if (value := getattr(self, key)) is not None}
        if not changes:
            return scenario
        return with_overrides(scenario, motor=msgspec.to_builtins(scenario.motor) | changes)


class MotorLink(msgspec.Struct, frozen=True, kw_only=True):
    """How the emulator reaches its drives. feedback "sync": every bit of u; "bus": the protocol's own status."""

    can: CanUri = DEFAULT_CAN
    feedback: Annotated[Literal["sync", "bus"], Option(
        "--feedback",
        "What the plant gets: the exact force after the gears (sync), or as the motor protocol reports it (bus).",
        only_with=_WITH_A_BUS
    )] = "sync"  # fmt: skip
    log: Annotated[Path | None, Option(
        "--can-log", "Record of the bus: .blf, .log, .asc or .csv; by default motor_bus.blf in the run folder.",
        "FILE", type=FILE, only_with=_WITH_A_BUS
    )] = None  # fmt: skip
    tap: Annotated[str | None, Option(
        "--tap", "Forward the bus as CAN_FRAME to a station on this MAVLink link (udpin://, tcpin://).", "URI",
        only_with=_WITH_A_BUS
    )] = None  # fmt: skip


class MotorOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How a process of drives runs."""

    can: CanUri = DEFAULT_CAN
    out: Annotated[Path | None, folder_option("Folder for the counters.")] = None


class EmulatorOptions(EndOptions, frozen=True, kw_only=True):
    """How the process runs.

    speed: None: as fast as possible. delay_ns: added to the arrival of data. truth_hz: as if the peer had requested it.
    bus: where the drives are, with `motor` "can". core: the processor core to run on with `realtime`.
    """

    link: Annotated[str, Option(
        "--link", "Where the controller is: udpin://, udpout://, tcpin://, tcpout://, serial:///dev/x:baud.", "URI"
    )] = DEFAULT_EMULATOR_LINK  # fmt: skip
    speed: Annotated[float | None, Option(
        "--speed", "Pace lockstep to X times real time; by default it runs as fast as possible.", "X", min=0.001
    )] = None  # fmt: skip
    profile: Annotated[Literal["exact", "tolerant"], Option(
        "--profile",
        "Lockstep that waits for each answer (exact), or steps on without an answer that is late (tolerant: for other "
        "autopilots)."
    )] = "exact"  # fmt: skip
    delay_ns: DelayNs = 0
    truth_hz: Annotated[float | None, Option(
        "--truth",
        "Send the true state on the link, and so to the log, at this rate: HIL_STATE_QUATERNION and ODOMETRY.", "HZ",
        min=0.1
    )] = None  # fmt: skip
    motor: Annotated[Literal["direct", "can"], Option(
        "--motor", "Motors and gears inside the emulator (direct), or in drives on a CAN bus (can)."
    )] = "direct"  # fmt: skip
    bus: MotorLink = MotorLink()
    station: Station = None
    out: Annotated[Path | None, folder_option("Folder for the log, the ground truth and the counters.")] = None
    on_log_error: OnLogError = "stop"
    core: int | None = None

    @property
    def motors(self) -> MotorLink | None:
        """How the drives are reached; None where motors and gears are in the plant."""
        return self.bus if self.motor == "can" else None
