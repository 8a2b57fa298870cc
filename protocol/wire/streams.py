"""Every message of the link in one table: who says it, when, what it is for. The README's table is printed from it.

`rate_hz` is the rate of a stream in simulation time; None means once for each tick, or on an event (see `rule`).
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from typing import NamedTuple

from protocol.due import NANOSECONDS

HEARTBEAT_TIMEOUT_NS = 3 * NANOSECONDS


class End(enum.Enum):
    """Who sends."""

    EMULATOR = "emulator"
    CONTROLLER = "controller"
    BOTH = "both"
    STATION = "ground station"


class Stream(NamedTuple):
    """One row: a MAVLink message, its sender, its rate and its rule; each_tick: one of it for every tick."""

    message: str
    sender: End
    rate_hz: float | None
    rule: str
    each_tick: bool = False


STREAMS = (
    Stream("HEARTBEAT", End.BOTH, 1.0, "who is there, and whether the controller is armed; lost after 3 s"),
    Stream(
        "AUTOPILOT_VERSION", End.BOTH, None, "at the start: 8 bytes of the scenario's digest; a mismatch is refused"
    ),
    Stream(
        "ATT_POS_MOCAP", End.EMULATOR, None, "every tick, before it: position and attitude, all that a law reads", True
    ),
    Stream("HIL_SENSOR", End.EMULATOR, None, "the tick: simulation time, and an IMU for real autopilots", True),
    Stream("HIL_GPS", End.EMULATOR, 10.0, "for real autopilots"),
    Stream(
        "HIL_ACTUATOR_CONTROLS", End.CONTROLLER, None, "one for each tick; time_usec echoes the sample it answers", True
    ),
    Stream(
        "PARAM_VALUE",
        End.CONTROLLER,
        None,
        "gains, scales, limits, gears: each once at the start, for the log, and when changed; to a ground station on request",
    ),
    Stream("POSITION_TARGET_LOCAL_NED", End.CONTROLLER, 50.0, "the reference at the sample's time, for the log"),
    Stream("ATTITUDE_TARGET", End.CONTROLLER, 50.0, "the reference at the sample's time, for the log"),
    Stream("PARAM_REQUEST_LIST", End.STATION, None, "to the controller, on its station's link: all of them"),
    Stream("PARAM_REQUEST_READ", End.STATION, None, "one of them"),
    Stream("PARAM_SET", End.STATION, None, "a gain, while disarmed"),
    Stream("PARAM_ERROR", End.CONTROLLER, None, "why one was not given or not set"),
    Stream("FILE_TRANSFER_PROTOCOL", End.CONTROLLER, None, "the refusal of files, for which stations ask first"),
    Stream(
        "TIMESYNC", End.BOTH, 1.0, "real time only: how far the other end's clock is ahead; 20 Hz for the first ten"
    ),
    Stream(
        "CAN_FRAME",
        End.EMULATOR,
        None,
        "on the tap's own link (`--tap`): the motor bus, while 32000 is renewed within 5 s",
    ),
    Stream(
        "HIL_STATE_QUATERNION", End.EMULATOR, None, "the true state, on request (511, 512, `--truth`); no law reads it"
    ),
    Stream("ODOMETRY", End.EMULATOR, None, "the same to the full: float metres, body rates"),
    Stream(
        "RAW_RPM",
        End.EMULATOR,
        None,
        "drives on a bus: how fast each says it turns; 10 Hz to a ground station, or on request",
    ),
    Stream(
        "COMMAND_LONG",
        End.STATION,
        None,
        "400 (arm, disarm) to the controller; 511, 512 (a message at a rate, once) and 32000 (CAN) to the emulator",
    ),
    Stream("COMMAND_ACK", End.BOTH, None, "the answer to it"),
)


def stream(message: str) -> Stream:
    """The row of `message`. Raises KeyError where the table has none."""
    for row in STREAMS:
        if row.message == message:
            return row
    raise KeyError(f"no stream {message}")


def markdown_table() -> Iterator[str]:
    """The lines of the table as it stands in the README."""
    yield "| message | sent by | rate | rule |"
    yield "| --- | --- | --- | --- |"
    for row in STREAMS:
        rate = f"{row.rate_hz:g} Hz" if row.rate_hz else "-"
        yield f"| {row.message} | {row.sender.value} | {rate} | {row.rule} |"


if __name__ == "__main__":
    import sys

    sys.stdout.writelines(line + "\n" for line in markdown_table())
